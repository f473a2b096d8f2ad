"""How well a garment sits on a body before anything is simulated: as it is skinned, and as a rollout starts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hood.assets.fitting.suspicions import Suspicion, suspect_limbs, suspect_place, suspect_sides
from hood.contact.contact import find_contact
from hood.scene.body_motion.motion import BodyMotion
from hood.scene.scene import Scene
from hood.scene.start import settle


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
    start, end = scene.cloth.edges.unbind(dim=1)
    return ((pos[end] - pos[start]).norm(dim=1) / scene.cloth.rest_length - 1.0).double()
