"""The page of ``hood view``: program, pictures of the data and drawing library in one file of HTML.

What a rollout's settings say of its course, in words: when something is opened, closed, held or let go, and the wind.

Numbers that change little from frame to frame, as short text inside a page, and back.
"""

from __future__ import annotations

import base64
import html
import json
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np

from hood.assets.formats.raw_mesh import Texture
from hood.media.colouring import COLOURINGS, Colouring, colouring_of, colours_at
from hood.media.film import seconds_per_frame
from hood.media.pieces import hideable_parts, looks_of, pieces_of, split_seams
from hood.rollouts.file.reader import RolloutData
from hood.rollouts.verdict.rule import Verdict, judge_rollout
from hood.scene.holding import first_step

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
        frame = _stored(data, frame)
        if frame < len(data.time) - 1:
            found.append((frame, f"{action} {_names(event[action])}"))
    return sorted(found, key=lambda moment: moment[0])


@dataclass(frozen=True)
class TimelineMark:
    """Frames that the time line marks, in words."""

    frame: int
    last: int
    kind: str  # event, alarm (of the guard), unsound or doubt (of the verdict)
    words: str
    title: str = ""  # the whole sentence, where the words are only its beginning


def timeline_marks(data: RolloutData, verdict: Verdict | None = None) -> list[TimelineMark]:
    """Events, alarms of the guard, and what the ``verdict`` says of frames, by frame; frames that are not there are left out.

    Alarms of one cause that lie close together are one mark, with the worst value. What is said of no frame is marked at 0.
    """
    found = [TimelineMark(frame, frame, "event", words) for frame, words in moments_of(data)]
    said: list[tuple[str, str, str, Sequence[tuple[int, int]]]] = []  # kind, words, title and runs of simulated frames
    for cause in dict.fromkeys(str(alarm["cause"]) for alarm in data.alarms):
        mine = {int(alarm["frame"]): alarm for alarm in data.alarms if str(alarm["cause"]) == cause}
        for run in _joined([(frame, frame) for frame in sorted(mine)], len(data.time)):
            worst = max((mine[frame] for frame in mine if run[0] <= frame <= run[1]), key=lambda alarm: float(alarm["value"]))
            told = f"{cause}, {worst['value']:.3g}" if np.isfinite(worst["value"]) else cause
            limit = f" (limit {worst['limit']:.3g})" if np.isfinite(worst["limit"]) else ""
            said.append(("alarm", cause, f"guard: {told} in frame {_stored(data, int(worst['frame']))}{limit}", [run]))
    if verdict is not None and verdict.sound is False:
        said += [("unsound", one.kind, f"unsound: {one.sentence}", one.frames) for one in verdict.reasons]
    for doubt in () if verdict is None else verdict.doubts:
        runs = [(frame, frame) for frame in sorted(doubt["frames"])]
        said.append(("doubt", str(doubt["kind"]), f"doubt: {doubt['sentence']}", runs))
    for kind, words, title, given in said:
        for first, last in _joined(given, len(data.time)) or [(0, 0)]:
            ends = _stored(data, first), min(_stored(data, last), len(data.time) - 1)
            found.append(TimelineMark(*ends, kind, words.replace("_", " "), title))
    return sorted((mark for mark in found if 0 <= mark.frame < len(data.time)), key=lambda mark: (mark.frame, mark.last))


def shared_marks(
    rollouts: Sequence[tuple[str, RolloutData]], verdicts: Sequence[Verdict] | None = None
) -> list[dict[str, Any]]:
    """Those of several named rollouts as JSON; where not all have one, with the names of those that do."""
    by_mark: dict[TimelineMark, list[str]] = {}
    for at, (name, data) in enumerate(rollouts):
        for mark in dict.fromkeys(timeline_marks(data, None if verdicts is None else verdicts[at])):
            by_mark.setdefault(mark, []).append(name)
    return [
        asdict(mark) | ({} if len(names) == len(rollouts) else {"words": f"{mark.words} ({', '.join(names)})"})
        for mark, names in sorted(by_mark.items(), key=lambda item: (item[0].frame, item[0].last))
    ]


def _stored(data: RolloutData, frame: int) -> int:
    """The first stored frame that is no earlier than a simulated one."""
    return frame if data.steps is None else ceil(frame / data.steps.rate.stride)


#: Marks of one kind that are nearer than this share of all frames are one: they would cover each other.
_NEAR = 1 / 60


def _joined(runs: Sequence[tuple[int, int]], count: int) -> list[tuple[int, int]]:
    """Those runs, first and last frames in rising order, that lie close together, as one."""
    joined: list[tuple[int, int]] = []
    for first, last in runs:
        if joined and first - joined[-1][1] <= max(1, _NEAR * count):
            joined[-1] = (joined[-1][0], last)
        else:
            joined.append((first, last))
    return joined


def wind_of(data: RolloutData) -> str:
    """``wind 3 m/s, gusts 20%``, or nothing where there is no air."""
    settings = _settings(data)
    wind, air = settings.get("wind"), ((settings.get("losses") or {}).get("terms") or {}).get("air") or {}
    gusts = air.get("gusts")
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


#: Distance [m] between the positions that a page can hold: none is off by more than half of it in each coordinate.
STEP = 1.8e-4
#: Coordinates beyond this [m] are taken for cloth that blew up.
_FARTHEST = 3e4


def pack_positions(pos: np.ndarray) -> tuple[dict[str, Any], list[int]]:
    """Positions as JSON, within ``STEP / 2`` of what they are, and the frames that cannot be drawn.

    Whole multiples of ``STEP`` are kept as their second differences over the frames, which are small while a mesh moves
    smoothly. Frames with a coordinate that is not finite or is beyond 30 km repeat the frame before.

    Args:
        pos: (T, V, 3) [m].
    """
    flat = np.asarray(pos, dtype=np.float64).reshape(len(pos), -1)
    with np.errstate(invalid="ignore"):
        sound = (np.abs(flat) <= _FARTHEST).all(axis=1)  # false for NaN
    latest = np.maximum.accumulate(np.where(sound, np.arange(len(flat)), -1))
    first = int(np.argmax(sound)) if sound.any() else 0
    drawn = flat[np.where(latest < 0, first, latest)] if sound.any() else np.zeros_like(flat)
    whole = np.rint(drawn / STEP).astype(np.int64)
    second = np.diff(np.diff(whole, axis=0, prepend=0), axis=0, prepend=0)
    packed = {"frames": len(flat), "vertices": int(pos.shape[1]), "step": STEP, "data": pack_integers(second)}
    return packed, np.flatnonzero(~sound).tolist()


def unpack_positions(packed: dict[str, Any]) -> np.ndarray:
    """(T, V, 3) [m] of :func:`pack_positions`; the page does the same."""
    second = unpack_integers(packed["data"]).reshape(packed["frames"], -1)
    whole = np.cumsum(np.cumsum(second, axis=0, dtype=np.int32), axis=0, dtype=np.int32)
    return (whole * packed["step"]).reshape(packed["frames"], packed["vertices"], 3)


def pack_integers(values: np.ndarray) -> str:
    """Integers modulo 2^32 as text: signs folded into the lowest bit, all lowest bytes first, deflated, base64."""
    wrapped = np.asarray(values).astype(np.int64).astype(np.int32).ravel()
    folded = ((wrapped << 1) ^ (wrapped >> 31)).view(np.uint32).astype("<u4")
    return pack_bytes(folded.view(np.uint8).reshape(-1, 4).T)


def unpack_integers(text: str) -> np.ndarray:
    """(N,) int32 of :func:`pack_integers`."""
    planes = np.frombuffer(unpack_bytes(text), dtype=np.uint8).reshape(4, -1)
    folded = planes.T.copy().view("<u4").ravel()
    return ((folded >> 1) ^ (np.uint32(0) - (folded & 1))).view(np.int32)


def pack_bytes(values: np.ndarray) -> str:
    """(...) uint8, deflated and in base64."""
    return base64.b64encode(zlib.compress(np.ascontiguousarray(values, dtype=np.uint8).tobytes(), 6)).decode()


def unpack_bytes(text: str) -> bytes:
    """The bytes of :func:`pack_bytes`."""
    return zlib.decompress(base64.b64decode(text))


#: The ramp's last colour, of vertices without a value; the codes of values are below.
_UNKNOWN = 255
#: Codes of values below and above the scale, where there are such.
_BELOW, _ABOVE = 8, 30
#: What the menu calls a colouring, factor and unit of its numbers there, and its scale that is the same in every page.
_SHOWN: dict[str, tuple[str, float, str, tuple[float, float]]] = {
    "strain": ("strain", 100.0, "%", (0.0, 0.1)),
    "rg": ("unbalanced force", 1.0, "g", (1e-4, 1.0)),
    "contact": ("contact", 1e3, "mm", (0.02, 0.0)),
}
#: Distance between texture coordinates that a page can hold, and the farthest.
UV_STEP, _FARTHEST_UV = 2.0**-16, 2.0**14
_HERE = Path(__file__).parent
#: Modules by the names under which they are imported.
_OWN = ("data", "figures", "colours", "scene", "camera", "marks", "controls")
_MODULES = {"three": "three.module.min.js", "orbit": "OrbitControls.js"} | {name: f"{name}.js" for name in _OWN}
#: Figures of the chart: metric, title.
_CHARTED = (("strain_p99", "strain p99"), ("relative_gradient", "rg"), ("ms_total", "ms a frame"))


def view_page(
    rollouts: Sequence[tuple[str, RolloutData]],
    title: str,
    textures: Sequence[Mapping[str, Texture]] | None = None,
    whole: Sequence[RolloutData] | None = None,
) -> str:
    """The HTML of named rollouts, which loads nothing from anywhere.

    Args:
        textures: of every rollout the images of its garments, by the names of :func:`hood.media.pieces.pieces_of`.
        whole: the rollouts with all their frames, whose verdicts the time line marks; None marks events and alarms only.

    Raises:
        ValueError: there is none, or their frames are not equally far apart in time.
    """
    if not rollouts:
        raise ValueError("no rollout is given")
    seconds = [seconds_per_frame(data) for _, data in rollouts]
    for (name, _), step in zip(rollouts, seconds, strict=True):
        if abs(step - seconds[0]) > 1e-3 * seconds[0]:
            raise ValueError(
                f"{name}: its frames are {step:g} s apart, those of {rollouts[0][0]} {seconds[0]:g} s; "
                "show rollouts of one frame rate together"
            )
    every = [data for _, data in rollouts]
    painted = {name: _colourings(every, name) for name in COLOURINGS if all(_has(data, name) for data in every)}
    levels = {name: _levels(by) for name, by in painted.items()}
    laid_on = textures or [{}] * len(rollouts)
    images = list(dict.fromkeys(texture for by in laid_on for texture in by.values()))
    content = {
        "images": [image.address for image in images],
        "seconds": seconds[0],
        "moments": shared_marks(rollouts, None if whole is None else [judge_rollout(data) for data in whole]),
        "floor": min(_lowest(data) for data in every),
        "ramp": np.rint(255.0 * colours_at(np.append(np.linspace(0.0, 1.0, _UNKNOWN), np.nan))).astype(int).tolist(),
        "scales": [_scale(name, by[0], levels[name]) for name, by in painted.items()],
        "rollouts": [
            _rollout(name, data, every[0] if at else None)
            | {"values": {kind: pack_bytes(_codes(by[at], levels[kind])) for kind, by in painted.items()}}
            | _parted(data, laid_on[at], images)
            for at, (name, data) in enumerate(rollouts)
        ],
    }
    return _fill(title, content)


def _has(data: RolloutData, colour: str) -> bool:
    """Whether a rollout holds what ``colour`` shows."""
    return {"strain": True, "rg": "rg" in data.fields, "contact": len(data.body_faces) > 0}[colour]


def _colourings(rollouts: Sequence[RolloutData], colour: str) -> list[Colouring]:
    """That of every rollout, with one scale."""
    found = [colouring_of(data, colour, [other for other in rollouts if other is not data]) for data in rollouts]
    return [one for one in found if one is not None]


def _lowest(data: RolloutData) -> float:
    """Height [m] of the floor: the lowest finite point of the body, or of the cloth where there is none."""
    heights = (data.body_pos if data.body_pos.shape[1] else data.cloth_pos)[..., 1]
    finite = heights[np.abs(heights) <= _FARTHEST]
    return float(finite.min()) if finite.size else 0.0


def _levels(colourings: Sequence[Colouring]) -> np.ndarray:
    """Places (255,) on a scale, rising, one a code: evenly from 0 to 1 between its ends, and ever wider apart beyond them.

    They go as far as there are values, but at most 1.5 lengths of the scale below and 1,000 above it, 1 and 3 on a logarithmic
    scale; farther values have the last code.
    """
    farthest = (-1.0, 4.0) if colourings[0].logarithmic else (-1.5, 1e3)
    place = np.concatenate([_place(one).ravel() for one in colourings])
    place = np.clip(place[~np.isnan(place)], *farthest)
    low, high = float(place.min(initial=0.0)), float(place.max(initial=1.0))
    below, above = (_BELOW if low < 0 else 0), (_ABOVE if high > 1 else 0)
    return np.concatenate(
        [
            low * np.linspace(1.0, 0.0, below, endpoint=False) ** 2,
            np.linspace(0.0, 1.0, _UNKNOWN - below - above),
            1.0 + (high - 1.0) * np.linspace(1.0, 0.0, above, endpoint=False)[::-1] ** 2,
        ]
    )


def _place(colouring: Colouring) -> np.ndarray:
    """(T, V) where values lie on the scale, also beyond its ends; NaN where there is none."""
    low, high = colouring.low, colouring.high
    if colouring.logarithmic:
        with np.errstate(divide="ignore", invalid="ignore"):  # zero lies below every scale
            return np.asarray(np.log(colouring.values / low) / np.log(high / low))
    return np.asarray((colouring.values - low) / (high - low))


def _codes(colouring: Colouring, levels: np.ndarray) -> np.ndarray:
    """(T, V) numbers of the nearest levels."""
    place = _place(colouring)
    nearest = np.searchsorted(0.5 * (levels[1:] + levels[:-1]), place)
    return np.where(np.isnan(place), _UNKNOWN, nearest)


def _scale(name: str, colouring: Colouring, levels: np.ndarray) -> dict[str, Any]:
    label, times, unit, fixed = _SHOWN[name]
    low, high = colouring.low, colouring.high
    values = low * (high / low) ** levels if colouring.logarithmic else low + (high - low) * levels
    return {
        "name": name,
        "label": label,
        "title": colouring.title,
        "times": times,
        "unit": unit,
        "low": low,
        "high": high,
        "fixed": fixed,
        "logarithmic": colouring.logarithmic,
        "levels": [float(f"{value:.5g}") for value in values.tolist()],
    }


def _rollout(name: str, data: RolloutData, first: RolloutData | None) -> dict[str, Any]:
    """One rollout as JSON; its body is null where it is that of the first."""
    cloth, lost = _mesh(data.cloth_pos, data.cloth_faces)
    looks, number = looks_of(data)
    every = np.array([look.colour for look in looks])[number]
    same = first is not None and _same_body(first, data)
    return {
        "name": name,
        "note": wind_of(data),
        "cloth": cloth,
        "lost": lost,
        "fabric": pack_bytes(np.rint(255.0 * every)),
        "body": None if same else _mesh(data.body_pos, data.body_faces)[0],
        "figures": [
            {"name": key, "title": label, "values": _plain(data.metrics[key])}
            for key, label in _CHARTED
            if key in data.metrics and np.isfinite(data.metrics[key]).any()
        ],
    }


def _mesh(pos: np.ndarray, faces: np.ndarray) -> tuple[dict[str, Any], list[int]]:
    packed, lost = pack_positions(pos)
    return packed | {"faces": pack_integers(faces)}, lost


def _parted(data: RolloutData, textures: Mapping[str, Texture], images: Sequence[Texture]) -> dict[str, Any]:
    """Parts that can be hidden, by the faces, and what is drawn where garments have images; ``mapped`` is None where none has.

    In ``mapped``, ``points`` are vertices, those on seams of a texture several times, ``faces`` are over points, ``uv`` in
    steps of :data:`UV_STEP`; ``groups`` say of how many faces in their order which image is drawn on them, null for none.
    """
    pieces = pieces_of(data)
    names, part = hideable_parts(data, pieces)
    parts = {"names": names, "of": pack_integers(part)}
    if not textures:
        return {"parts": parts, "mapped": None}
    corners = np.zeros_like(data.cloth_faces)
    table, groups, order, start = [np.zeros((1, 2))], [], [], 1  # coordinate 0 is that of garments without an image
    for piece in pieces:
        texture = textures.get(piece.name)
        order.append(piece.faces)
        groups.append([len(piece.faces), None if texture is None else images.index(texture)])
        if texture is not None:
            assert piece.uv is not None
            assert piece.uv_faces is not None
            corners[piece.faces] = piece.uv_faces + start
            table.append(piece.uv)
            start += len(piece.uv)
    chosen = np.concatenate(order)
    points, coordinate, faces = split_seams(data.cloth_faces[chosen], corners[chosen])
    uv = np.clip(np.concatenate(table)[coordinate], -_FARTHEST_UV, _FARTHEST_UV)
    mapped = {
        "points": pack_integers(points),
        "faces": pack_integers(faces),
        "uv": pack_integers(np.rint(uv / UV_STEP)),
        "step": UV_STEP,
        "groups": groups,
    }
    return {"parts": parts | {"of": pack_integers(part[chosen])}, "mapped": mapped}


def _same_body(first: RolloutData, other: RolloutData) -> bool:
    return np.array_equal(first.body_faces, other.body_faces) and np.array_equal(first.body_pos, other.body_pos)


def _plain(values: np.ndarray) -> list[float | None]:
    """Four digits of every value; null where there is none."""
    return [float(f"{value:.4g}") if np.isfinite(value) else None for value in values.tolist()]


def _fill(title: str, content: dict[str, Any]) -> str:
    """The page with its parts in place. ``</`` ends a script wherever it stands, so that none may be in the data."""
    sources = {name: base64.b64encode(_read(file).encode()).decode() for name, file in _MODULES.items()}
    imports = {name: f"data:text/javascript;base64,{text}" for name, text in sources.items()}
    parts = {
        "TITLE": html.escape(title),
        "STYLE": _read("viewer.css"),
        "LICENCE": html.escape(_read("LICENSE-three.txt")).replace("--", "- -"),
        "IMPORTS": json.dumps({"imports": imports}),
        "CONTENT": json.dumps(content, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c"),
        "PROGRAM": _read("viewer.js"),
    }
    page = _read("viewer.html")
    pieces = page.split("@@")  # text and names of parts in turn
    return "".join(parts[piece] if at % 2 else piece for at, piece in enumerate(pieces))


def _read(name: str) -> str:
    return (_HERE / name).read_text(encoding="utf-8")
