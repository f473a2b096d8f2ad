"""``size=``, ``fit=`` and how the garment sits: keys of a rollout, and what its summary says."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

from omegaconf import DictConfig

from hood.assets.garment.garment import Garment
from hood.assets.garment.tailoring import tailored
from hood.config import ConfigError, plain, require_choice, shown
from hood.dynamics.ease import Ease
from hood.scene.motion import BodyMotion, Motion
from hood.scene.sizing import Sizes, sizes_of

#: Whether the pattern follows the body's shape, or is that of the mean body for everybody.
FITS = ("betas", "none")


def checked_sizes(config: DictConfig) -> Sizes:
    """The sizes that the config asks for.

    Raises:
        ConfigError: they are none, or they change in steps of fixed shapes.
    """
    end, parts = plain(config.size_end), checked_parts(config)
    require_choice(config, "fit", FITS)
    if parts and end is not None:
        raise ConfigError(f"size_end={end}: parts of a garment keep their size; give size as one factor or three")
    seconds = float(config.size_seconds)
    if not seconds > 0:
        raise ConfigError(f"size_seconds={config.size_seconds}: give seconds above 0, such as size_seconds=2")
    size = 1.0 if parts else plain(config.size)
    for key, value in (("size", size), ("size_end", size if end is None else end)):
        try:
            sizes = replace(sizes_of(value), parts=tuple(parts.values()))
        except (ValueError, TypeError) as error:
            raise ConfigError(f"{key}={shown(config[key])}: {error}") from error
    sizes = replace(sizes_of(size, end, seconds), parts=tuple(parts.values()))
    if sizes.changing and str(config.step) != "plain":
        raise ConfigError(
            f"size_end={end}: step={config.step} has fixed shapes, which a garment that grows has not; use step=plain"
        )
    return replace(sizes, to_measure=str(config.fit) == "betas")


def checked_parts(config: DictConfig) -> dict[str, float]:
    """Factors by part, where ``size`` is a table of them; empty where it is not.

    Raises:
        ConfigError: a factor that is no number.
    """
    value = plain(config.size)
    if not isinstance(value, dict):
        return {}
    for part, factor in value.items():
        if isinstance(factor, bool) or not isinstance(factor, (int, float)):
            raise ConfigError(f"size: {part} is {factor!r}; give a factor of the part, such as size={{{part}:1.1}}")
    if not value:
        raise ConfigError("size={}: names no part; give parts and factors, such as size={sleeves:1.2}, or one factor")
    return {str(part): float(factor) for part, factor in value.items()}


def cut_to_size(config: DictConfig, garment: Garment, motion: Motion) -> Garment:
    """``garment`` with its parts cut as the config asks for, if it does.

    Raises:
        ValueError: it names a part that the garment does not have.
    """
    parts = checked_parts(config)
    body = motion.body if isinstance(motion, BodyMotion) else None
    return tailored(garment, parts, body) if parts else garment


def summarise_ease(first: Ease | None, last: Ease | None) -> dict[str, Any]:
    """What ``summary.json`` says of how the garment sat in frame 0 and in the last one; nothing where it was not measured."""
    if first is None or last is None:
        return {}
    return {"ease": {name: asdict(ease) | {"word": ease.word} for name, ease in (("first", first), ("last", last))}}


def describe_ease(summary: Mapping[str, Any]) -> list[str]:
    """A line on it; none where the summary does not say."""
    found = summary.get("ease")
    if not found:
        return []
    words = []
    for name, when in (("first", "frame 0"), ("last", "the last frame")):
        ease = found[name]
        low, middle, high = (1e3 * value for value in ease["gap"])
        skin = f"skin {low:.0f}, {middle:.0f}, {high:.0f} mm away at p5, p50, p95; on the skin {100 * ease['on_skin']:.0f}%"
        skin = skin if low == low else "no skin within 10 cm"
        stretched = f"stretched by {100 * ease['stretch']:.1f}% there; upper rim {100 * ease['slid']:.0f} cm down"
        words.append(f"{when}: {ease['word']} ({skin}, {stretched})")
    return ["size, " + "; ".join(words)]
