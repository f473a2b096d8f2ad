"""A garment put on the body that it was made for: outside the skin, with edges as near their lengths as can be."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from hood.assets.garment.binding import PosedBody
from hood.assets.garment.garment import Garment
from hood.assets.material import Material
from hood.scene.cloth import build_cloth
from hood.scene.start import free_stretch, settle
from hood.scene.state import Obstacle

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
    """The garment worn near ``pos`` (V, 3) [m], outside ``posed``; the lengths of its edges are those of ``rest_pos``.

    Pushing single vertices out of the body changes the edges between them; settling (:func:`hood.scene.start.settle`)
    spreads that over the cloth around.
    """
    cloth = build_cloth(garment.rest_pos, garment.faces, Material(), dtype=torch.float64)
    surface, faces = torch.as_tensor(posed.surface), torch.as_tensor(posed.faces)
    scenes = [torch.zeros(len(table), dtype=torch.int64) for table in (surface, faces)]
    obstacle = Obstacle(surface, surface, surface, faces, *scenes)
    worn = settle(cloth, torch.as_tensor(pos), obstacle, clearance, thorough=True)
    stretch = free_stretch(cloth, worn).numpy()
    return Worn(worn.numpy(), float(stretch.max()), float(-stretch.min()), float((stretch > STRETCHED).mean()))
