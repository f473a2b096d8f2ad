"""``size=`` and how the garment sits: keys of a rollout, and what its summary says."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from omegaconf import DictConfig

from hood.config import ConfigError, plain, shown
from hood.dynamics.ease import Ease
from hood.scene.sizing import Sizes, sizes_of


def checked_sizes(config: DictConfig) -> Sizes:
    """The sizes that the config asks for.

    Raises:
        ConfigError: they are none, or they change in steps of fixed shapes.
    """
    end, seconds = plain(config.size_end), float(config.size_seconds)
    if not seconds > 0:
        raise ConfigError(f"size_seconds={config.size_seconds}: give seconds above 0, such as size_seconds=2")
    for key in ("size", "size_end"):
        try:
            sizes = sizes_of(plain(config.size) if config[key] is None else plain(config[key]))
        except (ValueError, TypeError) as error:
            raise ConfigError(f"{key}={shown(config[key])}: {error}") from error
    sizes = sizes_of(plain(config.size), end, seconds)
    if sizes.changing and str(config.step) != "plain":
        raise ConfigError(
            f"size_end={end}: step={config.step} has fixed shapes, which a garment that grows has not; use step=plain"
        )
    return sizes


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
