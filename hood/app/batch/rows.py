"""The rows of a data set: lists of garments, bodies, fabrics and motions, or a file; the folder and the seed of each row."""

from __future__ import annotations

import csv
import hashlib
import io
import itertools
import json
import random
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from omegaconf import DictConfig

from hood.app.batch.batch import place_motions, require_motions
from hood.app.settings.compose import ConfigError, load_config, options, plain, shown
from hood.app.settings.rollout_settings import overrides
from hood.assets.files.library import locate, names, unknown
from hood.assets.files.text import read_text
from hood.assets.garment.garment import locate_garment
from hood.assets.motion.motion_files import find_motions
from hood.scene.body_motion.load import NO_MOTION

#: Lists of the command, the key of a rollout that an entry stands for, and what that is called among assets.
AXES = {
    "garments": ("garment", "garments"),
    "bodies": ("body", "body"),
    "fabrics": ("material", ""),
    "motions": ("sequence", "motions"),
}
#: Other words for keys of a rollout, in tables and files of rows.
_ALSO = {"motion": "sequence", "fabric": "material"}
#: Keys of a rollout that all rows have in common.
_COMMON = ("output", "resume", "root", "fail_on", "plan", "device")
#: What the folder of a garment, a body or a fabric may be called.
_LABEL = re.compile(r"[\w.,=+-]+")


@dataclass(frozen=True)
class DataRow:
    """One rollout of a data set.

    Args:
        name: its folder below the output folder, with ``/``.
        words: ``key=value`` of ``hood rollout`` that it has beside those of all rows.
    """

    name: str
    words: tuple[str, ...]

    @property
    def keys(self) -> dict[str, str]:
        """What the words say, without the quotes around names."""
        return {key: value.strip("'") for key, _, value in (word.partition("=") for word in self.words)}


@dataclass(frozen=True)
class _Entry:
    """One of a list: what it is called in names of folders, and its keys of a rollout."""

    label: str
    keys: Mapping[str, Any]


def rows_of(config: DictConfig, given: Sequence[str]) -> tuple[list[DataRow], str]:
    """The rows that a command asks for, those of one garment, body and fabric one after the other, and the folder from which
    they are named after their motions; empty without one.

    Args:
        config: of ``hood dress``.
        given: its keys that the command has.

    Raises:
        ConfigError, FileNotFoundError: lists, names, a file or a root that cannot be used; two rows of one folder.
    """
    if config.rows is None:
        rows, start = _product(config)
    else:
        beside = next((key for key in (*AXES, "per_motion") if key in given), None)
        if beside is not None:
            raise ConfigError(f"{beside}: the rows come from rows={config.rows}; leave one of the two out")
        rows, start = _listed(Path(str(config.rows)).expanduser(), config.root, int(config.seed))
    _require_apart(rows)
    return rows, start


def row_seed(seed: int, name: str) -> int:
    """The seed of a row, from 0 to 2³¹ - 1: always the same for a name, whatever other rows there are."""
    return int.from_bytes(hashlib.sha256(f"{seed}:{name}".encode()).digest()[:4], "big") >> 1


def _product(config: DictConfig) -> tuple[list[DataRow], str]:
    garments, bodies, fabrics = (_entries(config, axis) for axis in ("garments", "bodies", "fabrics"))
    motions, start = _motions(config)
    combined = list(itertools.product(garments, bodies, fabrics))
    chosen = {motion.label: _drawn(config, motion.label, len(combined)) for motion in motions}
    rows = []
    for place, parts in enumerate(combined):
        for motion in motions:
            if place in chosen[motion.label]:
                name = "/".join(part.label for part in (*parts, motion))
                keys = {key: value for part in (*parts, motion) for key, value in part.keys.items()}
                rows.append(_row(name, keys, int(config.seed)))
    return rows, start


def _row(name: str, keys: Mapping[str, Any], seed: int) -> DataRow:
    """``keys`` by value; a text that a file has stays as it is."""
    words = overrides({"seed": row_seed(seed, name), **keys})
    return DataRow(name, tuple(words))


def _drawn(config: DictConfig, motion: str, count: int) -> set[int]:
    """Which of ``count`` combinations a motion has."""
    most = config.per_motion
    if most is None:
        return {*range(count)}
    if isinstance(most, bool) or not isinstance(most, int) or most < 1:
        raise ConfigError(f"per_motion={shown(most)}: give a whole number from 1 on, or null for all combinations")
    return {*random.Random(f"{config.seed}/{motion}").sample(range(count), min(most, count))}


def _entries(config: DictConfig, axis: str) -> list[_Entry]:
    """The entries of a list; a name that is typed wrongly is refused here, a file that cannot be used costs its rows."""
    key, kind = AXES[axis]
    found: dict[str, _Entry] = {}
    for index, value in enumerate(plain(config[axis])):
        entry = _entry(f"{axis}[{index}]", key, value)
        for name in _named(entry.keys.get(key)):
            _require(f"{axis}[{index}]", key, kind, name)
        if entry.label in found:
            way = f"give one another name, {{{key}:{shown(value)},name:other}}"
            raise ConfigError(f"{axis}: two entries would both go to folders named {entry.label}; {way}")
        found[entry.label] = entry
    if not found:
        raise ConfigError(f"{axis}=[]: give at least one")
    return list(found.values())


def _entry(place: str, key: str, value: Any) -> _Entry:
    """An entry as it is given: a name, an outfit, or a table of keys."""
    if not isinstance(value, dict):
        keys = {key: _absolute(key, value if isinstance(value, list) else str(value))}
        return _Entry(_label(place, _label_of(value)), keys)
    keys = _checked({str(name): item for name, item in value.items()}, place)
    label = keys.pop("name", None)
    if label is None:
        parts = [_label_of(keys[key])] if key in keys else []
        parts += [re.sub(r"[][{}()'\"\s]", "", f"{name}={shown(item)}") for name, item in keys.items() if name != key]
        label = ",".join(parts)
    if key in keys:
        keys[key] = _absolute(key, keys[key])
    elif key == "sequence":
        raise ConfigError(f"{place}: names no sequence; give one, {{sequence:plie,…}}")
    return _Entry(_label(place, str(label)), keys)


def _label_of(value: Any) -> str:
    """What a name, a file or an outfit is called."""
    return "+".join(Path(name).name if Path(name).is_dir() else Path(name).stem for name in _named(value))


def _label(place: str, label: str) -> str:
    if not _LABEL.fullmatch(label) or label.startswith("."):
        raise ConfigError(f"{place}: {label!r} cannot be the name of a folder; give a table with a name, {{…,name:large}}")
    return label


def _named(value: Any) -> list[str]:
    return [] if value is None else [str(name) for name in value] if isinstance(value, list) else [str(value)]


def _absolute(key: str, value: Any, folder: Path | None = None) -> Any:
    """Files by their whole path, embedded names as they are. Those of a file of rows may lie in its ``folder``."""
    kind = next((kind for one, kind in AXES.values() if one == key), "")
    if not kind:
        return value
    if isinstance(value, list):
        return [_absolute(key, one, folder) for one in value]
    text = str(value)
    if text in names(kind) or text == NO_MOTION:
        return text
    beside = None if folder is None else folder / text
    path = beside if beside is not None and beside.exists() else Path(text).expanduser()
    return str(path.absolute()) if path.exists() or path.suffix or "/" in text else text


def _require(place: str, key: str, kind: str, name: str) -> None:
    """Raise an error unless there is such a garment, body or fabric."""
    try:
        if key == "garment":
            locate_garment(name)
        elif key == "material":
            if name not in options("material"):
                raise ConfigError(unknown("fabric", name, options("material")))
        elif name != "none" and not Path(name).exists():
            locate(kind, name, folders=True)
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{place}: {error}") from error


def _motions(config: DictConfig) -> tuple[list[_Entry], str]:
    """Motions with the paths that they have below the root, and the root."""
    given = plain(config.motions)
    if not given:
        raise ConfigError("motions=[]: give names, files, folders, globs or lists, such as motions=[amass/CMU]")
    tables = [_entry(f"motions[{index}]", "sequence", one) for index, one in enumerate(given) if isinstance(one, dict)]
    texts = [str(one) for one in given if not isinstance(one, dict)]
    require_motions("motions", [text for text in texts if text != NO_MOTION])
    found = find_motions(texts, check=False)
    places, start = _places(found, config.root)
    entries = [_Entry(places[name], {"sequence": _absolute("sequence", name)}) for name in found]
    return [*entries, *tables], start


def _places(found: Sequence[str], root: str | None) -> tuple[dict[str, str], str]:
    """The paths of motions below the root, and the root; empty where all are embedded ones."""
    folders, start = place_motions(found, Path(), root)
    has_files = any(Path(name).suffix for name in found)
    return {name: folder.as_posix() for name, folder in zip(found, folders, strict=True)}, str(start) if has_files else ""


def _listed(path: Path, root: str | None, seed: int) -> tuple[list[DataRow], str]:
    """The rows of a file."""
    lines = _read(path)
    keyed = []
    for place, given in lines:
        keys = _checked(given, place)
        keys |= {key: _absolute(key, keys[key], path.parent.absolute()) for key, _ in AXES.values() if key in keys}
        keyed.append((place, keys))
    found = list(dict.fromkeys(str(keys["sequence"]) for _, keys in keyed if "sequence" in keys))
    places, start = _places(found, root)
    usual = {key: str(load_config("rollout").get(key, "default")) for key in ("garment", "body", "sequence")}
    rows = []
    for place, keys in keyed:
        name = keys.pop("name", None)
        if name is None:
            labels = [_label_of(keys.get(key, usual.get(key, "default"))) for key in ("garment", "body", "material")]
            name = "/".join([*labels, places.get(str(keys.get("sequence")), usual["sequence"])])
        rows.append(_row(_checked_name(str(name), place), keys, seed))
    kinds = ("garment", "body", "material")
    return sorted(rows, key=lambda row: [row.keys.get(key, "") for key in kinds]), start


def _read(path: Path) -> list[tuple[str, dict[str, Any]]]:
    """The lines of a file of rows, each behind its place there."""
    if path.suffix.lower() not in (".csv", ".jsonl"):
        raise ConfigError(f"rows={path}: give a .csv table or a .jsonl file")
    text = read_text(path)
    if path.suffix.lower() == ".csv":
        table = csv.DictReader(io.StringIO(text, newline=""), skipinitialspace=True)
        found = [(f"{path}, row {number}", _cells(f"{path}, row {number}", cells)) for number, cells in enumerate(table, 2)]
    else:
        found = []
        for number, line in enumerate(text.splitlines(), 1):
            if line.strip():
                found.append((f"{path}, line {number}", _object(f"{path}, line {number}", line)))
    if not found:
        raise ConfigError(f"rows={path}: has no rows")
    return found


def _cells(place: str, cells: Mapping[Any, Any]) -> dict[str, Any]:
    """The cells of a table that hold something."""
    if None in cells:
        raise ConfigError(f"{place}: has more cells than there are columns; put a cell with commas in quotes")
    return {str(key).strip(): _value(text.strip()) for key, text in cells.items() if text and text.strip()}


def _value(text: str) -> Any:
    """Numbers, lists and tables of a cell as such; everything else is text."""
    try:
        return json.loads(text)
    except ValueError:
        return text


def _object(place: str, line: str) -> dict[str, Any]:
    try:
        found = json.loads(line)
    except ValueError as error:
        raise ConfigError(f"{place}: not readable as JSON ({error})") from error
    if not isinstance(found, dict):
        raise ConfigError(f'{place}: give an object, such as {{"garment": "dress", "sequence": "plie"}}')
    return found


def _checked(given: Mapping[str, Any], place: str) -> dict[str, Any]:
    """By keys of a rollout, and ``name``; a key that no row can have is refused."""
    keys = {_ALSO.get(key, key): value for key, value in given.items()}
    known = [str(key) for key in load_config("rollout") if key not in _COMMON]
    for key in keys:
        if key in _COMMON:
            raise ConfigError(f"{place}: {key} is the same for all rows; leave it out there")
        if key != "name" and key.split(".")[0] not in known:
            raise ConfigError(f"{place}: {unknown('key', key, [*known, 'name'])}")
    return keys


def _checked_name(name: str, place: str) -> str:
    path = PurePosixPath(name)
    if not name or path.is_absolute() or any(part in ("..", ".") or part.startswith(".") for part in path.parts):
        raise ConfigError(f"{place}: the name {name!r} is no folder below the output folder; give one such as a/b")
    return path.as_posix()


def _require_apart(rows: Sequence[DataRow]) -> None:
    """Raise ConfigError where two rows would share a folder, or one lie in that of the other."""
    known: dict[str, DataRow] = {}
    for row in rows:
        if row.name in known:
            raise ConfigError(f"two rows would both go to {row.name}; give them names, in a column or a key name")
        known[row.name] = row
    for row in rows:
        inside = next((str(one) for one in PurePosixPath(row.name).parents if str(one) in known), None)
        if inside is not None:
            raise ConfigError(
                f"the folder {row.name} would lie in that of another row, {inside}; rename a motion, or give names"
            )
