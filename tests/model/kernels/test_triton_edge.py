"""The fused edge update against the plain one: by Triton's interpreter on any machine, compiled where there is a GPU.

Triton decides at its import whether it interprets, so the kernels run in a process of their own: this file as a script
computes all cases and writes what came out.
"""

import os
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from hood.model.graph.builder import EdgeSet, edge_set
from hood.model.kernels import triton_edge
from hood.model.network.message_passing import update_edges
from hood.model.network.mlp import MLP
from hood.tensors.dense import linear
from hood.tensors.precision import products

TILE = max(triton_edge.TILES.values())
BOUND = {torch.float32: 1e-5, torch.bfloat16: 0.015}
DTYPES = {"fp32": torch.float32, "bf16": torch.bfloat16}
GRAPHS = ("ring", "hub", "gaps", "star", "full tiles", "one edge")
CASES = [(graph, 64, dtype) for graph in GRAPHS for dtype in DTYPES]
CASES += [("ring", width, dtype) for width in (16, 48, 128) for dtype in DTYPES]
EXTRA = 5  # rows of the node table beyond the nodes


@dataclass
class Case:
    """An edge network with its inputs, the same for everyone who asks."""

    mlp: MLP
    edges: EdgeSet
    nodes: Tensor
    latent: Tensor


def pairs(graph: str) -> Tensor:
    ring = torch.stack([torch.arange(40), (torch.arange(40) + 1) % 40], dim=1)
    if graph in ("ring", "gaps"):  # gaps: see below
        return torch.cat([ring, ring + torch.tensor([0, 3])])
    if graph == "hub":  # a node in the middle with edges in many tiles
        spokes = torch.arange(41, 61 + 3 * TILE)
        return torch.cat([ring, torch.stack([torch.full_like(spokes, 40), spokes], dim=1)])
    if graph == "star":  # the first node fills tiles, the last tiles hold many nodes
        return torch.stack([torch.zeros(TILE * 2, dtype=torch.int64), torch.arange(1, TILE * 2 + 1)], dim=1)
    if graph == "full tiles":  # two nodes, one tile each
        return torch.stack([torch.zeros(TILE, dtype=torch.int64), torch.ones(TILE, dtype=torch.int64)], dim=1)
    return torch.tensor([[0, 1]])


def with_gaps(edges: EdgeSet) -> EdgeSet:
    """The same edges between the even ones of twice as many nodes; the odd ones have none."""
    return replace(
        edges,
        nodes=torch.arange(2 * len(edges.nodes)),
        local_senders=2 * edges.local_senders,
        local_receivers=2 * edges.local_receivers,
        offsets=torch.cat([edges.offsets[:1], edges.offsets[1:].repeat_interleave(2)]),
    )


def make(graph: str, width: int, dtype: str, device: str = "cpu") -> Case:
    torch.manual_seed(width)
    mlp = MLP(3 * width, width, width).requires_grad_(False)
    mlp.norm.weight.normal_()
    mlp.norm.bias.normal_()
    edges = edge_set(pairs(graph))
    edges = with_gaps(edges) if graph == "gaps" else edges
    nodes = torch.randn(len(edges.nodes) + EXTRA, width).to(DTYPES[dtype])
    latent = torch.randn(edges.num_edges, width).to(DTYPES[dtype])
    edges = EdgeSet(**{name: value.to(device) for name, value in vars(edges).items() if isinstance(value, Tensor)})
    return Case(mlp.to(device), edges, nodes.to(device), latent.to(device))


def fused(case: Case, overwrite: bool = False) -> tuple[Tensor, Tensor]:
    first, width = case.mlp.first, case.latent.shape[1]
    weight = torch.cat(first.weight.split(width, dim=1)[:2])
    table = linear(case.nodes, weight, torch.cat([first.bias, torch.zeros_like(first.bias)]))
    return triton_edge.update_edges_fused(case.mlp, table, case.latent, case.edges, overwrite)


def assert_equal_update(result: tuple[Tensor, Tensor], case: Case, bound: float) -> None:
    """Latents and sums within ``bound`` of the RMS of the plain path's in float32."""
    with torch.no_grad():
        expected = update_edges(case.mlp, case.nodes.float(), case.latent.float(), case.edges)
    for value, reference in zip(result, expected, strict=True):
        assert value.shape == reference.shape
        assert float((value.float() - reference).norm() / reference.norm()) < bound
    degree = case.edges.offsets.diff()
    assert not result[1][: len(degree)][degree == 0].any()
    assert not result[1][len(degree) :].any()


@pytest.fixture(scope="module")
def interpreted(tmp_path_factory) -> dict[tuple[str, int, str], tuple[Tensor, Tensor]]:
    """Results of all cases by the interpreter."""
    pytest.importorskip("triton", reason="Triton is built for Linux only")
    path = tmp_path_factory.mktemp("triton") / "results.pt"
    root = str(Path(__file__).parents[3])
    search = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = {**os.environ, "TRITON_INTERPRET": "1", "PYTHONPATH": search}
    subprocess.run([sys.executable, __file__, str(path)], check=True, env=environment, timeout=300)
    return torch.load(path)


@pytest.mark.parametrize("graph, width, dtype", CASES)
def test_latents_and_sums_are_those_of_the_plain_path(interpreted, graph, width, dtype):
    case = make(graph, width, dtype)
    assert_equal_update(interpreted[graph, width, dtype], case, BOUND[case.latent.dtype])


def test_the_graphs_cover_every_kind_of_border():
    sets = {graph: make(graph, 16, "fp32").edges for graph in GRAPHS}
    degree = {graph: int(edges.offsets.diff().max()) for graph, edges in sets.items()}
    assert degree["hub"] > 3 * TILE  # more than two whole tiles of one node
    assert degree["full tiles"] == TILE
    assert sets["full tiles"].num_edges == 2 * TILE
    assert all(sets[graph].num_edges % TILE for graph in ("ring", "hub", "gaps", "one edge"))
    assert int((sets["gaps"].offsets.diff() == 0).sum()) == len(sets["gaps"].nodes) // 2


def test_no_edges_give_no_sums():
    case = make("one edge", 16, "fp32")
    empty = edge_set(torch.zeros(0, 2, dtype=torch.int64))
    updated, received = fused(Case(case.mlp, empty, case.nodes, case.latent[:0]))
    assert updated.shape == (0, 16)
    assert received.shape == case.nodes.shape
    assert not received.any()


def test_only_a_cuda_device_without_gradients_takes_it(monkeypatch):
    latent = torch.zeros(4, 64)
    with torch.no_grad():
        assert not triton_edge.applies(latent)
        monkeypatch.setattr(Tensor, "is_cuda", True)
        monkeypatch.setattr(triton_edge, "_supported", lambda device: True)
        assert triton_edge.applies(latent)
        assert triton_edge.applies(latent.bfloat16())
        assert not triton_edge.applies(latent.double())
        assert not triton_edge.applies(torch.zeros(4, 40))
        assert not triton_edge.applies(torch.zeros(4, 256))
        monkeypatch.setenv("HOOD_TRITON", "off")
        assert not triton_edge.applies(latent)
        monkeypatch.delenv("HOOD_TRITON")
    assert not triton_edge.applies(latent)


def test_products_are_as_exact_as_torchs():
    assert triton_edge.input_precision() == "tf32x3"
    with products("tf32"):
        assert triton_edge.input_precision() == "tf32"


def test_unknown_precisions_are_refused():
    case = make("one edge", 16, "fp32")
    with pytest.raises(ValueError, match="precision is 'tf16'; choose ieee or tf32x3 or tf32"):
        triton_edge.update_edges_fused(case.mlp, case.nodes, case.latent, case.edges, precision="tf16")


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("graph, width, dtype", CASES)
def test_compiled_on_a_gpu(graph, width, dtype):
    case = make(graph, width, dtype, "cuda")
    with torch.no_grad():
        result = fused(case)
        again = fused(case)
        through = update_edges(case.mlp, case.nodes, case.latent.clone(), case.edges, overwrite=True)
    assert all(torch.equal(a, b) for a, b in zip(result, again, strict=True))  # to the last bit
    assert all(torch.equal(a, b) for a, b in zip(result, through, strict=True))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOOD_TRITON", "off")
        assert_equal_update(result, case, BOUND[case.latent.dtype])


def main(path: str) -> None:
    torch.set_num_threads(1)
    results = {}
    for case in CASES:
        results[case] = fused(made := make(*case), overwrite=case[0] == "hub")
        assert (results[case][0] is made.latent) == (case[0] == "hub")
    torch.save(results, path)


if __name__ == "__main__":
    with torch.no_grad():
        main(sys.argv[1])
