"""Cloth near cloth: pairs of features that may come near each other, and how far vertices may move before two of them meet.

A pair is a vertex and a face, or two edges, of one mesh, without a common vertex. The work is done in ``hood/native/layers.h``;
nothing of it is shared with :mod:`hood.mesh.penetration.crossing`, which counts what passes through what.

Held vertices that cloth is in the way of: how far they come in a step before cloth meets cloth.
"""

from __future__ import annotations

import ctypes
import weakref
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hood import native
from hood.mesh import topology
from hood.mesh.flat import flat_mesh
from hood.native.arguments import COUNT, POINTER, REAL, fields, num_parts
from hood.native.build import LAYER_FLAGS, build

_SOURCE = Path(native.__file__).with_name("layers.cpp")
#: Of the distance of two features at least this share is left by one move.
LEFT = 0.1
#: How far vertices may be off the ways that the list of pairs was made for: a share of half of the smallest height of a face
#: around, and at most so much [m].
SHARE, MARGIN = 0.3, 5e-3
#: Beyond its reach by so much [m] a pair is apart after any shift of all cloth, rounded as it may be.
SPARE = 1e-6
#: Faces that are worth a thread in a search for pairs.
_FACES = 1000
#: Share of a move that is left where features would meet, below which it is bent around them (:meth:`Layers.ease`).
EASED = 0.1


class _Mesh(ctypes.Structure):
    _fields_ = [
        *fields("num_vertices num_faces num_edges", COUNT),
        *fields("faces edges face_vertex face_edge order piece reach vertex_area edge_area edge_length_sq topology", POINTER),
    ]


@cache
def library() -> ctypes.CDLL:
    """The compiled search.

    Raises:
        hood.native.build.BuildError: there is no compiler, or it fails.
    """
    lib = build(_SOURCE, LAYER_FLAGS)
    lib.layers_make.restype = POINTER
    lib.layers_make.argtypes = [*[POINTER] * 5, REAL, *[COUNT] * 3]
    lib.layers_topology.restype = POINTER
    for name in ("topology", "topology_free", "free"):
        getattr(lib, f"layers_{name}").argtypes = [POINTER]
    lib.layers_crossed.argtypes = [POINTER]
    lib.layers_pressing.argtypes = [POINTER, POINTER]
    lib.layers_approach.argtypes = [POINTER, POINTER, REAL]
    lib.layers_resort.argtypes = [POINTER, POINTER]
    lib.layers_fixed_are_free.argtypes = [POINTER, POINTER, POINTER, REAL, REAL]
    lib.layers_follow.argtypes = [POINTER, POINTER, REAL, POINTER]
    for name in ("layers_limit", "layers_ease"):
        getattr(lib, name).argtypes = [POINTER, POINTER, POINTER, REAL]
    lib.layers_restart.argtypes = [POINTER]
    lib.layers_apart.argtypes = [POINTER, POINTER, REAL]
    lib.layers_free_way.argtypes = [*[POINTER] * 3, REAL, REAL]
    for name in ("crossed", "apart", "free_way", "approach", "follow", "model", "fixed_are_free"):
        getattr(lib, f"layers_{name}").restype = COUNT
    for name in ("layers_limit", "layers_energy"):
        getattr(lib, name).restype = REAL
    for name, count in (("energy", 2), ("model", 2), ("contacts", 5), ("forces", 3), ("rows", 2), ("counts", 3)):
        getattr(lib, f"layers_{name}").argtypes = [POINTER] * count
    lib.layers_number.restype = POINTER
    lib.layers_number.argtypes = [POINTER, POINTER, COUNT]
    return lib


class _Apart(NamedTuple):
    """Positions where nothing is near or through anything, with :data:`SPARE` to spare."""

    pos: np.ndarray  # (V, 3) m
    held: np.ndarray  # (V,) vertices of pairs that do not count if it is all four
    between: bool


class LayerMesh:
    """What is constant as long as a cloth: which face answers for which vertex and edge, areas, and reaches.

    Args:
        rest_pos: (V, 3) m.
        faces: (F, 3).
        reach: m, distance at which features are near each other. Where faces are small it is half of the smallest height of
            the faces around: at rest nothing is near anything.
        flat: (F, 2, 2) m, edges x₁ - x₀ and x₂ - x₀ of the faces in a flat pattern, where lengths and areas are those of one.
    """

    def __init__(self, rest_pos: np.ndarray, faces: np.ndarray, reach: float, flat: np.ndarray | None = None) -> None:
        rest, faces = np.asarray(rest_pos, np.float64), np.asarray(faces, np.int64)
        edges = topology.unique_edges(faces)
        sides = topology.edge_index(edges, faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)).reshape(-1, 3)
        length = np.linalg.norm(rest[edges[:, 1]] - rest[edges[:, 0]], axis=1)
        normal = np.cross(rest[faces[:, 1]] - rest[faces[:, 0]], rest[faces[:, 2]] - rest[faces[:, 0]])
        area = 0.5 * np.linalg.norm(normal, axis=1)
        if flat is not None:
            area = 0.5 * np.abs(np.linalg.det(flat))
            ways = np.linalg.norm(np.stack([flat[:, 0], flat[:, 1] - flat[:, 0], flat[:, 1]], axis=1), axis=2).reshape(-1)
            count = np.bincount(sides.reshape(-1), minlength=len(edges))
            length = np.bincount(sides.reshape(-1), ways, minlength=len(edges)) / np.maximum(count, 1)
        thirds = np.repeat(area / 3.0, 3)
        self.room = vertex_room(rest, faces)
        if flat is not None:
            corners, own = flat_mesh(flat)
            self.room = np.full(len(rest), np.inf)
            np.minimum.at(self.room, faces.reshape(-1), vertex_room(corners, own))
        self._arrays = {  # in the order of the structure
            "faces": np.ascontiguousarray(faces, np.int32),
            "edges": np.ascontiguousarray(edges, np.int32),
            "face_vertex": _answered(faces, len(rest)),
            "face_edge": _answered(sides, len(edges)),
            "order": _order(rest[faces].mean(axis=1)),
            "piece": topology.connected_components(len(rest), edges).astype(np.int32),
            "reach": np.minimum(self.room, reach),
            "vertex_area": np.bincount(faces.reshape(-1), thirds, minlength=len(rest)),
            "edge_area": np.bincount(sides.reshape(-1), thirds, minlength=len(edges)),
            "edge_length_sq": length**2,
        }
        self.apart: _Apart | None = None  # where a step has ended lately
        self.num_vertices, self.num_faces, self.reach = len(rest), len(faces), self._arrays["reach"]  # reach (V,) m
        counts = len(rest), len(faces), len(edges)
        self._structure = _Mesh(*counts, *(self._arrays[name].ctypes.data for name in self._arrays))

    @cached_property
    def address(self) -> int:
        """Of the structure that the compiled search reads, as long as this lives."""
        lib, address = library(), ctypes.addressof(self._structure)
        topology = lib.layers_topology(address)
        weakref.finalize(self, lib.layers_topology_free, topology)
        self._structure.topology = topology
        return address

    def known_apart(self, pos: np.ndarray, held: np.ndarray, between: bool) -> bool:
        """Whether ``pos`` (V, 3) are the positions :attr:`apart`, moved as a whole."""
        known = self.apart
        if known is None or known.between != between or not np.array_equal(known.held, held):
            return False
        if np.array_equal(pos, known.pos):
            return True
        with np.errstate(invalid="ignore"):  # no number is less
            shift = pos - known.pos
            return bool(np.abs(shift - shift.mean(axis=0)).max(initial=0.0) < 0.1 * SPARE)


def vertex_room(rest: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Half of the smallest height [m] (V,) of the faces (F, 3) around every vertex of ``rest`` (V, 3); infinite without any."""
    corners = rest[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1, initial=0.0)
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    room = np.full(len(rest), np.inf)
    np.minimum.at(room, faces.reshape(-1), np.repeat(area / longest, 3))
    return room


def _answered(corners: np.ndarray, count: int) -> np.ndarray:
    """Of ``corners`` (F, 3) those that a face is the first to have, then -1."""
    first = np.zeros(corners.size, bool)
    first[np.unique(corners.reshape(-1), return_index=True)[1]] = True
    assert corners.size == 0 or corners.max() < count
    return -np.sort(-np.where(first.reshape(corners.shape), corners, -1), axis=1).astype(np.int32)


def _order(centre: np.ndarray) -> np.ndarray:
    """Faces (F,) in an order whose neighbours are near each other: halves along the longest axis, again and again."""
    order = np.arange(len(centre))
    stack = [(0, len(centre))]
    while stack:
        begin, end = stack.pop()
        if end - begin <= 4:
            continue
        part, middle = order[begin:end], (begin + end) // 2
        axis = int(np.ptp(centre[part], axis=0).argmax())
        order[begin:end] = part[np.argsort(centre[part, axis], kind="stable")]
        stack += [(begin, middle), (middle, end)]
    return order.astype(np.int32)


@dataclass(frozen=True)
class Contacts:
    """N pairs of features within their reach; the gap between them is Σ w_c x_c over four vertices."""

    corners: np.ndarray  # (N, 4): a vertex and a face, or two edges
    edges: np.ndarray  # (N,) bool, two edges
    weights: np.ndarray  # (N, 4)
    reach: np.ndarray  # (N,) m
    area: np.ndarray  # (N,) m² at rest that the pair stands for
    parallel: np.ndarray  # (N,) m⁴, square of the edges' cross product below which their barrier fades; 0 for others


_NO_CONTACTS = Contacts(np.empty((0, 4), np.int64), np.empty(0, bool), np.empty((0, 4)), *np.empty((3, 0)))


class Work(NamedTuple):
    """What the search of one step has come to."""

    listed: int  # pairs in the list
    left_out: int  # pairs of features that are not
    searches: int
    refreshes: int  # searches for some vertices alone
    overflowed: bool  # no list: nearly everything is near everything, in torn cloth, or a position is not finite
    # Processor time [s].
    searching: float
    limiting: float  # moves
    energies: float
    models: float

    @property
    def seconds(self) -> float:
        """All of it."""
        return self.searching + self.limiting + self.energies + self.models


class ClothSurface:
    """Cloth near cloth during one step, from positions ``pos`` (V, 3) [m] on.

    Faces that pass through each other at ``pos`` would be held there: pairs of their features are left out until they have
    come apart, and ``crossed`` is how many such pairs of faces there are.

    Args:
        fixed: (V,) bool, vertices that go where they must.
        pressure: Pa, what the barrier (:class:`hood.energies.self_contact.LayerBarrier`) scales with.
        between: pairs of two pieces (connected parts) of the mesh alone.
        ahead: (V, 3) m, where the step may end; near it no search is needed but the first. Default ``pos``.
    """

    def __init__(
        self,
        mesh: LayerMesh,
        pos: np.ndarray,
        fixed: np.ndarray,
        pressure: float,
        between: bool = False,
        ahead: np.ndarray | None = None,
    ) -> None:
        self.mesh, self.pressure, self._lib = mesh, pressure, library()
        start, held = _positions(pos), np.ascontiguousarray(fixed, np.uint8)
        end = start if ahead is None else _positions(ahead)
        margin = np.minimum(SHARE * mesh.room, MARGIN)
        given = (start.ctypes.data, end.ctypes.data, held.ctypes.data, margin.ctypes.data)
        self._apart = mesh.known_apart(start, held, between)
        rules = pressure, int(between), int(self._apart), num_parts(mesh.num_faces, _FACES)
        self.handle = self._lib.layers_make(mesh.address, *given, *rules)
        weakref.finalize(self, self._lib.layers_free, self.handle)
        self._held, self.between = held, between
        self._found: tuple[np.ndarray, Contacts] | None = None  # positions that were asked about last, and their pairs
        self.forced = 0  # pairs of features that held vertices drive through each other

    def begun_at(self, pos: np.ndarray) -> ClothSurface:
        """The layers of a step that begins at ``pos`` (V, 3); these here do not change."""
        return ClothSurface(self.mesh, pos, self._held, self.pressure, self.between)

    @property
    def crossed(self) -> int:
        """Pairs of faces that pass through each other where the step begins."""
        return int(self._lib.layers_crossed(self.handle))

    def restart(self) -> None:
        """Forget what has been asked so far: what comes next does not depend on it, to the bit."""
        self._found = None
        self._lib.layers_restart(self.handle)

    def remember_apart(self, pos: np.ndarray, known: bool = False) -> None:
        """Spare the next step from ``pos`` (V, 3) its search there, if nothing is near anything there, or that is known."""
        here = _positions(pos)
        if known or self._lib.layers_apart(self.handle, here.ctypes.data, SPARE):
            self.mesh.apart = _Apart(here.copy(), self._held, self.between)

    def free_way(self, now: np.ndarray, there: np.ndarray) -> tuple[bool, bool]:
        """Whether no two features meet on the straight ways from ``now`` to ``there`` (V, 3), nor are within their reach at
        their ends, and whether :data:`SPARE` is left there as well. Where not, :meth:`restart`.

        Asked first where nothing is near anything, it is a search of these ways alone, without margins: half the time.
        """
        now, there = _positions(now), _positions(there)
        answer = int(self._lib.layers_free_way(self.handle, now.ctypes.data, there.ctypes.data, LEFT, SPARE))
        return answer > 0, answer > 1

    def approach(self, target: np.ndarray) -> np.ndarray:
        """Positions (V, 3) near ``target`` (V, 3) that straight ways from the start lead to on which no two features meet.

        Vertices of pairs that would meet go on together. ``fixed`` ones are at their targets; where that leads nowhere, the
        others are taken as near as can be from where :meth:`resort_to` says. Pairs that cannot make room even so are left out
        and counted in ``forced``.
        """
        there, self._found = _positions(target).copy(), None
        self.forced += int(self._lib.layers_approach(self.handle, there.ctypes.data, LEFT))
        return there

    def fixed_are_free(self, along: np.ndarray, there: np.ndarray) -> bool:
        """Whether ``fixed`` vertices surely meet nothing where others do not move, on straight ways from ``along`` to ``there``
        (V, 3): the start moved as one body, and the same with them at their targets. Asked first of all."""
        farthest = float(np.linalg.norm(there - along, axis=1).max(initial=0.0))
        if not 2.0 * farthest < (1.0 - LEFT) * float(self.mesh.reach.min(initial=np.inf)):
            return False  # they may come to what is in no list
        if self._apart:
            return True
        ways = [_positions(pos) for pos in (along, there)]
        return bool(self._lib.layers_fixed_are_free(self.handle, *(way.ctypes.data for way in ways), farthest, LEFT))

    def resort_to(self, pos: np.ndarray) -> None:
        """Say where (V, 3) ways from the start lead on which no features meet, with ``fixed`` vertices at their targets."""
        self._lib.layers_resort(self.handle, _positions(pos).ctypes.data)

    def follow(self, target: np.ndarray) -> tuple[np.ndarray, bool]:
        """Positions (V, 3) that straight ways from the start lead to on which no two features meet, with ``fixed`` vertices as
        near to ``target`` (V, 3) as they come, where others fly to, and whether all are there. Layers that are asked this are
        good for nothing else; see :func:`hood.mesh.cloth_proximity.follow`.
        """
        there, reached = _positions(target), np.empty((self.mesh.num_vertices, 3))
        arrived = self._lib.layers_follow(self.handle, there.ctypes.data, LEFT, reached.ctypes.data)
        return reached, bool(arrived)

    def limit(self, now: np.ndarray, there: np.ndarray) -> float:
        """Share of the straight ways from ``now`` to ``there`` (V, 3) on which no two features meet: 1 for all of it."""
        now, there = _positions(now), _positions(there)
        return float(self._lib.layers_limit(self.handle, now.ctypes.data, there.ctypes.data, LEFT))

    def ease(self, now: np.ndarray, there: np.ndarray) -> np.ndarray:
        """Positions (V, 3) near ``there`` (V, 3) that straight ways from ``now`` (V, 3) lead to on which no two features meet.

        Features that would meet go on together, and lose of their ways towards each other alone; as a last resort all ways are
        shortened by the same share.
        """
        now, to = _positions(now), _positions(there).copy()
        self._lib.layers_ease(self.handle, now.ctypes.data, to.ctypes.data, LEFT)
        return to

    def energy(self, pos: np.ndarray) -> float:
        """Energy [J] of the barrier at ``pos`` (V, 3)."""
        here = _positions(pos)
        return float(self._lib.layers_energy(self.handle, here.ctypes.data))

    def contacts(self, pos: np.ndarray) -> Contacts:
        """All pairs within their reach at ``pos`` (V, 3)."""
        here = _positions(pos)
        if self._found is None or not np.array_equal(self._found[0], here):
            self._found = here.copy(), self._contacts(here)
        return self._found[1]

    def _contacts(self, here: np.ndarray) -> Contacts:
        count = int(self._lib.layers_model(self.handle, here.ctypes.data))
        if not count:
            return _NO_CONTACTS
        corners, edges = np.empty((count, 4), np.int64), np.empty(count, np.int64)
        weights, constants = np.empty((count, 4)), np.empty((count, 3))
        self._lib.layers_contacts(self.handle, *(array.ctypes.data for array in (corners, edges, weights, constants)))
        return Contacts(corners, edges != 0, weights, *np.ascontiguousarray(constants.T))

    def model(self, pos: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Gradient (V, 3) [N] at ``pos`` (V, 3), and its curvature: the sum of n nᵀ over rows n (N, 4, 3) of the vertices
        (N, 4), diagonal blocks of which are (V, 6) upper triangles."""
        found = self._contacts(_positions(pos))
        gradient, own = np.empty((self.mesh.num_vertices, 3)), np.empty((self.mesh.num_vertices, 6))
        rows = np.empty((len(found.corners), 4, 3))
        self._lib.layers_forces(self.handle, gradient.ctypes.data, own.ctypes.data)
        self._lib.layers_rows(self.handle, rows.ctypes.data)
        return gradient, rows, found.corners, own

    def number(self, row: np.ndarray, num_rows: int) -> int:
        """Name vertices by ``row`` (V,), of which those from ``num_rows`` on do not move; address of what the compiled solver
        reads (``hood/native/layer_view.h``), as long as this lives."""
        numbers = np.ascontiguousarray(row, np.int32)
        return int(self._lib.layers_number(self.handle, numbers.ctypes.data, num_rows))

    @property
    def work(self) -> Work:
        """What has been done so far."""
        counts, seconds = np.empty(5, np.int64), np.empty(4)
        self._lib.layers_counts(self.handle, counts.ctypes.data, seconds.ctypes.data)
        listed, left_out, searches, refreshes, overflowed = counts.tolist()
        return Work(listed, left_out, searches, refreshes, bool(overflowed), *seconds.tolist())


def _positions(pos: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(pos, np.float64)


#: Weight of standing still in the turn that fits held vertices: those on a line do not say how they turn about it.
_STEADY = 1e-9


class Followed(NamedTuple):
    """Where held vertices come to in a step."""

    pos: np.ndarray  # (V, 3) m, all vertices on ways on which cloth has met no cloth
    lag: np.ndarray  # (V,) m, how far held ones stop short of their targets
    seconds: float  # of processor time that searches took

    @property
    def late(self) -> bool:
        """Whether any is short of its target."""
        return bool(self.lag.any())


def follow(layers: ClothSurface, pos: np.ndarray, held: np.ndarray, target: np.ndarray) -> Followed:
    """Held vertices on their ways from ``pos`` to their targets, stopped where cloth would meet cloth.

    First all vertices turn and shift as one body with the held ones, and meet nothing. From there the held ones go straight
    to their targets. The others make way: they stay, or go where they fly, and on together with what they would meet. Where
    that is not enough, because held vertices drive layers against each other, these stop short, both sides alike; in the
    next step they go on from there. Nothing is searched for where all moves nearly as one body and no cloth is near any.

    Args:
        layers: of the step, of which nothing else has been asked yet.
        pos: (V, 3) m, where it begins.
        held: (V,) bool, at least one.
        target: (V, 3) m, finite: where held vertices shall go, and others fly.
    """
    along = _as_one_body(pos, held, target)
    there = np.where(held[:, None], target, along)
    if layers.fixed_are_free(along, there):
        return Followed(there, np.zeros(len(pos)), 0.0)
    ways = ClothSurface(layers.mesh, along, held, layers.pressure, layers.between)
    reached, arrived = ways.follow(target)
    lag = np.zeros(len(pos)) if arrived else np.where(held, np.linalg.norm(reached - target, axis=1), 0.0)
    return Followed(reached, lag, ways.work.seconds)


def _as_one_body(pos: np.ndarray, held: np.ndarray, target: np.ndarray) -> np.ndarray:
    """All vertices (V, 3) turned and shifted as the held ones are on the whole."""
    here, there = pos[held].mean(axis=0), target[held].mean(axis=0)
    spread = (target[held] - there).T @ (pos[held] - here)
    left, _, right = np.linalg.svd(spread + (_STEADY * np.abs(spread).sum() + 1e-30) * np.eye(3))
    turn = (left * [1.0, 1.0, np.linalg.det(left @ right)]) @ right
    return there + (pos - here) @ turn.T
