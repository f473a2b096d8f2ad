"""Cloth near cloth for the graph: layers, folds, and nothing along a sheet."""

import numpy as np
import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth, concatenate_cloths
from hood.model.graph.builder import find_near_cloth
from hood.testing import cylinder, grid

RADIUS = 0.03


def sheets(gap: float, n: int = 8):
    pos, faces = grid(n, n, 0.2)
    both = np.concatenate([faces, faces + len(pos)])
    cloth = build_cloth(np.concatenate([pos, pos]), both, Material(), dtype=torch.float64)
    return cloth, torch.as_tensor(np.concatenate([pos, pos + [0.005, gap, 0.003]]))


def test_two_layers_are_all_pairs_within_reach_and_no_neighbours() -> None:
    cloth, pos = sheets(0.01)
    pairs = find_near_cloth(cloth, pos, RADIUS)
    apart = torch.cdist(pos, pos) < RADIUS
    apart[:64, :64] = apart[64:, 64:] = False
    expected = torch.triu(apart).nonzero()
    assert torch.equal(pairs, expected)
    assert len(pairs) > 60


def test_layers_that_are_far_have_none() -> None:
    cloth, pos = sheets(0.04)
    assert find_near_cloth(cloth, pos, RADIUS).shape == (0, 2)


@pytest.mark.parametrize("around", [24, 96])
def test_a_sheet_at_rest_has_none_however_fine(around: int) -> None:
    points, faces = cylinder(around=around, rows=around // 2, radius=0.1, height=0.2)
    cloth = build_cloth(points, faces, Material(), dtype=torch.float64)
    assert len(find_near_cloth(cloth, cloth.rest_pos, RADIUS)) == 0


def test_a_fold_has_pairs_between_its_two_sides() -> None:
    pos, faces = grid(21, 5, 0.4)
    over = pos[:, 0] > 0.2
    folded = np.stack([np.where(over, 0.4 - pos[:, 0], pos[:, 0]), np.where(over, 0.012, 0.0), pos[:, 2]], axis=1)
    cloth = build_cloth(pos, faces, Material(), dtype=torch.float64)
    first, second = find_near_cloth(cloth, torch.as_tensor(folded), RADIUS).unbind(1)
    assert len(first) > 30
    assert (torch.as_tensor(over)[first] != torch.as_tensor(over)[second]).all()
    assert (cloth.rest_pos[first] - cloth.rest_pos[second]).norm(dim=1).min() >= 1.5 * RADIUS


def test_scenes_of_a_batch_are_not_near_each_other() -> None:
    first, first_pos = sheets(0.01)
    second, second_pos = sheets(0.02, n=6)
    pairs = find_near_cloth(concatenate_cloths([first, second]), torch.cat([first_pos, second_pos]), RADIUS)
    alone = [find_near_cloth(first, first_pos, RADIUS), find_near_cloth(second, second_pos, RADIUS) + 128]
    assert torch.equal(pairs, torch.cat(alone))


def test_places_that_are_not_finite_are_near_nothing() -> None:
    cloth, pos = sheets(0.01)
    pos[3] = float("nan")
    pairs = find_near_cloth(cloth, pos, RADIUS)
    assert len(pairs) > 0
    assert not (pairs == 3).any()
    assert len(find_near_cloth(cloth, torch.full_like(pos, torch.nan), RADIUS)) == 0
