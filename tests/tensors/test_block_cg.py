"""Conjugate gradients in two kernels an iteration against those that the host leads, by Triton's interpreter.

Triton decides at its import whether it interprets, so the kernels run in a process of their own: this file as a script
computes all cases and writes what came out.
"""

import sys

import numpy as np
import pytest
import torch
from torch import Tensor

from hood.solver.system.linear import invert_blocks
from hood.solver.system.sparsity import BlockPattern
from hood.tensors import conjugate_gradients as block_cg
from hood.tensors.dense import assumed
from tests.interpreted import interpret

#: Rows of the scenes, shift of the second half of the scenes' matrices (negative: indefinite), iterations, number.
CASES = {
    "one": ((70,), 0.0, 12, torch.float64),
    "several": ((40, 1, 90), 0.0, 12, torch.float64),
    "indefinite": ((30, 20), -8.0, 12, torch.float64),
    "float32": ((50,), 0.0, 8, torch.float32),
    "a matrix in float32": ((60, 30), 0.0, 12, torch.float64),
    "solved before": ((5, 40), 0.0, 20, torch.float64),
    "none": ((20,), 0.0, 0, torch.float64),
}
RANDOM = {
    f"random {seed}": ((1 + seed % 40, 1 + (7 * seed) % 23), -float(seed % 3 == 0), 4, torch.float64) for seed in range(500)
}


def system(name: str) -> tuple[Tensor, ...]:
    """Matrix as triples, inverse blocks, right-hand side and tolerance, and the tables of the rows."""
    sizes, shift, _, dtype = {**CASES, **RANDOM}[name]
    rng = np.random.default_rng(sum(name.encode()))
    count, first = sum(sizes), np.cumsum([0, *sizes])
    pairs = np.concatenate([rng.integers(a, b, (3 * (b - a), 2)) for a, b in zip(first[:-1], first[1:], strict=True)])
    pattern = BlockPattern(count, pairs)
    matrix = 0.5 * np.eye(3 * count)
    for i, j in pairs:
        pull = np.zeros(3 * count)
        pull[3 * i : 3 * i + 3] += rng.normal(size=3)
        pull[3 * j : 3 * j + 3] -= pull[3 * i : 3 * i + 3]
        matrix += np.outer(pull, pull)
    half = 3 * first[len(sizes) // 2]
    definite = matrix.copy()
    matrix[half:, half:] += shift * np.eye(3 * count - half)
    triples, kept = (
        torch.tensor(np.stack([whole[row, 3 * col : 3 * col + 3] for row, col in zip(*where, strict=True)]), dtype=dtype)
        for where in [(pattern.triple_rows, pattern.triple_cols)]
        for whole in (matrix, definite)
    )
    if name == "a matrix in float32":
        triples = triples.float()
    inverse = invert_blocks(kept[pattern.diagonal.reshape(-1)].view(-1, 3, 3))
    right = torch.tensor(rng.normal(size=(count, 3)), dtype=dtype)
    scene = torch.as_tensor(np.repeat(np.arange(len(sizes)), sizes))
    tolerance = torch.full((len(sizes),), 1e-2 if name == "solved before" else 1e-6, dtype=dtype)
    return triples, inverse, right, tolerance, *block_cg.block_rows(pattern.cols, pattern.starts, scene, len(sizes))


def solve(name: str) -> tuple[Tensor, Tensor]:
    triples, inverse, right, tolerance, *rows = system(name)
    return block_cg.block_cg(triples, inverse, right, tolerance, rows, {**CASES, **RANDOM}[name][2])


def assert_same(found: tuple[Tensor, Tensor], name: str) -> None:
    x, indefinite = solve(name)
    bound = 1e-10 if x.dtype == torch.float64 else 1e-4
    assert float((found[0] - x).norm()) <= bound * float(x.norm())
    assert torch.equal(found[1], indefinite)


def test_kernels_find_what_the_host_finds(tmp_path):
    results = interpret(__file__, "CASES", tmp_path, 300)
    for name in CASES:
        assert_same(results[name], name)
    assert results["indefinite"][1].tolist() == [0, 1]
    assert float(results["none"][0].abs().max()) == 0.0


@pytest.mark.slow
def test_five_hundred_random_systems(tmp_path):
    results = interpret(__file__, "RANDOM", tmp_path, 3600)
    assert len(results) == 500
    for name in RANDOM:
        assert_same(results[name], name)


def test_a_tile_has_rows_of_one_scene():
    _, _, right, _, *fields = system("several")
    rows = block_cg.BlockRows(*fields)
    starts, ends = rows.tile_rows.tolist(), rows.tile_ends.tolist()
    covered = [row for start, end in zip(starts, ends, strict=True) for row in range(start, min(start + block_cg.TILE, end))]
    assert covered == list(range(len(right)))
    for start, end, scene in zip(starts, ends, rows.tile_scene.tolist(), strict=True):
        assert rows.scene[start:end].unique().tolist() == [scene]
    assert rows.scene_tiles.tolist() == [0, 1, 2, 4]


if __name__ == "__main__":
    with assumed():
        torch.save({name: solve(name) for name in globals()[sys.argv[1]]}, sys.argv[2])
