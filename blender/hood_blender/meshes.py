"""Garments as hood reads them: triangles, rims sewn, loose vertices left out, and how Blender's vertices map to them."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from .fault import BakeError

#: Vertices of rims nearer to each other than this [m] are one.
SAME = 1e-6


class Exported(NamedTuple):
    """A garment for hood."""

    pos: np.ndarray  # (V, 3) m, y up
    faces: np.ndarray  # (F, 3)
    part: np.ndarray  # (F,) material slot of every triangle
    number_of: np.ndarray  # (N,) of every vertex in Blender its number in pos; −1: loose
    polygon_of: np.ndarray  # (F,) polygon in Blender of every triangle

    def originals(self, vertices: list[int]) -> list[int]:
        """Vertices in Blender of vertices in ``pos``."""
        return np.flatnonzero(np.isin(self.number_of, vertices)).tolist()

    def polygons(self, faces: list[int]) -> list[int]:
        """Polygons in Blender of triangles."""
        kept = [face for face in faces if 0 <= face < len(self.polygon_of)]
        return np.unique(self.polygon_of[kept]).tolist() if kept else []


def export_mesh(
    name: str, pos: np.ndarray, faces: np.ndarray, part: np.ndarray, polygon: np.ndarray, sew: float = 0.0
) -> Exported:
    """A garment of Blender for hood.

    Args:
        name: of the object, for messages.
        pos: (N, 3) m, y up, of all its vertices.
        faces: (F, 3) triangles; ``part`` (F,) their material slots, ``polygon`` (F,) what they are part of.
        sew: m, vertices of rims so near to each other become one; at least those at the same place do.

    Raises:
        BakeError: no faces, a position that is not finite, an edge of three faces, a face without area.
    """
    if not len(faces):
        raise BakeError(f"{name} has no faces; give it a mesh with faces", name)
    broken = np.flatnonzero(~np.isfinite(pos).all(axis=1))
    if len(broken):
        raise BakeError(f"{name}: vertex {broken[0]} has no finite position; delete it", name, broken.tolist())
    first = _sewn(pos, faces, max(sew, SAME))
    joined = first[faces]
    thin = np.flatnonzero(_twice_areas(pos, joined) < 1e-14)
    if len(thin):
        fix = "delete it, or choose Merge by Distance in edit mode"
        raise BakeError(f"{name}: face {polygon[thin[0]]} has no area; {fix}", name, (), np.unique(polygon[thin]).tolist())
    edges = np.sort(np.concatenate([joined[:, [0, 1]], joined[:, [1, 2]], joined[:, [2, 0]]]), axis=1)
    shared, count = np.unique(edges, axis=0, return_counts=True)
    if (count > 2).any():
        bad = shared[count > 2]
        sentence = (
            f"{name}: the edge between vertices {bad[0][0]} and {bad[0][1]} has {count.max()} faces, cloth has two at most; "
            f"delete the inner faces ({len(bad)} such edges)"
        )
        raise BakeError(sentence, name, np.unique(bad).tolist())
    used = np.unique(joined)
    number = np.full(len(pos), -1)
    number[used] = np.arange(len(used))
    return Exported(pos[used], number[joined], part, number[first], polygon)


def _twice_areas(pos: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (pos[faces[:, k]] for k in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1)


def _sewn(pos: np.ndarray, faces: np.ndarray, distance: float) -> np.ndarray:
    """(N,) of every vertex the one that it becomes: of rims, the first one within ``distance``."""
    first = np.arange(len(pos))
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    shared, count = np.unique(edges, axis=0, return_counts=True)
    rim = np.unique(shared[count == 1])
    joined = {tuple(edge) for edge in shared.tolist()}
    order = rim[np.argsort(pos[rim, 0], kind="stable")]
    along = pos[order, 0]
    for place, vertex in enumerate(order.tolist()):
        end = int(np.searchsorted(along, along[place] + distance, side="right"))
        near = order[place + 1 : end]
        near = near[np.linalg.norm(pos[near] - pos[vertex], axis=1) <= distance]
        for other in near.tolist():
            if (min(vertex, other), max(vertex, other)) not in joined:  # never the two ends of an edge
                keep, gone = sorted((int(first[vertex]), int(first[other])))
                first[first == gone] = keep
    return first


def part_names(garment: str, slots: list[str]) -> list[str]:
    """Names of material slots as names of parts for hood: letters, digits and underscores, one garment's unlike another's."""
    return [f"{garment}__{number}_{plain_name(slot)}" for number, slot in enumerate(slots)]


def plain_name(name: str) -> str:
    """``name`` in lower-case letters, digits and underscores, which no command line has to quote."""
    plain = "".join(sign if sign.isascii() and sign.isalnum() else "_" for sign in name).strip("_").lower()
    return plain or "garment"


def unlike(names: list[str]) -> list[str]:
    """Plain names, none twice."""
    found: list[str] = []
    for name in map(plain_name, names):
        number, own = 1, name
        while own in found or own == "body":
            number += 1
            own = f"{name}_{number}"
        found.append(own)
    return found


def write_obj(path: Path, mesh: Exported, parts: list[str]) -> None:
    """The garment as OBJ; its triangles keep their order, their part is a material where there are several."""
    lines = [f"o {path.stem}", *("v {:.9g} {:.9g} {:.9g}".format(*row) for row in mesh.pos.tolist())]
    last = None
    for face, part in zip((mesh.faces + 1).tolist(), mesh.part.tolist(), strict=True):
        if len(parts) > 1 and part != last:
            lines.append(f"usemtl {parts[min(part, len(parts) - 1)]}")
            last = part
        lines.append("f {} {} {}".format(*face))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def read_obj_faces(path: Path) -> np.ndarray:
    """(F, 3) triangles of an OBJ file."""
    rows = [line.split()[1:4] for line in path.read_text(encoding="ascii").splitlines() if line.startswith("f ")]
    return np.array([[int(corner.split("/")[0]) - 1 for corner in row] for row in rows]).reshape(-1, 3)
