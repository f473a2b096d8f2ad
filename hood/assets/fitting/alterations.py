"""Repairs of a garment file, step by step; each step returns the garment and a report with counts."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from hood.assets.fitting.placement import Placement
from hood.assets.fitting.suspicions import suspect_sides
from hood.assets.garment.binding import PosedBody, bind_posed, push_out, signed_distances
from hood.assets.garment.garment import Garment
from hood.assets.garment.record import Fitting
from hood.mesh import topology
from hood.mesh.editing import repair
from hood.mesh.editing.repair import turn_caps
from hood.mesh.flat import SIDE_TABLES

#: A garment whose middle vertex is farther from the skin than this [m] was made for another place or body.
_FARTHEST = 0.35
#: With more of its vertices inside the body it does not surround it.
_MOST_INSIDE = 0.5
#: How far [m] an open edge that lies on another one is drawn back, but by no more than a share of the way to its neighbours.
OPENING, _MOST_OPENED = 1e-4, 0.05
#: Edges shorter than this share of the median edge join their ends.
SHORT = 1e-3


def place(fitting: Fitting, placement: Placement) -> None:
    """Bring the coordinates of the file to the body: scaled to metres, turned, moved."""
    garment = fitting.garment
    turn, skin_pos, rest_turn = placement.rotation, garment.skin_pos, garment.rest_turn
    fitting.garment = replace(
        garment,
        rest_pos=placement.apply(garment.rest_pos),
        skin_pos=None if skin_pos is None else placement.apply(skin_pos),
        rest_turn=None if rest_turn is None else turn @ rest_turn @ turn.T,
        riders=None if garment.riders is None else replace(garment.riders, pos=placement.apply(garment.riders.pos)),
        thickness=None if garment.thickness is None else placement.scale * garment.thickness,
        flat=None if garment.flat is None else placement.scale * garment.flat,
    )
    count, offset = len(garment.rest_pos), np.round(placement.offset, 4).tolist()
    if placement.scale != 1.0:
        fitting.note("scaled", count, f"scaled by {placement.scale:g}", factor=placement.scale)
    if placement.up != "y":
        fitting.note("turned", count, f"turned from {placement.up} up to y up")
    if placement.turn:
        fitting.note("faced", count, f"turned by {placement.turn:g} degrees about the vertical", degrees=placement.turn)
    if np.any(placement.offset):
        fitting.note("moved", count, f"moved by {offset} m", offset=offset)


def sew(fitting: Fitting, tolerance: float | None, left_out: np.ndarray | None = None) -> None:
    """Weld boundary vertices within ``tolerance`` [m], but for those in ``left_out`` and those of fasteners; None: a thousandth
    of the median edge."""
    garment = fitting.garment
    if tolerance is None:
        tolerance = repair.weld_tolerance(garment.rest_pos, garment.faces)
    sides = [*(garment.fasteners or {}).values(), *([] if left_out is None else [left_out])]
    open_edges = np.concatenate([np.zeros(0, dtype=np.int64), *(pairs.reshape(-1) for pairs in sides)])
    welded = repair.weld(garment.rest_pos, garment.faces, tolerance, open_edges)
    count = len(garment.rest_pos) - len(welded.kept)
    if count:
        fitting.garment = keep_vertices(garment, welded.vertex_map[garment.faces], welded.kept, welded.vertex_map)
        fitting.vertex_map = np.where(fitting.vertex_map < 0, -1, welded.vertex_map[fitting.vertex_map])
    fitting.note("welded", count, f"welded {count} vertices on seams, within {1e3 * tolerance:.2g} mm", tolerance=tolerance)


def drop_faces(fitting: Fitting, kept: np.ndarray, thickness: np.ndarray | None = None) -> None:
    """Keep the faces ``kept`` (F,) bool, and of the vertices all but those that lose their last face; ``thickness`` (V,) is a
    new field of the garment where it is given."""
    garment = fitting.garment if thickness is None else replace(fitting.garment, thickness=thickness)
    gone = repair.isolated_vertices(len(garment.rest_pos), garment.faces[kept])
    gone &= ~repair.isolated_vertices(len(garment.rest_pos), garment.faces)
    number = np.where(gone, -1, np.cumsum(~gone) - 1)
    left = keep_faces(garment, kept)
    fitting.garment = keep_vertices(left, number[left.faces], np.flatnonzero(~gone), number) if gone.any() else left
    fitting.vertex_map = np.where(fitting.vertex_map < 0, -1, number[fitting.vertex_map])


def clean(fitting: Fitting) -> None:
    """Remove faces without area, duplicate faces and unused vertices; turn faces over that lie against their neighbours."""
    garment = fitting.garment
    broken = repair.broken_faces(garment.rest_pos, garment.faces)
    garment = keep_faces(garment, ~broken)
    duplicate = repair.duplicate_faces(garment.faces)
    garment = keep_faces(garment, ~duplicate)
    if len(garment.faces) == 0:
        raise ValueError(f"{garment.name}: no face has an area; nothing is left of the garment")
    flipped = repair.flipped_faces(garment.faces)
    garment = _turn_faces(garment, flipped)
    alone = repair.isolated_vertices(len(garment.rest_pos), garment.faces)
    number = np.where(alone, -1, np.cumsum(~alone) - 1)
    kept = np.flatnonzero(~alone)
    fitting.garment = keep_vertices(garment, number[garment.faces], kept, number) if alone.any() else garment
    fitting.vertex_map = np.where(fitting.vertex_map < 0, -1, number[fitting.vertex_map])
    for what, mask, text in (
        ("removed_broken_faces", broken, "removed {} faces without area"),
        ("removed_duplicate_faces", duplicate, "removed {} duplicate faces"),
        ("turned_faces", flipped, "turned {} faces over, their winding was against their neighbours'"),
        ("removed_unused_vertices", alone, "removed {} vertices of no face"),
    ):
        fitting.note(what, int(mask.sum()), text.format(int(mask.sum())))


def face_out(fitting: Fitting, surface: np.ndarray, body_faces: np.ndarray) -> None:
    """Turn all faces over where the garment is inside out on the body (W, 3) [m], ``body_faces`` (G, 3)."""
    garment = fitting.garment
    pos = garment.worn_pos
    if suspect_sides(pos, garment.faces, surface, body_faces):
        count = len(garment.faces)
        fitting.garment = _turn_faces(garment, np.ones(count, dtype=bool))
        fitting.note("turned_inside_out", count, f"turned all {count} faces over: the garment was inside out")


def leave_body(fitting: Fitting, posed: PosedBody, clearance: float) -> np.ndarray:
    """Positions (V, 3) [m] with the vertices that lie inside the posed body moved straight out to ``clearance`` [m].

    Only these positions move. The garment keeps its rest shape: the lengths and angles that it was made with.

    Raises:
        ValueError: the garment is not around this body at all.
    """
    garment = fitting.garment
    dist = signed_distances(garment.rest_pos, posed.surface, posed.faces)
    inside = float((dist < 0).mean())
    if np.median(np.abs(dist)) > _FARTHEST or inside > _MOST_INSIDE:
        gap = posed.surface.mean(axis=0) - garment.rest_pos.mean(axis=0)
        raise ValueError(
            f"{garment.name}: does not surround the body ({100 * inside:.0f}% of the vertices inside, the middle one "
            f"{np.median(np.abs(dist)):.2f} m from the skin, centres {np.round(gap, 2).tolist()} m apart); "
            "check scale, up, offset and pose"
        )
    pushed = push_out(garment.rest_pos, posed.surface, posed.faces, clearance)
    fitting.note(
        "pushed_out",
        pushed.num_inside,
        f"{pushed.num_inside} vertices ({100 * inside:.1f}%) lie inside the body, the deepest {1e3 * pushed.depth:.1f} mm: "
        "they start outside, the rest shape stays",
        depth=pushed.depth,
    )
    # Vertices that are merely nearer than the clearance were where their maker wanted them.
    return np.where((dist < 0)[:, None], pushed.pos, garment.rest_pos)


def bind(fitting: Fitting, posed: PosedBody, worn_pos: np.ndarray) -> None:
    """Bind to the body in the pose and shape the garment was made in, worn at ``worn_pos`` (V, 3) [m] there."""
    fitting.garment = bind_posed(fitting.garment, posed, worn_pos)


def length_ratios(fitting: Fitting, betas: np.ndarray) -> np.ndarray:
    """Rest lengths (E',) of the garment on a body of shape ``betas``, over those in its file, scaled to metres.

    Edges that are no longer there do not count: those that welding closed and those of removed vertices.
    """
    file, garment = fitting.file, fitting.garment
    edges = topology.unique_edges(file.faces)
    factor = math.prod(change.details["factor"] for change in fitting.changes if change.what == "scaled")
    before = factor * _lengths(file.rest_pos, edges)
    ends = fitting.vertex_map[edges]
    kept = (ends >= 0).all(axis=1) & (ends[:, 0] != ends[:, 1]) & (before > 0)
    rest_pos = garment.shaped(betas) if garment.bound and not file.bound else garment.rest_pos
    return _lengths(rest_pos, ends[kept]) / before[kept]


def _lengths(pos: np.ndarray, edges: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.norm(pos[edges[:, 1]] - pos[edges[:, 0]], axis=1))


def summary(garment: Garment) -> str:
    """Size of a garment in one line."""
    edges = topology.unique_edges(garment.faces)
    used = ~repair.isolated_vertices(len(garment.rest_pos), garment.faces)
    parts = len(np.unique(topology.connected_components(len(garment.rest_pos), edges)[used]))
    openings = len(topology.boundary_loops(garment.faces))
    return f"{len(garment.rest_pos)} vertices, {len(garment.faces)} triangles, {parts} component(s), {openings} openings"


def piece_of(garment: Garment, kept: np.ndarray) -> Garment:
    """The piece of a garment that its faces ``kept`` (F,) bool are, with the vertices that they use; without texture."""
    left = keep_faces(replace(garment, uv=None, uv_faces=None, normal_faces=None, riders=None), kept)
    used = np.zeros(len(garment.rest_pos), dtype=bool)
    used[left.faces] = True
    number = np.where(used, np.cumsum(used) - 1, -1)
    return keep_vertices(left, number[left.faces], np.flatnonzero(used), number)


def join_short_edges(garment: Garment) -> tuple[Garment, int]:
    """Faces whose corners lie almost in one place take one vertex for them, the first; and how many vertices are left over.

    An edge of less than :data:`SHORT` of the median one has no direction that float32 knows, and a stiffness that no step
    resolves. Vertices keep their numbers; those left over are of no face. Edges of no length are a fault of the file, which
    is refused where cloth is made of it.
    """
    if garment.flat is not None:  # lengths are those of the pattern
        return garment, 0
    edges = topology.unique_edges(garment.faces)
    lengths = _lengths(garment.rest_pos, edges)
    short = edges[(lengths > 0.0) & (lengths < SHORT * np.median(lengths))] if len(edges) else edges
    if not len(short):
        return garment, 0
    merged = repair.merge(len(garment.rest_pos), short)
    taken = merged.kept[merged.vertex_map]
    pinned = garment.pinned.copy()
    np.logical_or.at(pinned, taken, garment.pinned)
    faces = taken[garment.faces]
    whole = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    pairs = {name: taken[row] for name, row in (garment.fasteners or {}).items()}
    fasteners = {name: row[row[:, 0] != row[:, 1]] for name, row in pairs.items()} or None
    riders = None if garment.riders is None else garment.riders.renumbered(taken)
    joined = keep_faces(replace(garment, faces=faces, riders=riders), whole)
    return replace(joined, pinned=pinned, fasteners=fasteners, coarse_edges=None), len(taken) - len(merged.kept)


def turn_flat_faces(garment: Garment) -> tuple[Garment, int]:
    """Faces a corner of which lies on the opposite edge are divided anew with the face behind it; and how many there were.

    Their stiffness across is without bounds. Vertices keep their numbers. What has numbers of the sides of its faces stays.
    """
    if garment.flat is not None or any(getattr(garment, key) is not None for key in SIDE_TABLES):
        return garment, 0
    corners, parent, count = turn_caps(garment.rest_pos, garment.faces)
    if not count:
        return garment, 0
    face, corner = corners[..., 0], corners[..., 1]
    tables = {key: getattr(garment, key)[face, corner] for key in _PER_FACE if getattr(garment, key) is not None}
    panels = {name: mask[parent] for name, mask in (garment.panels or {}).items()} or None
    return replace(garment, **tables, panels=panels, coarse_edges=None), count


def part_open_seams(garment: Garment) -> tuple[Garment, int]:
    """Vertices that lie on those of another edge of the cloth are drawn back from it by :data:`OPENING`; how many are.

    Cloth that is kept apart needs a distance to begin with. The rest shape and the worn one are changed alike. What is held
    together by fasteners stays.
    """
    seen = repair.weld(garment.rest_pos, garment.faces, repair.weld_tolerance(garment.rest_pos, garment.faces))
    doubled = np.bincount(seen.vertex_map)[seen.vertex_map] > 1
    doubled[[vertex for pairs in (garment.fasteners or {}).values() for vertex in pairs.reshape(-1)]] = False
    rows = np.flatnonzero(doubled)
    if not len(rows):
        return garment, 0
    edges = topology.unique_edges(garment.faces)
    start, end = np.concatenate([edges, edges[:, ::-1]]).T
    shapes = {key: getattr(garment, key) for key in ("rest_pos", "skin_pos") if getattr(garment, key) is not None}
    for key, pos in shapes.items():
        inwards = np.zeros_like(pos)
        np.add.at(inwards, start, pos[end] - pos[start])
        inwards = inwards[rows] / np.bincount(start, minlength=len(pos))[rows, None]
        length = np.linalg.norm(inwards, axis=1, keepdims=True)
        moved = pos.copy()
        moved[rows] += inwards * np.minimum(OPENING / np.where(length > 0, length, 1.0), _MOST_OPENED)
        shapes[key] = moved
    return replace(garment, **shapes), len(rows)


_PER_VERTEX = (
    "rest_pos", "pinned", "lbs_weights", "shapedirs", "colours", "skin_pos", "rest_turn", "piece", "region", "stiffness",
    "thickness",
)  # fmt: skip
_PER_FACE = ("faces", "uv_faces", "normal_faces", "flat", *SIDE_TABLES)


def keep_vertices(garment: Garment, faces: np.ndarray, kept: np.ndarray, number: np.ndarray) -> Garment:
    """The garment with its vertices ``kept`` and ``faces`` in their numbers, where ``number`` (V,) says what became of each,
    -1 if it is gone; its coarse edges are of another mesh now."""
    rows: dict[str, Any] = {key: getattr(garment, key)[kept] for key in _PER_VERTEX if getattr(garment, key) is not None}
    pairs = {name: number[row][(number[row] >= 0).all(axis=1)] for name, row in (garment.fasteners or {}).items()}
    rows["fasteners"] = {name: row for name, row in pairs.items() if len(row)} or None
    rows["riders"] = None if garment.riders is None else garment.riders.renumbered(number)
    if garment.file_numbers is not None:
        rows["file_numbers"] = np.where(garment.file_numbers < 0, -1, number[garment.file_numbers])
    return replace(garment, **rows | {"faces": faces, "coarse_edges": None})


def keep_faces(garment: Garment, kept: np.ndarray) -> Garment:
    tables = {k: getattr(garment, k)[kept] for k in _PER_FACE if getattr(garment, k) is not None}
    panels = {name: mask[kept] for name, mask in (garment.panels or {}).items()}
    return replace(garment, **tables, panels={name: mask for name, mask in panels.items() if mask.any()} or None)


def _turn_faces(garment: Garment, turned: np.ndarray) -> Garment:
    tables = {key: getattr(garment, key).copy() for key in _PER_FACE if getattr(garment, key) is not None}
    for table in tables.values():
        table[turned] = table[turned][:, ::-1]
    if "fold" in tables:  # seen from the other side
        tables["fold"][turned] *= -1.0
    return replace(garment, **tables)
