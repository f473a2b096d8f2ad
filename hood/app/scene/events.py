"""``events=``: fasteners that are opened and closed, and vertices that are held and let go, during a rollout.

What ``summary.json`` says of events: when each row of fasteners was opened and closed and how well it then held, and when
vertices were held and let go.
"""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hood.app.settings.compose import ConfigError, plain
from hood.app.settings.rollout_settings import RolloutSettings, fixed_shapes
from hood.assets.files.library import unknown
from hood.assets.garment.pins import pin_mask, pin_numbers
from hood.rollouts.file.reader import RolloutData
from hood.scene.body_motion.motion import BodyMotion
from hood.scene.holding import CLOSED, SPEED, Event, Grasp, Holding, first_step
from hood.scene.scene import Scene


def summarise_fasteners(data: RolloutData) -> dict[str, Any]:
    """Of every row by name: the number of its pairs, its events, and by how much [m] a pair was off its distance at most while
    the row was closed. Nothing of rollouts without fasteners.

    Events that no frame shows are left out. A closing event says from which frame on all pairs are within a millimetre of their
    distance (``within_frame``, ``within_time``; None where they never were before the row was opened again).
    """
    if "fastening" not in data.attributes:
        return {}
    known = json.loads(data.attributes["fastening"])
    pairs, row, length = (data.still[name] for name in ("fastened", "fastened_row", "fastened_length"))
    apart = np.linalg.norm(data.step_pos(pairs[:, 0]) - data.step_pos(pairs[:, 1]), axis=2)
    off = np.abs(apart - length)
    rows = {}
    for number, name in enumerate(known["names"]):
        events = [(frame, closes) for frame, event, closes in known["events"] if event == name]
        if name in known["closed_at_first"]:
            events.insert(0, (-1, True))
        rows[name] = _row(off[:, row == number], events, data.step_time)
    return {"fasteners": rows}


def _row(off: np.ndarray, events: list[tuple[int, bool]], time: np.ndarray) -> dict[str, Any]:
    """Of deviations (T, P) [m] of a row's pairs; an event acts in the frame after its own for the first time."""
    reported, worst, last = [], [], len(off) - 1
    for place, (frame, closes) in enumerate(events):
        if frame >= last:
            break
        end = min((later for later, _ in events[place + 1 :]), default=last)
        phase = off[frame + 1 : end + 1].max(axis=1)
        within = np.flatnonzero(phase <= CLOSED)
        first = int(frame + 1 + within[0]) if closes and len(within) else None
        if first is not None:
            worst.append(float(off[first : end + 1].max()))
        if frame < 0:
            continue
        event: dict[str, Any] = {"action": "close" if closes else "open", "frame": frame, "time": float(time[frame])}
        if closes:
            event |= {
                "within_frame": first,
                "within_time": None if first is None else float(time[first]),
                "left_open": int((off[min(end, last)] > CLOSED).sum()),
            }
        reported.append(event)
    return {
        "pairs": off.shape[1],
        "closed_at_first": bool(events and events[0] == (-1, True)),
        "events": reported,
        "off_while_closed_max_m": max(worst, default=None),
    }


def describe_fasteners(summary: Mapping[str, Any]) -> list[str]:
    """A line on every row that was opened or closed."""
    lines = []
    for name, row in summary.get("fasteners", {}).items():
        if not row["events"]:
            continue
        said = "; ".join(_sentence(event, row["pairs"]) for event in row["events"])
        off = row["off_while_closed_max_m"]
        held = "" if off is None else f"; closed pairs at most {1e3 * off:.2f} mm off"
        lines.append(f"{name} ({row['pairs']} pairs): {said}{held}")
    return lines


def _sentence(event: Mapping[str, Any], pairs: int) -> str:
    when = f"{event['time']:.2f} s (frame {event['frame']})"
    if event["action"] == "open":
        return f"opened at {when}"
    if event["within_frame"] is None:
        return f"closing from {when} on, {event['left_open']} of {pairs} pairs still apart in the end"
    return f"closing from {when} on, within 1 mm at {event['within_time']:.2f} s (frame {event['within_frame']})"


def summarise_held(scene: Scene, data: RolloutData) -> dict[str, Any]:
    """Of every event that holds vertices or lets them go: its frame and how many; of vertices that are taken hold of, the first
    frame in which all are within a millimetre of where the skinned garment has them. Nothing of scenes without such events."""
    if scene.holding is None:
        return {}
    time = data.step_time
    rows, last = [], len(time) - 1
    for place, grasp in enumerate(scene.holding.grasps):
        if grasp.frame >= last:
            break
        row: dict[str, Any] = {
            "action": "attach" if grasp.holds else "detach",
            "frame": grasp.frame,
            "time": float(time[grasp.frame]),
            "vertices": int(grasp.vertices.sum()),
        }
        if grasp.holds:
            end = next((later.frame for later in scene.holding.grasps[place + 1 :] if not later.holds), last)
            chosen = np.flatnonzero(grasp.vertices.cpu().numpy())
            pos = data.step_pos(chosen)
            within = (f for f in range(grasp.frame + 1, min(end, last) + 1) if _off(scene, pos[f], f, chosen) <= CLOSED)
            first = next(within, None)
            row |= {"within_frame": first, "within_time": None if first is None else float(time[first])}
        rows.append(row)
    return {"held": rows}


def _off(scene: Scene, pos: np.ndarray, frame: int, chosen: np.ndarray) -> float:
    """How far [m] chosen vertices (K,), at ``pos`` (K, 3), are from where the skinned garment has them, at most."""
    origin = scene.motion.translation[frame]
    there = scene.skinned(frame, origin).cpu().double().numpy() + origin
    return float(np.linalg.norm(pos - there[chosen], axis=1).max())


def describe_held(summary: Mapping[str, Any]) -> list[str]:
    """A line on vertices that were held or let go."""
    said = []
    for event in summary.get("held", []):
        when = f"{event['vertices']} vertices from {event['time']:.2f} s (frame {event['frame']}) on"
        if event["action"] == "detach":
            said.append(f"let go of {when}")
        elif event["within_frame"] is None:
            said.append(f"holds {when}, not in their places by the end")
        else:
            said.append(f"holds {when}, in their places at {event['within_time']:.2f} s (frame {event['within_frame']})")
    return ["; ".join(said)] if said else []


#: What an event does: to rows of fasteners, whether that closes them, and to vertices, whether that holds them.
ROWS, VERTICES = {"open": False, "close": True}, {"detach": False, "attach": True}
ACTIONS = (*ROWS, *VERTICES)
#: Those that bring together what is apart, at their speed.
TOGETHER = tuple(name for name, together in (ROWS | VERTICES).items() if together)
_KEYS = ("time", "frame", "speed", *ACTIONS)
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
    speed: float = SPEED  # m/s

    def first_step(self, dt: float) -> int:
        """The frame whose step is the first with it."""
        return int(self.moment) if self.in_frames else first_step(float(self.moment), dt)


def checked_events(config: RolloutSettings) -> tuple[Asked, ...]:
    """The events that the config asks for, in its order.

    Raises:
        ConfigError: something else than events; names the event by its place, from 0.
    """
    given = plain(config.events)
    if not isinstance(given, list):
        raise ConfigError(f"events={given}: give a list, {_FORM}")
    asked = tuple(_asked(index, event) for index, event in enumerate(given))
    held = next((one for one in asked if one.action in VERTICES), None)
    if held is not None and fixed_shapes(config):
        raise ConfigError(
            f"events[{held.index}]: step={config.step} has fixed shapes, in which the same vertices are held; use step=plain"
        )
    return asked


def _asked(index: int, event: Any) -> Asked:
    where = f"events[{index}]"
    if not isinstance(event, dict):
        raise ConfigError(f"{where} is {event}; give a time and what happens, {_FORM}")
    for key in event:
        if key not in _KEYS:
            raise ConfigError(f"{where}: {unknown('key', str(key), _KEYS)}")
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
    return Asked(
        index, value, moments[0] == "frame", action, _names(where, action, event[action]), _speed(where, action, event)
    )


def _speed(where: str, action: str, event: dict[str, Any]) -> float:
    """At which what comes together does [m/s]."""
    speed = event.get("speed", SPEED)
    if isinstance(speed, bool) or not isinstance(speed, (int, float)) or not 0.0 < speed < math.inf:
        raise ConfigError(f"{where}: speed is {speed}; give a speed > 0 in m/s, such as speed: {SPEED:g}")
    if "speed" in event and action not in TOGETHER:
        raise ConfigError(f"{where}: speed belongs to {' and '.join(TOGETHER)}; {action} acts at once, leave speed out")
    return float(speed)


def _names(where: str, action: str, given: Any) -> tuple[str | int, ...]:
    names = given if isinstance(given, list) else [given]
    kinds = str if action in ROWS else (str, int)
    if not names or not all(isinstance(name, kinds) and not isinstance(name, bool) for name in names):
        what = "a name or a list of names" if action in ROWS else "pins (a region, painted, vertex numbers, a list of them)"
        raise ConfigError(f"{where}: {action} is {given}; give {what}")
    return tuple(dict.fromkeys(names))


def with_events(scene: Scene, config: RolloutSettings) -> Scene:
    """The scene with what is opened, closed, held and let go as the config asks; warns of events after the last frame.

    Raises:
        ConfigError: the garment has no such fasteners or vertices, or an event contradicts another or does nothing; names it.
    """
    asked = checked_events(config)
    for one in asked:
        _warn_if_late(one, one.first_step(scene.dt), min(int(config.num_frames), scene.num_frames), scene.dt)
    scene = _with_rows(scene, [one for one in asked if one.action in ROWS])
    return _with_grasps(scene, [one for one in asked if one.action in VERTICES])


def _with_rows(scene: Scene, asked: list[Asked]) -> Scene:
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
            events[frame, name] = one.index, Event(frame, name, ROWS[one.action], one.speed)
    return replace(scene, fastening=scene.fastening.with_events([event for _, event in events.values()]))


def _with_grasps(scene: Scene, asked: list[Asked]) -> Scene:
    if not asked:
        return scene
    held, grasps, soft = scene.cloth.pinned, list[Grasp](), _soft(scene)
    for one in sorted(asked, key=lambda event: event.first_step(scene.dt)):
        where, frame, holds = f"events[{one.index}]", one.first_step(scene.dt), VERTICES[one.action]
        try:
            vertices = _vertices(scene, one.names).to(held.device)
        except ValueError as error:
            raise ConfigError(f"{where}: {one.action}: {str(error).removeprefix('pins: ')}") from error
        changed = ~held if holds else held | soft
        if not bool((vertices & changed).any()):
            state = "held already" if holds else "held then; pins=… holds vertices from the start"
            raise ConfigError(f"{where}: {one.action}: {'all' if holds else 'none'} of these vertices are {state}")
        clash = next((grasp for grasp in grasps if grasp.frame == frame and grasp.holds != holds), None)
        if clash is not None and bool((clash.vertices & vertices).any()):
            raise ConfigError(
                f"{where}: {one.action}: another event in frame {frame} does the opposite to some of these vertices"
            )
        held, soft = (held | vertices, soft) if holds else (held & ~vertices, soft & ~vertices)
        grasps.append(Grasp(frame, vertices, holds, one.speed))
    return replace(scene, holding=Holding(tuple(grasps)))


def _vertices(scene: Scene, names: tuple[str | int, ...]) -> Tensor:
    """(V,) bool."""
    body = scene.motion.body if isinstance(scene.motion, BodyMotion) else None
    named = [name for name in names if name != PINS]
    pin_numbers(named)  # refuses tables
    chosen = torch.as_tensor(pin_mask(named, scene.garment, body))
    if PINS in names:
        chosen = chosen | torch.as_tensor(scene.garment.pinned) | _soft(scene).cpu()
    if not bool(chosen.any()):
        raise ValueError("there are no such vertices; give a region, painted, vertex numbers, or a .txt or .json list of them")
    return chosen


def _soft(scene: Scene) -> Tensor:
    """(V,) bool: vertices that springs hold."""
    soft = None if scene.held is None else scene.held.stiffness
    return torch.zeros_like(scene.cloth.pinned) if soft is None else soft > 0


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
