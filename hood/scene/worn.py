"""Which parts of a garment are worn where a frame puts them, and what each is called.

A garment put on the body that it was made for: outside the skin, with edges as near their lengths as can be.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from hood.assets.fitting.suspicions import lies_in_place
from hood.assets.garment.binding import PosedBody
from hood.assets.garment.garment import Garment
from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.cloth.state import Obstacle
from hood.mesh.parts import MeshPart, find_parts
from hood.scene.start import free_stretch, settle

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


def name_worn_part(scene: Scene, part: MeshPart, num_parts: int) -> str:
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
    before = scene.cloth.rest_length.double().cpu().numpy()
    now = np.linalg.norm(pos[edges[:, 0]] - pos[edges[:, 1]], axis=1)
    vertex = edges[int(np.argmax(now / np.maximum(before, 1e-12))), 0]
    return next(name_worn_part(scene, part, len(parts)) for part in parts if vertex in part.vertices)


#: An edge that is worn longer by more than this share counts as stretched.
STRETCHED = 0.1


@dataclass(frozen=True)
class Worn:
    """Where a garment is worn, and what that does to its edges."""

    pos: np.ndarray  # (V, 3) m
    stretch_max: float  # greatest relative lengthening of an edge
    compression_max: float  # greatest relative shortening
    stretched_share: float  # of the edges, longer by more than ``STRETCHED``


def put_on(garment: Garment, pos: np.ndarray, posed: PosedBody, clearance: float) -> Worn:
    """The garment worn near ``pos`` (V, 3) [m], outside ``posed``; the lengths of its edges are those at rest.

    Pushing single vertices out of the body changes the edges between them; settling (:func:`hood.scene.start.settle`)
    spreads that over the cloth around.
    """
    cloth = build_cloth(garment.rest_pos, garment.faces, Material(), dtype=torch.float64, flat=garment.flat)
    surface, faces = torch.as_tensor(posed.surface), torch.as_tensor(posed.faces)
    scenes = [torch.zeros(len(table), dtype=torch.int64) for table in (surface, faces)]
    obstacle = Obstacle(surface, surface, surface, faces, *scenes)
    worn = settle(cloth, torch.as_tensor(pos), obstacle, clearance, thorough=True)
    stretch = free_stretch(cloth, worn).numpy()
    return Worn(worn.numpy(), float(stretch.max()), float(-stretch.min()), float((stretch > STRETCHED).mean()))
