"""The compiled form of Newton's method: ``hood/native/newton.cpp`` with the arrays it works on.

The same potential, the same rules as the torch form (:mod:`hood.solver.newton`), which stays the reference, but for the
preconditioner of conjugate gradients: sweeps, which vertices take one after the other, have no form in torch. Energies and
gradients are float64; the matrix and the linear solver are float32, and float64 from where a step in float32 leads nowhere.
"""

from __future__ import annotations

import ctypes
import weakref
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from hood import native
from hood.cloth.cloth import Cloth
from hood.contact.self_contact import SceneLayers
from hood.energies.bending import HingeForm
from hood.energies.contact import Walls
from hood.energies.friction import Grip
from hood.energies.mass_points import attachment_targets
from hood.energies.membrane import green_strain
from hood.energies.potential import Potential
from hood.energies.problem import StepProblem, inertial_guess
from hood.energies.self_contact import LayerGrips
from hood.energies.term import LAYER_FORMS, BlockForm, Form, having
from hood.mesh.geometry import dihedral_angles
from hood.native.arguments import COUNT, POINTER, REAL, fields
from hood.native.build import NATIVE_FLAGS, WIDE_FLAGS, build
from hood.solver.compiled.tables import Tables
from hood.solver.derivatives.compiled_vertices import whole
from hood.solver.derivatives.elements import face_constants, hinge_constants
from hood.solver.derivatives.self_contact import grips_of, layers_of
from hood.solver.derivatives.step_terms import PointForces, point_forces, stretch_rate
from hood.solver.derivatives.vertices import VertexForces, known_forces, terms_without_form
from hood.solver.system.iterate import fixed_positions
from hood.tensors.batch import made_of

#: Vertices of a part that is worth a thread: an iteration of conjugate gradients takes 16 us at 1,000 vertices.
_ROWS = 400

SOURCE = Path(native.__file__).with_name("newton.cpp")


class _Points(ctypes.Structure):
    _fields_ = [
        *fields("count num_walls num_grips num_drags", COUNT),
        *fields("corners weights starts uses walls grips drags model path", POINTER),
    ]


class _Engine(ctypes.Structure):
    """``Engine`` of ``newton.cpp``."""

    _fields_ = [
        *fields("num_vertices num_rows num_faces num_hinges num_springs most_blocks", COUNT),
        *fields("vertex face_corners hinge_corners row_starts", POINTER),
        *fields("num_pairs", COUNT),
        *fields("slot row_of_slot pair_starts pair_cols", POINTER),
        *fields("face_starts face_uses hinge_starts hinge_uses spring_starts spring_uses spring_ends", POINTER),
        *fields("shape area mu lambda bulk soft rest_angle hinge_weight rest_length", POINTER),
        *fields("weave face_rate face_before hinge_rate hinge_before", POINTER),
        *fields("base fixed inertia weight spring_stiffness spring_target walls grips points", POINTER),
        *fields("num_walls num_grips num_points bending membrane", COUNT),
        ("dt_sq", REAL),
        *fields("pos acc trial_pos trial_acc gradient direction path face_force hinge_force", POINTER),
        *fields(
            "face_model hinge_model matrix indefinite_part own own_indefinite_part row_sum block inverse x r z p q", POINTER
        ),
        *fields("indefinite_share raised phi noise", REAL),
        *fields("modelled cg_used parts reach", COUNT),
        *fields("border outside border_blocks", POINTER),
        *fields("num_border", COUNT),
        *fields("outer_blocks outer_starts", POINTER),
        *fields("layers vertex_of_scene", POINTER),
        *fields("kept eased", REAL),
        *fields("layer_grips others", POINTER),
    ]


class _LayerGrips(ctypes.Structure):
    """``LayerGrips`` of ``layer_grips.h``."""

    _fields_ = [("count", COUNT), *fields("corners weights normal force limit model gradient own own_indefinite_part", POINTER)]


#: Functions of Python that ``OtherTerms`` of ``newton.cpp`` calls with the address of positions (V, 4) in the solver's order.
ENERGY_CALLBACK = ctypes.CFUNCTYPE(REAL, POINTER)
MODEL_CALLBACK = ctypes.CFUNCTYPE(None, POINTER)


class _OtherTerms(ctypes.Structure):
    _fields_ = [("energy", ENERGY_CALLBACK), ("model", MODEL_CALLBACK), *fields("gradient own", POINTER)]


@cache
def library(wide: bool = False) -> ctypes.CDLL:
    """The compiled solver, its matrix and linear solver in float32, or in float64 (``wide``).

    Raises:
        hood.native.build.BuildError: there is no compiler, or it fails.
    """
    lib = build(SOURCE, WIDE_FLAGS if wide else NATIVE_FLAGS)
    lib.newton_model.restype = REAL
    lib.newton_move.argtypes = [POINTER, REAL, COUNT]
    lib.newton_matrix.argtypes = [POINTER, REAL]
    lib.newton_solve.argtypes = [POINTER, POINTER, REAL, COUNT, POINTER]
    lib.newton_exact.argtypes = [POINTER] * 2
    lib.newton_alone.argtypes = [POINTER] * 4
    lib.newton_together.argtypes = [POINTER, POINTER, POINTER, COUNT, POINTER]
    for name in ("newton_move", "newton_solve", "newton_face_record", "newton_hinge_record"):
        getattr(lib, name).restype = COUNT
    return lib


def applies(potential: Potential, problem: StepProblem) -> bool:
    """Whether the compiled solver takes the terms of the potential that play a role in ``problem``, on a CPU."""
    active = potential.active(problem)
    hinges = [term.closed_form(problem) for term in having(active, Form.HINGES).values()]
    damped, elastic = ([form for form in hinges if (form.damping is None) == whether] for whether in (False, True))
    about_rest = not damped or (len(damped) == 1 and [form.by_length for form in elastic] == [False])
    one = len(elastic) <= 1 and about_rest
    return problem.state.pos.device.type == "cpu" and one


@dataclass(frozen=True)
class Fabric:
    """What the elements of one scene depend on but their corners; float64, in the order of the tables."""

    shape: np.ndarray
    area: np.ndarray
    mu: np.ndarray
    lam: np.ndarray
    bulk: np.ndarray
    soft: np.ndarray
    rest_angle: np.ndarray
    hinge_weight: np.ndarray
    rest_length: np.ndarray
    weave: np.ndarray | None  # roots of the stiffness of cloth with warp and weft


def build_fabric(cloth: Cloth, tables: Tables, factor: float) -> Fabric:
    """Constants of a scene's elements, with a ``factor`` to the membrane; ``cloth`` is in float64."""
    faces, hinges = face_constants(cloth, factor), hinge_constants(cloth)
    mu, lam, weight = (value.numpy() for value in (faces.lame_mu, faces.lame_lambda, faces.weight))
    padded, about = tables.faces.padded, tables.hinges.padded
    return Fabric(
        shape=padded(faces.shape.reshape(6, -1).numpy()),
        area=padded(weight),
        mu=padded(mu),
        lam=padded(lam),
        bulk=padded(np.sqrt(weight * (lam + mu))),
        soft=padded(np.sqrt(weight * mu)),
        rest_angle=about(hinges.rest_angle.numpy()),
        hinge_weight=about(hinges.weight.numpy()),
        rest_length=about(hinges.rest_length.numpy(), padding=1.0),
        weave=None if faces.weave is None else padded(faces.weave.numpy()),
    )


@dataclass(frozen=True)
class CompiledStep:
    """One step of a whole batch as the compiled solver reads it: float64, vertices in their own order."""

    cloth: Cloth
    dt: Tensor  # (B,) s
    base: np.ndarray  # (V, 3) m, free flight
    fixed: np.ndarray  # (V, 3) m, where vertices are that do not move
    inertia: np.ndarray  # (V,) kg
    weight: np.ndarray  # (V, 3) N
    spring_stiffness: np.ndarray  # (A,) N/m
    spring_target: np.ndarray  # (A, 4) m, what the difference of the ends is drawn to, and 0
    walls: tuple[Walls, ...]
    grips: tuple[Grip, ...]
    points: tuple[PointForces, ...]
    bending: int  # 0 none, 1 about the rest shape, 2 with the current length
    membrane: int  # how many such terms
    layers: tuple[SceneLayers, ...]  # one per scene, or none
    layer_grips: LayerGrips | None  # of the whole batch
    others: tuple[BlockForm, ...]  # computed in torch
    stretch_damping: tuple[np.ndarray, np.ndarray] | None  # (F,) rates and (3, F) strains at t
    bend_damping: tuple[np.ndarray, np.ndarray] | None  # (H,) rates and (H,) angles at t

    def of(self, vertex: np.ndarray) -> dict[str, np.ndarray]:
        """What vertices (N,) have, in their order: loops over them then read it in one go."""
        return {name: np.take(getattr(self, name), vertex, axis=0) for name in ("base", "fixed", "inertia", "weight")}

    def contact_of(self, vertex: np.ndarray) -> tuple[tuple[Walls, ...], tuple[Grip, ...]]:
        """Walls and grips of vertices (N,), in their order."""
        rows = torch.from_numpy(vertex)
        return tuple(wall.take(rows) for wall in self.walls), tuple(grip.take(rows) for grip in self.grips)


def compiled_step(potential: Potential, problem: StepProblem) -> CompiledStep:
    """The step ``problem``, in float64 and prepared, with the terms of ``potential``; kept for the next one who asks with the
    same problem: in a scene of float64 a guess, and the solver that goes on from there."""
    made, versions = made_of(problem), problem.versions()
    known = made.get("compiled step")
    if known is not None and known[0]() is problem and known[1] == versions and potential.is_as(known[2]):
        step: CompiledStep = known[3]
        return step
    step = _compiled_step(potential, problem)
    if not step.others:  # these hold the problem itself
        made["compiled step"] = weakref.ref(problem), versions, potential.parts(), step
    return step


def _compiled_step(potential: Potential, problem: StepProblem) -> CompiledStep:
    potential = potential.settled(problem)
    active = potential.terms
    hinges = [term.closed_form(problem) for term in having(active, Form.HINGES).values()]
    forces: VertexForces = known_forces(potential, problem)
    bending = next((form for form in hinges if form.damping is None), None)
    springs = [term.closed_form(problem) for term in having(active, Form.SPRINGS).values()]
    stiffness = torch.stack(springs).sum(0) if springs else problem.state.pos.new_zeros(_num_attachments(problem))
    base = inertial_guess(problem.state, problem.step, problem.cloth.vertex_scene)
    return CompiledStep(
        cloth=problem.cloth,
        dt=problem.step.dt,
        base=_array(base),
        fixed=_array(fixed_positions(problem)),
        inertia=_array(forces.inertia.squeeze(1)),
        weight=_array(forces.weight),
        spring_stiffness=_array(stiffness),
        spring_target=_spring_target(problem, len(stiffness)),
        walls=tuple(Walls(w.weight, *(whole(t) for t in (w.point, w.normal, w.reach))) for w in forces.walls),
        grips=tuple(Grip(*(whole(t) for t in (g.force, g.normal, g.anchor, g.limit))) for g in forces.grips),
        points=point_forces(potential, problem),
        bending=0 if bending is None else 2 if bending.by_length else 1,
        membrane=len(having(active, Form.MEMBRANE)),
        layers=layers_of(potential, problem),
        layer_grips=grips_of(potential, problem),
        others=_others(potential, problem),
        stretch_damping=_stretch_damping(potential, problem),
        bend_damping=_bend_damping(hinges, problem),
    )


@dataclass(frozen=True)
class WithoutForm:
    """Energies whose derivatives are not written out: their slope by autograd, and no curvature."""

    potential: Potential
    problem: StepProblem

    def energy(self, pos: Tensor) -> Tensor:
        """Energy [J] (B,) at ``pos`` (V, 3)."""
        pos = pos.to(self.problem.state.pos.dtype)
        energies = self.potential.energies(self.problem, pos, self.problem.acceleration(pos))
        return torch.stack(list(energies.values())).sum(dim=0)

    def derivatives(self, pos: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient [N] (V, 3) at ``pos`` (V, 3), and matrices (V, 3, 3) of zeros."""
        pos = pos.to(self.problem.state.pos.dtype)
        gradient, _ = self.potential.gradient(self.problem, pos, self.problem.acceleration(pos))
        return gradient, pos.new_zeros(len(pos), 3, 3)


def _others(potential: Potential, problem: StepProblem) -> tuple[BlockForm, ...]:
    blocks = [term.closed_form(problem) for term in having(potential.active(problem), Form.BLOCKS).values()]
    others = terms_without_form(potential, problem)
    if others is not None:
        layers = having(others.terms, *LAYER_FORMS)
        unknown = {name: term for name, term in others.terms.items() if name not in layers}
        blocks += [WithoutForm(potential.only(unknown), problem)] if unknown else []
    return tuple(blocks)


def _stretch_damping(potential: Potential, problem: StepProblem) -> tuple[np.ndarray, np.ndarray] | None:
    rate, cloth = stretch_rate(potential, problem), problem.cloth
    if rate is None:
        return None
    before = green_strain(problem.state.pos.double(), cloth.faces, cloth.rest_inverse.double())
    return _array(rate), _array(torch.stack(before))


def _bend_damping(hinges: list[HingeForm], problem: StepProblem) -> tuple[np.ndarray, np.ndarray] | None:
    time = next((form.damping for form in hinges if form.damping is not None), None)
    if time is None:
        return None
    rate = time / problem.step.dt[problem.cloth.hinge_scene]
    return _array(rate), _array(dihedral_angles(problem.state.pos.double(), problem.cloth.hinges))


def _num_attachments(problem: StepProblem) -> int:
    return 0 if problem.step.attachments is None else len(problem.step.attachments.edges)


def _spring_target(problem: StepProblem, count: int) -> np.ndarray:
    target = attachment_targets(problem)
    return np.zeros((count, 4)) if target is None else np.pad(_array(target), ((0, 0), (0, 1)))


def _array(values: Tensor) -> np.ndarray:
    return whole(values).numpy()
