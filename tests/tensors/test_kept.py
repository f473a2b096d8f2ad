"""Values kept by identity go with their object."""

from __future__ import annotations

import weakref

from hood.tensors.batch import forget


class Thing:
    pass


def test_a_value_goes_with_its_object():
    thing, kept = Thing(), {}
    kept[7] = weakref.ref(thing, forget(kept, 7))
    assert kept
    del thing
    assert not kept
    forget(kept, 7)(None)  # gone already
