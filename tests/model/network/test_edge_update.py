"""The edge update in blocks: where a block ends and which nodes have edges changes nothing."""

from dataclasses import replace

import pytest
import torch

from hood.model.graph.builder import EdgeSet, edge_set
from hood.model.network.message_passing import update_edges
from hood.model.network.mlp import MLP
from hood.tensors import dense

NUM_NODES = 120


def sparse_set() -> EdgeSet:
    """700 edges of 120 nodes, the first with more than 256, between every third of 360 nodes; the others have none."""
    generator = torch.Generator().manual_seed(0)
    hub = torch.stack([torch.zeros(300, dtype=torch.int64), torch.arange(300) % (NUM_NODES - 1) + 1], dim=1)
    edges = edge_set(torch.cat([hub, torch.randint(1, NUM_NODES, (400, 2), generator=generator)]))
    offsets = torch.cat([edges.offsets[:1], edges.offsets[1:].repeat_interleave(3)])
    local = {"local_senders": 3 * edges.local_senders, "local_receivers": 3 * edges.local_receivers}
    return replace(edges, nodes=torch.arange(3 * len(edges.nodes)), offsets=offsets, **local)


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("dtype, bound", [(torch.float64, 1e-12), (torch.float32, 1e-5), (torch.bfloat16, 0.015)])
def test_blocks_and_nodes_without_edges_change_nothing(dtype, bound, overwrite, monkeypatch):
    torch.manual_seed(0)
    mlp, edges = MLP(48, 16, 16).requires_grad_(False), sparse_set()
    mlp.norm.weight.data.normal_()
    mlp.norm.bias.data.normal_()
    nodes, latent = torch.randn(len(edges.nodes) + 5, 16).to(dtype), torch.randn(edges.num_edges, 16).to(dtype)
    mlp = mlp.double()
    ends = [nodes[edges.local_receivers].double(), nodes[edges.local_senders].double(), latent.double()]
    message = mlp(torch.cat(ends, dim=1))
    sums = torch.zeros(len(nodes), 16, dtype=torch.float64).index_add(0, edges.local_receivers, message)
    mlp = mlp.to(torch.float64 if dtype == torch.float64 else torch.float32)
    monkeypatch.setattr(dense, "BLOCK_BYTES", 0)
    with torch.no_grad():
        results = update_edges(mlp, nodes, latent.clone(), edges, overwrite)
    for value, expected in zip(results, (latent.double() + message, sums), strict=True):
        assert value.dtype == dtype
        assert float((value.double() - expected).norm() / expected.norm()) < bound
    degree = edges.offsets.diff()
    assert not results[1][: len(degree)][degree == 0].any()
    assert not results[1][len(degree) :].any()
