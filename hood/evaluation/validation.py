"""Own-rollout validation: the states a model reaches itself, on motions it was not trained on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hood.assets.body import Body
from hood.assets.garment import Garment
from hood.assets.sequence import PoseSequence
from hood.dynamics.rollout import simulate
from hood.dynamics.simulator import Simulator
from hood.losses.potential import Potential
from hood.scene.scene import build_scene


@dataclass(frozen=True)
class Validation:
    """Short rollouts of every garment on one motion each (motions go round), default fabric, mean shape."""

    body: Body
    garments: Sequence[Garment]
    motions: Sequence[PoseSequence]
    potential: Potential
    num_frames: int = 60

    def __call__(self, simulator: Simulator) -> dict[str, float]:
        """Medians over garments of p99 strain, penetrating share, rg; and the number of non-finite rollouts."""
        strain, share, residual, broken = [], [], [], 0
        for index, garment in enumerate(self.garments):
            scene = build_scene(garment, self.body, self.motions[index % len(self.motions)])
            frames = list(simulate(simulator, scene, self.potential, self.num_frames))
            table = {key: np.array([f.metrics.get(key, np.nan) for f in frames[1:]]) for key in _KEYS}
            broken += int(not np.isfinite(table["strain_p99"]).all())
            strain.append(np.nanmedian(table["strain_p99"]))
            share.append(np.nanmean(table["penetration_share"]))
            residual.append(np.nanmedian(table["relative_gradient"]))
        return {
            "strain_p99": float(np.median(strain)),
            "strain_p99_worst": float(np.max(strain)),
            "penetration_share": float(np.mean(share)),
            "relative_gradient": float(np.median(residual)),
            "non_finite": float(broken),
        }


_KEYS = ("strain_p99", "penetration_share", "relative_gradient")
