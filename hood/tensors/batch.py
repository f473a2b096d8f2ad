"""Concatenate frozen dataclasses of tensors into one flat batch: indices shifted, everything else stacked end to end.

Selection by a mask into a fixed number of rows, as captured graphs need it.

Tensors with gradients inside of something, and the same thing with others in their place.

A cache keyed by the identity of an object, such as a batch, which does not outlive it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, MutableMapping, Sequence
from copy import copy
from dataclasses import Field, field, fields, is_dataclass, replace
from typing import Any, TypeVar

import torch
from torch import Tensor, nn
from torch.nn import functional


def gather_true(mask: Tensor, size: int) -> Tensor:
    """Indices of the first ``size`` − 1 true entries of ``mask`` (N,) in places 0 …, N in the others: (size,)."""
    count = mask.shape[0]
    place = torch.where(mask, mask.cumsum(0) - 1, size - 1).clamp_max(size - 1)
    index = torch.arange(count, device=mask.device)
    found = torch.full((size,), count, dtype=torch.int64, device=mask.device).scatter(0, place, index)
    # Whatever had no place of its own went to the last one.
    return functional.pad(found[: size - 1], (0, 1), value=count)


T = TypeVar("T")


def indexes(kind: str) -> Any:
    """Dataclass field holding indices into ``kind`` (``"vertices"``, ``"scenes"``…): shifted when batched."""
    return field(metadata={"indexes": kind})


def concatenate(items: Sequence[T], counts: Mapping[str, Sequence[int]]) -> T:
    """One dataclass from several of the same class.

    ``counts[kind][i]`` is how many of ``kind`` item *i* holds; index fields of item *i* are shifted by the sum of the
    counts before it. Tensor fields are concatenated along the first axis, integer fields are summed, None stays None.
    """
    first = items[0]
    if len(items) == 1:
        return first
    merged: dict[str, Any] = {}
    for spec in fields(first):  # type: ignore[arg-type]
        values = [getattr(item, spec.name) for item in items]
        merged[spec.name] = _merge(spec, values, counts)
    return type(first)(**merged)


def _merge(spec: Field[Any], values: list[Any], counts: Mapping[str, Sequence[int]]) -> Any:
    if all(value is None for value in values):
        return None
    if any(value is None for value in values):
        raise ValueError(f"cannot batch {spec.name!r}: present in some items and absent in others")
    if isinstance(values[0], int):
        return sum(values)
    kind = spec.metadata.get("indexes")
    if kind is not None:
        shifted, offset = [], 0
        for value, count in zip(values, counts[kind], strict=True):
            shifted.append(value + offset)
            offset += count
        values = shifted
    return torch.cat(values)


def sent(value: Tensor, device: torch.device | str) -> Tensor:
    """``value`` on ``device``; nothing waits until it has arrived there."""
    if value.device.type != "cpu" or torch.device(device).type == "cpu":
        return value.to(device)
    return value.pin_memory().to(device, non_blocking=True)


def to_device(item: T, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> T:
    """The same dataclass with its tensors on ``device`` and its floating tensors in ``dtype`` (float64 origins stay); what the
    host has found out about it stays known."""
    moved: dict[str, Any] = {}
    for spec in fields(item):  # type: ignore[arg-type]
        value = getattr(item, spec.name)
        if isinstance(value, Tensor):
            keep = spec.metadata.get("float64", False) or not value.is_floating_point()
            value = (value if device is None else sent(value, device)).to(dtype=None if keep else dtype)
        moved[spec.name] = value
    made = type(item)(**moved)
    known = {name: value for name, value in vars(item).items() if name not in moved and isinstance(value, (bool, int, float))}
    vars(made).update(known)
    return made


def given_in(item: object) -> tuple[Tensor, ...]:
    """The tensors in dataclasses, lists, dicts and modules that require a gradient, each once."""
    found: dict[int, Tensor] = {}
    _collect(item, found)
    return tuple(found.values())


def _collect(item: object, found: dict[int, Tensor]) -> None:
    if isinstance(item, Tensor):
        if item.requires_grad:
            found[id(item)] = item
    elif is_dataclass(item):
        for spec in fields(item):
            _collect(getattr(item, spec.name), found)
    elif isinstance(item, dict | nn.Module):
        for value in (item if isinstance(item, dict) else vars(item)).values():
            _collect(value, found)
    elif isinstance(item, list | tuple):
        for value in item:
            _collect(value, found)


def swapped(item: T, table: Mapping[int, Tensor]) -> T:
    """``item`` with its tensors replaced by those of the table, by what they are; itself where none is."""
    if isinstance(item, Tensor):
        return table.get(id(item), item)  # type: ignore[return-value]
    if is_dataclass(item) and not isinstance(item, type):
        there = {spec.name: getattr(item, spec.name) for spec in fields(item)}
        changed = _changed(there, table)
        return replace(item, **changed) if changed else item
    if type(item) in (list, tuple):
        entries = [swapped(value, table) for value in item]  # type: ignore[attr-defined]
        return item if all(one is other for one, other in zip(entries, item, strict=True)) else type(item)(entries)  # type: ignore[call-arg, call-overload]
    if isinstance(item, dict | nn.Module):
        changed = _changed(item if isinstance(item, dict) else vars(item), table)
        if changed:
            item = copy(item)
            (item if isinstance(item, dict) else vars(item)).update(changed)
    return item


def without_gradient(item: T) -> T:
    """``item`` with its tensors detached; itself where none requires a gradient."""
    return swapped(item, {id(one): one.detach() for one in given_in(item)})


def _changed(there: Mapping[Any, Any], table: Mapping[int, Tensor]) -> dict[Any, Any]:
    return {name: new for name, old in there.items() if (new := swapped(old, table)) is not old}


class _Made(dict[str, Any]):
    """Copies of the owner, in memory or on disk, begin without it."""

    def __deepcopy__(self, memo: Any) -> _Made:
        return _Made()

    def __reduce__(self) -> tuple[type, tuple[()]]:
        return _Made, ()


def made_of(owner: Any) -> dict[str, Any]:
    """What was made of a tensor or a cloth, by names, kept as long as that lives. It may refer to its owner; in a table of weak
    references that would keep both for ever."""
    made: dict[str, Any] = vars(owner).setdefault("_made", _Made())
    return made


def forget(kept: MutableMapping[Any, Any], key: Any) -> Callable[[Any], None]:
    """For :class:`weakref.ref`: takes ``key`` out of ``kept`` when the object is gone; works while Python shuts down, too, when
    the names of modules are gone as well."""

    def remove(_: Any) -> None:
        kept.pop(key, None)

    return remove
