"""The settings of a rollout: its configuration, typed key by key.

Python values as the ``key=value`` words of a command.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from omegaconf import DictConfig, ListConfig, OmegaConf

from hood.app.settings.compose import NOT_FIXED, TABLES, ConfigError, brief, load_config, plain, with_words
from hood.app.settings.overrides import bare_or_quoted, coded
from hood.assets.material import NO_GRADIENT
from hood.rollouts.verdict.surface import SURFACE_STRIDE


@dataclass(frozen=True, kw_only=True)
class RolloutSettings(Mapping[str, Any]):
    """What ``configs/rollout.yaml`` says with the words of a command, checked by :func:`hood.app.settings.compose.load_config`.

    The file says what each key means. Tables are typed where they are read (:func:`refinement` and others); ``Any`` is of
    several kinds, which the reader checks. Groups are nodes for :func:`hood.app.settings.compose.build`.
    """

    material: DictConfig
    losses: DictConfig
    model: DictConfig | None = None
    solver: DictConfig
    stepper: str
    stepping: DictConfig | None = None
    garment: str | ListConfig
    sequence: str
    body: str
    checkpoint: str
    plan: str | float | None
    num_frames: int
    device: str
    precision: str
    kernels: str
    step: str
    refine: Any
    guard: str
    seed: int
    output: str
    worn: bool
    fail_on: str
    root: str | None
    resume: bool
    betas: ListConfig | None
    gender: str | None
    hands: str
    up: str
    person: str | int | None
    unit: str | float | None
    file_fps: float | None
    start: str | float | None
    stop: str | float | None
    loop: int
    blend_in: Any
    animation: str | int | None
    fps: float
    output_fps: float | None
    gravity: float
    wind: Any
    damping: float
    size: Any
    fit: str
    size_end: Any
    fabrics: DictConfig | None
    fabrics_seam: float
    body_friction: DictConfig | None
    pins: Any
    events: ListConfig
    objects: Any
    weld: str | float
    shells: str
    small_parts: str
    triangulate: bool
    settle: str | int
    layers: str | ListConfig
    cloth_contact: Any
    metrics: Any
    colour: str
    texture: Any
    picture: Any
    video: Any
    sheet: bool
    refine_mesh: int
    formats: ListConfig

    @classmethod
    def of(cls, config: DictConfig) -> RolloutSettings:
        """Those of a loaded configuration of ``hood rollout``."""
        return cls(**{str(key): config[key] for key in config})

    @classmethod
    def from_words(cls, words: Sequence[str]) -> RolloutSettings:
        """Those that words of ``hood rollout`` ask for. Raises ConfigError as :func:`hood.app.settings.compose.load_config`."""
        return cls.of(load_config("rollout", words))

    def with_values(self, **changes: Any) -> RolloutSettings:
        """The same with other values."""
        return replace(self, **changes)

    def with_words(self, words: Sequence[str]) -> RolloutSettings:
        """The same with some ``key=value`` more, see :func:`hood.app.settings.compose.with_words`."""
        return RolloutSettings.of(with_words(OmegaConf.create(dict(self)), words))

    def __getitem__(self, key: str) -> Any:
        if key not in self.__dataclass_fields__:
            raise KeyError(key)
        return getattr(self, key)

    def __contains__(self, key: object) -> bool:
        return key in list(self)

    def __iter__(self) -> Iterator[str]:
        return (field.name for field in fields(self) if field.name not in _ABSENT or self[field.name] is not None)

    def __len__(self) -> int:
        return sum(1 for _ in self)


#: Groups that may be left out.
_ABSENT = ("model", "stepping")


#: Settings of a rollout, or the configuration of another command that has the keys which are asked for.
Settings = RolloutSettings | DictConfig


# ---- keys that take one value, or a table of it and further ones -----------------------------------------------------------


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
    surface_every: int = SURFACE_STRIDE
    fields: tuple[str, ...] = ()


class ClothContact(NamedTuple):
    """``cloth_contact``: which layers of cloth are kept apart, and their coefficient of friction."""

    mode: str = "auto"
    friction: float = 0.0


class Objects(NamedTuple):
    """``objects``: names of the objects of a garment's file that are worn, and of those of a file that are the body."""

    garment: tuple[str | int, ...] = ()
    body: tuple[str | int, ...] = ()


class PictureSettings(NamedTuple):
    """``picture``: how films and contact sheets show the body.

    Args:
        width, height: pixels; None: 1280 and 720, of GIF films half of them.
        views, camera, fabric_looks: of :class:`hood.media.film.Shots`.
        background: ``studio``, ``transparent``, or a colour, three numbers from 0 to 255; None: studio, of PNG
            films transparent.
        thin_body: mm by which the body is drawn thinner under the cloth.
    """

    views: tuple[str | float, ...] = ("front", "back")
    width: int | None = None
    height: int | None = None
    camera: str = "follow"
    background: str | tuple[int, ...] | None = None
    fabric_looks: bool = True
    thin_body: float = 0


_Table = TypeVar("_Table", Refinement, Measurement, ClothContact, Objects)
#: By type of the usual value: the types that may stand for it, and what they are called.
_KINDS: dict[type, tuple[tuple[type, ...], str]] = {
    int: ((int,), "a whole number"),
    float: ((int, float), "a number"),
    str: ((str, int, float), "text"),
    tuple: ((list, tuple), "a list of names in brackets"),
    type(None): ((str, type(None)), "a file"),
}


def fixed_shapes(config: Mapping[Any, Any]) -> bool:
    """Whether ``step`` asks for steps of fixed shapes; ``auto`` takes them only where nothing speaks against it."""
    return str(config["step"]) not in NOT_FIXED


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


#: Keys of tables: names of parts in any alphabet, and of files.
_KEY = re.compile(r"[\w./+@-]+")
#: Keys of what is read from files, and how they are given.
_NAMES = {
    "garment": "a name, a file or a list of them, and to hood.simulate also by hood.Garment objects",
    "sequence": "a name (hood.names('motions')) or a file, and to hood.simulate also by a hood.PoseSequence",
    "body": "a name or a file, and to hood.simulate also by a hood.BodyMesh or a hood.Body",
    "checkpoint": "a name (hood.names('weights')) or a file",
}


def overrides(keys: Mapping[str, Any], group: str = "") -> list[str]:
    """Python values as the ``key=value`` words of a command.

    Args:
        keys: by name; None is ``null``, numbers and arrays of NumPy and torch are numbers and lists. A dictionary is a group
            of keys, of :data:`hood.app.settings.compose.TABLES` and in lists a table.
        group: what stands before every key, with a dot.

    Raises:
        ConfigError: a value that no command line can hold.
    """
    words: list[str] = []
    for key, value in keys.items():
        if isinstance(value, Mapping) and value and f"{group}{key}" not in TABLES:
            words += overrides(value, f"{group}{key}.")
        else:
            words.append(f"{group}{key}={_word(value, group + key)}")
    return words


def _word(value: Any, key: str) -> str:
    if key in _NAMES and not _may_name(value):
        raise ConfigError(f"{key} is given by {_NAMES[key]}, not as {_sort(value)}")
    if getattr(value, "requires_grad", False):
        raise ConfigError(f"{key}: {NO_GRADIENT}")
    if hasattr(value, "tolist"):  # of NumPy or torch
        value = value.tolist()
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (int, float)):
        return repr(value)
    if isinstance(value, (list, tuple)):
        return f"[{','.join(_word(item, key) for item in value)}]"
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{_key(name, key)}:{_word(item, key)}" for name, item in value.items()) + "}"
    if isinstance(value, (str, Path)):
        return bare_or_quoted(str(value))
    raise ConfigError(f"{key}={_sort(value)}: give a number, a word, a path, a list or a table of them, or None")


def _may_name(value: Any) -> bool:
    """Whether a value can be a name, or a list of some; lists are refused later where one name is wanted."""
    if isinstance(value, (list, tuple)):
        return all(map(_may_name, value))
    return value is None or isinstance(value, (str, Path, int, float, Mapping)) or getattr(value, "ndim", 1) == 0


def _sort(value: Any) -> str:
    """What a value is, without what it holds."""
    if hasattr(value, "tolist"):
        return f"an array {tuple(value.shape)}" if hasattr(value, "shape") else "an array"
    if isinstance(value, (list, tuple)):
        return f"a list of {_sort(value[0])}" if value else "an empty list"
    return f"an object of type {type(value).__name__}"


def _key(name: Any, key: str) -> str:
    text = str(name)
    if not _KEY.fullmatch(unicodedata.normalize("NFC", text)):
        raise ConfigError(f"{key}: {text!r} cannot be a key of a table; use letters, digits and _ . / + @ -")
    return coded(text)
