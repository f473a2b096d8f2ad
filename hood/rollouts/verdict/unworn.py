"""Parts of a garment that have come off the body, in words."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from hood.assets.files.said import Doubt
from hood.limits import AWAY_UNSOUND, SHIFTED_UNSOUND, SLIPPED_UNSOUND, SUNK_SETTLING, SUNK_UNSOUND, TOLERATED
from hood.rollouts.file.reader import RolloutData
from hood.rollouts.verdict.frames import Cause, FoundFrames
from hood.rollouts.verdict.surface import Meshes
from hood.rollouts.verdict.worn import Wear, measure_wear

#: Stored frames that are looked at, at most.
_LOOKED_AT = 60


def worn_causes(data: RolloutData, meshes: Meshes, count: int) -> FoundFrames:
    """Every part of the garment that has left its place on the body, by the ``count`` simulated frames. Nothing without a body,
    with ``worn=false``, and from the first event on that lets go of held cloth."""
    config = _config(data)
    if config.get("worn", True) is False or not len(meshes.body_faces) or not len(meshes.faces):
        return FoundFrames()
    last = _detached(config, data, len(meshes.cloth))
    notes = _note_on_events(meshes, last)
    finite = np.isfinite(meshes.cloth[:last]).all(axis=(1, 2))
    usable = np.flatnonzero(finite)
    if not len(usable) or usable[0] != 0:
        return FoundFrames(notes=notes)
    chosen = usable[np.unique(np.linspace(0, len(usable) - 1, min(len(usable), _LOOKED_AT)).astype(np.int64))]
    wear = measure_wear(meshes.cloth, meshes.faces, meshes.body, meshes.body_faces, chosen.tolist(), meshes.pinned)
    if wear is None:
        return FoundFrames(notes=notes)
    found = FoundFrames(_fallen_before(data, count), notes=notes)
    for part in range(len(wear.num_vertices)):
        found += _of_part(data, meshes, wear, part, count)
    return found


def _before(data: RolloutData) -> tuple[float, float]:
    """How far the garment moved away and sank while the start was settled [m], the worst of its parts; NaN: not known."""
    rows = [data.step_metrics.get(name) for name in ("settle_away", "settle_sunk")]
    away, sunk = (np.nan if row is None or not len(row) else float(row[0]) for row in rows)
    return away, sunk


def _fallen_before(data: RolloutData, count: int) -> list[Cause]:
    """What came off while the start was settled, before frame 0."""
    away, sunk = _before(data)
    if not (away > AWAY_UNSOUND.value or sunk > SUNK_SETTLING.value):
        return []
    way, limit = (away, AWAY_UNSOUND) if away > AWAY_UNSOUND.value else (sunk, SUNK_SETTLING)
    text = (
        f"{str(data.attributes.get('garment', 'garment'))!r} came off when it was settled on the body, before frame 0: it has "
        f"moved by {way:.2f} m from where it was put on (beyond {limit.value:.2f}); pins=… hold it, a smaller size stays"
    )
    bad = np.ones(count, dtype=bool)
    return [Cause("not_worn", text, bad, np.full(count, way), limit.value, limit.unit, ".2f", whole=True)]


def _of_part(data: RolloutData, meshes: Meshes, wear: Wear, part: int, count: int) -> FoundFrames:
    away, slipped = wear.away[:, part], wear.slipped[:, part]
    if not np.isfinite(away).any():
        return FoundFrames(doubts=[_not_worn_at_first(data, wear, part)])
    ways = (
        (away, AWAY_UNSOUND, "it is away from where it was on the body"),
        (slipped, SLIPPED_UNSOUND, "its highest opening has slipped along the body"),
        (wear.sunk[:, part], SUNK_UNSOUND, "its top has slid down the body"),
        (wear.shifted[:, part], SHIFTED_UNSOUND, "it has shifted along the body"),
    )
    off = np.any([way > limit.value for way, limit, _ in ways], axis=0)
    # What has come off stays off; a film does not show a moment.
    if not (off[-1] or off.mean() > TOLERATED.value and off.sum() > 1):
        return FoundFrames()
    first = int(np.argmax(off))
    frames = meshes.step[wear.frames]
    bad = np.zeros(count, dtype=bool)
    for place in np.flatnonzero(off).tolist():
        until = frames[place + 1] if place + 1 < len(frames) else count
        bad[frames[place] : until] = True
    beyond = [(float(np.nanmax(way)), way, limit, how) for way, limit, how in ways if (way > limit.value).any()]
    worst, way, limit, how = max(beyond, key=lambda one: one[0])
    values = np.full(count, np.nan)
    values[frames] = way
    text = (
        f"{_name_part(data, wear, part)} has come off: from frame {frames[first]} on {how}, by "
        f"{worst:.2f} m at worst (beyond {limit.value:.2f})"
    )
    return FoundFrames([Cause("not_worn", text, bad, values, limit.value, limit.unit, ".2f", part=part + 1, whole=True)])


def _not_worn_at_first(data: RolloutData, wear: Wear, part: int) -> Doubt:
    text = (
        f"{_name_part(data, wear, part)} is not worn in frame 0, it is {100 * wear.gap[part]:.0f} cm from the body or hardly "
        "touches it, so nobody can tell whether it stays on; worn=false says that it need not"
    )
    return Doubt("worn", text, (0,), float(wear.gap[part]), "m")


def _name_part(data: RolloutData, wear: Wear, part: int) -> str:
    """A part in words: the garment, or its number, vertices and the lowest of them."""
    garment = str(data.attributes.get("garment", "garment"))
    if len(wear.num_vertices) == 1:
        return repr(garment)
    piece, names = data.still.get("piece"), garment.split("+")
    if piece is not None and len(names) == len(wear.num_vertices) and len(np.unique(piece)) == len(names):
        return repr(names[int(piece[wear.first_vertex[part]])])
    return (
        f"part {part + 1} of {len(wear.num_vertices)} of {garment!r} ({wear.num_vertices[part]} vertices, the lowest is "
        f"{wear.first_vertex[part]})"
    )


def _note_on_events(meshes: Meshes, last: int) -> list[str]:
    if last >= len(meshes.cloth):
        return []
    return [f"whether the garment stays on is not judged from frame {meshes.step[last]} on, where an event lets go of it"]


def _detached(config: dict[str, Any], data: RolloutData, count: int) -> int:
    """The first stored frame at which an event lets go of held cloth; ``count`` where none does."""
    events = config.get("events") or []
    moments = [_moment(event, data) for event in events if isinstance(event, dict) and "detach" in event]
    if not moments:
        return count
    return int(np.searchsorted(data.time, min(moments) - 1e-9))


def _moment(event: dict[str, Any], data: RolloutData) -> float:
    if "time" in event:
        return float(event["time"])
    times, frame = data.step_time, int(event["frame"])
    return float(times[frame]) if frame < len(times) else np.inf


def _config(data: RolloutData) -> dict[str, Any]:
    """The settings that the rollout was made with; files from before may lack them."""
    try:
        found = json.loads(str(data.attributes.get("config", "{}")))
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}
