"""Other ways to write the same content: another kind of numbers or containers, other keys, deeper in the file."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch


def opened(item: Any) -> Any:
    """Content with plain dicts and lists for arrays of objects, and arrays of numpy for tensors."""
    if isinstance(item, torch.Tensor):
        return item.numpy()
    if isinstance(item, np.ndarray) and item.dtype == object:
        return opened(item.item() if item.ndim == 0 else item.tolist())
    if isinstance(item, dict):
        return {key: opened(value) for key, value in item.items()}
    return [opened(value) for value in item] if isinstance(item, list) else item


def _each(change: Callable[[np.ndarray], Any]) -> Callable[[Any], Any]:
    """Content with every table of numbers changed."""

    def inside(item: Any) -> Any:
        if isinstance(item, dict):
            return {key: inside(value) for key, value in item.items()}
        if isinstance(item, list):
            return [inside(value) for value in item]
        return change(item) if isinstance(item, np.ndarray) and item.dtype.kind in "fiu" else item

    return inside


def _keys(change: Callable[[str], str]) -> Callable[[Any], Any]:
    def inside(item: Any) -> Any:
        if isinstance(item, dict):
            return {change(key) if isinstance(key, str) else key: inside(value) for key, value in item.items()}
        return [inside(value) for value in item] if isinstance(item, list) else item

    return inside


def _camel(key: str) -> str:
    first, *rest = key.split("_")
    return first + "".join(word.title() for word in rest)


def _more(content: Any) -> Any:
    if not isinstance(content, dict):
        return content
    return {**content, "note": "x", "verts": np.zeros((60, 5, 3)), "joints": np.zeros((60, 24, 3)), "checked": None}


#: Each: the suffix of the file, and the content for it.
SIBLINGS: dict[str, tuple[str, Callable[[Any], Any]]] = {
    "pickle": (".pkl", lambda content: content),
    "single precision": (".pkl", _each(lambda table: table.astype(np.float32) if table.dtype.kind == "f" else table)),
    "other byte order": (".pkl", _each(lambda table: table.astype(">f8") if table.dtype.kind == "f" else table)),
    "tensors": (".pt", _each(lambda table: torch.from_numpy(np.ascontiguousarray(table)))),
    "tensors in a pickle": (".pkl", _each(lambda table: torch.from_numpy(np.ascontiguousarray(table)))),
    "lists": (".pkl", _each(lambda table: table.tolist())),
    "joblib": (".jl.pkl", lambda content: content),
    "capitals": (".pkl", _keys(str.upper)),
    "camel case": (".pkl", _keys(_camel)),
    "nested": (".pkl", lambda content: {"version": 1, "result": {"data": content, "name": "x"}}),
    "list of one": (".pkl", lambda content: [content] if isinstance(content, dict) else content),
    "more keys": (".pkl", _more),
}
