"""``material=`` and ``fabrics=``: what a garment of a rollout is made of, all of it or part by part."""

from __future__ import annotations

from omegaconf import DictConfig

from hood.assets.files.library import unknown
from hood.assets.garment.garment import Garment
from hood.assets.garment.parts import part_faces
from hood.assets.material import Material
from hood.config import ConfigError, build, load_config, options, plain
from hood.scene.fabric import patchwork
from hood.scene.motion import BodyMotion, Motion


def fabric_of(config: DictConfig, garment: Garment, motion: Motion) -> Material:
    """The fabric that the config gives to ``garment``.

    Raises:
        ConfigError: ``fabrics`` is no table of parts and fabrics, or names a fabric that there is not.
        ValueError: it names a part that the garment does not have.
    """
    material: Material = build(config.material)
    parts = checked_fabrics(config)
    if not parts:
        return material
    body = motion.body if isinstance(motion, BodyMotion) else None
    pieces = [(part_faces(part, garment, body), fabric_named(fabric)) for part, fabric in parts.items()]
    return patchwork(material, pieces, garment.rest_pos, garment.faces)


def checked_fabrics(config: DictConfig) -> dict[str, str]:
    """``fabrics`` of a config: names of fabrics by part.

    Raises:
        ConfigError: it is something else, or a fabric is unknown.
    """
    value = plain(config.fabrics)
    if value is None:
        return {}
    if not isinstance(value, dict) or not all(isinstance(fabric, str) for fabric in value.values()):
        raise ConfigError(
            f"fabrics={value}: give fabrics by part, such as fabrics={{below_waistband:silk,above_waistband:denim}}"
        )
    parts = {str(part): str(fabric) for part, fabric in value.items()}
    known = options("material")
    for part, fabric in parts.items():
        if fabric not in known:
            raise ConfigError(f"fabrics: {part}: {unknown('material', fabric, known)}")
    return parts


def fabric_named(name: str) -> Material:
    """The fabric of an option of ``material=``."""
    material: Material = build(load_config("rollout", [f"material={name}"]).material)
    return material
