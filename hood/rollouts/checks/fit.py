"""How a garment sits on a body: its distance to the skin, how far it is stretched, how far it has slid down; in one word."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hood.cloth.cloth import Cloth
from hood.cloth.state import State
from hood.contact.contact import find_contact
from hood.scene.scene import Scene
from hood.solver.step_figures import edge_strain

#: Edges at the skin that are stretched by so much on average are tight: figures in hood/studies/notes/sizes.md.
TIGHT = 0.04
#: A garment whose upper rim is so far [m] below its place has come off.
FALLEN = 0.1
#: The upper rim: this share of the vertices that can move, the highest as worn.
_RIM = 0.1
#: Cloth within this distance [m] of the skin lies on it.
_ON_SKIN = 5e-3

FITS, IS_TIGHT, FALLS_OFF = "fits", "tight", "falls off"


@dataclass(frozen=True)
class Ease:
    """How a garment sits in one frame.

    Args:
        gap: 5th percentile, median and 95th of the distances [m] of its vertices from the skin, of those within the reach of
            the search (a decimetre); NaN without any.
        on_skin: share of its vertices that lie on the skin.
        stretch: mean relative lengthening of the edges on the skin, shortened ones as 0.
        slid: mean height [m] of the upper rim below its place as worn; negative above it.
    """

    gap: tuple[float, float, float]
    on_skin: float
    stretch: float
    slid: float

    @property
    def word(self) -> str:
        """``fits``, ``tight`` or ``falls off``."""
        if not self.slid <= FALLEN:
            return FALLS_OFF
        return IS_TIGHT if self.stretch > TIGHT else FITS


def measure_ease(scene: Scene, cloth: Cloth, state: State, frame: int) -> Ease | None:
    """Of the ``cloth`` at ``state`` on the body of ``frame``; None without a body."""
    origin = state.origin[0].numpy()
    obstacle = scene.motion.obstacle(frame, origin, static=True)
    if obstacle is None:
        return None
    contact = find_contact(state.pos, cloth.vertex_scene, obstacle)
    near = contact.valid.cpu().numpy()
    dist = np.where(near, contact.dist.cpu().double().numpy(), np.inf)
    low, middle, high = np.percentile(dist[near], [5, 50, 95]) if near.any() else [np.nan] * 3
    on_skin = dist < _ON_SKIN
    edges = cloth.edges.cpu().numpy()
    touching = on_skin[edges].all(axis=1)
    strain = edge_strain(cloth, state.pos).cpu().double().numpy().clip(min=0.0)[touching]
    free = cloth.free.cpu().numpy()
    worn = scene.motion.skinned(scene.garment, frame, origin)
    place, height = (values[:, 1].cpu().double().numpy()[free] for values in (worn, state.pos))
    rim = np.argsort(-place, kind="stable")[: max(1, round(_RIM * len(place)))]
    below = place[rim] - height[rim]
    return Ease(
        gap=(float(low), float(middle), float(high)),
        on_skin=float(on_skin.mean()),
        stretch=float(strain.mean()) if len(strain) else 0.0,
        slid=float(below.mean()) if len(below) else 0.0,
    )
