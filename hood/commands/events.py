"""``events=``: fasteners that are opened and closed, and vertices that are held and let go, during a rollout."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace
from typing import Any

import torch
from omegaconf import DictConfig
from torch import Tensor

from hood.assets.files.library import unknown
from hood.assets.garment.pins import pin_mask
from hood.config import ConfigError, plain
from hood.scene.fastening import SPEED, Event, first_step
from hood.scene.holding import Grasp, Holding
from hood.scene.motion import BodyMotion
from hood.scene.scene import Scene

#: What an event does: to rows of fasteners, whether that closes them, and to vertices, whether that holds them.
ROWS, VERTICES = {"open": False, "close": True}, {"detach": False, "attach": True}
ACTIONS = (*ROWS, *VERTICES)
_FORM = "events=[{time: 2.0, open: front_buttons}, {frame: 120, close: front_buttons}, {time: 3.0, detach: waistband}]"
#: The pins that the garment has, as a name in attach and detach.
PINS = "pins"


@dataclass(frozen=True)
class Asked:
    """An event of a config."""

    index: int
    moment: float | int  # s, or a frame where ``in_frames``
    in_frames: bool
    action: str
    names: tuple[str | int, ...]

    def first_step(self, dt: float) -> int:
        """The frame whose step is the first with it."""
        return int(self.moment) if self.in_frames else first_step(float(self.moment), dt)


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
        raise ConfigError(f"events_speed={speed}: give a speed > 0 in m/s, such as {SPEED:g}")
    asked = tuple(_asked(index, event) for index, event in enumerate(given))
    held = next((one for one in asked if one.action in VERTICES), None)
    if held is not None and str(config.step) != "plain":
        raise ConfigError(
            f"events[{held.index}]: step={config.step} has fixed shapes, in which the same vertices are held; use step=plain"
        )
    return asked


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
        raise ConfigError(f"{where} has {len(actions)} of {', '.join(ACTIONS)}; give one, such as open: front_buttons")
    value, action = event[moments[0]], actions[0]
    number = isinstance(value, (int, float)) and not isinstance(value, bool) and 0.0 <= value < math.inf
    if not number or (moments[0] == "frame" and value != int(value)):
        fix = "seconds >= 0, such as time: 2.0" if moments[0] == "time" else "a whole number >= 0, such as frame: 60"
        raise ConfigError(f"{where}: {moments[0]} is {value}; give {fix}")
    return Asked(index, value, moments[0] == "frame", action, _names(where, action, event[action]))


def _names(where: str, action: str, given: Any) -> tuple[str | int, ...]:
    names = given if isinstance(given, list) else [given]
    kinds = str if action in ROWS else (str, int)
    if not names or not all(isinstance(name, kinds) and not isinstance(name, bool) for name in names):
        what = "a name or a list of names" if action in ROWS else "pins (a region, painted, vertex numbers, a list of them)"
        raise ConfigError(f"{where}: {action} is {given}; give {what}")
    return tuple(dict.fromkeys(names))


def with_events(scene: Scene, config: DictConfig) -> Scene:
    """The scene with what is opened, closed, held and let go as the config asks; warns of events after the last frame.

    Raises:
        ConfigError: the garment has no such fasteners or vertices, or an event contradicts another or does nothing; names it.
    """
    asked, speed = checked_events(config), float(config.events_speed)
    for one in asked:
        _warn_if_late(one, one.first_step(scene.dt), min(int(config.num_frames), scene.num_frames), scene.dt)
    scene = _with_rows(scene, [one for one in asked if one.action in ROWS], speed)
    return _with_grasps(scene, [one for one in asked if one.action in VERTICES], speed)


def _with_rows(scene: Scene, asked: list[Asked], speed: float) -> Scene:
    if scene.fastening is None:
        if asked:
            raise ConfigError(
                f"events[{asked[0].index}]: garment {scene.garment.name!r} has nothing that opens or closes; wear shirt or "
                "jacket, or name pairs of your garment's vertices with hood prepare fasten=…"
            )
        return scene
    events: dict[tuple[int, str], tuple[int, Event]] = {}
    for one in asked:
        frame = one.first_step(scene.dt)
        for name in map(str, one.names):
            if name not in scene.fastening.names:
                raise ConfigError(f"events[{one.index}]: {unknown('fastener', name, list(scene.fastening.names))}")
            other = events.get((frame, name))
            if other is not None and other[1].closes != ROWS[one.action]:
                raise ConfigError(
                    f"events[{one.index}]: {one.action}s {name} in frame {frame}, where events[{other[0]}] does the opposite; "
                    "give them different times"
                )
            events[frame, name] = one.index, Event(frame, name, ROWS[one.action])
    return replace(scene, fastening=scene.fastening.with_events([event for _, event in events.values()], speed))


def _with_grasps(scene: Scene, asked: list[Asked], speed: float) -> Scene:
    if not asked:
        return scene
    held, grasps = scene.cloth.pinned, list[Grasp]()
    for one in sorted(asked, key=lambda event: event.first_step(scene.dt)):
        where, frame, holds = f"events[{one.index}]", one.first_step(scene.dt), VERTICES[one.action]
        try:
            vertices = _vertices(scene, one.names).to(held.device)
        except ValueError as error:
            raise ConfigError(f"{where}: {one.action}: {str(error).removeprefix('pins: ')}") from error
        if not bool((vertices & (held != holds)).any()):
            state = "held already" if holds else "held then; pins=… holds vertices from the start"
            raise ConfigError(f"{where}: {one.action}: {'all' if holds else 'none'} of these vertices are {state}")
        clash = next((grasp for grasp in grasps if grasp.frame == frame and grasp.holds != holds), None)
        if clash is not None and bool((clash.vertices & vertices).any()):
            raise ConfigError(
                f"{where}: {one.action}: another event in frame {frame} does the opposite to some of these vertices"
            )
        held = held | vertices if holds else held & ~vertices
        grasps.append(Grasp(frame, vertices, holds))
    return replace(scene, holding=Holding(tuple(grasps), speed))


def _vertices(scene: Scene, names: tuple[str | int, ...]) -> Tensor:
    """(V,) bool."""
    body = scene.motion.body if isinstance(scene.motion, BodyMotion) else None
    mask = pin_mask([name for name in names if name != PINS], scene.garment, body)
    chosen = torch.as_tensor(mask | scene.garment.pinned if PINS in names else mask)
    if not bool(chosen.any()):
        raise ValueError("there are no such vertices; give a region, painted, vertex numbers, or a .txt or .json list of them")
    return chosen


def _warn_if_late(event: Asked, frame: int, num_frames: int, dt: float) -> None:
    if frame > num_frames - 2:
        warnings.warn(
            f"events[{event.index}]: no step begins at {frame * dt:.2f} s (frame {frame}) or later, the last one begins at "
            f"{max(num_frames - 2, 0) * dt:.2f} s; it has no effect",
            stacklevel=3,
        )


def fastening_attributes(scene: Scene) -> dict[str, Any]:
    """What ``rollout.h5`` says of fasteners beside their pairs: names of the rows, those that are closed at first, and events,
    each a frame, a row and whether it closes. Nothing of scenes without any."""
    fastening = scene.fastening
    if fastening is None:
        return {}
    events = [[event.frame, event.name, event.closes] for event in fastening.events]
    closed = [name for name, state in zip(fastening.names, fastening.closed(-1), strict=True) if state]
    return {"fastening": {"names": list(fastening.names), "closed_at_first": closed, "events": events}}
