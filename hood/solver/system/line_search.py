"""The line search: along a path that bends away from the body where the straight one would run into it."""

from __future__ import annotations

import torch
from torch import Tensor

from hood.energies.contact import Walls
from hood.energies.laws import contact_push
from hood.solver.derivatives.step_terms import PointForces
from hood.solver.system.iterate import Iterate, Unknowns
from hood.tensors.dense import add_rows

ARMIJO = 1e-4
BACKTRACKS = 40


class Path:
    """Where steps of some length from an iterate lead.

    A Newton step knows the contact force and its slope at its start: a vertex outside the body meets no resistance and
    one inside too little, so that a few vertices would shorten the step of all. Here every vertex with contact ends where
    the *whole* cubic penalty balances the Newton model, moved along the compliance of its own 3 × 3 block. The
    correction is of second order in the step, so the path starts in the Newton direction and short steps descend.

    Args:
        direction: (V, 3) m, zero for fixed vertices.
        inverse: (N, 3, 3) inverses of the model's diagonal blocks.
        vertices: (N,) their vertices.
    """

    def __init__(self, unknowns: Unknowns, now: Iterate, direction: Tensor, inverse: Tensor, vertices: Tensor) -> None:
        self._unknowns, self._now = unknowns, now
        self._step = direction / unknowns.dt_sq
        walls = unknowns.terms.vertices.walls
        self._stops = []
        for wall in walls:
            # A straight line is deepest at one of its ends.
            deepest = torch.maximum(wall.depth(now.pos), wall.depth(now.pos + direction))[vertices]
            rows = (deepest > 0).nonzero().squeeze(1)
            if len(rows):
                self._stops.append(Stop(wall, now.pos, inverse[rows], vertices[rows]))
        every = now.pos.new_zeros(len(now.pos), 3, 3).index_copy(0, vertices, inverse) if unknowns.terms.points else inverse
        ends = now.pos, now.pos + direction
        self._point_stops = [
            _PointStop(points, wall, ends, every) for points in unknowns.terms.points for wall in points.forces.walls
        ]

    def at(self, length: Tensor) -> Iterate:
        """The iterate at step lengths (B,)."""
        return self._unknowns.evaluate(self._straight(length))

    def _straight(self, length: Tensor) -> Tensor:
        unknowns = self._unknowns
        acc = self._now.acc + length[unknowns.scene].unsqueeze(1) * self._step
        for stop in self._stops:
            rows = stop.vertices
            acc[rows] += stop.correction(unknowns.place_free(rows, acc[rows])) / unknowns.dt_sq[rows]
        for point_stop in self._point_stops:
            acc += point_stop.correction(unknowns.place(acc)) / unknowns.dt_sq
        return acc

    def reached(self, length: Tensor, goal: Tensor) -> tuple[Iterate, Tensor]:
        """The iterate at step lengths (B,), and what is left of them where cloth would meet cloth.

        Where little is left the way is bent around cloth instead, if that leads to a potential of at most ``goal`` (B,) [J].
        """
        unknowns, now = self._unknowns, self._now
        acc = self._straight(length)
        share = unknowns.free_share(now, acc)
        if share is None:
            return unknowns.evaluate(acc), length
        shortened = unknowns.evaluate(now.acc + share[unknowns.scene].unsqueeze(1) * (acc - now.acc))
        bent = unknowns.around(now, acc, share)
        if bent is None:
            return shortened, length * share
        around = bent[1] & (bent[0].phi <= goal)
        return unknowns.select(around, bent[0], shortened), torch.where(around, length, length * share)


class Stop:
    """Contact of n vertices with a wall during a step."""

    def __init__(self, wall: Walls, pos: Tensor, inverse: Tensor, vertices: Tensor) -> None:
        self.vertices = vertices
        self._wall = wall.take(vertices)
        self._depth = self._wall.depth(pos[vertices]).clamp_min(0.0)
        self._give = torch.bmm(inverse, self._wall.normal.unsqueeze(2)).squeeze(2)
        self._compliance = (self._give * self._wall.normal).sum(1)

    def correction(self, pos: Tensor) -> Tensor:
        """Displacement (n, 3) of vertices that the Newton model has put at ``pos`` (n, 3)."""
        push = contact_push(self._wall.weight, self._depth, self._wall.depth(pos), self._compliance)
        return push[:, None] * self._give


class _PointStop:
    """Contact of points inside edges and faces with a wall during a step.

    A point gives as its vertices do together, each along its own block. A vertex with several points that push takes the
    mean of what they ask of it: all of it would throw cloth that meets the body as a whole far out.

    Args:
        ends: positions (V, 3) at the start and at the end of the straight line.
        inverse: (V, 3, 3), 0 for vertices that do not move.
    """

    def __init__(self, points: PointForces, wall: Walls, ends: tuple[Tensor, Tensor], inverse: Tensor) -> None:
        start, end = (wall.depth(points.at(pos)) for pos in ends)
        give = torch.einsum("nk,nkab,nb->nka", points.weights, inverse[points.vertices], wall.normal)
        compliance = torch.einsum("nk,nka,na->n", points.weights, give, wall.normal)
        rows = ((torch.maximum(start, end) > 0) & (compliance > 0)).nonzero().squeeze(1)
        self._points, self._wall, self._depth = points.take(rows), wall.take(rows), start[rows].clamp_min(0.0)
        self._give, self._compliance = give[rows], compliance[rows]

    def correction(self, pos: Tensor) -> Tensor:
        """Displacement (V, 3) of vertices that the Newton model has put at ``pos`` (V, 3)."""
        points = self._points
        push = contact_push(self._wall.weight, self._depth, self._wall.depth(points.at(pos)), self._compliance)
        target = points.vertices.reshape(-1)
        total = add_rows(torch.zeros_like(pos), target, (push[:, None, None] * self._give).reshape(-1, 3))
        asked = ((push > 0)[:, None] & (points.weights > 0)).to(pos.dtype).reshape(-1)
        count = add_rows(pos.new_zeros(len(pos)), target, asked)
        return total / count.clamp_min(1.0)[:, None]


def backtrack(unknowns: Unknowns, path: Path, now: Iterate, slope: Tensor, searching: Tensor) -> tuple[Iterate, Tensor]:
    """The next iterate, and the scenes (B,) of ``searching`` that moved: Armijo backtracking, scene by scene.

    Args:
        slope: (B,) J, of the potential along the path at its start.
    """
    length = torch.ones_like(slope)
    searching, moved, result = searching & (slope < 0), torch.zeros_like(searching), now
    for _ in range(BACKTRACKS):
        if not bool(searching.any()):
            break
        trial, taken = path.reached(length * searching, now.phi + ARMIJO * length * slope + now.noise)
        length = torch.where(searching, taken, length)
        accepted = searching & (trial.phi <= now.phi + ARMIJO * length * slope + now.noise)
        if bool(accepted.all()):
            return trial, accepted
        result = unknowns.select(accepted, trial, result)
        moved, searching = moved | accepted, searching & ~accepted
        length = torch.where(searching, shorter(length, slope, trial.phi - now.phi), length)
    return result, moved


def shorter(length: Tensor, slope: Tensor, rise: Tensor) -> Tensor:
    """Step length (B,) at the minimum of the parabola through what is known, between a tenth and a half of the last."""
    excess = rise - length * slope
    usable = torch.isfinite(excess) & (excess > 0)
    parabola = torch.where(usable, -0.5 * slope * length**2 / torch.where(usable, excess, 1.0), 0.1 * length)
    return torch.minimum(torch.maximum(parabola, 0.1 * length), 0.5 * length)
