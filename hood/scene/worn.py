"""Which parts of a garment are worn where a frame puts them, and what each is called.

A garment put on the body that it was made for: outside the skin, with edges as near their lengths as can be.

How well a garment sits on a body before anything is simulated: as it is skinned, and as a rollout starts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from hood.assets.fitting.suspicions import Suspicion, lies_in_place, suspect_limbs, suspect_place, suspect_sides
from hood.assets.garment.binding import PosedBody
from hood.assets.garment.garment import Garment
from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.cloth.state import Obstacle
from hood.contact.contact import find_contact
from hood.mesh.parts import MeshPart, find_parts
from hood.scene.body_motion.motion import BodyMotion
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
    flat, made = garment.flat, garment.construction
    cloth = build_cloth(garment.rest_pos, garment.faces, Material(), dtype=torch.float64, flat=flat, made=made)
    surface, faces = torch.as_tensor(posed.surface), torch.as_tensor(posed.faces)
    scenes = [torch.zeros(len(table), dtype=torch.int64) for table in (surface, faces)]
    obstacle = Obstacle(surface, surface, surface, faces, *scenes)
    worn = settle(cloth, torch.as_tensor(pos), obstacle, clearance, thorough=True)
    stretch = free_stretch(cloth, worn).numpy()
    return Worn(worn.numpy(), float(stretch.max()), float(-stretch.min()), float((stretch > STRETCHED).mean()))


@dataclass(frozen=True)
class FitFigures:
    """Figures of one state of a garment on a body."""

    stretch_max: float  # greatest relative lengthening of an edge
    strain_p99: float  # of the absolute edge strains
    num_inside: int  # vertices inside the body
    depth_max: float  # m, of the deepest of them
    dist_median: float  # m, to the skin; infinite without a body


def fit_figures(scene: Scene, frame: int = 0, settled: bool = True) -> FitFigures:
    """Figures of the start at ``frame``: settled as a rollout does, or merely skinned."""
    origin = scene.motion.translation[frame]
    pos = scene.motion.skinned(scene.garment, frame, origin)
    obstacle = scene.motion.obstacle(frame, origin, static=True)
    if settled:  # not by Scene.start, which refuses what is told here in numbers
        pos = settle(scene.cloth, pos, obstacle, scene.clearance, thorough=True)
    strain = _strain(scene, pos)
    dist = torch.full((len(pos),), torch.inf, dtype=torch.float64)
    if obstacle is not None:
        dist = find_contact(pos, scene.cloth.vertex_scene, obstacle).dist.double()
    return FitFigures(
        stretch_max=float(strain.max()),
        strain_p99=float(torch.quantile(strain.abs()[:_QUANTILE_LIMIT], 0.99)),
        num_inside=int((dist < 0).sum()),
        depth_max=float((-dist).max().clamp_min(0.0)),
        dist_median=float(dist.abs().median()),
    )


def misplacement(scene: Scene, frame: int = 0, on_meshes: bool = False) -> Suspicion | None:
    """Why the garment is not worn where ``frame`` puts it, not yet settled; None: it is, or there is no body.

    Of sheets far from a mesh that mesh warns itself, see :meth:`hood.scene.body_motion.mesh_motion.MeshMotion.dressed`: with
    ``on_meshes`` alone they are told here too.
    """
    origin = scene.motion.translation[frame]
    surface = scene.motion.surface(frame, origin).double().cpu().numpy()
    if not len(surface):
        return None
    pos = scene.motion.skinned(scene.garment, frame, origin).double().cpu().numpy()
    found = suspect_place(pos, scene.garment.faces, surface, scene.motion.faces)
    if isinstance(scene.motion, BodyMotion):  # in its T-pose, where planes of symmetry are seen
        body = scene.motion.body
        found = suspect_limbs(scene.garment.worn_pos, scene.garment.faces, body.v_template, body.faces) + found
    return next((one for one in found if one.grave or on_meshes or isinstance(scene.motion, BodyMotion)), None)


def doubts(scene: Scene, frame: int = 0) -> list[tuple[str, Suspicion]]:
    """What is strange about garments that are worn, by the name of each, where ``frame`` puts them, not yet settled: one that
    is inside out, held vertices inside the body. A rollout goes on with it."""
    origin, garment = scene.motion.translation[frame], scene.garment
    surface = scene.motion.surface(frame, origin).double().cpu().numpy()
    if not len(surface):
        return []
    pos, outfit = scene.motion.skinned(garment, frame, origin), scene.outfit
    piece = np.zeros(len(pos), dtype=np.int64) if outfit is None else outfit.piece
    places = pos.double().cpu().numpy()
    inside = _held_inside(scene, pos, frame)
    found: list[tuple[str, Suspicion]] = []
    for number, name in enumerate((garment.name,) if outfit is None else outfit.names):
        faces = garment.faces[piece[garment.faces[:, 0]] == number]
        found += [(name, one) for one in suspect_sides(places, faces, surface, scene.motion.faces)]
        deep = np.where(piece == number, inside, 0.0)
        if (deep > _INSIDE).any():
            held = int((garment.pinned & (piece == number)).sum())
            what = (
                f"has {int((deep > _INSIDE).sum())} of its {held} held vertices inside the body in frame {frame}, to "
                f"{1e3 * deep.max():.1f} mm (vertex {int(deep.argmax())}), where they stay and hold the cloth under the skin"
            )
            fix = "hold others (pins=…), none (pins=none), or prepare the garment for this body"
            found.append((name, Suspicion(what, fix, False)))
    return found


def _held_inside(scene: Scene, pos: Tensor, frame: int) -> np.ndarray:
    """Depth [m] (V,) of held vertices inside the body, 0 of others."""
    held = scene.cloth.pinned
    obstacle = scene.motion.obstacle(frame, scene.motion.translation[frame], static=True)
    if obstacle is None or not bool(held.any()):
        return np.zeros(len(pos))
    dist = find_contact(pos, scene.cloth.vertex_scene, obstacle).dist
    return torch.where(held & torch.isfinite(dist), -dist, 0.0).double().clamp_min(0.0).cpu().numpy()


#: Held vertices deeper than this [m] inside the body are told; cloth is kept as far off it.
_INSIDE = 2e-3
#: torch.quantile refuses longer inputs.
_QUANTILE_LIMIT = 1 << 24


def _strain(scene: Scene, pos: Tensor) -> Tensor:
    return scene.cloth.edge_strain(pos).double()
