"""``objects``, ``weld``, ``shells`` and ``small_parts`` of a config."""

from __future__ import annotations

from typing import Any

import numpy as np
from omegaconf import DictConfig

from hood.assets.garment.contents.wanted import SHELLS, SMALL_PARTS, Wanted
from hood.config import ConfigError, brief, plain, require_choice

AUTO, NONE = "auto", "none"


def wanted_of(config: DictConfig) -> Wanted:
    """What is asked of garments' files.

    Raises:
        ConfigError: a value of the wrong kind; names the key.
    """
    require_choice(config, "shells", SHELLS)
    require_choice(config, "small_parts", SMALL_PARTS)
    weld = plain(config.weld)
    return Wanted(
        objects=tuple(_names(config.objects)),
        sew=weld != NONE,
        gap=None if weld in (AUTO, NONE) else _metres(weld),
        shells=str(config.shells),
        small_parts=str(config.small_parts),
        layered=plain(config.get("layers", AUTO)) != AUTO,
    )


def words_of(wanted: Wanted) -> list[str]:
    """The words of a command that ask for this; none for what is usual."""
    usual = Wanted()
    weld = NONE if not wanted.sew else f"{wanted.gap}"
    words = {
        "objects": None if not wanted.objects else f"objects=[{','.join(wanted.objects)}]",
        "weld": None if (wanted.sew, wanted.gap) == (usual.sew, usual.gap) else f"weld={weld}",
        "shells": None if wanted.shells == usual.shells else f"shells={wanted.shells}",
        "small_parts": None if wanted.small_parts == usual.small_parts else f"small_parts={wanted.small_parts}",
    }
    return [word for word in words.values() if word is not None]


def _names(given: Any) -> list[str]:
    value = plain(given)
    names = value if isinstance(value, list) else [value]
    if not all(isinstance(name, (str, int, float)) and not isinstance(name, bool) for name in names):
        raise ConfigError(f"objects={brief(value)}: give names of objects, groups, materials or parts, objects=[tank,part_2]")
    return [str(name) for name in names]


def _metres(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not (np.isfinite(value) and value >= 0):
        raise ConfigError(f"weld={value}: give a number ≥ 0 or auto")
    return float(value)
