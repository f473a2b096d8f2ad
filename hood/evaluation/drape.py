"""The drape test of Cusick ("The measurement of fabric drape", J. Text. Inst. 59, 1968; BS 5058, ISO 9073-9), simulated.

A circular sample of 30 cm lies on a disc of 18 cm, held by a second one, and hangs over its edge. Light from above throws its
shadow. The drape coefficient is the share of the overhanging ring that the shadow covers: near 0% for cloth that hangs
straight down, 100% for a board.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import Delaunay

from hood.assets.material import Material
from hood.cloth.cloth import Cloth, build_cloth
from hood.cloth.state import State, StepInput
from hood.energies.bending import Bending
from hood.energies.mass_points import Gravity, Inertia
from hood.energies.membrane import Stretching
from hood.energies.potential import Potential
from hood.energies.problem import StepProblem
from hood.solver.newton import NewtonSettings, minimize

_Array = NDArray[np.float64]
_Faces = NDArray[np.int64]

#: Radii [m] of the disc and of the sample.
DISC, SAMPLE = 0.09, 0.15
#: Bounds [m] of the mean edge that a sample is meshed with.
FINEST, COARSEST = 2e-3, 3e-2
#: Folds of the rim that a sample starts with, the slope of their crests, and the height [m] of vertices off that at random.
STARTS = (3, 4, 5, 6, 7, 8, 9, 10, 12)
_SLOPE, _ROUGHNESS = 0.1, 1e-5
#: Steps of the way to rest [s], the first and the longest; the way [m] of the fastest vertex that lets them grow.
_SHORTEST, _LONGEST, _STRIDE = 1.0 / 30.0, 1.0, 0.02
#: At rest: in the longest step no vertex moves farther than this [m].
_REST = 5e-4
_MOST_STEPS = 200
_ON_THE_WAY, _FINE = NewtonSettings(target_rg=1e-2, max_iterations=30), NewtonSettings(target_rg=1e-3)
#: Width of the held faces inside the edge of the disc, as a share of the mean edge: a hinge there has the cloth of its outer
#: face alone to bend, as cloth that a disc holds has.
_HEM = 0.02
#: Pixel [m] of the shadow.
PIXEL = 5e-4


@dataclass(frozen=True)
class DrapedRest:
    """A state of rest of a sample.

    Args:
        coefficient: drape coefficient, a share of 1.
        folds: waves of the rim; 0 where it is round.
        energy: [J] of stretching, bending and gravity, above that of the flat sample.
        pos: (V, 3) m, y up, the disc in the plane y = 0.
        shadow: (N, N) bool, pixels of :data:`PIXEL`, the disc included; rows along z, columns along x.
        reached: whether the sample came to rest.
    """

    coefficient: float
    folds: int
    energy: float
    pos: _Array
    shadow: NDArray[np.bool_]
    reached: bool


@dataclass(frozen=True)
class Drape:
    """What the test gives for one fabric on one mesh.

    Args:
        edge: [m] mean edge.
        faces: (F, 3) of the sample.
        states: of rest, from every start; the first has the lowest energy, and is the result.
    """

    edge: float
    faces: _Faces
    states: tuple[DrapedRest, ...]

    @property
    def rest(self) -> DrapedRest:
        return self.states[0]


@torch.no_grad()
def drape(material: Material, edge: float = 0.01) -> Drape:
    """A sample of ``material`` laid on the disc and followed to rest, from :data:`STARTS`, of which the lowest energy counts.

    Cloth has several states of rest, with more and fewer folds, in the laboratory as well. One that is dropped flat ends in one
    of too many: folds that are short grow fastest. Steps are implicit, each from rest, of growing dt. The sample does not touch
    itself, and what hangs does not touch the stand.

    Args:
        edge: [m] mean edge of the mesh.

    Raises:
        ValueError: ``edge`` is out of bounds.
    """
    if not FINEST <= edge <= COARSEST:
        raise ValueError(f"edge={edge}: a sample is meshed with edges of {FINEST} to {COARSEST} m")
    pos, faces = sample_mesh(edge)
    radius, angle = np.hypot(pos[:, 0], pos[:, 2]), np.arctan2(pos[:, 2], pos[:, 0])
    held, rim = radius < DISC + 1e-9, radius > SAMPLE - 1e-9
    cloth = build_cloth(pos, faces, material, held, dtype=torch.float64)
    noise = _ROUGHNESS * np.random.default_rng(0).standard_normal(len(pos))
    states = []
    for folds in STARTS:
        start = pos.copy()
        start[:, 1] = np.where(held, 0.0, _SLOPE * (radius - DISC) * np.cos(folds * angle) + noise)
        rest, reached = settled(cloth, start)
        shadow = cast_shadow(rest, faces)
        energy = _energy(_problem(cloth, rest))
        states.append(DrapedRest(coefficient_of(shadow), folds_of(rest[rim]), energy, rest, shadow, reached))
    return Drape(edge, faces, tuple(sorted(states, key=lambda state: state.energy)))


def _problem(cloth: Cloth, pos: _Array) -> StepProblem:
    """A step from rest at ``pos`` (V, 3)."""
    state = State(torch.as_tensor(pos), torch.zeros_like(cloth.rest_pos), torch.zeros(1, 3, dtype=torch.float64))
    step = StepInput(torch.tensor([_SHORTEST], dtype=torch.float64), pin_target=cloth.rest_pos)
    return StepProblem(cloth, state, step)


def _energy(problem: StepProblem) -> float:
    """[J] at the state of the problem."""
    pos = problem.state.pos
    return sum(float(term(problem, pos, torch.zeros_like(pos))) for term in (Stretching(), Bending(), Gravity()))


@torch.no_grad()
def settled(cloth: Cloth, start: _Array) -> tuple[_Array, bool]:
    """Where a cloth comes to rest under its weight, (V, 3) [m], from ``start`` (V, 3), and whether it has come to rest.

    Args:
        cloth: in float64; what is pinned stays in its place at rest.
    """
    problem = _problem(cloth, start)
    potential = Potential({"stretching": Stretching(), "bending": Bending(), "inertia": Inertia(), "gravity": Gravity()})
    dt = _SHORTEST
    for _ in range(_MOST_STEPS):
        longest = dt >= _LONGEST
        problem = replace(problem, step=replace(problem.step, dt=torch.full_like(problem.step.dt, dt)))
        here = problem.state
        pos, _ = minimize(potential, problem, here.pos, _FINE if longest else _ON_THE_WAY)
        moved = float((pos - here.pos).norm(dim=1).max())
        problem = replace(problem, state=replace(here, pos=pos))
        if longest and moved <= _REST:
            return pos.numpy(), True
        dt = min(max(dt * min(max(_STRIDE / max(moved, 1e-9), 0.5), 2.0), _SHORTEST), _LONGEST)
    return problem.state.pos.numpy(), False


@cache
def sample_mesh(edge: float) -> tuple[_Array, _Faces]:
    """The ring of the sample that hangs, and a narrow rim by which it is held: positions (V, 3) [m] in the plane y = 0 and
    faces (F, 3), nearly equilateral where they hang."""
    height = edge * math.sqrt(3.0) / 2.0
    disc = _ring(DISC, edge)
    fixed = np.concatenate([(1.0 - _HEM * edge / DISC) * disc, disc, _ring(SAMPLE, edge)])
    count = int(SAMPLE / height) + 1
    row, column = np.mgrid[-count : count + 1, -count : count + 1]
    lattice = np.stack([(column + 0.5 * (row % 2)) * edge, row * height], axis=-1).reshape(-1, 2)
    radius = np.linalg.norm(lattice, axis=1)
    free = lattice[(radius > DISC + 0.6 * edge) & (radius < SAMPLE - 0.6 * edge)]
    for _ in range(20):
        points = np.concatenate([fixed, free])
        triangles = _ring_triangles(points)
        ends = np.unique(np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
        both = np.concatenate([ends, ends[:, ::-1]])
        total = np.stack([np.bincount(both[:, 0], points[both[:, 1], axis], len(points)) for axis in (0, 1)], axis=1)
        free = (total / np.bincount(both[:, 0], minlength=len(points))[:, None])[len(fixed) :]
    points = np.concatenate([fixed, free])
    pos = np.stack([points[:, 0], np.zeros(len(points)), points[:, 1]], axis=1)
    return pos, _ring_triangles(points)


def _ring(radius: float, edge: float) -> _Array:
    angle = 2.0 * math.pi * np.arange(round(2.0 * math.pi * radius / edge)) / round(2.0 * math.pi * radius / edge)
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _ring_triangles(points: _Array) -> _Faces:
    triangles = Delaunay(points).simplices
    inside = np.linalg.norm(points, axis=1).min() * (1.0 + 1e-9)
    hole = (np.linalg.norm(points[triangles], axis=2) < inside).all(axis=1)
    return triangles[~hole].astype(np.int64)


def cast_shadow(pos: _Array, faces: _Faces) -> NDArray[np.bool_]:
    """(N, N) bool, which pixels of :data:`PIXEL` the disc and a cloth (V, 3) hide from light that falls along y."""
    half = round(1.1 * SAMPLE / PIXEL)
    centre = (np.arange(-half, half) + 0.5) * PIXEL
    shadow = np.hypot(*np.meshgrid(centre, centre)) < DISC
    for corners in pos[:, [0, 2]][faces]:
        low = np.clip(np.floor(corners.min(axis=0) / PIXEL).astype(int) + half, 0, 2 * half)
        high = np.clip(np.ceil(corners.max(axis=0) / PIXEL).astype(int) + half, 0, 2 * half)
        x, z = centre[low[0] : high[0]][None, :], centre[low[1] : high[1]][:, None]
        side = [
            (b[0] - a[0]) * (z - a[1]) - (b[1] - a[1]) * (x - a[0]) for a, b in zip(corners, corners[[1, 2, 0]], strict=True)
        ]
        shadow[low[1] : high[1], low[0] : high[0]] |= (np.minimum.reduce(side) >= 0) | (np.maximum.reduce(side) <= 0)
    return shadow


def coefficient_of(shadow: NDArray[np.bool_]) -> float:
    """Drape coefficient of a shadow that holds the disc."""
    disc, sample = math.pi * DISC**2, math.pi * SAMPLE**2
    return (float(shadow.sum()) * PIXEL**2 - disc) / (sample - disc)


def folds_of(rim: _Array) -> int:
    """Waves of a rim (N, 3) in its order around the axis: the strongest of its distance from it; 0 where none is 1 mm high."""
    radius = np.hypot(rim[:, 0], rim[:, 2])
    waves = 2.0 * np.abs(np.fft.rfft(radius - radius.mean())) / len(radius)
    return int(waves.argmax()) if waves.max() > 1e-3 else 0
