"""Outfits: several garments joined into one mesh."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import chain, count

import numpy as np

from hood.assets.garment.garment import Garment
from hood.mesh.flat import SIDE_TABLES
from hood.mesh.parts import join_riders


def join_garments(garments: Sequence[Garment]) -> Garment:
    """The garments as one garment of several components, in their order; bound if all of them are, to the same body.

    The name joins theirs by ``+``. Garments without texture coordinates get the corner (0, 0) if another has some, those
    without colours become white. Coarse edges are kept if all have as many levels; ``piece`` says which garment a vertex is
    of. A single garment is returned as it is.
    """
    if len(garments) == 1:
        return garments[0]
    counts = [len(garment.rest_pos) for garment in garments]
    starts = np.cumsum([0, *counts[:-1]])
    bodies = {garment.bound_to for garment in garments}
    bound = all(garment.bound for garment in garments) and len(bodies) == 1
    shapes = [garment.shapedirs for garment in garments if garment.shapedirs is not None]
    num_betas = min((shape.shape[2] for shape in shapes), default=0)
    uv, uv_faces = _join_uv(garments)
    return Garment(
        name="+".join(garment.name for garment in garments),
        rest_pos=np.concatenate([garment.rest_pos for garment in garments]),
        faces=np.concatenate([garment.faces + start for garment, start in zip(garments, starts, strict=True)]),
        pinned=np.concatenate([garment.pinned for garment in garments]),
        lbs_weights=np.concatenate([_weights(garment) for garment in garments]) if bound else None,
        shapedirs=np.concatenate([shape[..., :num_betas] for shape in shapes]) if bound else None,
        bound_to=bodies.pop() if bound else None,
        uv=uv,
        uv_faces=uv_faces,
        normal_faces=_join_normals(garments),
        colours=_join_rows(garments, "colours", lambda garment: np.ones((len(garment.rest_pos), 3))),
        skin_pos=_join_rows(garments, "skin_pos", lambda garment: garment.rest_pos),
        rest_turn=_join_rows(garments, "rest_turn", lambda garment: np.tile(np.eye(3), (len(garment.rest_pos), 1, 1))),
        coarse_edges=_join_levels(garments, starts),
        piece=_join_pieces(garments),
        stiffness=_join_rows(garments, "stiffness", lambda garment: np.ones(len(garment.rest_pos))),
        region=_join_rows(garments, "region", lambda garment: np.zeros(len(garment.rest_pos), dtype=np.int64)),
        fasteners=_join_fasteners(garments, starts),
        panels=_join_panels(garments),
        flat=_join_faces(garments, "flat", np.full((3, 2), np.nan)),  # those without keep the rest shape of their mesh
        **{key: _join_faces(garments, key, np.full(3, plain)) for key, plain in SIDE_TABLES.items()},
        thickness=_join_rows(garments, "thickness", lambda garment: np.zeros(len(garment.rest_pos))),
        riders=join_riders([garment.riders for garment in garments], starts.tolist(), _uv_starts(garments)),
        file_numbers=_join_numbers(garments, starts),
    )


def _weights(garment: Garment) -> np.ndarray:
    assert garment.lbs_weights is not None
    return garment.lbs_weights


def _join_rows(garments: Sequence[Garment], key: str, default: Callable[[Garment], np.ndarray]) -> np.ndarray | None:
    """A per-vertex field of all garments; None where no garment has it."""
    tables = [getattr(garment, key) for garment in garments]
    if all(table is None for table in tables):
        return None
    return np.concatenate([default(g) if table is None else table for g, table in zip(garments, tables, strict=True)])


def _join_uv(garments: Sequence[Garment]) -> tuple[np.ndarray | None, np.ndarray | None]:
    if all(garment.uv is None for garment in garments):
        return None, None
    tables, corners, start = [], [], 0
    for garment in garments:
        uv, table = garment.uv, garment.uv_faces
        if uv is None or table is None:
            uv, table = np.zeros((1, 2)), np.zeros_like(garment.faces)
        tables.append(uv)
        corners.append(table + start)
        start += len(uv)
    return np.concatenate(tables), np.concatenate(corners)


def _uv_starts(garments: Sequence[Garment]) -> list[int]:
    """Where the texture coordinates of each begin in those of all."""
    if all(garment.uv is None for garment in garments):
        return [0] * len(garments)
    counts = [1 if garment.uv is None or garment.uv_faces is None else len(garment.uv) for garment in garments]
    return np.cumsum([0, *counts[:-1]]).tolist()


def _join_normals(garments: Sequence[Garment]) -> np.ndarray | None:
    """Smooth garments share the normals of their vertices; None where all are smooth."""
    if all(garment.normal_faces is None for garment in garments):
        return None
    tables, start = [], 0
    for garment in garments:
        table = garment.faces if garment.normal_faces is None else garment.normal_faces
        tables.append(table + start)
        start += int(table.max(initial=-1)) + 1
    return np.concatenate(tables)


def _join_pieces(garments: Sequence[Garment]) -> np.ndarray:
    """Numbers of the single garments; those of an outfit among them go on counting."""
    pieces: list[np.ndarray] = []
    for garment in garments:
        own = np.zeros(len(garment.rest_pos), dtype=np.int64) if garment.piece is None else garment.piece
        pieces.append(own + (1 + int(pieces[-1].max()) if pieces else 0))
    return np.concatenate(pieces)


def _join_fasteners(garments: Sequence[Garment], starts: np.ndarray) -> dict[str, np.ndarray] | None:
    """Rows of all garments; of two with one name the later one is called ``name_2``, and so on."""
    rows: dict[str, np.ndarray] = {}
    for garment, start in zip(garments, starts, strict=True):
        for name, pairs in (garment.fasteners or {}).items():
            rows[_free(name, rows)] = pairs + start
    return rows or None


def _join_panels(garments: Sequence[Garment]) -> dict[str, np.ndarray] | None:
    """Panels of all garments, named as :func:`_join_fasteners` names rows."""
    counts = [len(garment.faces) for garment in garments]
    panels: dict[str, np.ndarray] = {}
    for place, garment in enumerate(garments):
        for name, mask in (garment.panels or {}).items():
            others = [mask if other == place else np.zeros(size, dtype=bool) for other, size in enumerate(counts)]
            panels[_free(name, panels)] = np.concatenate(others)
    return panels or None


def _join_faces(garments: Sequence[Garment], key: str, default: np.ndarray) -> np.ndarray | None:
    """A field of faces of all garments, ``default`` for every face of those without; None where no garment has it."""
    tables = [getattr(garment, key) for garment in garments]
    if all(table is None for table in tables):
        return None
    count = [len(garment.faces) for garment in garments]
    rows = [np.broadcast_to(default, (size, *default.shape)) if t is None else t for size, t in zip(count, tables, strict=True)]
    return np.concatenate(rows)


def _free(name: str, taken: Mapping[str, np.ndarray]) -> str:
    """``name``, or ``name_2`` and so on where that is taken."""
    return next(key for key in chain([name], (f"{name}_{k}" for k in count(2))) if key not in taken)


def _join_numbers(garments: Sequence[Garment], starts: np.ndarray) -> np.ndarray | None:
    """Vertices of all files, one after the other; None where all are as in their files."""
    if all(garment.file_numbers is None for garment in garments):
        return None
    tables = [np.arange(len(g.rest_pos)) if g.file_numbers is None else g.file_numbers for g in garments]
    return np.concatenate([np.where(table < 0, -1, table + start) for table, start in zip(tables, starts, strict=True)])


def _join_levels(garments: Sequence[Garment], starts: np.ndarray) -> tuple[np.ndarray, ...] | None:
    levels = [garment.coarse_edges for garment in garments if garment.coarse_edges is not None]
    if len(levels) != len(garments) or len({len(level) for level in levels}) != 1:
        return None
    return tuple(
        np.concatenate([edges + start for edges, start in zip(level, starts, strict=True)])
        for level in zip(*levels, strict=True)
    )
