"""A window of a rollout on another mesh of the same garment, or with another time step, held against the full model.

Neither has a γ: the potential of another mesh or step is another one. So both begin at rest on the still body of the
window's first frame, each in its own equilibrium, take steps for the same time, and are compared in mm at points that both
meshes have.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from hood.cloth.state import State
from hood.mesh.closest_point.search import search_surface
from hood.scene.scene import Scene
from hood.studies.plan.ablation import Variant, advance, rest_at, vertex_distances, world


@dataclass(frozen=True)
class _Points:
    """Points that move with a mesh: weights (N, 3) of the vertices ``corners`` (N, 3)."""

    corners: Tensor
    weights: Tensor

    def of(self, pos: Tensor) -> Tensor:
        """Where they are, (N, 3) m, by the positions (V, 3) [m] of the mesh's vertices."""
        return (pos[self.corners] * self.weights.to(pos).unsqueeze(2)).sum(dim=1)


def common_points(one: Scene, other: Scene) -> tuple[_Points, _Points]:
    """Points that two meshes of a garment share, on ``one`` and on ``other``: the vertices of the coarser mesh, and where they
    lie on the finer one at rest. A fold that the coarser mesh cannot show is no difference there."""
    if other.cloth.num_vertices > one.cloth.num_vertices:
        on_other, on_one = common_points(other, one)
        return on_one, on_other
    points, finer = other.cloth.rest_pos.double().cpu(), one.cloth.rest_pos.double().cpu()
    faces = torch.as_tensor(one.garment.faces)
    scenes = [torch.zeros(count, dtype=torch.int64) for count in (len(points), len(finer), len(faces))]
    hit = search_surface(points, scenes[0], finer, faces, scenes[1], scenes[2])
    itself = torch.arange(len(points)).unsqueeze(1).expand(-1, 3)
    alone = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64).expand(len(points), 3)
    return _Points(faces[hit.face], hit.bary), _Points(itself, alone)


@dataclass(frozen=True)
class Elsewhere:
    """Another scene of the same garment and motion.

    Args:
        variant: what moves there, and by what.
        points: on the full model's mesh, and here; None where the mesh is the same.
        pace: steps for one step of the full model, a whole number or ½.
    """

    variant: Variant
    points: tuple[_Points, _Points] | None = None
    pace: float = 1.0

    def span(self, first: int, steps: int) -> tuple[int, int]:
        """First frame and number of steps of the full model that are whole ones here as well: the frame is not later, the
        steps are not fewer."""
        unit = max(round(1.0 / self.pace), 1)
        return first // unit * unit, -(-steps // unit) * unit

    def rest(self, first: int, settle: str, known: State | None = None) -> State:
        """At rest in frame ``first`` of the full model; ``known`` is where the full model is at rest then."""
        frame = round(first * self.pace)
        if known is None or self.points is not None:
            return rest_at(self.variant, frame, settle)
        return State(known.pos, self.variant.scene.start_velocity(frame), known.origin)


@dataclass
class Apart:
    """How far off another scene is, window by window.

    Args:
        half_mm, mm: median and 95th percentile of the points, at the end of every window.
        ms: of every step, all windows.
    """

    half_mm: list[float] = field(default_factory=list)
    mm: list[float] = field(default_factory=list)
    ms: list[float] = field(default_factory=list)

    def frame_ms(self, pace: float) -> float:
        """Of a frame of the full model: the median step times the steps that a frame takes."""
        return float(np.median(self.ms)) * pace


class Reference:
    """The full model in windows that begin at rest, each computed once.

    Args:
        full: the model.
        settle: as in :func:`hood.rollouts.loop.simulate`.
        rests: by frame, where it is known to be at rest.
    """

    def __init__(self, full: Variant, settle: str, rests: dict[int, State]) -> None:
        self.full, self.settle, self.rests = full, settle, dict(rests)
        self.ms: list[float] = []  # of every step
        self._ends: dict[tuple[int, int], Tensor] = {}

    def rest(self, first: int) -> State:
        """At rest in frame ``first``."""
        if first not in self.rests:
            self.rests[first] = rest_at(self.full, first, self.settle)
        return self.rests[first]

    def end(self, first: int, steps: int) -> Tensor:
        """Positions (V, 3) [m], world, ``steps`` after ``first``."""
        if (first, steps) not in self._ends:
            *_, (_, state) = advance(self.full, self.rest(first), first, steps, self.ms)
            self._ends[first, steps] = world(state)
        return self._ends[first, steps]


def measure_elsewhere(reference: Reference, other: Elsewhere, firsts: Sequence[int], steps: int) -> Apart:
    """How far ``other`` is from the full model ``steps`` steps after the frames ``firsts``, and the time that it takes."""
    found = Apart()
    for given in firsts:
        first, count = other.span(given, steps)
        end = reference.end(first, count)
        rest = other.rest(first, reference.settle, reference.rest(first))
        frame, steps_there = round(first * other.pace), round(count * other.pace)
        *_, (_, last) = advance(other.variant, rest, frame, steps_there, found.ms)
        there = world(last)
        if other.points is not None:
            end, there = other.points[0].of(end), other.points[1].of(there)
        half, most = vertex_distances(there, end)
        found.half_mm.append(half)
        found.mm.append(most)
    return found
