"""The people in a motion file: where each stands in it, and the one that is asked for."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hood.assets.files.guarded import listed
from hood.assets.files.text import flat, squeezed
from hood.assets.motion.layouts.content import LAYOUTS, MotionLayout, Unread, find_layout, layout_sizes, length

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
