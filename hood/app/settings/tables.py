"""Keys of a rollout that take one value, or a table of it and further ones: what each says, typed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, TypeVar

from hood.app.settings.compose import ConfigError, brief, plain


class Refinement(NamedTuple):
    """``refine``: how far steps are refined (:mod:`hood.app.stepping.refinement`).

    Args:
        goal: a number of iterations, or what they are to reach.
        method: how steps are refined.
        most: iterations of a frame at most.
        table: file of a table that says with how many iterations to begin.
    """

    goal: int | float | str = "auto"
    method: str = "newton"
    most: int = 50
    table: str | None = None


class Measurement(NamedTuple):
    """``metrics``: what is measured in frames.

    Args:
        kind: in every frame, one of :data:`hood.rollouts.frame.METRIC_CHOICES`.
        surface_every: frames from one measurement of the cut surface to the next.
        fields: values of every vertex that are written.
    """

    kind: str = "all"
    surface_every: int = 5
    fields: tuple[str, ...] = ()


class ClothContact(NamedTuple):
    """``cloth_contact``: which layers of cloth are kept apart, and their coefficient of friction."""

    mode: str = "auto"
    friction: float = 0.0


class Objects(NamedTuple):
    """``objects``: names of the objects of a garment's file that are worn, and of those of a file that are the body."""

    garment: tuple[str | int, ...] = ()
    body: tuple[str | int, ...] = ()


_Table = TypeVar("_Table", Refinement, Measurement, ClothContact, Objects)
#: By type of the usual value: the types that may stand for it, and what they are called.
_KINDS: dict[type, tuple[tuple[type, ...], str]] = {
    int: ((int,), "a whole number"),
    float: ((int, float), "a number"),
    str: ((str, int, float), "text"),
    tuple: ((list, tuple), "a list of names in brackets"),
    type(None): ((str, type(None)), "a file"),
}


def refinement(config: Mapping[Any, Any]) -> Refinement:
    """What ``refine`` says. Raises ConfigError where a part of its table is unknown or of another kind, as the others do."""
    return _read(config, "refine", Refinement)


def measurement(config: Mapping[Any, Any]) -> Measurement:
    """What ``metrics`` says."""
    found = _read(config, "metrics", Measurement)
    return found._replace(fields=tuple(map(str, found.fields)))


def cloth_contact(config: Mapping[Any, Any]) -> ClothContact:
    """What ``cloth_contact`` says."""
    return _read(config, "cloth_contact", ClothContact)


def objects(config: Mapping[Any, Any]) -> Objects:
    """What ``objects`` says."""
    return _read(config, "objects", Objects)


def with_value(given: Any, first: str, value: Any) -> Any:
    """The value of a key with ``value`` for what it says alone or as ``first``; what else a table says stays."""
    return {**given, first: value} if isinstance(given, Mapping) else value


def _read(config: Mapping[Any, Any], key: str, kind: type[_Table]) -> _Table:
    usual, given = kind(), plain(config.get(key))
    names = kind._fields
    table = given if isinstance(given, Mapping) else {} if given is None else {names[0]: given}
    for name, value in table.items():
        if name not in names:
            some = ", ".join(names)
            raise ConfigError(f"{key}={brief(given)}: {name!r} is no part of it; give a value, or a table of some of {some}")
        types, called = _KINDS[type(getattr(usual, name))]
        if isinstance(value, bool) or not isinstance(value, types):
            where = f"{key}={brief(given)}" + (f": {name}" if isinstance(given, Mapping) else "")
            raise ConfigError(f"{where}: give {called}, not {brief(value)}")
    said: dict[str, Any] = {name: tuple(value) if isinstance(value, list) else value for name, value in table.items()}
    return kind(**said)
