"""The people in a motion file: where each stands in it, and the one that is asked for.

Files that hold one entry a frame, gathered into one table a person.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hood.assets.files.guarded import listed
from hood.assets.files.text import flat, squeezed
from hood.assets.motion.layouts.content import LAYOUTS, MotionLayout, Unread, counts_of, find_layout, layout_sizes, length
from hood.assets.motion.layouts.rotations import as_turns

#: Entries of a list that are looked into.
_MOST = 1000


@dataclass(frozen=True)
class Person:
    """What a file holds of one person: values by squeezed key, and the keys as they are written."""

    name: str
    layout: MotionLayout
    fields: Mapping[str, Any]
    keys: Mapping[str, str]
    around: tuple[Mapping[str, Any], ...] = ()  # the dicts that this one stands in, innermost first

    def rows(self, name: str, chosen: Any) -> Person:
        """The person with ``chosen`` of every value that has one entry a person or row."""
        return Person(name, self.layout, {key: chosen(value) for key, value in self.fields.items()}, self.keys, self.around)


class SeveralPeopleError(ValueError):
    """Nobody says which of a file's people is meant."""

    def __init__(self, path: Path, people: list[Person]) -> None:
        self.people = people
        names = [person.name for person in people]
        super().__init__(f"{path}: holds {len(people)} people ({listed(names)}); choose one with person={names[0]}")


def find_people(content: Any) -> list[Person]:
    """Everyone in a file whose motion stands there in one of the layouts; the most telling layout counts, none else."""
    found = list(_walk(content, "", (), ()))
    if not found:
        return []
    best = min(LAYOUTS.index(person.layout) for person in found)
    of_best = [person for person in found if LAYOUTS.index(person.layout) == best]
    # Hands and objects beside a body may have the keys of a pose; their shapes are none.
    plausible = [person for person in of_best if _is_pose(person)] or of_best
    people = [each for person in _named(plausible) for each in _apart(person)]
    if len({person.name for person in people}) < len(people):
        return [replace(person, name=str(index)) for index, person in enumerate(people)]
    return people


def choose_person(path: Path, people: list[Person], name: int | str | None) -> Person:
    """The person called ``name``, or at that place; the only one where ``name`` is None.

    Raises:
        SeveralPeopleError: there are more, and no name is given.
        ValueError: nobody is called so; names those who are there.
    """
    if name is None:
        if len(people) > 1:
            raise SeveralPeopleError(path, people)
        return people[0]
    text, names = str(name), [person.name for person in people]
    if text in names:
        return people[names.index(text)]
    # Where people are called by numbers a place would be taken for the wrong name.
    if text.isdigit() and int(text) < len(people) and not all(each.isdigit() for each in names):
        return people[int(text)]
    if len(people) == 1 and text == "0":
        return people[0]
    raise ValueError(f"{path}: nobody in it is person={text[:40]}; it holds {listed(names)}")


def _walk(item: Any, above: str, trail: tuple[str, ...], around: tuple[Mapping[str, Any], ...]) -> Iterator[Person]:
    if isinstance(item, Mapping):
        keys: dict[str, str] = {}
        for key in item:
            keys.setdefault(squeezed(key), key)
        layout = find_layout(keys, above)
        if layout is not None and all(isinstance(item[keys[key]], (np.ndarray, list, Unread)) for key in layout.poses):
            fields = {key: item[written] for key, written in keys.items()}
            yield Person("/".join(trail), layout, fields, keys, around)
            return
        for key, value in item.items():
            yield from _walk(value, squeezed(key), (*trail, key), (item, *around))
    elif isinstance(item, list) and len(item) <= _MOST:
        for index, value in enumerate(item):
            yield from _walk(value, "", (*trail, str(index)), around)


def _named(people: list[Person]) -> list[Person]:
    """People by the part of their places in the file that tells them apart; one alone is 0."""
    trails = [person.name.split("/") for person in people]
    first = next((i for i, keys in enumerate(zip(*trails, strict=False)) if len(set(keys)) > 1), 0)
    last = next((i for i, keys in enumerate(zip(*map(reversed, trails), strict=False)) if len(set(keys)) > 1), 0)
    names = ["/".join(trail[first : len(trail) - last]) if len(people) > 1 else "0" for trail in trails]
    return [replace(person, name=name) for person, name in zip(people, names, strict=True)]


def _is_pose(person: Person) -> bool:
    for key in person.layout.poses:
        value, sizes = person.fields[key], layout_sizes(key)
        first = value[0] if isinstance(value, list) and value else value
        shape = first.shape if isinstance(first, np.ndarray) else ()
        if not any(int(np.prod(shape[axis:])) in sizes for axis in range(len(shape))):
            return False
    return True


# ---- several people in one table ----------------------------------------------------------------------------------------


def _apart(person: Person) -> list[Person]:
    """The people of a dict whose tables have one entry a person, or rows of several people."""
    count = _entries_a_person(person)
    if count is not None:
        return [_at(person, index, count) for index in range(count)]
    rows = _groups(person)
    total = sum(len(chosen) for chosen in rows.values())
    return [_of_rows(person, name, chosen, total) for name, chosen in rows.items()] or [person]


def _at(person: Person, index: int, count: int) -> Person:
    return person.rows(str(index), lambda value: value[index] if length(value) == count else value)


def _of_rows(person: Person, name: str, chosen: np.ndarray, total: int) -> Person:
    def take(value: Any) -> Any:
        if length(value) != total:
            return value
        return value[chosen] if isinstance(value, np.ndarray) else [value[row] for row in chosen]

    return person.rows(name, take)


def _entries_a_person(person: Person) -> int | None:
    """How many people the first axis of the poses, or their list, is over; None where it is over frames."""
    key = person.layout.poses[-1]
    value, sizes = person.fields[key], layout_sizes(key)
    if isinstance(value, list):
        # A list of tables is one of people, a list of rows one of frames.
        many = [entry for entry in value if isinstance(entry, np.ndarray) and entry.ndim >= 2 and entry.size not in sizes]
        return len(value) if many and len(many) == len(value) else None
    if not isinstance(value, np.ndarray) or value.ndim < 3 or len(value) < 2:
        return None
    each = int(np.prod(value.shape[1:]))
    # (P, N, 63) is not a frame of any joints; (N, 24, 3) is.
    return len(value) if each not in sizes and any(int(np.prod(value.shape[axis:])) in sizes for axis in (2, 3)) else None


def _groups(person: Person) -> dict[str, np.ndarray]:
    """Numbers of the rows of everyone, by the tracker's number or the subject and folder of the picture."""
    if "imgname" in person.fields:
        return _by_picture(person)
    key = next((key for key in person.layout.ids if key in person.fields), None)
    ids = flat(person.fields[key]) if key is not None else np.zeros(0)
    if len(ids) != length(person.fields[person.layout.poses[0]]):
        return {}
    return {str(name): np.flatnonzero(ids == name) for name in np.unique(ids)}


def _by_picture(person: Person) -> dict[str, np.ndarray]:
    pictures = [str(_text(name)) for name in flat(person.fields["imgname"])]
    subjects = [str(_text(name)) for name in flat(person.fields.get("sub", [""] * len(pictures)))]
    if len(subjects) != len(pictures):
        return {}
    names = ["/".join(filter(None, (str(Path(picture).parent), sub))) for picture, sub in zip(pictures, subjects, strict=True)]
    order: dict[str, list[int]] = {}
    for row, name in enumerate(names):
        order.setdefault(name, []).append(row)
    return {name: np.array(sorted(rows, key=lambda row: pictures[row])) for name, rows in order.items()}


def _text(name: Any) -> str:
    return name.decode("latin-1") if isinstance(name, bytes) else str(name)


#: Names of frames: those of pictures, and numbers behind such a word.
_FRAME_NAME = re.compile(r".*\.(jpe?g|png|bmp|webp)$|(frame|image|img)[_ -]?\d+$", re.IGNORECASE)
_IDS = ("tid", "trackids", "trackedids", "trackid", "id", "personid", "subjectid")
#: Keys of the dicts that hold the pose of each person of a frame.
_POSES = ("smpl", "smplparams", "predsmplparams", "params")
#: Containers within each other that are looked into.
_DEEPEST = 4


def gather_frames(path: Path, content: Any, depth: int = 0) -> Any:
    """``content`` with a dict of people, each with tables of one row a frame, for whatever in it has one entry a frame.

    People are told apart by the number that trackers give them; ``frame_ids`` say in which frames each is seen.

    Raises:
        ValueError: several people in a frame and no such numbers; names the file.
    """
    entries = _entries(content)
    if entries is None:
        if depth < _DEEPEST and isinstance(content, Mapping):
            return {key: gather_frames(path, value, depth + 1) for key, value in content.items()}
        if depth < _DEEPEST and isinstance(content, list) and len(content) == 1:
            return [gather_frames(path, content[0], depth + 1)]
        return content
    people: dict[str, list[dict[str, Any]]] = {}
    for frame, entry in enumerate(entries):
        rows = _rows(entry)
        names = [str(row.get("person", number)) for number, row in enumerate(rows)]
        if len(rows) > 1 and (len(set(names)) < len(rows) or any("person" not in row for row in rows)):
            raise ValueError(
                f"{path}: holds {len(rows)} people in its frame {frame} and no track numbers to tell them apart; write one "
                "file a person, with poses (N, 72) and trans (N, 3)"
            )
        for name, row in zip(names, rows, strict=True):
            people.setdefault(name, []).append({**row, "frame_ids": frame})
    return {name: _stacked(rows) for name, rows in people.items()}


def _entries(content: Any) -> list[Any] | None:
    """What stands for each frame; None where the content is not arranged so."""
    if isinstance(content, Mapping) and len(content) > 1:
        pictures = [key for key in content if _FRAME_NAME.fullmatch(key) and isinstance(content[key], (Mapping, list))]
        if len(pictures) > 1:
            return [content[key] for key in sorted(pictures, key=_numbers)]
        values = [content[key] for key in sorted(content, key=_numbers)]
        return values if all(key.isdigit() and _is_row(content[key]) for key in content) else None
    if isinstance(content, list) and len(content) > 1 and all(_is_row(entry) for entry in content):
        return content
    return None


def _numbers(key: str) -> tuple[list[int], str]:
    return [int(digits[-18:]) for digits in re.findall(r"\d+", key)], key


def _is_row(entry: Any) -> bool:
    """Whether a dict holds the pose of one frame alone."""
    if not isinstance(entry, Mapping):
        return False
    keys = {squeezed(key): key for key in entry}
    layout = find_layout(keys)
    if layout is None:
        return False
    try:
        parts = [(key, np.asarray(entry[keys[key]], dtype=float)) for key in layout.poses]
        return all(len(as_turns(Path(), key, array, *counts_of(key)).values) == 1 for key, array in parts)
    except (TypeError, ValueError):  # no numbers, rows of several lengths, or no rotations of these joints
        return False


def _rows(entry: Any) -> list[dict[str, Any]]:
    """The people of one frame, each a dict; the key ``person`` has the number that a tracker gave it."""
    if isinstance(entry, list):
        return [row for part in entry for row in _rows(part)]
    if not isinstance(entry, Mapping):
        return []
    fields = {squeezed(key): value for key, value in entry.items()}
    poses = next((fields[key] for key in _POSES if isinstance(fields.get(key), list)), None)
    layout = find_layout({key: key for key in fields})
    if poses is not None:
        count = len(poses)
    elif layout is None:
        return []
    else:
        count = 1 if _is_row(entry) else len(fields[layout.poses[0]])
        if count == 1:
            return [_named(dict(fields))]
    rows = []
    for index in range(count):
        own = {key: value[index] for key, value in fields.items() if length(value) == count}
        if poses is not None and isinstance(poses[index], Mapping):
            own |= {squeezed(key): value for key, value in poses[index].items()}
        rows.append(_named(own))
    return rows


def _named(row: dict[str, Any]) -> dict[str, Any]:
    name = next((row[key] for key in _IDS if key in row), None)
    number = flat(name)
    if name is not None and len(number) == 1 and number.dtype.kind in "iu":
        row["person"] = int(number[0])
    return row


def _stacked(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Tables (N, …) of what every row holds in the same shape."""
    fields: dict[str, Any] = {}
    for key in rows[0]:
        values = [row.get(key) for row in rows]
        if all(isinstance(value, (np.ndarray, np.generic, int, float)) for value in values):
            arrays = [np.asarray(value) for value in values]
            if len({array.shape for array in arrays}) == 1:
                fields[key] = np.stack(arrays)
    return fields
