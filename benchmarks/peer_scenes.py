"""What benchmarks/peers.py simulates with every program, the same fabric in the terms of others, and what it measures."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
import torch

from hood.assets.body.load import load_body
from hood.assets.garment.garment import Garment, load_garment
from hood.assets.material import Material
from hood.assets.motion.load import load_sequence
from hood.cloth.cloth import Cloth
from hood.cloth.state import State, StepInput
from hood.energies.bending import Bending, bending_weight
from hood.energies.mass_points import Gravity
from hood.energies.membrane import Stretching
from hood.energies.potential import Potential, default_potential
from hood.energies.problem import StepProblem
from hood.energies.self_contact import LayerBarrier, LayerFriction, has_layers
from hood.evaluation.gap import gap
from hood.rollouts.equilibrium import find_equilibrium
from hood.rollouts.loop import rest_state
from hood.rollouts.verdict.surface import SurfaceMeter
from hood.scene.body_motion.mesh_motion import NoBody
from hood.scene.scene import Scene, build_scene, dressed_scene, local_origin
from hood.solver.step_figures import strain_metrics
from hood.steppers.newton import NewtonStepper
from hood.testing import grid

#: Frames a second of every scene, and the fabric: the default one.
FPS = 30.0
FABRIC = Material()
#: Coefficient of friction, speed [m/s] below which it counts as static, distance [m] from the skin where contact sets in.
FRICTION, SLIP_SPEED, CONTACT_RADIUS = 0.5, 5e-3, 2e-3
#: Distance [m] between layers of cloth where their contact sets in.
LAYER_REACH = 3e-3
#: Side [m] of the sheet, and vertices along it, by the name of its scene.
SIDE, SHEETS = 1.0, {"drape_1k": 32, "drape_4k": 64, "curtain_1k": 32}
SCENES = (*SHEETS, "body")
GRAVITY = 9.81
_NO_STEP = StepInput(torch.tensor([1.0 / FPS], dtype=torch.float64))


class CannotDoError(ValueError):
    """A program has no means for a scene."""


class Moment(NamedTuple):
    """A cloth at one time: positions and velocities (V, 3) [m], [m/s] in float64, in the world."""

    pos: np.ndarray
    vel: np.ndarray


class Simulation(Protocol):
    """A program with a scene in it, at some frame of it."""

    name: str

    def step(self) -> float:
        """From one frame to the next; CPU milliseconds that this took."""
        ...

    def now(self) -> Moment:
        """The cloth at this frame."""
        ...


@dataclass(frozen=True)
class Setting:
    """One scene with its start, the same for every program.

    Args:
        scene: in float64; nothing in it settles the cloth again.
        start: positions and velocities of frame 0.
        num_frames: with frame 0.
        self_contact: cloth is kept off cloth.
    """

    name: str
    scene: Scene
    start: Moment
    num_frames: int
    fabric: Material = FABRIC
    self_contact: bool = False

    @property
    def cloth(self) -> Cloth:
        return self.scene.cloth

    @property
    def pinned(self) -> np.ndarray:
        """(V,) bool."""
        return self.cloth.pinned.numpy()

    @cached_property
    def body(self) -> np.ndarray:
        """(T, W, 3) m: the body's surface in every frame, (T, 0, 3) without one."""
        frames = (self.scene.motion.surface(frame, np.zeros(3)).double().numpy() for frame in range(self.num_frames))
        return np.stack(list(frames))

    def at(self, dtype: torch.dtype, substeps: int = 1) -> Scene:
        """The scene in another precision, or with so many steps a frame."""
        if dtype == torch.float64 and substeps == 1:
            return self.scene
        scene = _scene_of(self.name, self.num_frames, self.fabric, dtype, substeps)
        return replace(scene, start_pos=self.start.pos, start_vel=self.start.vel)


#: Garment and motion of the scene with a body.
GARMENT, MOTION = "dress", "walk_proud"


#: Waves of a sheet that hangs, along its upper edge, and the share of its width that its corners are apart, less of the
#: curtain, which falls on itself.
WAVES, WIDTH, CURTAIN = 3.5, 0.8, 0.25


def sheet(side: int, width: float = WIDTH) -> Garment:
    """A square of ``side`` × ``side`` vertices that hangs in waves, held at its two upper corners, which are ``width`` of its
    side apart; flat at rest.

    The waves are as long as the cloth is: where it starts nothing is stretched, to the second order of an edge.
    """
    flat, faces = grid(side, side, SIDE)
    pinned = np.zeros(len(flat), dtype=bool)
    pinned[[0, (side - 1) * side]] = True
    share = np.linspace(0.0, 1.0, 20001)
    slope = 2.0 * math.pi * WAVES * np.cos(2.0 * math.pi * WAVES * share)

    def length(height: float) -> np.ndarray:
        speed = np.sqrt(width**2 + (height * slope) ** 2)
        return np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(share))])

    low, high = 0.0, 1.0
    for _ in range(50):
        height = 0.5 * (low + high)
        low, high = (height, high) if length(height)[-1] < 1.0 else (low, height)
    along = np.interp(flat[:, 0] / SIDE, length(low), share)
    waves = low * np.sin(2.0 * math.pi * WAVES * along)
    hung = SIDE * np.stack([width * along, -flat[:, 2] / SIDE, waves], axis=1)
    return Garment(f"sheet {side} × {side}", flat, faces, pinned, skin_pos=hung)


def make_potential(self_contact: bool) -> Potential:
    """What hood minimises: the default, with contact and friction between layers of cloth where they are asked for."""
    potential = default_potential()
    if not self_contact:
        return potential
    return potential.with_terms(layers=LayerBarrier(LAYER_REACH), layer_friction=LayerFriction(FRICTION, SLIP_SPEED))


def make_setting(name: str, num_frames: int, potential: Potential, stretch: float = 1.0) -> Setting:
    """The scene of a name in :data:`SCENES`; cloth is kept off cloth where ``potential`` does so.

    A sheet starts at rest; the dress starts settled on the still body by hood's solver for ``potential``, with the
    velocity of the skinned garment. The fabric is ``stretch`` times as hard to stretch as the default one.

    Raises:
        ValueError: there is no such scene.
    """
    mu, lam = float(np.asarray(FABRIC.lame_mu)), float(np.asarray(FABRIC.lame_lambda))
    fabric = replace(FABRIC, lame_mu=stretch * mu, lame_lambda=stretch * lam)
    scene = _scene_of(name, num_frames, fabric, torch.float64)
    if name in SHEETS:
        start = Moment(scene.garment.worn_pos, np.zeros_like(scene.garment.rest_pos))
    else:
        state, _ = rest_state(NewtonStepper(potential), scene, potential, 0)
        start = Moment(state.pos.numpy() + state.origin[0].numpy(), state.vel.numpy())
    return Setting(
        name, replace(scene, start_pos=start.pos, start_vel=start.vel), start, num_frames, fabric, has_layers(potential)
    )


def _scene_of(name: str, num_frames: int, fabric: Material, dtype: torch.dtype, substeps: int = 1) -> Scene:
    fps = FPS * substeps
    if name in SHEETS:
        width = CURTAIN if name.startswith("curtain") else WIDTH
        return dressed_scene(sheet(SHEETS[name], width), NoBody((num_frames - 1) * substeps + 1, fps, dtype), fabric)
    if name != "body":
        raise ValueError(f"scene {name!r}: choose of {', '.join(SCENES)}")
    return build_scene(load_garment(GARMENT), load_body("default"), load_sequence(MOTION, fps), fabric, dtype=dtype)


class Membrane(NamedTuple):
    """Stiffness of a membrane of St. Venant-Kirchhoff's law, h times what the solid has, in the terms of other programs."""

    mu: float  # N/m, h μ
    lam: float  # N/m, h λ

    @property
    def young(self) -> float:
        """E h [N/m]: tension by strain where the sides are free, 4 μ (λ + μ) / (λ + 2 μ)."""
        return 4.0 * self.mu * (self.lam + self.mu) / (self.lam + 2.0 * self.mu)

    @property
    def poisson(self) -> float:
        """λ / (λ + 2 μ)."""
        return self.lam / (self.lam + 2.0 * self.mu)


def membrane(material: Material) -> Membrane:
    """Of a fabric of one number a property; h is its ``thickness``."""
    thickness = float(np.asarray(material.thickness))
    return Membrane(thickness * float(np.asarray(material.lame_mu)), thickness * float(np.asarray(material.lame_lambda)))


def hinge_stiffness(cloth: Cloth) -> np.ndarray:
    """(H,) J: second derivative of hood's bending energy by the angle of every hinge, k l₀² / (4 (A₁ + A₂))."""
    return bending_weight(cloth.bending_stiffness, cloth.hinge_rest_length**2, cloth.hinge_area).double().numpy()


def spring_stiffness(pos: np.ndarray, faces: np.ndarray, edges: np.ndarray, young: float) -> np.ndarray:
    """(E,) N/m of springs along ``edges`` (E, 2) that stretch like a membrane of ``young`` = E h [N/m]: E h Σ A / l², over the
    faces of an edge (Van Gelder, "Approximate simulation of elastic membranes by triangulated spring meshes", 1998).

    A network of springs has a Poisson ratio of its own, near 1/3, whatever that of the membrane is.
    """
    corners = pos[faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    total: dict[tuple[int, int], float] = {}
    for face, size in zip(faces.tolist(), area.tolist(), strict=True):
        for a, b in ((0, 1), (1, 2), (2, 0)):
            key = (min(face[a], face[b]), max(face[a], face[b]))
            total[key] = total.get(key, 0.0) + size
    length_sq = ((pos[edges[:, 0]] - pos[edges[:, 1]]) ** 2).sum(axis=1)
    return young * np.array([total[min(a, b), max(a, b)] for a, b in edges.tolist()]) / length_sq


def contact_stiffness(cloth: Cloth, weight: float, loads: float = 10.0) -> float:
    """N/m of a linear contact that gives way as far as hood's cubic one, of ``weight`` w [J/m³], under so many times the mean
    weight F of a vertex: F / p with 3 w p² = F."""
    force = loads * GRAVITY * float(cloth.mass.mean())
    return force / math.sqrt(force / (3.0 * weight))


@dataclass(frozen=True)
class Row:
    """What one program did in one scene."""

    name: str
    ms: float  # median of a frame
    strain: float  # 99th percentile of the edge strain, mean over the frames
    cut: float  # share of triangles cut by the skin, mean over the measured frames
    depth: float  # m, greatest height of skin above the cloth
    crossed: float  # pairs of triangles of cloth that pass through each other, most of the measured frames
    gamma: float  # median over the measured frames, of hood's potential; NaN where none was measured
    energy: float  # J above the static minimum at the end; NaN with a body
    kinetic: float  # J at the end


def measured_frames(num_frames: int, stride: int) -> Iterator[int]:
    """Every ``stride``-th frame, and the last."""
    return (frame for frame in range(1, num_frames) if frame % stride == 0 or frame == num_frames - 1)


class Measures:
    """Follows one program through a setting."""

    def __init__(self, setting: Setting, potential: Potential, stride: int) -> None:
        self.setting, self.potential = setting, potential
        self._frames = set(measured_frames(setting.num_frames, stride))
        self._meter = SurfaceMeter(setting.scene.garment, setting.scene.motion.faces)
        self._times: list[float] = []
        self._strain: list[float] = []
        self._cut: list[tuple[float, float, float]] = []
        self._gamma: list[float] = []
        self._last = setting.start

    def see(self, frame: int, ms: float, moment: Moment) -> None:
        """The step to ``frame``."""
        self._times.append(ms)
        self._strain.append(strain_metrics(self.setting.cloth, torch.as_tensor(moment.pos))["strain_p99"])
        if frame in self._frames:
            found = self._meter(moment.pos, self.setting.body[frame])
            self._cut.append((found["cut_face_share"], found["skin_depth"], found["self_crossings"]))
            self._gamma.append(gamma(self.setting, self.potential, frame - 1, self._last, moment.pos))
        self._last = moment

    def row(self, name: str, minimum: float) -> Row:
        """After the last frame; ``minimum`` [J] of :func:`static_minimum`."""
        cut, cloth = np.array(self._cut), self.setting.cloth
        return Row(
            name,
            float(np.median(self._times[WARM_UP:])),
            float(np.mean(self._strain)),
            float(cut[:, 0].mean()),
            float(cut[:, 1].max()),
            float(cut[:, 2].max()),
            float(np.median(self._gamma)),
            resting_energy(cloth, self._last.pos) - minimum,
            0.5 * float((cloth.mass.numpy() * (self._last.vel**2).sum(axis=1)).sum()),
        )


#: Frames whose time does not count.
WARM_UP = 3


def problem_at(setting: Setting, frame: int, moment: Moment, scene: Scene | None = None) -> tuple[StepProblem, np.ndarray]:
    """hood's step from ``frame``, of a cloth that is at ``moment``, and the origin (3,) [m] of its positions; ``scene`` is that
    of the setting in another precision."""
    scene = scene or setting.scene
    origin = local_origin(moment.pos.mean(axis=0))
    pos = torch.as_tensor(moment.pos - origin).to(scene.cloth.rest_pos)
    state = State(pos, torch.as_tensor(moment.vel).to(pos), torch.as_tensor(origin)[None])
    gravity = torch.tensor([0.0, -GRAVITY, 0.0]).to(pos)
    return StepProblem(scene.cloth, state, scene.step_input(frame, state), gravity=gravity), origin


def gamma(setting: Setting, potential: Potential, frame: int, moment: Moment, next_pos: np.ndarray) -> float:
    """γ of the step from ``frame`` to ``next_pos`` (V, 3) under ``potential``, from a program's own state; infinite where its
    positions are not finite."""
    if not (np.isfinite(next_pos).all() and np.isfinite(moment.pos).all() and np.isfinite(moment.vel).all()):
        return math.inf
    problem, origin = problem_at(setting, frame, moment)
    return float(gap(potential, problem, torch.as_tensor(next_pos - origin)).gamma)


def resting_energy(cloth: Cloth, pos: np.ndarray) -> float:
    """[J] of stretching, bending and gravity at ``pos`` (V, 3)."""
    here = torch.as_tensor(pos)
    state = State(here, torch.zeros_like(here), torch.zeros(1, 3, dtype=torch.float64))
    problem = StepProblem(cloth, state, _NO_STEP)
    return sum(float(term(problem, here, state.vel)) for term in (Stretching(), Bending(), Gravity()))


def static_minimum(setting: Setting, potential: Potential, pos: np.ndarray) -> float:
    """[J] of :func:`resting_energy` where a sheet that is at ``pos`` (V, 3) comes to rest; NaN with a body."""
    return resting_energy(setting.cloth, at_rest(setting, potential, pos)) if setting.name in SHEETS else math.nan


def at_rest(setting: Setting, potential: Potential, pos: np.ndarray) -> np.ndarray:
    """(V, 3) m where a sheet that is at ``pos`` (V, 3) comes to rest under ``potential``."""
    state = State(torch.as_tensor(pos), torch.zeros_like(torch.as_tensor(pos)), torch.zeros(1, 3, dtype=torch.float64))
    rest = find_equilibrium(setting.scene, potential, state, 0, torch.tensor([0.0, -GRAVITY, 0.0], dtype=torch.float64))
    return np.asarray(rest.pos.numpy())
