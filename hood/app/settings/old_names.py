"""Earlier names: keys of ``hood rollout`` and ``hood inspect``, and classes that configs and records name as ``_target_``.

Words, configs and records of then are read as those of today.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from decimal import Decimal
from functools import cache
from typing import Any, NamedTuple

from hydra.errors import HydraException
from omegaconf import DictConfig, ListConfig

from hood.app.settings.overrides import bare_or_quoted, coded, decoded, parse, plain_word, readable
from hood.assets.files.said import say

#: Values of then that mean nothing else than what is usual.
_SPEED, _SECONDS = 0.25, 2.0
_USUAL = "it is what is usual"


class _Old(NamedTuple):
    """An earlier key.

    Args:
        into: the key of today.
        value: of today's key, from that of then and from all that is set; None where the earlier key did nothing.
        idle: why it did nothing.
        beside: whether a value of today's key may be given beside the earlier key.
    """

    into: str
    value: Callable[[Any, Mapping[str, Any]], Any]
    idle: str
    beside: Callable[[Any], bool] = lambda given: False


def _settle(steps: Any, settings: Mapping[str, Any]) -> Any:
    """Only what has a start of its own took another number of relaxing steps than 1 without ``settle=paper``."""
    return steps if steps != 1 else "paper" if settings.get("settle") == "paper" else None


def _events(speed: Any, settings: Mapping[str, Any]) -> Any:
    """Of the events that bring something together and have no speed of their own."""
    events = settings.get("events")
    if not isinstance(events, list) or speed == _SPEED:
        return events or None
    moved = [isinstance(event, dict) and bool({"close", "attach"} & event.keys()) for event in events]
    pairs = zip(events, moved, strict=True)
    return [{**event, "speed": event.get("speed", speed)} if own else event for event, own in pairs] or None


def _blend_in(pose: Any, settings: Mapping[str, Any]) -> Any:
    seconds = settings.get("blend_in") or None
    return seconds if pose == "t" or seconds is None else [seconds, pose]


def _size_end(seconds: Any, settings: Mapping[str, Any]) -> Any:
    size = settings.get("size_end")
    return size if seconds == _SECONDS or size is None else {"size": size, "seconds": seconds}


def _allow_unsound(allowed: Any, settings: Mapping[str, Any]) -> Any:
    if settings.get("doubts") == "refuse":
        return None
    kept = "doubts" if settings.get("fail_on") == "doubts" else "unsound"
    return "nothing" if allowed is True else kept if allowed is False else allowed


def _doubts(doubts: Any, settings: Mapping[str, Any]) -> Any:
    kept = "nothing" if settings.get("fail_on") == "nothing" else "unsound"
    return {"refuse": "doubts", "report": kept}.get(str(doubts), doubts)


def _unit(unit: Any, _: Mapping[str, Any]) -> Any:
    return None if unit == "auto" else unit


def _video(stride: Any, settings: Mapping[str, Any]) -> Any:
    video = settings.get("video", "mp4")
    return None if video == "none" else video if stride == 1 else [video, stride]


def _goal(unit: str, times: int = 1) -> Callable[[Any, Mapping[str, Any]], Any]:
    def refine(value: Any, _: Mapping[str, Any]) -> Any:
        if value is None or isinstance(value, bool) or not isinstance(value, (int, float)):
            return value if value is None else f"{value}{unit}"
        return f"{(Decimal(repr(value)) * times).normalize():f}{unit}"

    return refine


def _part(key: str, first: str, part: str, usual: Any) -> Callable[[Any, Mapping[str, Any]], Any]:
    """For what is a part of the table of ``key`` now; a value alone there is its part ``first``."""

    def table(value: Any, settings: Mapping[str, Any]) -> Any:
        given = settings.get(key)
        known = given if isinstance(given, dict) else {} if given is None else {first: given}
        return None if value == usual else {**known, part: value}

    return table


def _lacks(part: str) -> Callable[[Any], bool]:
    return lambda given: not isinstance(given, dict) or part not in given


def _is_unrefined(given: Any) -> bool:
    return given in (0, "auto")


#: Earlier keys, in the order in which they are read.
_OLD = {
    "relaxing_steps": _Old("settle", _settle, "settle=equilibrium takes none", lambda given: given == "paper"),
    "events_speed": _Old("events", _events, "events are not given", lambda given: True),
    "allow_unsound": _Old("fail_on", _allow_unsound, "doubts=refuse is fail_on=doubts now, and unsound results fail as well"),
    "doubts": _Old("fail_on", _doubts, ""),
    "trans_unit": _Old("unit", _unit, "the unit is found"),
    "body_scale": _Old("unit", _unit, "the file is in metres"),
    "gusts": _Old("losses.terms.air.gusts", lambda gusts, _: gusts, ""),
    "video_stride": _Old("video", _video, "video=none", lambda given: not isinstance(given, list)),
    "target_rg": _Old("refine", _goal("rg"), "null asks for nothing", _is_unrefined),
    "budget_ms": _Old("refine", _goal("ms"), "null asks for nothing", _is_unrefined),
    "max_strain": _Old("refine", _goal("%", 100), "null asks for nothing", _is_unrefined),
    "size_seconds": _Old("size_end", _size_end, "size_end is not given", lambda given: not isinstance(given, dict)),
    "blend_from": _Old("blend_in", _blend_in, "blend_in is 0", lambda given: not isinstance(given, list)),
    "refine_method": _Old("refine", _part("refine", "goal", "method", "newton"), _USUAL, _lacks("method")),
    "refine_most": _Old("refine", _part("refine", "goal", "most", 50), _USUAL, _lacks("most")),
    "refine_table": _Old("refine", _part("refine", "goal", "table", None), _USUAL, _lacks("table")),
    "surface_stride": _Old("metrics", _part("metrics", "kind", "surface_every", 5), _USUAL, _lacks("surface_every")),
    "export": _Old("metrics", _part("metrics", "kind", "fields", []), _USUAL, _lacks("fields")),
    "cloth_friction": _Old("cloth_contact", _part("cloth_contact", "mode", "friction", 0.0), _USUAL, _lacks("friction")),
    "body_parts": _Old("objects", _part("objects", "garment", "body", []), _USUAL, _lacks("body")),
    "thin_body": _Old("picture", _part("picture", "views", "thin_body", 0), _USUAL, _lacks("thin_body")),
    "accuracy": _Old("plan", lambda accuracy, _: accuracy, "null asks for no plan", lambda given: given == "auto"),
}
#: Those that ``hood inspect`` had as well.
_OF_INSPECT = ("blend_from", "trans_unit", "body_scale", "body_parts")


def todays_words(words: Sequence[str], command: str = "rollout") -> tuple[str, ...]:
    """The words of a command by today's keys. Every earlier key among them is said, each word once in a process.

    Raises:
        ValueError: a word contradicts another.
    """
    given = {word.partition("=")[0]: word for word in words if "=" in word}
    old_ones = [key for key in {"rollout": _OLD, "inspect": _OF_INSPECT}.get(command, ()) if key in given]
    if not old_ones:
        return tuple(words)
    known = {*old_ones, *(_OLD[key].into for key in old_ones)}
    settings = {key: _value(word) for key, word in given.items() if key in known}
    said = {key: given[key] for key in known if key in given}
    made: dict[str, str] = {}  # words of today
    for key in old_ones:
        into, value = _OLD[key].into, _OLD[key].value(settings[key], settings)
        if value is None:
            _tell(f"{given[key]} has no effect: {_OLD[key].idle}")
            continue
        before = settings.get(into)
        if before not in (None, value) and not _OLD[key].beside(before):
            raise ValueError(f"{said[into]} and {given[key]} contradict each other; give one of them")
        settings[into], said[into], made[into] = value, given[key], _word(into, value)
        _tell(f"{given[key]} is called {made[into]} now")
    return (*(word for word in words if word.partition("=")[0] not in {*old_ones, *made}), *made.values())


def put_todays_keys(record: dict[str, Any]) -> None:
    """Put today's keys into the record of a rollout, in place of earlier ones; those of other commands stay as they are."""
    if "sequence" not in record:  # trainings and evaluations have sequences, and keys of their own by some of these names
        return
    for key, old in _OLD.items():
        value = old.value(record[key], record) if key in record else None
        if value is not None:
            _put(record, old.into.split("."), value)
    for key in _OLD:
        record.pop(key, None)


def _put(record: Any, path: Sequence[str], value: Any) -> None:
    """Set what is below ``path``; nothing where the record ends before it."""
    for name in path[:-1]:
        record = record.get(name) if isinstance(record, dict) else None
    if isinstance(record, dict):
        record[path[-1]] = value


def _value(word: str) -> Any:
    try:
        override = parse(readable(word, several=True))
    except HydraException as error:
        raise ValueError(f"cannot read {word!r}: write key=value") from error
    if override.is_sweep_override():
        raise ValueError(f"{word}: give one value")
    return decoded(override.value())


def _word(key: str, value: Any) -> str:
    return plain_word(key, value) if isinstance(value, str) else f"{key}={_written(value)}"


def _written(value: Any) -> str:
    if isinstance(value, list):
        return "[" + ",".join(map(_written, value)) + "]"
    if isinstance(value, dict):
        return "{" + ",".join(f"{coded(str(key))}:{_written(item)}" for key, item in value.items()) + "}"
    if isinstance(value, str):
        return bare_or_quoted(value)
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else repr(value)


@cache
def _tell(sentence: str) -> None:
    from hood.training import distributed  # torch, which few commands need at once

    if distributed.is_first():
        say(sentence)


#: Modules of then and of today.
_MOVED = {
    "hood.assets.measured": "hood.assets.material",
    "hood.dynamics.refine": "hood.steppers.refined",
    "hood.dynamics.simulator": "hood.steppers.network",
    "hood.dynamics.stepper": "hood.steppers.newton",
    "hood.energies.inertia": "hood.energies.mass_points",
    "hood.energies.self_friction": "hood.energies.self_contact",
    "hood.energies.springs": "hood.energies.mass_points",
    "hood.losses.attachment": "hood.energies.mass_points",
    "hood.losses.bending": "hood.energies.bending",
    "hood.losses.collision": "hood.energies.contact",
    "hood.losses.damping": "hood.energies.damping",
    "hood.losses.friction": "hood.energies.friction",
    "hood.losses.gravity": "hood.energies.mass_points",
    "hood.losses.inertia": "hood.energies.mass_points",
    "hood.losses.layer_friction": "hood.energies.self_contact",
    "hood.losses.layer_sides": "hood.energies.self_contact",
    "hood.losses.layers": "hood.energies.self_contact",
    "hood.losses.potential": "hood.energies.potential",
    "hood.losses.stretching": "hood.energies.membrane",
    "hood.losses.weave": "hood.energies.membrane",
    "hood.losses.wind": "hood.energies.wind",
}


def rename_targets(node: Any) -> None:
    """Put the path of today into every ``_target_`` of a config, in place; others stay as they are."""
    if isinstance(node, dict | DictConfig):
        target = node.get("_target_")
        module, _, name = target.rpartition(".") if isinstance(target, str) else ("", "", "")
        if module in _MOVED:
            node["_target_"] = f"{_MOVED[module]}.{name}"
        for key in node:
            _rename_child(node, key)
    elif isinstance(node, list | ListConfig):
        for index in range(len(node)):
            _rename_child(node, index)


def _rename_child(node: Any, key: Any) -> None:
    if isinstance(node, DictConfig | ListConfig) and node._get_node(key) is None:
        return
    child = node[key]
    if isinstance(child, dict | list | DictConfig | ListConfig):
        rename_targets(child)
