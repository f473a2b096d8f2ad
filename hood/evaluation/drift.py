"""Sideways drift: what a model does to a garment on a body that stands still and prefers no side."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.assets.material import Material
from hood.assets.motion.poses import A_POSE_ANGLE, arms_down
from hood.dynamics.rollout import simulate
from hood.dynamics.stepper import Stepper
from hood.losses.potential import Potential
from hood.scene.scene import Scene, build_scene


def standing_scene(
    garment: Garment,
    body: Body,
    num_frames: int,
    material: Material | None = None,
    fps: float = 30.0,
    device: torch.device | str = "cpu",
) -> Scene:
    """The garment on a body of mean shape that stands still with its arms half down, the same to the left and to the right."""
    still = arms_down(A_POSE_ANGLE)
    poses, transl = np.repeat(still.poses, num_frames, axis=0), np.repeat(still.transl, num_frames, axis=0)
    standing = replace(still, name="standing", poses=poses, transl=transl, fps=fps)
    return build_scene(garment, body, standing, material, device=device)


def sideways_drift(stepper: Stepper, scene: Scene, potential: Potential) -> float:
    """How far [m] the garment's centre goes to either side of where it starts, over all frames of the scene.

    Infinite when a frame is not finite. The body of :func:`standing_scene` faces along z, so that x is sideways.
    """
    start, largest = None, 0.0
    for frame in simulate(stepper, scene, potential, metrics="none"):
        centre = float(frame.world_pos[:, 0].mean())
        start = centre if start is None else start
        away = abs(centre - start)
        if not np.isfinite(away):
            return float("inf")
        largest = max(largest, away)
    return largest
