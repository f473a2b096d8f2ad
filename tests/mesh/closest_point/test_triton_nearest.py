"""The three nearest vertices by one kernel against all pairs, by Triton's interpreter; compiled for GPUs that are not here.

Triton decides at its import whether it interprets, so the kernel runs in a process of its own: this file as a script computes
all cases and writes what came out.
"""

import sys

import numpy as np
import pytest
import torch
from torch import Tensor

from hood.mesh.closest_point import static_shapes, vertices
from hood.tensors.dense import assumed
from tests.interpreted import interpret
from tests.spills import CAPABILITIES, LEAST, spilled

#: Points and vertices of each scene, and the precision.
CASES = {
    "one": (((70, 150),), torch.float32),
    "several": (((40, 130), (1, 1), (30, 65)), torch.float64),
    "two vertices": (((10, 2),), torch.float32),
    "no vertex of its scene": (((10, 80), (5, 0)), torch.float64),
    "a grid": (((90, 64),), torch.float32),  # equally far ones
    "not finite": (((20, 90),), torch.float32),
}
RANDOM = {
    f"random {seed}": (((1 + seed % 90, 3 + (13 * seed) % 200), (seed % 7, seed % 5)), (torch.float32, torch.float64)[seed % 2])
    for seed in range(500)
}


def query(name: str) -> tuple[Tensor, ...]:
    """Points and their scenes, vertices and theirs, and which of these count."""
    sizes, dtype = {**CASES, **RANDOM}[name]
    rng = np.random.default_rng(sum(name.encode()))
    of_points, of_vertices = (torch.as_tensor(np.repeat(np.arange(len(sizes)), [one[i] for one in sizes])) for i in range(2))
    points, targets = (torch.tensor(rng.normal(size=(len(scene), 3)), dtype=dtype) for scene in (of_points, of_vertices))
    if name == "a grid":
        points, targets = points.round(), targets.round()
    if name == "not finite":
        targets[::3, 1] = torch.nan
        targets[1::3, 0] = torch.inf
    return points, of_points, targets, of_vertices, torch.as_tensor(rng.random(len(targets)) < 0.8)


def find(name: str) -> tuple[Tensor, Tensor]:
    return static_shapes._nearest(*query(name))


def find_one(name: str) -> tuple[Tensor, Tensor]:
    """The nearest within 0.7 m."""
    points, of_points, targets, of_vertices, usable = query(name)
    scenes = (of_points, of_vertices) if len(targets) and int(of_points.max()) else (None, None)
    return tuple(vertices.nearest_dense(points, scenes[0], targets, scenes[1], usable, 0.7))


def by_order(name: str) -> tuple[Tensor, Tensor]:
    """All distances in the order of the vertices, sorted so that equal ones stay in it."""
    points, of_points, targets, of_vertices, usable = query(name)
    pairs = (points[:, None] - targets).square().sum(dim=2).nan_to_num(nan=torch.inf)
    pairs = pairs.masked_fill(~usable | (of_points[:, None] != of_vertices), torch.inf)
    away, index = pairs.sort(dim=1, stable=True)
    missing = max(3 - len(targets), 0)
    away = torch.cat([away[:, :3], away.new_full((len(away), missing), torch.inf)], dim=1)
    index = torch.cat([index[:, :3], index[:, :1].expand(-1, missing)], dim=1)
    return torch.where(torch.isinf(away), index[:, :1], index), away.sqrt()


def assert_same(found: tuple[Tensor, Tensor], name: str) -> None:
    index, away = by_order(name)
    there = torch.isfinite(away)
    assert torch.equal(torch.isfinite(found[1]), there)
    torch.testing.assert_close(found[1][there], away[there], rtol=4 * torch.finfo(away.dtype).eps, atol=0.0)
    exact = name == "a grid" or away.dtype == torch.float64
    same = (found[0] == index) | ~there
    assert bool(same.all()) if exact else float(same.double().mean()) > 0.999  # of two at one distance but for a rounding


def test_one_kernel_finds_what_all_pairs_have(tmp_path):
    results = interpret(__file__, "CASES", tmp_path, 300)
    for name in CASES:
        assert_same(results[name], name)
        expected, found = find_one(name), results[f"{name}, one"]
        torch.testing.assert_close(found, expected)
    assert not torch.isfinite(results["no vertex of its scene"][1][10:]).any()


@pytest.mark.slow
def test_five_hundred_random_queries(tmp_path):
    results = interpret(__file__, "RANDOM", tmp_path, 3600)
    assert len(results) == 1000
    for name in RANDOM:
        assert_same(results[name], name)


@pytest.mark.parametrize("capability", CAPABILITIES)
@pytest.mark.parametrize("dtype", ["*fp32", pytest.param("*fp64", marks=pytest.mark.slow)])
def test_registers_suffice(dtype, capability, tmp_path, monkeypatch):
    pytest.importorskip("triton", reason="Triton is built for Linux only")
    from hood.mesh.closest_point import triton_nearest

    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path / "cache"))
    types = {"points": dtype, "vertices": dtype, "away": dtype, "usable": "*i1", "count": "i32", "number": "i32"}
    types |= dict.fromkeys(("point_scene", "vertex_scene", "index"), "*i64")
    constants = {"TILE": vertices.TILE, "CHUNK": vertices.CHUNK}
    options = {"num_warps": vertices.WARPS}
    assert spilled(triton_nearest.nearest_pass, types, constants, options, capability, tmp_path) <= LEAST


if __name__ == "__main__":
    with assumed():
        cases = globals()[sys.argv[1]]
        torch.save({name: find(name) for name in cases} | {f"{name}, one": find_one(name) for name in cases}, sys.argv[2])
