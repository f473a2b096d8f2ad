"""Garments of an outfit that are all held to the body: the held bands of outer layers are moved off the inner ones.

Every garment is drafted on the bare body, so a skirt and shorts are held at the same place, and no force takes held vertices
apart.
"""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from hood.assets.garment.garment import Garment
from hood.scene.body_motion.motion import BodyMotion
from hood.scene.following import held_by
from hood.scene.scene import LEAD_IN, Scene
from hood.scene.start import settle
from hood.scene.untangle import TangledError, crossing_pairs, likely_orders, separate

#: Held vertices are moved by so much [m] at most.
MOST_MOVED = 0.03


def with_held_layers_apart(scene: Scene) -> Scene:
    """The scene with the places that held vertices are held at moved off each other, where those of two garments lie in each
    other's cloth; itself where none do.

    In the T-pose all vertices but those held by the innermost garment are free, and the garments are taken apart
    (:func:`hood.scene.untangle.separate`); held vertices follow the body from where that leaves them. The rest shape stays.
    A warning says how far. A scene that cannot be taken apart there, or only by more than :data:`MOST_MOVED`, is left as it
    is: its start says why it is refused.
    """
    outfit, motion = scene.outfit, scene.motion
    if outfit is None or not isinstance(motion, BodyMotion) or scene.start_pos is not None:
        return scene
    held = [bool(scene.cloth.pinned[torch.as_tensor(outfit.piece == number)].any()) for number in range(len(outfit.names))]
    if sum(held) < 2:
        return scene
    lead = motion.lead_in(0, LEAD_IN)
    origin = lead.translation[0]
    given = lead.skinned(scene.garment, 0, origin)
    obstacle = lead.obstacle(0, origin, static=True)
    worn = settle(scene.cloth, given, obstacle, scene.clearance, thorough=True)
    crossed = outfit.faces[crossing_pairs(outfit, worn).reshape(-1)]
    if not len(crossed) or not bool(scene.cloth.pinned[torch.as_tensor(np.unique(crossed))].any()):
        return scene
    order = scene.layers or likely_orders(outfit, worn, obstacle)[0]
    innermost = next(number for number in order if held[number])
    fixed = scene.cloth.pinned & torch.as_tensor(outfit.piece == innermost)
    try:
        apart = separate(outfit._replace(cloth=replace(scene.cloth, pinned=fixed)), worn, obstacle, scene.clearance, order)
    except TangledError:
        return scene
    moves = scene.cloth.pinned & ~fixed
    shift = torch.where(moves.unsqueeze(1), apart.pos - given, 0.0)
    farthest = shift.norm(dim=1)
    if float(farthest.max()) > MOST_MOVED:
        return scene
    moved = sorted({outfit.names[number] for number in outfit.piece[(farthest > 0).numpy()]})
    warnings.warn(
        f"outfit: the places at which {', '.join(map(repr, moved))} is held are moved off the garment below by up to "
        f"{1e3 * float(farthest.max()):.0f} mm; their rest shapes stay",
        stacklevel=2,
    )
    garment = _shifted(scene.garment, lead, shift)
    return replace(scene, garment=garment, held=scene.held and held_by(scene.held.groups, motion, garment))


def _shifted(garment: Garment, motion: BodyMotion, shift: Tensor) -> Garment:
    """The garment that skinning takes ``shift`` (V, 3) [m] farther in the first frame of ``motion``."""
    origin, skin = motion.translation[0], garment.worn_pos
    here = motion.skinned(garment, 0, origin)
    axes = [motion.skinned(replace(garment, skin_pos=skin + axis), 0, origin) - here for axis in np.eye(3)]
    turn = torch.stack(axes, dim=2).cpu().double().numpy()  # (V, 3, 3): what a metre of the T-pose becomes
    return replace(garment, skin_pos=skin + np.linalg.solve(turn, shift.cpu().double().numpy()[..., None])[..., 0])
