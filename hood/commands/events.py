"""``events=``: fasteners of a garment that are opened and closed during a rollout."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace
from typing import Any

from omegaconf import DictConfig

from hood.assets.files.library import unknown
from hood.config import ConfigError, plain
from hood.scene.fastening import Event, first_step
from hood.scene.scene import Scene

#: What an event may do, and whether that closes a row of fasteners.
ACTIONS = {"open": False, "close": True}
_FORM = "events=[{time: 2.0, open: front_buttons}, {frame: 120, close: front_buttons}]"


@dataclass(frozen=True)
class Asked:
    """An event of a config."""

    index: int
    time: float | None  # s; None: at ``frame``
    frame: int | None
    action: str
    names: tuple[str, ...]

    def first_step(self, dt: float) -> int:
        """The frame whose step is the first with it."""
        return first_step(self.time, dt) if self.frame is None else self.frame  # type: ignore[arg-type]


def checked_events(config: DictConfig) -> tuple[Asked, ...]:
    """The events that the config asks for, in its order.

    Raises:
        ConfigError: something else than events, or ``events_speed`` is no speed; names the event by its place, from 0.
    """
    given = plain(config.events)
    if not isinstance(given, list):
        raise ConfigError(f"events={given}: give a list, {_FORM}")
    speed = config.events_speed
    if isinstance(speed, bool) or not isinstance(speed, (int, float)) or not 0.0 < speed < math.inf:
        raise ConfigError(f"events_speed={speed}: give a speed > 0 in m/s, such as 0.3")
    return tuple(_asked(index, event) for index, event in enumerate(given))


def _asked(index: int, event: Any) -> Asked:
    where = f"events[{index}]"
    if not isinstance(event, dict):
        raise ConfigError(f"{where} is {event}; give a time and what happens, {_FORM}")
    for key in event:
        if key not in ("time", "frame", *ACTIONS):
            raise ConfigError(f"{where}: {unknown('key', str(key), ['time', 'frame', *ACTIONS])}")
    moments, actions = [key for key in ("time", "frame") if key in event], [key for key in ACTIONS if key in event]
    if len(moments) != 1:
        raise ConfigError(f"{where} has {len(moments)} of time and frame; give one: time: 2.0 (s) or frame: 60")
    if len(actions) != 1:
        raise ConfigError(f"{where} has {len(actions)} of {' and '.join(ACTIONS)}; give one, such as open: front_buttons")
    value, names = event[moments[0]], event[actions[0]]
    number = isinstance(value, (int, float)) and not isinstance(value, bool) and 0.0 <= value < math.inf
    if not number or (moments[0] == "frame" and value != int(value)):
        fix = "seconds >= 0, such as time: 2.0" if moments[0] == "time" else "a whole number >= 0, such as frame: 60"
        raise ConfigError(f"{where}: {moments[0]} is {value}; give {fix}")
    names = names if isinstance(names, list) else [names]
    if not names or not all(isinstance(name, str) for name in names):
        raise ConfigError(f"{where}: {actions[0]} is {event[actions[0]]}; give a name or a list of names")
    time, frame = (float(value), None) if moments[0] == "time" else (None, int(value))
    return Asked(index, time, frame, actions[0], tuple(dict.fromkeys(names)))


def with_events(scene: Scene, config: DictConfig) -> Scene:
    """The scene whose fasteners are opened and closed as the config asks; warns of events after the last frame.

    Raises:
        ConfigError: the garment has no such fasteners, or two events in one frame contradict each other; names the event.
    """
    asked = checked_events(config)
    if scene.fastening is None:
        if asked:
            raise ConfigError(
                f"events[0]: garment {scene.garment.name!r} has nothing that opens or closes; wear shirt or jacket, or name "
                "pairs of your garment's vertices with hood prepare fasten=…"
            )
        return scene
    events: dict[tuple[int, str], tuple[int, Event]] = {}
    for one in asked:
        frame = one.first_step(scene.dt)
        for name in one.names:
            if name not in scene.fastening.names:
                raise ConfigError(f"events[{one.index}]: {unknown('fastener', name, list(scene.fastening.names))}")
            other = events.get((frame, name))
            if other is not None and other[1].closes != ACTIONS[one.action]:
                raise ConfigError(
                    f"events[{one.index}]: {one.action}s {name} in frame {frame}, where events[{other[0]}] does the opposite; "
                    "give them different times"
                )
            events[frame, name] = one.index, Event(frame, name, ACTIONS[one.action])
        _warn_if_late(one, frame, min(int(config.num_frames), scene.num_frames), scene.dt)
    rows = [event for _, event in events.values()]
    return replace(scene, fastening=scene.fastening.with_events(rows, float(config.events_speed)))


def _warn_if_late(event: Asked, frame: int, num_frames: int, dt: float) -> None:
    if frame > num_frames - 2:
        warnings.warn(
            f"events[{event.index}]: no step begins at {frame * dt:.2f} s (frame {frame}) or later, the last one begins at "
            f"{max(num_frames - 2, 0) * dt:.2f} s; it has no effect",
            stacklevel=3,
        )


def fastening_attributes(scene: Scene) -> dict[str, Any]:
    """What ``rollout.h5`` says of fasteners beside their pairs: names of the rows, whether they are closed at first, and events,
    each a frame, a row and whether it closes. Nothing of scenes without any."""
    fastening = scene.fastening
    if fastening is None:
        return {}
    events = [[event.frame, event.name, event.closes] for event in fastening.events]
    closed = [name for name, state in zip(fastening.names, fastening.closed(-1), strict=True) if state]
    return {"fastening": {"names": list(fastening.names), "closed_at_first": closed, "events": events}}
