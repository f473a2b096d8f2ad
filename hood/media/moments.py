"""What a rollout's settings say of its course, in words: when something is opened, closed, held or let go, and the wind."""

from __future__ import annotations

import json
from collections.abc import Sequence
from math import ceil
from pathlib import Path
from typing import Any

from hood.dynamics.recorder import RolloutData
from hood.scene.fastening import first_step

_ACTIONS = ("open", "close", "detach", "attach")


def moments_of(data: RolloutData) -> list[tuple[int, str]]:
    """Frames whose steps are the first with an event, and what that does: ``(30, "open front_buttons")``, by frame.

    Events count simulated frames; where others are stored (``output_fps``) it is the first stored one that is no earlier.
    Events that no step shows are left out. Rollouts made otherwise than by ``hood rollout`` have none.
    """
    found, dt = [], float(data.attributes.get("dt", 0.0))
    rate = None if data.steps is None else data.steps.rate
    step = dt if rate is None else 1.0 / rate.simulated_fps
    for event in (_settings(data).get("events") or []) if dt > 0 else []:
        action = next(action for action in _ACTIONS if action in event)
        frame = int(event["frame"]) if "frame" in event else first_step(float(event["time"]), step)
        frame = frame if rate is None else ceil(frame / rate.stride)
        if frame < len(data.time) - 1:
            found.append((frame, f"{action} {_names(event[action])}"))
    return sorted(found, key=lambda moment: moment[0])


def shared_moments(rollouts: Sequence[tuple[str, RolloutData]]) -> list[tuple[int, str]]:
    """Those of several named rollouts; where not all have one, with the names of those that do."""
    by_moment: dict[tuple[int, str], list[str]] = {}
    for name, data in rollouts:
        for moment in dict.fromkeys(moments_of(data)):
            by_moment.setdefault(moment, []).append(name)
    return [
        (frame, words if len(names) == len(rollouts) else f"{words} ({', '.join(names)})")
        for (frame, words), names in sorted(by_moment.items())
    ]


def wind_of(data: RolloutData) -> str:
    """``wind 3 m/s, gusts 20%``, or nothing where there is no air."""
    settings = _settings(data)
    wind, gusts = settings.get("wind"), settings.get("gusts")
    if wind is None:
        return ""
    speed = f"({', '.join(f'{part:g}' for part in wind)})" if isinstance(wind, list) else f"{wind:g}"
    return f"wind {speed} m/s" + (f", gusts {gusts:.0%}" if gusts else "")


def _settings(data: RolloutData) -> dict[str, Any]:
    try:
        settings = json.loads(data.attributes.get("config", "{}"))
    except ValueError:
        return {}
    return settings if isinstance(settings, dict) else {}


def _names(given: Any) -> str:
    names = given if isinstance(given, list) else [given]
    numbers = [name for name in names if isinstance(name, int)]
    counted = [f"{len(numbers)} vertices" if len(numbers) > 1 else f"vertex {numbers[0]}"] if numbers else []
    return ", ".join([*(Path(name).name for name in names if isinstance(name, str)), *counted])
