"""Which parts of a garment are worn where a frame puts them, and what each is called."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hood.assets.garment.in_place import lies_in_place
from hood.mesh.parts import Part, find_parts

if TYPE_CHECKING:
    from hood.scene.scene import Scene


def worn_vertices(scene: Scene, frame: int = 0) -> np.ndarray:
    """(V,) bool: vertices of the parts worn in ``frame``: those that can be put on, and sheets that lie around the body.

    Other sheets, such as one that is to fall on a body, start as they are given.
    """
    garment, worn = scene.garment, np.zeros(len(scene.garment.rest_pos), dtype=bool)
    surface: np.ndarray | None = None
    pos = garment.rest_pos
    for part in find_parts(garment.rest_pos, garment.faces):
        if part.can_be_put_on:
            worn[part.vertices] = True
            continue
        if scene.motion.num_vertices == 0:
            continue
        if surface is None:
            origin = scene.motion.translation[frame]
            surface = scene.motion.surface(frame, origin).double().cpu().numpy()
            pos = scene.motion.skinned(garment, frame, origin).double().cpu().numpy()
        used, corners = np.unique(garment.faces[part.faces], return_inverse=True)
        worn[part.vertices] = lies_in_place(pos[used], corners.reshape(-1, 3), surface, scene.motion.faces)
    return worn


def name_part(scene: Scene, part: Part, num_parts: int) -> str:
    """What a part is called in a message: its number, its vertices and where it is at rest; "" where there is one alone."""
    if num_parts == 1:
        return ""
    middle = np.round(0.5 * (part.low + part.high), 2).tolist()
    outfit = scene.outfit
    of = "" if outfit is None else f" of {outfit.names[int(outfit.piece[part.vertices[0]])]!r}"
    return f"part {part.number}{of} ({len(part.vertices)} vertices from {int(part.vertices[0])} on, at {middle} m)"


def worst_part(scene: Scene, pos: np.ndarray) -> str:
    """The part with the longest stretched edge at ``pos`` (V, 3), in words for a message; "" where there is one alone."""
    parts = find_parts(scene.garment.rest_pos, scene.garment.faces)
    edges = scene.cloth.edges.cpu().numpy()
    if len(parts) == 1 or not len(edges):
        return ""
    rest = scene.cloth.rest_pos.double().cpu().numpy()
    now, before = (np.linalg.norm(table[edges[:, 0]] - table[edges[:, 1]], axis=1) for table in (pos, rest))
    vertex = edges[int(np.argmax(now / np.maximum(before, 1e-12))), 0]
    return next(name_part(scene, part, len(parts)) for part in parts if vertex in part.vertices)
