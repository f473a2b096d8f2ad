"""A cache keyed by the identity of an object, which does not outlive it."""

from __future__ import annotations

from collections.abc import Callable, MutableMapping
from typing import Any


def forget(kept: MutableMapping[Any, Any], key: Any) -> Callable[[Any], None]:
    """For :class:`weakref.ref`: takes ``key`` out of ``kept`` when the object is gone; works while Python shuts down, too, when
    the names of modules are gone as well."""

    def remove(_: Any) -> None:
        kept.pop(key, None)

    return remove
