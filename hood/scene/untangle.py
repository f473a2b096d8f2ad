"""Layers of an outfit: which garment lies over which, and a start in which none passes through another.

Garments are drafted one by one on the bare body, so that an outfit starts with hundreds of triangles through each other.
Forces between layers keep what has been crossed, so the layers are sorted out before the first step.

Garments of an outfit that lie in the same place, as a lining made of the garment itself: none is over the other.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations, product
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from hood.assets.files.said import ProgressLines
from hood.cloth.cloth import Cloth
from hood.cloth.state import Obstacle
from hood.contact.contact import match_surface
from hood.mesh.penetration.crossing import self_crossings
from hood.mesh.topology import boundary_loops
from hood.scene.start import LazySearch, Momentum, descend, free_stretch, leave, push_out_of_body

#: Vertices nearer than this [m] are in the same place, and garments where that is more than this share of one's vertices.
#: Seams that two garments share are fewer.
_SAME, _SHARE = 1e-5, 0.5


def layers_below(pos: Tensor, piece: np.ndarray, order: Sequence[int]) -> np.ndarray:
    """On how many garments that lie in the same place each vertex of ``pos`` (V, 3) [m] comes to lie, (V,); 0 where on none.

    Args:
        piece: (V,) garment of a vertex.
        order: garments from the body outwards.
    """
    place = np.round(pos.detach().double().cpu().numpy() / _SAME).astype(np.int64)
    number = np.unique(place, axis=0, return_inverse=True)[1].reshape(-1)
    below = np.zeros(len(piece), np.int64)
    for rank, outer in enumerate(order):
        rows = np.flatnonzero(piece == outer)
        same = (np.isin(number[rows], number[piece == inner]).mean() > _SHARE for inner in order[:rank])
        below[rows] = sum(map(bool, same))
    return below


#: Distance [m] that layers are taken apart to; where triangles still cross, by so much more a round, up to the last.
_GAP, _MORE, _WIDEST = 3e-3, 1e-3, 1.5e-2
#: Rounds at most, and steps of each; crossings are counted after a round.
_ROUNDS, _STEPS = 24, 20
#: Rounds after which a way is given up that has not become better.
_PATIENCE = 8
#: Garments that do not cross go on being smoothed for so many rounds while an edge is stretched by more than the second.
_SMOOTHING, _STRETCHED = 10, 0.1
#: Garments in their likeliest order may be stretched by so much before another order is tried, half before the other share.
_ACCEPTED = 0.5
#: Times that places are smoothed at most where a garment passes through itself.
_SMOOTHED = 40
#: A vertex belongs to the other side of a layer if it is nearer than this [m].
_NEAR = 0.04
#: Share of the vertices that may lie on the other side of a garment that is held, which is still taken for the inner one.
_HELD = 0.2
#: Garments lie against an order where more than this share of the vertices that are near the other one does.
_WRONG = 0.75
#: Orders of the layers that are tried where the likeliest does not come out well.
_TRIED = 3
#: Of so many garments all orders are looked at.
_PERMUTED = 6
#: What the inner layer takes of a push: nothing, which opens folds of an outer layer, or half, which opens narrow places but
#: leaves it in folds that the first steps find hard.
_SHARES = (0.0, 0.5)


class TangledError(ValueError):
    """Garments of an outfit that cannot be taken apart."""


@dataclass(frozen=True)
class Separation:
    """Garments of an outfit taken apart."""

    pos: Tensor  # (V, 3) m
    order: tuple[int, ...]  # garments from the body outwards
    before: int  # pairs of triangles of two garments that passed through each other
    after: int  # that still do
    stretch: float  # largest relative lengthening of an edge
    turned: tuple[tuple[int, int], ...] = ()  # garments over others, which lay under them against the order that was given
    seconds: float = 0.0  # of computing
    lifted: bool = False  # whether garments lay in the same place


class Outfit(NamedTuple):
    """Garments that are one mesh."""

    cloth: Cloth  # of all of them
    faces: np.ndarray  # (F, 3)
    piece: np.ndarray  # (V,) garment of a vertex, from 0
    names: tuple[str, ...]  # of the garments


def crossing_pairs(outfit: Outfit, pos: Tensor) -> np.ndarray:
    """Pairs (N, 2) of faces of different garments that pass through each other."""
    pairs = self_crossings(pos.double().cpu().numpy(), outfit.faces)
    garment = outfit.piece[outfit.faces[:, 0]]
    return pairs[garment[pairs[:, 0]] != garment[pairs[:, 1]]]


def smooth_out(cloth: Cloth, faces: np.ndarray, pos: Tensor, obstacle: Obstacle | None, clearance: float) -> Tensor:
    """``pos`` (V, 3) [m] with the places smoothed where triangles of a single garment pass through each other, as an armpit
    may when it is put on; the best that was found, itself where nothing crosses.

    A vertex of such a triangle, or beside one, goes half the way to the mean of its neighbours, and out of the body again.
    """
    best, least, found = pos, None, 0
    start, end = cloth.edges.unbind(dim=1)
    both, other = torch.cat([start, end]), torch.cat([end, start])
    count = torch.zeros_like(pos[:, 0]).index_add(0, both, torch.ones_like(pos[:, 0])[both]).clamp_min(1.0)[:, None]
    progress = ProgressLines("smoothing places where the garment passes through itself")
    for turn in range(_SMOOTHED):
        pairs = self_crossings(pos.double().cpu().numpy(), faces)
        progress.tell(f"round {turn + 1} of at most {_SMOOTHED}, {len(pairs)} pairs of triangles are left")
        if least is None or len(pairs) < least:
            best, least, found = pos, len(pairs), turn
        if len(pairs) == 0 or turn - found >= _PATIENCE:
            break
        near = torch.zeros_like(cloth.free)
        near[torch.as_tensor(np.unique(faces[pairs.reshape(-1)]))] = True
        near = near.index_put((both[near[other]],), torch.tensor(True)) & cloth.free
        mean = torch.zeros_like(pos).index_add(0, both, pos[other]) / count
        pos = push_out_of_body(cloth, torch.where(near[:, None], 0.5 * (pos + mean), pos), obstacle, clearance)
    return best


def separate(
    outfit: Outfit, pos: Tensor, obstacle: Obstacle | None, clearance: float, order: Sequence[int] | None = None
) -> Separation:
    """The garments at ``pos`` (V, 3) [m] taken apart, at least ``clearance`` [m] outside the body.

    Steps alternate edge-length projections with pushes: out of the body, and of the vertices of one layer to their side of
    the nearest triangle of another, which gives way as much where nothing else helps, or alone where the vertex is held. What
    still crosses after a round is pushed farther; once nothing does, steps are carried on with momentum
    (:class:`hood.scene.start.Momentum`), for some rounds or until no edge is stretched by more than a tenth. Matches on the
    rim of a layer that lie more than 45 degrees beside it are none: cloth beyond a hem has no side.

    Args:
        order: garments from the body outwards, also of those that lie the other way without touching; None: the likeliest of
            :func:`likely_orders` that comes out well.

    Raises:
        TangledError: triangles of two garments still cross, or a garment is not over another one that ``order`` has it over.
    """
    began = time.perf_counter()
    given, pos = pos, _lifted(outfit, pos, obstacle, order)
    before = len(crossing_pairs(outfit, pos))
    turned = () if order is None else _against(outfit, pos, obstacle, tuple(order))
    if before == 0 and not turned:
        chosen = tuple(order) if order is not None else likely_orders(outfit, pos, obstacle)[0]
        return Separation(pos, chosen, 0, 0, _longest(outfit, pos), lifted=pos is not given)
    orders = [tuple(order)] if order is not None else likely_orders(outfit, pos, obstacle)[:_TRIED]
    best: Separation | None = None
    for tried, inner_share in product(orders, _SHARES):
        now = _take_apart(outfit, pos, obstacle, clearance, tried, inner_share, before, turned)
        if best is None or (now.after, now.stretch) < (best.after, best.stretch):
            best = now
        # Settling relaxes what is stretched; a less likely order is worn for the whole rollout.
        bound = _ACCEPTED if inner_share == _SHARES[-1] else 0.5 * _ACCEPTED
        if best.after == 0 and best.stretch <= bound:
            break
    assert best is not None
    if best.after:
        raise TangledError(_refusal(outfit, best, obstacle))
    return replace(best, seconds=time.perf_counter() - began, lifted=pos is not given)


def _lifted(outfit: Outfit, pos: Tensor, obstacle: Obstacle | None, order: Sequence[int] | None) -> Tensor:
    """Garments that lie in the same place one over the other, in the order given or in that of the outfit."""
    below = layers_below(pos, outfit.piece, range(len(outfit.names)) if order is None else order)
    if not below.any():
        return pos
    outside = torch.zeros_like(pos)
    for sheet in _sheets(outfit, pos, obstacle):
        own = match_surface(pos[sheet.vertices], torch.zeros(len(sheet.vertices), dtype=torch.long), sheet.obstacle(pos))
        outside[sheet.vertices] = own.normal
    return pos + (_GAP * torch.as_tensor(below).to(pos) * outfit.cloth.free.to(pos)).unsqueeze(1) * outside


def _against(outfit: Outfit, pos: Tensor, obstacle: Obstacle | None, order: tuple[int, ...]) -> tuple[tuple[int, int], ...]:
    """Pairs (over, under) of an order whose vertices, where they are near each other, lie the other way round."""
    sheets, found = _sheets(outfit, pos, obstacle), []
    for under, over in combinations(order, 2):
        right = sheets[under].match(pos, sheets[over].vertices).over
        other = -sheets[over].match(pos, sheets[under].vertices).over
        height = torch.cat([right, other])
        if int((height < 0).sum()) > _WRONG * len(height):
            found.append((over, under))
    return tuple(found)


def likely_orders(outfit: Outfit, pos: Tensor, obstacle: Obstacle | None) -> list[tuple[int, ...]]:
    """All orders of the garments, from the body outwards, the likeliest first: by how many vertices lie on the side that the
    order gives them. Where that leaves it open a garment with held vertices lies under one without: what it holds to the body
    has no room beneath."""
    sheets = _sheets(outfit, pos, obstacle)
    count = len(outfit.names)
    outside = np.zeros((count, count))
    for a, b in combinations(range(count), 2):
        for over, under in ((a, b), (b, a)):
            height = sheets[under].match(pos, sheets[over].vertices).over
            outside[over, under] += float((height > 0).sum() - (height < 0).sum())
            held = [bool(outfit.cloth.pinned[sheets[garment].vertices].any()) for garment in (under, over)]
            outside[over, under] += _HELD * len(height) * (held[0] - held[1])
    if count > _PERMUTED:
        return [_from_inside(np.maximum(outside - outside.T, 0.0))]
    return sorted(
        permutations(range(count)),
        key=lambda order: -sum(outside[over, under] - outside[under, over] for under, over in combinations(order, 2)),
    )


def _from_inside(over: np.ndarray) -> tuple[int, ...]:
    """An order of many garments, where all orders are too many to compare: next comes the one that lies least over those left,
    by how much (C, C) each lies over each."""
    left, order = list(range(len(over))), []
    while left:
        order.append(min(left, key=lambda one: float(over[one, left].sum())))
        left.remove(order[-1])
    return tuple(order)


class _Match(NamedTuple):
    corners: Tensor  # (N, 3) vertices
    bary: Tensor  # (N, 3)
    height: Tensor  # (N,) m, over the surface
    normal: Tensor  # (N, 3)
    valid: Tensor  # (N,) bool

    @property
    def over(self) -> Tensor:
        """Heights of the valid ones."""
        return self.height[self.valid]


class _Sheet:
    """The surface of one garment, its outside away from the body."""

    def __init__(self, outfit: Outfit, garment: int) -> None:
        faces = outfit.faces[outfit.piece[outfit.faces[:, 0]] == garment]
        self.vertices = torch.as_tensor(np.flatnonzero(outfit.piece == garment))
        self._faces = torch.as_tensor(faces)
        self._rim = torch.zeros(len(outfit.piece), dtype=torch.bool)
        for loop in boundary_loops(faces):
            self._rim[torch.as_tensor(loop)] = True

    def turn(self) -> None:
        """Make the other side the outside."""
        self._faces = self._faces.flip(1)

    def obstacle(self, pos: Tensor) -> Obstacle:
        none = torch.zeros(len(pos), dtype=torch.long)
        return Obstacle(pos, pos, pos, self._faces, none, torch.zeros(len(self._faces), dtype=torch.long), none.bool())

    def within_reach(self, pos: Tensor, rows: Tensor) -> Tensor:
        """Those of the vertices ``rows`` (N,) that are in the box around this surface; to the others no match is valid."""
        low, high = (edge(pos[self.vertices], dim=0) for edge in (torch.amin, torch.amax))
        at = pos[rows]
        return rows[((at >= low - _NEAR) & (at <= high + _NEAR)).all(dim=1)]

    def match(self, pos: Tensor, rows: Tensor) -> _Match:
        """Where the vertices ``rows`` (N,) are over this surface, both at ``pos`` (V, 3)."""
        found = match_surface(pos[rows], torch.zeros(len(rows), dtype=torch.long), self.obstacle(pos))
        corners, offset = self._faces[found.face], pos[rows] - found.point
        height = (offset * found.normal).sum(dim=1)
        beside = (offset - height[:, None] * found.normal).norm(dim=1)
        inside = found.bary > 1e-6
        on_rim = (self._rim[corners] | ~inside).all(dim=1) & ~inside.all(dim=1)
        near = found.dist.abs() <= _NEAR
        return _Match(corners, found.bary, height, found.normal, near & ~(on_rim & (beside > height.abs())))


def _sheets(outfit: Outfit, pos: Tensor, obstacle: Obstacle | None) -> list[_Sheet]:
    sheets = [_Sheet(outfit, garment) for garment in range(len(outfit.names))]
    if obstacle is None:
        return sheets
    body = match_surface(pos, torch.zeros(len(pos), dtype=torch.long), obstacle)
    for sheet in sheets:
        own = match_surface(pos[sheet.vertices], torch.zeros(len(sheet.vertices), dtype=torch.long), sheet.obstacle(pos))
        if float((own.normal * body.normal[sheet.vertices]).sum()) < 0:
            sheet.turn()
    return sheets


def _take_apart(
    outfit: Outfit,
    pos: Tensor,
    obstacle: Obstacle | None,
    clearance: float,
    order: tuple[int, ...],
    inner_share: float,
    before: int,
    turned: tuple[tuple[int, int], ...],
) -> Separation:
    """The garments apart in one order; the best of the rounds. What is not yet as the order has it counts as one crossing."""
    course = _Course(outfit, pos, obstacle, clearance, order)
    best, found, clean = Separation(pos, order, before, before + len(turned), _longest(outfit, pos), turned), 0, 0
    progress = ProgressLines("taking garments apart")
    for number in range(_ROUNDS):
        progress.tell(f"round {number + 1} of at most {_ROUNDS}, {best.after} pairs of triangles are left")
        course.round(inner_share, lengths=number > 0, carried=clean > 0)
        ended = push_out_of_body(outfit.cloth, course.pos, obstacle, clearance)
        pairs = crossing_pairs(outfit, ended)
        left = len(pairs) + (len(_against(outfit, ended, obstacle, order)) if turned else 0)
        now = Separation(ended, order, before, left, _longest(outfit, ended), turned)
        if (now.after, now.stretch) < (best.after, best.stretch):
            best, found = now, number
        clean += now.after == 0
        done = now.after == 0 and (now.stretch <= _STRETCHED or clean > _SMOOTHING)
        if done or number - found >= _PATIENCE:
            break
        course.widen(pairs)
    return best


class _Course:
    """The way of an outfit's garments apart, in rounds of steps."""

    def __init__(
        self, outfit: Outfit, pos: Tensor, obstacle: Obstacle | None, clearance: float, order: tuple[int, ...]
    ) -> None:
        self._outfit, self._order, self._clearance = outfit, order, clearance
        cloth, self._sheets = outfit.cloth, _sheets(outfit, pos, obstacle)
        self._rest_length = cloth.rest_length
        self._weight = torch.ones_like(self._rest_length)
        self._gap = torch.full_like(pos[:, 0], _GAP)
        self._search, self._course = LazySearch(cloth, obstacle), Momentum(pos)

    @property
    def pos(self) -> Tensor:
        """(V, 3) m, where the garments are."""
        return self._course.pos

    def round(self, inner_share: float, lengths: bool, carried: bool) -> None:
        """Steps in which the inner of two layers takes ``inner_share`` of the push, edges get their ``lengths`` back or not,
        and steps are ``carried`` on or not."""
        if not carried:
            self._course.stop(self.pos)
        cloth = self._outfit.cloth
        for _ in range(_STEPS):
            pos = self._course.ahead
            pos = descend(cloth, pos, self._weight, self._rest_length) if lengths else pos
            contact = self._search(pos)
            pos = self._layered(pos if contact is None else leave(cloth, pos, contact, self._clearance), inner_share)
            if carried:
                self._course.go(pos)
            else:
                self._course.stop(pos)

    def _layered(self, pos: Tensor, inner_share: float) -> Tensor:
        """``pos`` (V, 3) with every layer pushed to its side of every other one."""
        for inner, outer in combinations(self._order, 2):
            over, under = self._sheets[outer], self._sheets[inner]
            pos = _apart(self._outfit.cloth, pos, over.vertices, under, self._gap, 1.0, 1.0 - inner_share)
            pos = _apart(self._outfit.cloth, pos, under.vertices, over, self._gap, -1.0, inner_share)
        return pos

    def widen(self, pairs: np.ndarray) -> None:
        """Take the faces of ``pairs`` (N, 2), which cross, farther apart in the next rounds."""
        crossed = torch.as_tensor(np.unique(self._outfit.faces[pairs.reshape(-1)]))
        self._gap[crossed] = (self._gap[crossed] + _MORE).clamp_max(_WIDEST)


def _apart(cloth: Cloth, pos: Tensor, rows: Tensor, sheet: _Sheet, gap: Tensor, side: float, share: float) -> Tensor:
    """``pos`` (V, 3) with the vertices ``rows`` (N,) on a side of a sheet, +1 its outside, by their ``gap`` (V,) [m];
    ``share`` of the way is theirs, the rest the sheet's. What several ask of a vertex is averaged."""
    rows = sheet.within_reach(pos, rows)
    match = sheet.match(pos, rows)
    lacking = (gap[rows] - side * match.height).clamp_min(0.0) * match.valid
    touched = lacking > 0
    match, rows, lacking = _Match(*(values[touched] for values in match)), rows[touched], lacking[touched]
    free = cloth.free.to(pos.dtype)
    point, surface = free[rows], (match.bary * free[match.corners]).sum(dim=1)
    both = point * share + surface * (1.0 - share)
    own = torch.where(both > 0, point * share / both.clamp_min(1e-9), point)
    move = side * lacking[:, None] * match.normal
    load = match.bary * free[match.corners]
    target = torch.cat([rows, match.corners.reshape(-1)])
    asked = torch.cat([point, load.reshape(-1)])
    corner_moves = -((1.0 - own)[:, None] * move).repeat_interleave(3, dim=0)
    moves = asked[:, None] * torch.cat([own[:, None] * move, corner_moves])
    total = torch.zeros_like(pos).index_add(0, target, moves)
    count = torch.zeros_like(pos[:, 0]).index_add(0, target, asked)
    return pos + total / count.clamp_min(1e-9)[:, None]


def _longest(outfit: Outfit, pos: Tensor) -> float:
    return float(free_stretch(outfit.cloth, pos).max()) if len(outfit.cloth.edges) else 0.0


def _refusal(outfit: Outfit, best: Separation, obstacle: Obstacle | None) -> str:
    garments = outfit.piece[outfit.faces[:, 0]][crossing_pairs(outfit, best.pos)]
    if not len(garments):
        over, under = (outfit.names[garment] for garment in _against(outfit, best.pos, obstacle, best.order)[0])
        return (
            f"outfit: {over!r} lies under {under!r} at the start, not over it as the layers have it, and could not be brought "
            "there; give them from the body outwards as they lie, or layers=auto"
        )
    named = sorted({tuple(sorted((outfit.names[a], outfit.names[b]))) for a, b in garments.tolist()})
    through = ", ".join(f"{a!r} and {b!r}" for a, b in named)
    return (
        f"outfit: {len(garments)} pairs of triangles of {through} pass through each other at the start and could not be taken "
        "apart; give the layers from the body outwards (layers=[inner,outer]), free their pins (pins=none), start from another "
        "frame or a standing pose (start=…, blend_in=3), or simulate without contact between layers (cloth_contact=off)"
    )
