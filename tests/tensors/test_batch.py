"""Flat batches of dataclasses."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest
import torch
from torch import Tensor

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth, concatenate_cloths
from hood.cloth.state import State, concatenate_states
from hood.tensors.batch import concatenate, indexes, to_device
from hood.testing import cylinder, grid, strip


@dataclass(frozen=True)
class Item:
    values: Tensor
    pairs: Tensor = indexes("values")
    extra: Tensor | None = None
    count: int = 1
    place: Tensor = field(default_factory=lambda: torch.zeros(1, 3).double(), metadata={"float64": True})


def item(size: int, extra: bool = False) -> Item:
    return Item(torch.arange(float(size)), torch.tensor([[0, size - 1]]), torch.ones(size) if extra else None)


def test_indices_are_shifted_values_are_stacked_counts_are_summed() -> None:
    merged = concatenate([item(3), item(2), item(4)], {"values": [3, 2, 4]})
    assert merged.pairs.tolist() == [[0, 2], [3, 4], [5, 8]]
    assert merged.values.tolist() == [0, 1, 2, 0, 1, 0, 1, 2, 3]
    assert merged.extra is None
    assert merged.count == 3


def test_one_item_is_itself() -> None:
    alone = item(3)
    assert concatenate([alone], {"values": [3]}) is alone


def test_a_field_present_in_some_items_only_is_refused() -> None:
    with pytest.raises(ValueError, match="cannot batch 'extra'"):
        concatenate([item(3), item(2, extra=True)], {"values": [3, 2]})


def test_precision_of_origins_is_kept() -> None:
    moved = to_device(item(3), "cpu", torch.float16)
    assert moved.values.dtype == torch.float16
    assert moved.place.dtype == torch.float64
    assert moved.pairs.dtype == torch.int64
    assert moved.count == 1


def test_batched_cloths_hold_their_members() -> None:
    """Every element of the batch refers to the same positions as in the cloth it came from."""
    cloths = [build_cloth(*mesh, Material()) for mesh in (grid(3, 3, 0.2), cylinder(5, 3), strip(4))]
    batch = concatenate_cloths([cloths[0], concatenate_cloths(cloths[1:])])
    assert batch.num_scenes == 3
    for name, scene in (("faces", "face_scene"), ("edges", "edge_scene"), ("hinges", "hinge_scene")):
        for index, cloth in enumerate(cloths):
            rows = getattr(batch, scene) == index
            torch.testing.assert_close(batch.rest_pos[getattr(batch, name)[rows]], cloth.rest_pos[getattr(cloth, name)])
    for index, cloth in enumerate(cloths):
        torch.testing.assert_close(batch.mass[batch.vertex_scene == index], cloth.mass)


def test_batched_states() -> None:
    states = [State(torch.full((n, 3), n), torch.zeros(n, 3), torch.full((1, 3), float(n)).double()) for n in (2, 3)]
    merged = concatenate_states(states)
    assert merged.pos[:, 0].tolist() == [2, 2, 3, 3, 3]
    assert merged.origin.tolist() == [[2.0] * 3, [3.0] * 3]
