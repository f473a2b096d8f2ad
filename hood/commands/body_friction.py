"""``body_friction=``: parts of the body that grip the cloth more or less than the rest."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from omegaconf import DictConfig

from hood.assets.body.parts import body_part
from hood.config import ConfigError, plain
from hood.scene.motion import BodyMotion
from hood.scene.scene import Scene


def checked_friction(config: DictConfig) -> dict[str, float]:
    """``body_friction`` of a config: factors on the coefficient of friction by part of the body.

    Raises:
        ConfigError: it is something else.
    """
    value = plain(config.body_friction)
    if value is None:
        return {}
    if not isinstance(value, dict) or not value:
        raise ConfigError(f"body_friction={value}: give factors by part, such as body_friction={{left_wrist:3,below_pelvis:0}}")
    for part, factor in value.items():
        if isinstance(factor, bool) or not isinstance(factor, (int, float)) or not 0.0 <= factor < math.inf:
            raise ConfigError(f"body_friction: {part} is {factor!r}; give a finite factor >= 0, 1 for the usual friction")
    return {str(part): float(factor) for part, factor in value.items()}


def with_body_friction(scene: Scene, config: DictConfig) -> Scene:
    """The scene whose body grips as the config says; the same where it says nothing.

    Raises:
        ConfigError: the config has no such table, or there is no body.
        ValueError: the body has no such part.
    """
    parts = checked_friction(config)
    if not parts:
        return scene
    motion = scene.motion
    if motion.num_vertices == 0:
        raise ConfigError("body_friction: there is no body; leave it out")
    body = motion.body if isinstance(motion, BodyMotion) else None
    grip = np.ones(len(motion.faces))
    for part, factor in parts.items():
        try:
            grip[body_part(part, motion.faces, motion.num_vertices, body)] = factor
        except ValueError as error:
            raise ValueError(f"body_friction: {error}") from error
    return replace(scene, grip=torch.as_tensor(grip))
