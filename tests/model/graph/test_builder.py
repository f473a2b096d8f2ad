"""Edge sets of a step: order, body edges, attachments, active edges."""

import numpy as np
import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import Cloth, build_cloth
from hood.cloth.state import Attachments, Obstacle, StepInput
from hood.mesh.closest_point.vertices import Nearest
from hood.model.graph.builder import build_graph, build_static, edge_set
from hood.model.graph.hierarchy import build_hierarchy
from hood.testing import grid

DT = torch.tensor([1 / 30])


@pytest.fixture
def cloth() -> Cloth:
    return build_cloth(*grid(9, 9), Material())


def static_of(cloth: Cloth, names=("mesh", "coarse0", "coarse1")):
    hierarchy = build_hierarchy(cloth.num_vertices, cloth.edges.numpy(), cloth.rest_pos.numpy(), 2)
    return build_static(cloth, hierarchy, names)


def body_of(count: int, omitted: tuple[int, ...] = ()) -> Obstacle:
    pos, scene = torch.zeros(count, 3), torch.zeros(count, dtype=torch.int64)
    hidden = torch.zeros(count, dtype=torch.bool)
    hidden[list(omitted)] = True
    return Obstacle(pos, pos, pos, torch.zeros(1, 3, dtype=torch.int64), scene, torch.zeros(1, dtype=torch.int64), hidden)


def test_edge_set_has_both_directions_sorted_by_receiver_with_consistent_tables():
    pairs = torch.tensor([[4, 1], [1, 7], [7, 4], [2, 7]])
    edges = edge_set(pairs)
    directed = list(zip(edges.receivers.tolist(), edges.senders.tolist(), strict=True))
    assert directed == sorted([(4, 1), (1, 4), (1, 7), (7, 1), (7, 4), (4, 7), (2, 7), (7, 2)])
    assert torch.equal(edges.receivers[edges.reverse], edges.senders)
    assert torch.equal(edges.senders[edges.reverse], edges.receivers)
    assert edges.nodes.tolist() == [1, 2, 4, 7]
    assert torch.equal(edges.nodes[edges.local_senders], edges.senders)
    assert torch.equal(edges.nodes[edges.local_receivers], edges.receivers)
    assert edges.offsets.tolist() == [0, 2, 3, 5, 8]
    ends = torch.stack([edges.receivers, edges.senders], 1).sort(dim=1).values
    assert torch.equal(ends, pairs[edges.source].sort(dim=1).values)


def test_without_a_body_there_are_no_body_nodes(cloth):
    graph = build_graph(static_of(cloth), StepInput(DT))
    assert graph.num_nodes == cloth.num_vertices
    assert graph.edge_sets["body"].num_edges == 0
    assert list(graph.edge_sets) == ["mesh", "coarse0", "coarse1", "body"]


def test_body_edges_follow_the_radius_and_drop_omitted_vertices_after_the_search(cloth):
    vertex = torch.full((81,), 5)
    dist = torch.full((81,), 0.05)
    vertex[:4] = torch.tensor([9, 2, 9, 6])
    dist[:4] = torch.tensor([0.01, 0.029, 0.02, 0.01])
    graph = build_graph(static_of(cloth), StepInput(DT, body_of(12, omitted=(6,))), Nearest(vertex, dist))
    assert graph.body_vertex.tolist() == [2, 9]
    body = graph.edge_sets["body"]
    pairs = set(zip(body.senders.tolist(), body.receivers.tolist(), strict=True))
    assert pairs == {(82, 0), (81, 1), (82, 2), (0, 82), (1, 81), (2, 82)}


def test_body_subsets_keep_the_nodes_of_their_level_only(cloth):
    static = static_of(cloth)
    nearest = Nearest(torch.arange(81) % 12, torch.full((81,), 0.01))
    graph = build_graph(static, StepInput(DT, body_of(12)), nearest)
    body = graph.edge_sets["body"]
    assert graph.body_subsets[0].rows is None
    for level in (1, 2):
        subset = graph.body_subsets[level]
        ends = torch.minimum(subset.edges.senders, subset.edges.receivers)
        assert torch.equal(ends.unique(), (static.node_level >= level).nonzero().squeeze(1))
        assert torch.equal(body.senders[subset.rows], subset.edges.senders)
        assert torch.equal(subset.edges.receivers[subset.edges.reverse], subset.edges.senders)
        assert torch.equal(subset.edges.nodes[subset.edges.local_senders], subset.edges.senders)


def test_closed_attachments_join_the_mesh_edges(cloth):
    static = static_of(cloth)
    attachments = Attachments(torch.tensor([[0, 80], [8, 72]]), torch.tensor([True, False]))
    mesh = build_graph(static, StepInput(DT, attachments=attachments)).edge_sets["mesh"]
    pairs = set(zip(mesh.senders.tolist(), mesh.receivers.tolist(), strict=True))
    assert {(0, 80), (80, 0)} < pairs
    assert (8, 72) not in pairs
    assert mesh.num_edges == 2 * len(cloth.edges) + 2
    assert mesh.source.max() == len(cloth.edges)


def test_inactive_mesh_edges_are_left_out_and_sources_stay_valid(cloth):
    active = torch.ones(len(cloth.edges), dtype=torch.bool)
    active[::3] = False
    mesh = build_graph(static_of(cloth), StepInput(DT), active_edges=active).edge_sets["mesh"]
    assert mesh.num_edges == 2 * int(active.sum())
    ends = torch.stack([mesh.senders, mesh.receivers], 1).sort(dim=1).values
    assert torch.equal(ends, cloth.edges[mesh.source])


def test_missing_levels_and_foreign_hierarchies_are_refused(cloth):
    with pytest.raises(ValueError, match="no edge set 'coarse2'"):
        static_of(cloth, ("mesh", "coarse2"))
    other = build_hierarchy(1, np.zeros((0, 2)), np.zeros((1, 3)), 1)
    with pytest.raises(ValueError, match="1 vertices but the cloth has 81"):
        build_static(cloth, other, ("mesh",))
