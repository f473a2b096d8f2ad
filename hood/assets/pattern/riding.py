"""Pockets, buttons and the like of a pattern: small meshes that ride on the cloth and are drawn, and no part of its simulation.

The key ``hood`` of a panel says them, lengths in the unit of the file:
``"patches": [{"name": "pocket", "outline": [[2, 0], [14, 0], [14, 15], [2, 15]]}]`` is cloth on cloth, which bends with it, and
``"buttons": [[0, 1.5], [0, 9]], "radius": 0.9`` are rigid discs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from scipy.spatial import Delaunay, cKDTree

from hood.mesh.flat import in_triangles, inside
from hood.mesh.geometry import vertex_normals
from hood.mesh.parts import Riders, join_riders, rigid_anchors

if TYPE_CHECKING:
    from hood.assets.pattern.pattern import Pattern, PatternPanel
    from hood.assets.pattern.sheet import PatternSheet

#: Patches are so thick [m], and each lies so much higher than the one before it on its panel; buttons are so thick.
_CLOTH, _HIGHER, _BUTTON = 1.5e-3, 5e-4, 3.5e-3
#: Points of their outlines are at most so far [m] from each other; the foot of a rim is at this share of the height.
_STEP, _FOOT = 8e-3, 0.1
#: Less than this [m²] is no triangle.
_NO_AREA = 1e-9
#: What a button measures that does not say [m], and the corners of its outline.
_RADIUS, _CORNERS = 9e-3, 16


@dataclass(frozen=True)
class Patch:
    """A piece on a panel, with its outline (N, 2) [m] there; ``rigid`` as a button, else it bends with the cloth."""

    name: str
    outline: np.ndarray
    rigid: bool = False

    def mirrored(self) -> Patch:
        """The same at the other side of x = 0."""
        return Patch(self.name, self.outline[::-1] * [-1.0, 1.0], self.rigid)


def button(x: float, y: float, radius: float = _RADIUS) -> Patch:
    """A button with its middle at (x, y) [m] of a panel."""
    turn = np.linspace(0.0, 2.0 * np.pi, _CORNERS, endpoint=False)
    return Patch("button", np.stack([x + radius * np.cos(turn), y + radius * np.sin(turn)], axis=1), True)


def patches_of(where: str, made: Mapping[str, Any], scale: float) -> tuple[Patch, ...]:
    """What the key ``hood`` of a panel says of patches and buttons; ``scale`` [m] is the unit of its lengths.

    Raises:
        ValueError: what is none; names ``where``, the key, the value and the repair.
    """
    patches, buttons, radius = made.get("patches", []), made.get("buttons", []), made.get("radius", _RADIUS / scale)
    if not isinstance(patches, list) or not all(isinstance(one, dict) and one.keys() <= {"name", "outline"} for one in patches):
        raise ValueError(f"{where}: hood.patches is {patches!r}; write [{{name: pocket, outline: [[x, y], …]}}, …]")
    found = []
    for number, one in enumerate(patches):
        outline = _points(f"{where}: patch {number}: outline", one.get("outline"), 3)
        found.append(Patch(str(one.get("name", "patch")), scale * outline))
    if isinstance(radius, bool) or not isinstance(radius, (int, float)) or not 1e-3 <= scale * radius <= 0.1:
        raise ValueError(f"{where}: hood.radius is {radius!r}; give a number from {1e-3 / scale:g} to {0.1 / scale:g}")
    middles = _points(f"{where}: hood.buttons", buttons, 1) if buttons != [] else np.zeros((0, 2))
    return (*found, *(button(x, y, scale * radius) for x, y in (scale * middles).tolist()))


def _points(where: str, value: Any, least: int) -> np.ndarray:
    try:
        points = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        points = np.zeros(0)
    if points.ndim != 2 or points.shape[1] != 2 or len(points) < least or not np.isfinite(points).all():
        raise ValueError(f"{where} is {value!r}; give {least} points [x, y] or more")
    return points


def written_patches(panel: PatternPanel) -> dict[str, Any]:
    """What the key ``hood`` of a panel says of them in a file in centimetres, of which all buttons are outlines too."""
    found: dict[str, Any] = {}
    cloth = [patch for patch in panel.patches if not patch.rigid]
    if cloth:
        found["patches"] = [{"name": patch.name, "outline": np.round(100.0 * patch.outline, 10).tolist()} for patch in cloth]
    discs = [patch.outline for patch in panel.patches if patch.rigid]
    if discs:
        found["buttons"] = [np.round(100.0 * outline.mean(axis=0), 10).tolist() for outline in discs]
        found["radius"] = round(100.0 * float(np.linalg.norm(discs[0] - discs[0].mean(axis=0), axis=1).mean()), 10)
    return found


def riders_of(pattern: Pattern, sheet: PatternSheet, pos: np.ndarray) -> Riders | None:
    """Patches and buttons of a pattern on its mesh, whose vertices are at ``pos`` (V, 3) [m]; None without any."""
    found: list[Riders | None] = []
    normals = vertex_normals(torch.as_tensor(pos), torch.as_tensor(sheet.faces)).numpy()
    for name, panel in pattern.panels.items():
        own = sheet.panels[name]
        for number, patch in enumerate(panel.patches):
            height = _BUTTON if patch.rigid else _CLOTH + number * _HIGHER
            found.append(_rider(sheet, panel, own, patch, height, pos, normals))
    return join_riders(found, [0] * len(found), [0] * len(found))


def _rider(
    sheet: PatternSheet,
    panel: PatternPanel,
    own: np.ndarray,
    patch: Patch,
    height: float,
    pos: np.ndarray,
    normals: np.ndarray,
) -> Riders:
    """One of them: its upper side between points of the outline and the cloth's own inside, and a rim down to the cloth."""
    flat, corners = sheet.uv[sheet.uv_faces[own]], sheet.faces[own]
    rows = np.unique(sheet.uv_faces[own])
    start = sheet.uv[rows[sheet.outline[rows] == 0.0][0]]
    ring = _divided(patch.outline + start - panel.edges[0].start)
    inner = sheet.uv[rows][inside(sheet.uv[rows], ring)]
    inner = inner[cKDTree(ring).query(inner)[0] > 0.5 * _STEP] if len(inner) and not patch.rigid else inner[:0]
    points = np.concatenate([ring, inner])
    triangles = Delaunay(points).simplices.astype(np.int64)
    area = np.linalg.det(points[triangles][:, 1:] - points[triangles][:, :1])
    whole = inside(points[triangles].mean(axis=1), ring) & (np.abs(area) > _NO_AREA)
    triangles, area = triangles[whole], area[whole]
    face, bary = in_triangles(points, flat)
    # Wound as the cloth beneath; and the ring as the triangles.
    outer = np.sign(np.linalg.det(flat[:, 1:] - flat[:, :1]).sum())
    triangles[area * outer < 0] = triangles[area * outer < 0][:, ::-1]
    count, here = len(ring), np.arange(len(ring))
    x, y = ring.T
    following = np.roll(here, -1 if outer * float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum()) > 0 else 1)
    foot = len(points) + here
    sides = [np.stack([here, foot, foot[following]], axis=1), np.stack([here, foot[following], following], axis=1)]
    at, up = (np.einsum("nk,nkx->nx", bary, values[corners[face]]) for values in (pos, normals))
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    solid = np.concatenate([at + height * up, (at + _FOOT * height * up)[:count]])
    faces = np.concatenate([triangles, *sides])
    if patch.rigid:
        anchors = rigid_anchors(solid, pos, corners[face[0]])
        return Riders(solid, faces, np.zeros(len(solid), dtype=np.int64), anchors, np.zeros(len(anchors), dtype=np.int64))
    group = np.concatenate([np.arange(len(points)), here])
    return Riders(solid, faces, group, corners[face].reshape(-1), np.repeat(np.arange(len(points)), 3))


def _divided(outline: np.ndarray) -> np.ndarray:
    """A closed outline with more points on its sides."""
    pieces = []
    for start, end in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        count = max(int(np.ceil(np.linalg.norm(end - start) / _STEP)), 1)
        pieces.append(start + np.arange(count)[:, None] / count * (end - start))
    return np.concatenate(pieces)
