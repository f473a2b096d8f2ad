"""The decoder of mesh edges, and networks that have one."""

from __future__ import annotations

import pytest
import torch
from test_compiled_network import needs_compiler, single
from test_model import SHORT, WIDTHS, make_case, make_graph

from hood.model.network.message_passing import EdgeDecoder
from hood.model.network.model import MeshGraphNet
from hood.testing import grid


def make(width: int = 16, **options) -> MeshGraphNet:
    torch.manual_seed(0)
    return MeshGraphNet(5, WIDTHS, width, SHORT, edge_out_width=4, **options)


def test_the_parts_of_the_first_layer_are_the_layer() -> None:
    edges = make_graph(grid(5, 5)).edge_sets["mesh"]
    decoder, nodes, latent = EdgeDecoder(8, 4).double(), torch.randn(25, 8).double(), torch.randn(edges.num_edges, 8).double()
    together = torch.cat([nodes[edges.receivers], nodes[edges.senders], latent], dim=1)
    torch.testing.assert_close(decoder(nodes, latent, edges), decoder.mlp(together), rtol=0, atol=1e-12)


def test_a_network_with_an_output_of_edges_is_otherwise_the_one_without() -> None:
    case = make_case(make_graph(grid(9, 9)))
    network = make().double()
    torch.manual_seed(0)
    without = MeshGraphNet(5, WIDTHS, 16, SHORT).double()
    raw, edges = network.with_edges(case.graph, case.nodes, case.edges)
    assert torch.equal(raw, without(case.graph, case.nodes, case.edges))
    assert edges.shape == (case.graph.edge_sets["mesh"].num_edges, 4)
    edges.square().sum().backward()
    assert all(bool((p.grad != 0).any()) for p in network.edge_decoder.parameters())


def test_the_output_begins_near_zero() -> None:
    case = make_case(make_graph(grid(9, 9)))
    with torch.no_grad():
        outputs = [make(output_init=init).double().with_edges(case.graph, case.nodes, case.edges)[1] for init in (1, 0)]
    sizes = [float(output.abs().max()) for output in outputs]
    assert sizes[0] > 0.01
    assert sizes[1] == 0.0


@needs_compiler
def test_the_fused_network_gives_the_same_edges() -> None:
    network, case = make(48), single(make_case(make_graph(grid(14, 14))))
    with torch.no_grad():
        expected = network.with_edges(case.graph, case.nodes, case.edges)
        network.use_kernels("fused")
        found = network.with_edges(case.graph, case.nodes, case.edges)
    for a, b in zip(found, expected, strict=True):
        assert float((a - b).abs().max() / b.abs().max()) < 1e-5


def test_a_schedule_without_the_mesh_is_refused() -> None:
    with pytest.raises(ValueError, match=r"no step on the mesh.*1x\(mesh\)"):
        MeshGraphNet(5, WIDTHS, 16, "(coarse0)", edge_out_width=4)
