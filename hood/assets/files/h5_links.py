"""HDF5 datasets that lie in their own file; links to other files of the machine are refused."""

from __future__ import annotations

from typing import Any

import h5py


def own_group(file: h5py.File, key: str) -> h5py.Group | None:
    """The group ``key`` that lies in this file; None where there is none.

    Raises:
        ValueError: it lies elsewhere.
    """
    if file.get(key, getlink=True) is None:
        return None
    place = _follow(file, key)
    if not isinstance(place, h5py.Group):
        raise ValueError(f"{key} is no group of tables")
    return place


def own_dataset(file: h5py.File, key: str) -> h5py.Dataset:
    """The table ``key`` that lies in this file.

    Raises:
        ValueError: it lies elsewhere.
        KeyError: there is none.
    """
    place = _follow(file, key)
    if not isinstance(place, h5py.Dataset) or place.external or place.is_virtual:
        raise ValueError(f"{key} is not a dataset of its own; store the data itself")
    return place


def _follow(file: h5py.File, key: str) -> Any:
    place: Any = file
    for name in key.split("/"):
        link = place.get(name, getlink=True) if isinstance(place, h5py.Group) else None
        if link is None:
            raise KeyError(f"{key} is missing")
        if not isinstance(link, h5py.HardLink):
            raise ValueError(f"{key} is a link to another place; store the data itself")
        place = place[name]
    return place
