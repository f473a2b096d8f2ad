"""The compiled solver's linear system, as the solver asks for it."""

from __future__ import annotations

import ctypes
import math
from operator import is_
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hood.cloth.cloth import Cloth
from hood.contact.self_contact import SceneLayers
from hood.energies.potential import Potential, weight_norms
from hood.energies.problem import StepProblem
from hood.energies.self_contact import LayerGrips
from hood.mesh.cloth_proximity import EASED, LEFT
from hood.native.arguments import POINTER, REAL, address_of, num_parts
from hood.native.build import BuildError
from hood.solver.compiled.newton import (
    _ROWS,
    ENERGY_CALLBACK,
    MODEL_CALLBACK,
    CompiledStep,
    _array,
    _Engine,
    _LayerGrips,
    _OtherTerms,
    _Points,
    build_fabric,
    compiled_step,
    library,
)
from hood.solver.compiled.tables import Tables, build_tables, point_uses
from hood.solver.derivatives.compiled_vertices import drag_structures, grip_structures, wall_structures
from hood.solver.derivatives.self_contact import approached
from hood.solver.derivatives.step_terms import PointForces
from hood.solver.system.linear import TOLERANCES
from hood.solver.system.plan import SolverPlan


class CompiledScene:
    """One scene of a cloth in the compiled solver: memory that every step uses again, and the step's own numbers."""

    def __init__(self, cloth: Cloth, tables: Tables) -> None:
        self.tables = tables
        self.step: CompiledStep | None = None  # what was taken up last
        self._kept: dict[str, Any] = {}  # what the structure points to
        self._others: _OtherForces | None = None
        self._slots: np.ndarray | None = None
        self._fabric: tuple[int, tuple[Tensor | None, ...]] | None = None  # what the elements depend on
        self.values = _Engine(
            num_vertices=len(tables.vertex),
            num_rows=tables.num_rows,
            num_faces=tables.faces.corners.shape[1],
            num_hinges=tables.hinges.corners.shape[1],
            num_springs=len(tables.springs.order),
            most_blocks=tables.most_blocks,
            num_pairs=len(tables.pairs.starts) - 1,
            reach=tables.pairs.reach,
        )
        self._address = ctypes.byref(self.values)
        self._point(
            vertex=tables.vertex,
            face_corners=tables.faces.corners,
            hinge_corners=tables.hinges.corners,
            row_starts=tables.row_starts,
            slot=tables.pairs.slot,
            row_of_slot=tables.pairs.row,
            pair_starts=tables.pairs.starts,
            pair_cols=tables.pairs.cols,
            face_starts=tables.faces.starts,
            face_uses=tables.faces.uses,
            hinge_starts=tables.hinges.starts,
            hinge_uses=tables.hinges.uses,
            spring_starts=tables.springs.starts,
            spring_uses=tables.springs.uses,
            spring_ends=tables.springs.corners,
        )
        size, rows = len(tables.vertex), tables.num_rows
        self._point(**{name: np.zeros((size, 4)) for name in ("pos", "trial_pos")})
        self._point(**{name: np.zeros((rows, 4)) for name in ("acc", "trial_acc", "gradient", "direction")})
        self._point(face_force=np.zeros((self.values.num_faces, 10)), hinge_force=np.zeros((self.values.num_hinges, 14)))
        self._memory: dict[tuple[bool, int], dict[str, np.ndarray]] = {}
        self._form: tuple[bool, int] | None = None  # whose memory the structure points to
        self.share(1)

    def share(self, parts: int) -> None:
        """Do loops in as many parts, by threads of their own; results depend on the number, but not on who computes a part."""
        self.values.parts = parts
        self.widen(False)

    def widen(self, wide: bool) -> None:
        """Matrix and linear solver in float64, or in float32."""
        key = (wide, self.values.parts)
        if key == self._form:
            return
        self._form, self.wide, self._lib = key, wide, library(wide)
        if key not in self._memory:
            self._memory[key] = self._working_memory()
        self._point(**self._memory[key])
        self.values.modelled = 0  # those of the elements are elsewhere
        self.values.num_border = len(self._memory[key]["border"])

    def _working_memory(self) -> dict[str, np.ndarray]:
        values, kind = self.values, np.float64 if self.wide else np.float32
        rows, pairs = values.num_rows, values.num_pairs
        sizes = {"indefinite_part": len(self.tables.cols), "own": 6 * rows, "own_indefinite_part": 6 * rows}
        sizes |= {"matrix": 24 * len(self.tables.pairs.cols), **dict.fromkeys(("block", "inverse"), 24 * pairs)}
        memory = {name: _aligned(count, kind) for name, count in (sizes | dict.fromkeys("xrzpq", 8 * pairs)).items()}
        memory |= self.tables.border(values.parts, kind)
        memory["row_sum"] = _aligned(16 * values.most_blocks * values.parts, kind)
        memory["face_model"] = np.zeros(values.num_faces * self._lib.newton_face_record(), np.uint8)
        memory["hinge_model"] = np.zeros(values.num_hinges * self._lib.newton_hinge_record(), np.uint8)
        return memory

    def enter(self, step: CompiledStep, scene: int) -> None:
        """Take up scene ``scene`` of a step; the state is undefined until :meth:`start`."""
        values = self.values
        self.step = step
        self._take_fabric(step)
        self._point(**step.of(self.tables.vertex))
        self._point(**{name: getattr(step, name)[self.tables.springs.order] for name in ("spring_stiffness", "spring_target")})
        of_walls, of_grips = step.contact_of(self.tables.vertex)
        walls, grips = wall_structures(of_walls), grip_structures(of_grips)
        own = [_ScenePoints(points, self.tables, step.cloth.num_vertices) for points in step.points] if step.points else []
        points = (_Points * len(own))(*(one.values for one in own))
        self._kept |= {"walls": walls, "grips": grips, "points": (points, own), "step": step}
        values.walls, values.grips = ctypes.addressof(walls[0]), ctypes.addressof(grips[0])
        values.points = ctypes.addressof(points)
        if values.num_walls != len(step.walls) or "path" not in self._kept:
            self._point(path=np.zeros((len(step.walls), values.num_rows, 8)))
        values.num_walls, values.num_grips, values.num_points = len(step.walls), len(step.grips), len(own)
        values.bending, values.membrane = step.bending, step.membrane > 0
        values.dt_sq = float(step.dt[scene]) ** 2
        values.raised, values.cg_used, values.modelled = 0.0, 0, 0
        self._take_damping(step)
        self._take_layers(step.layers[scene] if step.layers else None)
        self._take_layer_grips(step.layer_grips, scene, step.cloth.num_vertices)
        self._others = _OtherForces(step, self.tables, scene) if step.others else None
        values.others = None if self._others is None else ctypes.addressof(self._others.values)
        self.share(num_parts(values.num_rows, _ROWS))

    def _take_damping(self, step: CompiledStep) -> None:
        for kind, damping, elements in (
            ("face", step.stretch_damping, self.tables.faces),
            ("hinge", step.bend_damping, self.tables.hinges),
        ):
            if damping is None:
                setattr(self.values, f"{kind}_rate", None)
            else:
                self._point(
                    **{f"{kind}_{name}": elements.padded(a) for name, a in zip(("rate", "before"), damping, strict=True)}
                )

    def _take_layers(self, scene: SceneLayers | None) -> None:
        self.layers = scene
        if scene is None:
            self.values.layers = None
            return
        slots = 2 * self.values.num_pairs
        if self._slots is None:  # of every vertex of the scene
            vertex = self.tables.vertex - scene.first
            self._slots = np.full(len(vertex), slots)
            self._slots[vertex[: self.values.num_rows]] = self.tables.pairs.slot
            self._point(vertex_of_scene=vertex)
        self.values.layers = scene.layers.number(self._slots, slots)
        self.values.kept, self.values.eased = LEFT, EASED

    def _take_layer_grips(self, grips: LayerGrips | None, scene: int, num_vertices: int) -> None:
        self.values.layer_grips = None
        rows = None if grips is None else (grips.scene == scene) & (grips.force > 0)
        if grips is None or rows is None or not bool(rows.any()):
            return
        number = np.full(num_vertices, -1, np.int32)
        number[self.tables.vertex] = np.arange(len(self.tables.vertex))
        size, count = len(self.tables.vertex), int(rows.sum())
        arrays = {name: _array(getattr(grips, name)[rows]) for name in ("weights", "normal", "force", "limit")}
        arrays |= {"corners": number[grips.corners[rows].numpy()], "model": np.empty((count, 5))}
        arrays |= {"gradient": np.empty((size, 3)), "own": np.empty((size, 6)), "own_indefinite_part": np.empty((size, 6))}
        structure = _LayerGrips(count=count)
        for name, array in arrays.items():
            setattr(structure, name, array.ctypes.data)
        self._kept["layer_grips"] = structure, arrays
        self.values.layer_grips = ctypes.addressof(structure)

    def start(self, acc: np.ndarray) -> None:
        """Take up accelerations (V, 3) of all vertices of the cloth."""
        self._lib.newton_start(self._address, acc.ctypes.data_as(POINTER))
        self._raise()

    def guess(self, mass: np.ndarray, gravity: np.ndarray) -> None:
        """Take up the better of the two first guesses; masses [kg] (V,) of the cloth, gravity (3,) m/s²."""
        self._lib.newton_guess(self._address, mass.ctypes.data_as(POINTER), gravity.ctypes.data_as(POINTER))
        self._raise()

    def model(self) -> float:
        """Gradient at the state; its norm [N]."""
        norm = float(self._lib.newton_model(self._address))
        self._raise()
        return norm

    def matrix(self, indefinite_share: float = 0.0) -> None:
        """The matrix of the model with a share of its indefinite part; a move makes its own."""
        self._lib.newton_matrix(self._address, indefinite_share)

    def exact(self) -> None:
        """The matrix becomes the Hessian at a state whose model has been made; of layers of cloth, of the published code's
        bending and of terms of other classes it has what the model has."""
        memory = self._memory[self.wide, self.values.parts]
        if "curvature" not in memory:
            memory["curvature"] = np.empty((self.values.num_hinges, 90), memory["matrix"].dtype)
        self._lib.newton_exact(self._address, memory["curvature"].ctypes.data)

    def solve(self, right: np.ndarray, tolerance: float, cg_iterations: int, found: np.ndarray) -> bool:
        """Write the solution of matrix x = ``right`` (V, 3) into ``found`` (V, 3), at this scene's free vertices; whether the
        matrix was positive definite as far as was seen."""
        return bool(self._lib.newton_solve(self._address, right.ctypes.data, tolerance, cg_iterations, found.ctypes.data))

    def move(self, tolerance: float, cg_iterations: int) -> bool:
        """Take a Newton step from a state whose model has been made, by a linear system solved to a tolerance; whether it led
        anywhere."""
        moved = bool(self._lib.newton_move(self._address, tolerance, cg_iterations))
        self._raise()
        return moved

    def read(self, pos: np.ndarray, acc: np.ndarray) -> None:
        """Write positions and accelerations (V, 3) of this scene's vertices into arrays of the whole cloth."""
        self._lib.newton_state(self._address, pos.ctypes.data_as(POINTER), acc.ctypes.data_as(POINTER))

    def read_direction(self, direction: np.ndarray) -> None:
        """Write the last Newton step (V, 3) [m] of this scene's free vertices into an array of the whole cloth."""
        count = self.values.num_rows
        direction[self.tables.vertex[:count]] = self.array("direction")[:count, :3]

    def alone(self, pos: int, force: int, step: int) -> None:
        """Write force [N] and local step [m] of this scene's free vertices at positions: addresses of tables (V, 3) of the
        whole cloth, in float32."""
        self._lib.newton_alone(self._address, pos, force, step)
        self._raise()

    def together(self, force: int, damping: int, cg_iterations: int, step: int) -> None:
        """Write the global step [m] of the free vertices under forces [N] with the matrix where :meth:`alone` has looked and
        more on its diagonal [N/m]: addresses of tables (V, 3), (V,) and (V, 3) of the whole cloth."""
        self._lib.newton_together(self._address, force, damping, cg_iterations, step)

    def _raise(self) -> None:
        if self._others is not None and self._others.error is not None:
            raise self._others.error

    def array(self, name: str) -> np.ndarray:
        """An array that the structure points to, by its name there."""
        return np.asarray(self._kept[name])

    def _take_fabric(self, step: CompiledStep) -> None:
        cloth = step.cloth
        now = (cloth.rest_inverse, cloth.rest_area, cloth.thickness, cloth.lame_mu, cloth.lame_lambda, cloth.bending_stiffness,
               cloth.rest_angle, cloth.hinge_rest_length, cloth.hinge_area, cloth.weave)  # fmt: skip
        if self._fabric is not None and self._fabric[0] == step.membrane and all(map(is_, now, self._fabric[1])):
            return
        self._fabric, made = (step.membrane, now), build_fabric(cloth, self.tables, float(step.membrane))
        fabric = {("lambda" if name == "lam" else name): value for name, value in vars(made).items()}
        self.values.weave = None
        self._point(**{name: value for name, value in fabric.items() if value is not None})

    def _point(self, **arrays: np.ndarray) -> None:
        for name, array in arrays.items():
            self._kept[name] = array
            setattr(self.values, name, address_of(array))


class _ScenePoints:
    """Points of one scene as the compiled solver reads them; what :attr:`values` points to lives as long."""

    def __init__(self, points: PointForces, tables: Tables, num_vertices: int) -> None:
        number = np.full(num_vertices, -1, np.int64)
        number[tables.vertex] = np.arange(len(tables.vertex))
        corners = number[points.vertices.numpy()]
        rows = torch.from_numpy(np.flatnonzero(corners[:, 0] >= 0))
        points, corners = points.take(rows), corners[rows.numpy()]
        weights = _array(points.weights)
        starts, uses = point_uses(tables, corners, weights)
        walls, grips = points.forces.walls, points.forces.grips
        arrays = {
            "corners": np.ascontiguousarray(corners, np.int32),
            "weights": weights,
            "starts": starts,
            "uses": uses,
            "model": np.zeros((len(corners), 16)),
            "path": np.zeros((len(walls), len(corners), 14)),
        }
        drags = points.forces.drags
        structures = wall_structures(walls), grip_structures(grips), drag_structures(drags)
        self._kept = arrays, structures
        self.values = _Points(count=len(corners), num_walls=len(walls), num_grips=len(grips), num_drags=len(drags))
        for name, array in arrays.items():
            setattr(self.values, name, array.ctypes.data)
        self.values.walls, self.values.grips, self.values.drags = (ctypes.addressof(one) for one, _ in structures)


class _OtherForces:
    """Terms of one scene that the compiled solver asks torch for; what :attr:`values` points to lives as long.

    Attributes:
        error: what a term raised; the energy is then NaN.
    """

    def __init__(self, step: CompiledStep, tables: Tables, scene: int) -> None:
        self._forms, self._scene, self._vertex = step.others, scene, torch.from_numpy(tables.vertex)
        self._fixed, self._rows = torch.from_numpy(step.fixed), tables.num_rows
        self._gradient, self._own = np.zeros((tables.num_rows, 3)), np.zeros((tables.num_rows, 6))
        self._upper = torch.triu_indices(3, 3)
        self.error: BaseException | None = None
        self.values = _OtherTerms(
            energy=ENERGY_CALLBACK(self._energy),
            model=MODEL_CALLBACK(self._model),
            gradient=self._gradient.ctypes.data,
            own=self._own.ctypes.data,
        )

    def _pos(self, address: int) -> Tensor:
        rows = np.ctypeslib.as_array((REAL * (4 * len(self._vertex))).from_address(address)).reshape(-1, 4)
        return self._fixed.index_copy(0, self._vertex, torch.from_numpy(rows[:, :3].copy()))

    def _energy(self, address: int) -> float:
        try:
            pos = self._pos(address)
            return float(sum(form.energy(pos)[self._scene] for form in self._forms))
        except BaseException as error:  # it would be lost on its way through compiled code
            self.error = error
            return math.nan

    def _model(self, address: int) -> None:
        try:
            free, pos = self._vertex[: self._rows], self._pos(address)
            gradients, matrices = zip(*(form.derivatives(pos) for form in self._forms), strict=True)
            self._gradient[:] = sum(gradients)[free].numpy()
            self._own[:] = sum(matrices)[free][:, self._upper[0], self._upper[1]].numpy()
        except BaseException as error:
            self.error = error
            self._gradient[:] = math.nan


def _aligned(count: int, kind: type) -> np.ndarray:
    """Zeros (``count``,) that begin at a multiple of 64 bytes."""
    size = count * np.dtype(kind).itemsize
    memory = np.zeros(size + 64, np.uint8)
    begin = -memory.ctypes.data % 64
    return memory[begin : begin + size].view(kind)


def compiled_scenes(problem: StepProblem, plan: SolverPlan) -> list[CompiledScene]:
    """The engines of a cloth's scenes, made once per plan; ``problem`` has the plan's cloth and attachments."""
    engines = plan.cache.get("engines")
    if engines is None:
        parts = [build_tables(problem.cloth, problem.step.attachments, scene) for scene in range(problem.num_scenes)]
        engines = plan.cache["engines"] = [CompiledScene(problem.cloth, tables) for tables in parts]
    assert isinstance(engines, list)
    return engines


class CompiledSystem:
    """The unknowns of a step in the compiled solver, scene by scene; see :class:`hood.solver.newton.System`."""

    def __init__(self, potential: Potential, problem: StepProblem, plan: SolverPlan, cg_iterations: int) -> None:
        self.problem, self._cg_iterations = problem, cg_iterations
        self._engines = compiled_scenes(problem, plan)
        self._step = compiled_step(potential, problem)
        for scene, engine in enumerate(self._engines):
            engine.enter(self._step, scene)
        dt = problem.step.dt.unsqueeze(1) if problem.num_scenes == 1 else problem.vertex_dt
        self._dt_sq = _array(dt**2)
        self._weight = weight_norms(problem)

    def begin(self, start: Tensor | None) -> None:
        """Take up positions (V, 3), or the better of the two first guesses; near them where cloth would meet cloth."""
        if start is None:
            mass, gravity = _array(self.problem.cloth.mass), _array(self.problem.gravity)
            for engine in self._engines:
                engine.guess(mass, gravity)
            if self._step.layers:
                self._start(self._apart(self.state()[0]))
        else:
            self._start(self._apart(start) if self._step.layers else start)

    def _apart(self, target: Tensor) -> Tensor:
        free = self.problem.cloth.free.unsqueeze(1)
        return approached(self._step.layers, torch.where(free, target, torch.from_numpy(self._step.fixed)))

    @property
    def engines(self) -> list[CompiledScene]:
        """Those of the scenes, in their order."""
        return self._engines

    def _start(self, pos: Tensor) -> None:
        acc = (_array(pos) - self._step.base) / self._dt_sq
        for engine in self._engines:
            engine.start(acc)

    @property
    def phi(self) -> list[float]:
        """(B) J."""
        return [engine.values.phi for engine in self._engines]

    @property
    def used(self) -> int:
        """Conjugate gradient iterations so far."""
        return sum(engine.values.cg_used for engine in self._engines)

    def model(self) -> list[float]:
        """Make the models of the state; the relative gradients (B)."""
        norms = [engine.model() for engine in self._engines]
        return [norm / weight if weight > 0 else 0.0 for norm, weight in zip(norms, self._weight, strict=True)]

    def move(self, residual: list[float], active: list[bool]) -> list[bool]:
        """Take a Newton step in the scenes ``active`` (B); which of them moved (B)."""
        moving = zip(self._engines, residual, active, strict=True)
        return [wanted and self._move(engine, share) for engine, share, wanted in moving]

    def _move(self, engine: CompiledScene, residual: float) -> bool:
        tolerance = min(max(math.sqrt(residual), TOLERANCES[0]), TOLERANCES[1])
        if engine.move(tolerance, self._cg_iterations):
            return True
        if engine.wide:
            return False
        try:
            engine.widen(True)
        except BuildError:  # kept from a time with a compiler, which is gone: the step ends here and is counted as missed
            return False
        engine.model()
        return engine.move(tolerance, self._cg_iterations)

    def state(self) -> tuple[Tensor, Tensor]:
        """Positions (V, 3) and accelerations (V, 3)."""
        pos, acc = self._step.fixed.copy(), (self._step.fixed - self._step.base) / self._dt_sq
        for engine in self._engines:
            engine.read(pos, acc)
        return torch.from_numpy(pos), torch.from_numpy(acc)

    def direction(self) -> Tensor:
        """(V, 3) m: the last Newton step, before contact and the line search took less of it."""
        direction = np.zeros_like(self._step.fixed)
        for engine in self._engines:
            engine.read_direction(direction)
        return torch.from_numpy(direction)
