"""Pressure of air inside the cloth: a puffer jacket, a balloon, air under a skirt."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from hood.cloth.cloth import Cloth
from hood.energies.problem import StepProblem, sum_per_scene
from hood.energies.term import Energy, Form, Passes, Role
from hood.mesh.topology import boundary_loops, connected_components
from hood.tensors.batch import made_of
from hood.tensors.dense import add_rows

#: Pascal, one atmosphere: no garment holds more.
_MOST = 1e5
#: Volume over area^1.5 below which a piece lies flat: a sphere has 0.094.
_FLAT = 1e-6


class Pressure(Energy):
    """Energy [J] of air at a constant pressure inside every connected piece of cloth, -p V with V the volume [m³] in it.

    The force is p times the area of each triangle, outwards. An open rim is closed by a fan of triangles to the mean of its
    vertices, so that air is held under a skirt as well; what presses on a fan pulls at its rim. So there is no net force and
    no torque, whatever the shape. Outwards is the side to which the volume at rest is positive: the winding of the faces plays
    no role. A piece that lies flat at rest has the winding of its first face.

    The body and other cloth inside take nothing off the volume, and air does not leak: p is the same however large V is.

    Args:
        pascal: p [Pa] above that of the air outside; below 0 it sucks. 10 carries a kilogram per square metre.

    Raises:
        ValueError: a value that is not finite or beyond one atmosphere.
    """

    kind: ClassVar[str] = "Pressure"
    role = Role.EXTERNAL
    form = Form.BLOCKS

    def __init__(self, pascal: float) -> None:
        if not abs(pascal) <= _MOST:
            raise ValueError(
                f"pressure: pascal is {pascal}; give Pa from {-_MOST:g} to {_MOST:g}, one atmosphere (10 is a lot)"
            )
        self.pascal = pascal if isinstance(pascal, Tensor) else float(pascal)  # steps are differentiated by a tensor

    def applies(self, problem: StepProblem) -> bool:
        return self.pascal != 0.0

    def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
        """Energy [J] (B,) at ``next_pos`` (V, 3)."""
        return self.closed_form(problem).energy(next_pos)

    def closed_form(self, problem: StepProblem, passes: Passes | None = None) -> Inflation:
        """The surfaces of the cloth and what presses on them.

        Raises:
            ValueError: a piece of cloth has no inside.
        """
        return Inflation(self.pascal, surface_of(problem.cloth))


def pressure(pascal: float | None = None) -> Pressure | None:
    """The term of a config; None, which a potential leaves out, for 0 or None.

    Raises:
        ValueError: not a number, or one out of range.
    """
    if pascal is not None and (isinstance(pascal, bool) or not isinstance(pascal, int | float)):
        raise ValueError(f"losses.terms.pressure.pascal={pascal}: give a number in Pa; 10 is a lot, null for none")
    return Pressure(pascal) if pascal else None


@dataclass(frozen=True)
class ClosedSurface:
    """The pieces of a cloth, closed over their rims; triangles wound outwards. Rows from V on are the means of the rims."""

    corners: Tensor  # (N, 3), of vertices and of means
    scene: Tensor  # (N,)
    piece: Tensor  # (N,)
    rims: Tensor  # (M,) vertices of the rims, and (M,) which mean each belongs to
    mean: Tensor
    share: Tensor  # (M,) 1 / number of vertices of the rim
    num_rims: int
    num_pieces: int
    num_scenes: int

    def points(self, pos: Tensor) -> Tensor:
        """``pos`` (V, 3) with the means of the rims (V + R, 3) after them."""
        means = add_rows(pos.new_zeros(self.num_rims, 3), self.mean, self.share.to(pos)[:, None] * pos[self.rims])
        return torch.cat([pos, means])

    def to_vertices(self, values: Tensor, num_vertices: int) -> Tensor:
        """Values (V + R, ...) of points, those of the means shared out to their rims: (V, ...)."""
        own, means = values[:num_vertices], values[num_vertices:]
        share = self.share.to(values).view(-1, *[1] * (values.ndim - 1))
        return own.index_add(0, self.rims, share * means[self.mean])

    def sizes(self, pos: Tensor) -> tuple[Tensor, Tensor]:
        """:meth:`volumes`, and the areas [m²] (N,) of the triangles."""
        x = self.points(pos)[self.corners]
        cross = torch.linalg.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])
        return self.volumes(pos), 0.5 * torch.linalg.vector_norm(cross, dim=1)

    def volumes(self, pos: Tensor) -> Tensor:
        """Signed volumes [m³] (N,) of the triangles with a point inside their piece at ``pos`` (V, 3)."""
        points = self.points(pos)
        x = points[self.corners]
        # The volume does not depend on the point, which thus has no slope; near it numbers are small.
        of_triangles = torch.cat([x.detach().mean(dim=1), torch.ones_like(x[:, 0, :1])], dim=1)
        sums = add_rows(pos.new_zeros(self.num_pieces, 4), self.piece, of_triangles)
        inside = (sums[:, :3] / sums[:, 3:])[self.piece]
        a, b, c = (x - inside[:, None]).unbind(dim=1)
        return (a * torch.linalg.cross(b, c)).sum(dim=1) / 6.0


@dataclass(frozen=True)
class Inflation:
    """A pressure [Pa] in closed surfaces: the closed form of :class:`Pressure`."""

    pascal: float
    surface: ClosedSurface

    def energy(self, pos: Tensor) -> Tensor:
        """Energy [J] (B,) at ``pos`` (V, 3)."""
        surface = self.surface
        return sum_per_scene(-self.pascal * surface.volumes(pos), surface.scene, surface.num_scenes)

    def derivatives(self, pos: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient [N] (V, 3) and the curvature that the solver takes [N/m] (V, 3, 3), diagonal and >= 0.

        The second derivative couples the ends of an edge by p/6 times a skew matrix of the way between its opposite vertices.
        Where p sucks, the cloth is pressed together: the sizes of these matrices at both ends bound it. Where p blows the
        surface up the curvature along the normals is negative, and the rest is small beside the membrane, which carries it: 0.
        With the bound there as well, a balloon of 500 Pa took 100 iterations in place of 22.
        """
        points, surface = self.surface.points(pos), self.surface
        x, index = points[surface.corners], surface.corners.reshape(-1)
        # Of a closed surface a vertex has a third of the area around it, however far it is from the origin.
        third = torch.linalg.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]) / 6.0
        slope = add_rows(torch.zeros_like(points), index, -self.pascal * third.repeat_interleave(3, dim=0))
        # From the middle of an edge to the opposite vertex of either face is at least half of the way between the two.
        median = torch.linalg.vector_norm(1.5 * (x - x.mean(dim=1, keepdim=True)), dim=2)
        size = max(-self.pascal, 0.0) / 6.0 * (median.sum(dim=1, keepdim=True) - median)
        bound = surface.to_vertices(add_rows(points.new_zeros(len(points)), index, size.reshape(-1)), len(pos))
        return surface.to_vertices(slope, len(pos)), torch.diag_embed(bound[:, None].expand(-1, 3))


def surface_of(cloth: Cloth) -> ClosedSurface:
    """The pieces of a cloth, closed; kept as long as its faces live.

    Raises:
        ValueError: a piece has no inside.
    """
    made = made_of(cloth.faces)
    if "closed" not in made:
        made["closed"] = _closed(cloth)
    surface: ClosedSurface = made["closed"]
    return surface


def _closed(cloth: Cloth) -> ClosedSurface:
    rest, faces = cloth.rest_pos.double(), _wound_alike(cloth.faces.cpu().numpy())
    loops = boundary_loops(faces)
    rim_of = {pair: len(rest) + number for number, loop in enumerate(loops) for pair in _edges_of(loop)}
    half = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).tolist()
    fans = [(b, a, rim_of[min(a, b), max(a, b)]) for a, b in half if (min(a, b), max(a, b)) in rim_of]
    corners = np.concatenate([faces, np.array(fans, np.int64).reshape(-1, 3)])
    label = connected_components(len(rest), cloth.edges.cpu().numpy())[corners[:, 0]]
    _, piece = np.unique(label, return_inverse=True)
    lengths = np.array([len(loop) for loop in loops], np.int64)
    mean = np.repeat(np.arange(len(loops)), lengths)
    rims = np.concatenate(loops) if loops else np.zeros(0, np.int64)
    scene = cloth.vertex_scene.cpu().numpy()[corners[:, 0]]
    to = rest.device
    surface = ClosedSurface(
        corners=torch.as_tensor(corners, device=to),
        scene=torch.as_tensor(scene, device=to),
        piece=torch.as_tensor(piece, device=to),
        rims=torch.as_tensor(rims, device=to),
        mean=torch.as_tensor(mean, device=to),
        share=torch.as_tensor(1.0 / lengths[mean], device=to),
        num_rims=len(loops),
        num_pieces=int(piece.max(initial=-1)) + 1,
        num_scenes=cloth.num_scenes,
    )
    volume, area = (rest.new_zeros(surface.num_pieces).index_add(0, surface.piece, values) for values in surface.sizes(rest))
    inside_out = (volume < -_FLAT * area**1.5)[surface.piece]
    return replace(surface, corners=torch.where(inside_out[:, None], surface.corners.flip(1), surface.corners))


def _edges_of(loop: np.ndarray) -> list[tuple[int, int]]:
    return [(min(a, b), max(a, b)) for a, b in zip(loop.tolist(), np.roll(loop, -1).tolist(), strict=True)]


def _wound_alike(faces: np.ndarray) -> np.ndarray:
    """``faces`` (F, 3) with the winding of the first face of their piece.

    Raises:
        ValueError: three faces share an edge, or a piece has one side alone.
    """
    half = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    owner = np.tile(np.arange(len(faces)), 3)
    key = np.sort(half, axis=1) @ np.array([int(faces.max(initial=0)) + 1, 1])
    order = np.argsort(key, kind="stable")
    first, second = order[:-1], order[1:]
    shared = key[first] == key[second]
    if bool((shared[1:] & shared[:-1]).any()):
        raise ValueError("pressure: three faces share an edge, so that the cloth has no inside; take the inner layers out")
    first, second = first[shared], second[shared]
    against = half[first, 0] == half[second, 0]  # neighbours that are wound alike run along their edge in opposite directions
    beside: dict[int, list[tuple[int, bool]]] = defaultdict(list)
    for a, b, turned in zip(owner[first].tolist(), owner[second].tolist(), against.tolist(), strict=True):
        beside[a].append((b, turned))
        beside[b].append((a, turned))
    flipped = np.full(len(faces), -1)
    for start in range(len(faces)):
        if flipped[start] >= 0:
            continue
        flipped[start], waiting = 0, [start]
        while waiting:
            face = waiting.pop()
            for other, turned in beside[face]:
                wanted = int(flipped[face]) ^ int(turned)
                if flipped[other] < 0:
                    flipped[other] = wanted
                    waiting.append(other)
                elif flipped[other] != wanted:
                    raise ValueError("pressure: the cloth has one side alone, like a Möbius strip, and so no inside")
    return np.where(flipped[:, None] == 1, faces[:, ::-1], faces)
