"""``material=`` and ``fabrics=``: what a garment of a rollout is made of, all of it or part by part.

``body_friction=``: parts of the body that grip the cloth more or less than the rest.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import torch
import yaml
from omegaconf import DictConfig

from hood.app.settings.compose import CONFIG_FOLDER, ConfigError, build, load_config, options, plain
from hood.app.settings.rollout_settings import Settings
from hood.assets.files.library import unknown
from hood.assets.garment.garment import Garment
from hood.assets.garment.parts import part_faces
from hood.assets.material import Material, measured
from hood.cloth.fabric import patchwork
from hood.plugins import config_folders
from hood.scene.body_motion.motion import BodyMotion, Motion
from hood.scene.following import part_of
from hood.scene.scene import Scene

_MEASURED = f"{measured.__module__}.{measured.__name__}"
AUTO = "auto"


def fabric_of(config: Settings, garment: Garment, motion: Motion) -> Material:
    """The fabric that the config gives to ``garment``.

    Raises:
        ConfigError: ``fabrics`` is no table of parts and fabrics, or names a fabric that there is not.
        ValueError: it names a part that the garment does not have.
    """
    material: Material = build(config.material)
    parts, width = checked_fabrics(config), checked_seams(config)
    if not parts:
        return material
    body = motion.body if isinstance(motion, BodyMotion) else None
    pieces = [(part_faces(part, garment, body), fabric) for part, fabric in parts.items()]
    return patchwork(material, pieces, garment.rest_pos, garment.faces, width)


def fabric_names(config: Settings, garment: Garment, motion: Motion) -> tuple[list[str], np.ndarray]:
    """What the fabrics of a garment are called: options of ``material=``, the most alike where some of their values were
    changed, empty where none is alike; and (V,) which of them most faces of a vertex are of."""
    names, number = [most_alike(plain(config.material))], np.zeros(len(garment.faces), dtype=np.int64)
    body = motion.body if isinstance(motion, BodyMotion) else None
    for part, given in (plain(config.fabrics) or {}).items():
        name = str(given if isinstance(given, str) else given.get("material", names[0]))
        names += [] if name in names else [name]
        number[part_faces(str(part), garment, body)] = names.index(name)
    votes = np.zeros((len(garment.rest_pos), len(names)))
    np.add.at(votes, (garment.faces, number[:, None]), 1.0)
    return names, votes.argmax(axis=1)


def most_alike(material: Mapping[str, Any]) -> str:
    """The option of ``material=`` that a fabric's values in a config are, or are most like; empty where none is alike."""

    def alike(name: str) -> int:
        return sum(material.get(key) == value for key, value in _values(name).items())

    best = max(options("material"), key=alike)
    return best if 2 * alike(best) > len(material) else ""


@cache
def _values(name: str) -> dict[str, Any]:
    """What the file of an option of ``material=`` says."""
    files = [folder / "material" / f"{name}.yaml" for folder in (CONFIG_FOLDER, *config_folders())]
    return dict(yaml.safe_load(next(file for file in files if file.exists()).read_text(encoding="utf-8")))


def solved(config: Settings) -> bool:
    """Whether a solver takes a rollout's steps, or may (``stepper=auto``); not in training and evaluation."""
    stepper, stepping = config.get("stepper"), plain(config.get("stepping"))
    return stepper == AUTO or (stepper is not None and isinstance(stepping, dict) and not stepping.get("network", False))


def checked_fabrics(config: Settings) -> dict[str, Material]:
    """``fabrics`` of a config: fabrics by part.

    Raises:
        ConfigError: it is something else, or a fabric or a property is unknown.
        ValueError: a property has no physical value.
    """
    value = plain(config.fabrics)
    if value is None:
        return {}
    if not isinstance(value, dict) or not all(isinstance(fabric, (str, dict)) for fabric in value.values()):
        raise ConfigError(
            f"fabrics={value}: give fabrics by part, such as fabrics={{below_waistband:silk,above_waistband:denim}}"
        )
    return {str(part): _fabric(str(part), fabric, config) for part, fabric in value.items()}


def checked_seams(config: Settings) -> float:
    """``fabrics_seam`` of a config [m].

    Raises:
        ConfigError: it is no length, or there are no fabrics that it could be between.
    """
    width = config.fabrics_seam
    if isinstance(width, bool) or not isinstance(width, (int, float)) or not 0.0 <= width < float("inf"):
        raise ConfigError(f"fabrics_seam={width}: give metres (0.03), 0 for a sharp seam")
    if width > 0.0 and config.fabrics is None:
        raise ConfigError(
            f"fabrics_seam={width:g}: is between fabrics; give fabrics={{below_waistband:silk}} too, or leave it out"
        )
    return float(width)


def _fabric(part: str, given: str | dict[str, Any], config: Settings) -> Material:
    """The fabric of a part: an option of ``material=``, or a table of one and of properties instead of its own."""
    own = {} if isinstance(given, str) else {str(key): value for key, value in given.items()}
    name = given if isinstance(given, str) else own.pop("material", None)
    known = options("material")
    if name is not None and name not in known:
        raise ConfigError(f"fabrics: {part}: {unknown('material', str(name), known)}")
    woven = own.pop("woven", None)
    for key, value in own.items():
        if key not in Material.names():
            raise ConfigError(f"fabrics: {part}: {unknown('property', key, ['material', 'woven', *Material.names()])}")
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise ConfigError(f"fabrics: {part}: {key} is {value!r}; give a number")
    if woven is not None and (name is None or not is_measured(name)):
        raise ConfigError(f"fabrics: {part}: woven is for measured cloth by its name (material: linen); give warp and weft")
    base: Material = build(config.material) if name is None else fabric_named(name, woven)
    return replace(base, **own)


def fabric_named(name: str, woven: Any = None) -> Material:
    """The fabric of an option of ``material=``; of measured cloth also with another ``woven`` than its own."""
    material: Material = build(
        load_config("rollout", [f"material={name}"]).material, **({} if woven is None else {"woven": woven})
    )
    return material


def is_measured(name: str) -> bool:
    """Whether an option of ``material=`` tells measured cloth."""
    return _tells_measured(load_config("rollout", [f"material={name}"]).material)


def measured_in(config: Settings) -> list[str]:
    """Measured cloth among the fabrics of a config, by name, none twice."""
    table = plain(config.fabrics)
    given = table.values() if isinstance(table, dict) else ()
    parts = [fabric.get("material") if isinstance(fabric, dict) else str(fabric) for fabric in given]
    names = [most_alike(plain(config.material)) or "the fabric"] if _tells_measured(config.material) else []
    return list(dict.fromkeys(names + [name for name in parts if name is not None and is_measured(name)]))


def _tells_measured(node: DictConfig) -> bool:
    return str(node.get("_target_")) == _MEASURED


def checked_friction(config: Settings) -> dict[str, float]:
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


def with_body_friction(scene: Scene, config: Settings) -> Scene:
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
    grip = np.ones(len(motion.faces))
    for part, factor in parts.items():
        try:
            grip[part_of(motion, part)] = factor
        except ValueError as error:
            raise ValueError(f"body_friction: {error}") from error
    return replace(scene, friction_scale=torch.as_tensor(grip))
