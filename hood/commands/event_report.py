"""What ``summary.json`` says of events: when each row of fasteners was opened and closed and how well it then held, and when
vertices were held and let go."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from hood.dynamics.recorder import RolloutData
from hood.scene.fastening import CLOSED
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
    there = scene.motion.skinned(scene.garment, frame, origin).cpu().double().numpy() + origin
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
