"""Graphs of fixed shapes against those of the shapes they need."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.cloth.state import Attachments, Obstacle, StepInput
from hood.mesh.closest_point.vertices import Nearest
from hood.model.graph.builder import BODY, MESH, EdgeSet, Graph, StaticGraph, build_graph, build_static, coarse_name
from hood.model.graph.hierarchy import build_hierarchy
from hood.model.graph.static_shapes import Capacity, FixedGraph, StaticLayout, build_fixed_graph, capacity_for, lay_out
from hood.testing import grid, sphere

RADIUS = 0.03
NUM_BODY = 42


@pytest.fixture(scope="module")
def static() -> StaticGraph:
    pos, faces = grid(7, 8, 0.3)
    cloth = build_cloth(pos, faces, Material())
    hierarchy = build_hierarchy(cloth.num_vertices, cloth.edges.numpy(), pos, 2)
    return build_static(cloth, hierarchy, (MESH, coarse_name(0), coarse_name(1)))


def obstacle(omitted: bool) -> Obstacle:
    pos, faces = sphere(1, 0.2)
    surface, tri = torch.as_tensor(pos), torch.as_tensor(faces)
    hidden = torch.arange(NUM_BODY) % 3 == 0 if omitted else None
    scenes = tri.new_zeros(len(pos)), tri.new_zeros(len(tri))
    return Obstacle(surface, surface, surface, tri, *scenes, hidden)  # type: ignore[arg-type]


def random_nearest(seed: int, num_cloth: int, share: float) -> Nearest:
    """Any body vertex may be nearest, at a ``share`` of the cloth vertices closer than the radius."""
    rng = np.random.default_rng(seed)
    vertex = torch.as_tensor(rng.integers(0, NUM_BODY, num_cloth))
    return Nearest(vertex, torch.as_tensor(rng.uniform(0, RADIUS / share, num_cloth)))


def messages(graph: Graph, edges: EdgeSet) -> dict[tuple[str, int], list[tuple[str, int]]]:
    """Who hears of whom, in the order of the sum: cloth nodes and body vertices by their own numbers."""
    # Places behind the active vertices hold no vertex; theirs are the messages that nobody may hear.
    active = int(graph.num_found[1]) if isinstance(graph, FixedGraph) else len(graph.body_vertex)

    def name(node: int) -> tuple[str, int]:
        if node < graph.num_cloth:
            return "cloth", node
        place = node - graph.num_cloth
        return ("body", int(graph.body_vertex[place])) if place < active else ("spare", 0)

    heard: dict[tuple[str, int], list[tuple[str, int]]] = {}
    for m, node in enumerate(edges.nodes.tolist()):
        for row in range(int(edges.offsets[m]), int(edges.offsets[m + 1])):
            assert int(edges.receivers[row]) == node
            assert int(edges.senders[row]) == int(edges.nodes[edges.local_senders[row]])
            heard.setdefault(name(node), []).append(name(int(edges.senders[row])))
    return heard


def without_spare(heard: dict[tuple[str, int], list[tuple[str, int]]]) -> dict[tuple[str, int], list[tuple[str, int]]]:
    assert {sender for sender in heard.pop(("spare", 0), [])} <= {("spare", 0)}
    return heard


@pytest.mark.parametrize("omitted", [False, True])
@pytest.mark.parametrize("share", [0.1, 0.6, 1.0])
def test_everyone_hears_what_they_hear_in_the_plain_graph(static: StaticGraph, share: float, omitted: bool) -> None:
    body, nearest = obstacle(omitted), random_nearest(1, static.num_cloth, share)
    plain = build_graph(static, StepInput(torch.ones(1), body), nearest, RADIUS)
    fixed = build_fixed_graph(lay_out(static, Capacity(static.num_cloth + 1, NUM_BODY + 1)), body, nearest, RADIUS)
    assert fixed.num_found.tolist() == [plain.edge_sets[BODY].num_edges // 2, len(plain.body_vertex)]
    assert torch.equal(fixed.body_vertex[: len(plain.body_vertex)], plain.body_vertex)
    for level, subset in plain.body_subsets.items():
        assert without_spare(messages(fixed, fixed.body_subsets[level].edges)) == messages(plain, subset.edges)


def test_rows_of_a_part_are_those_of_the_whole(static: StaticGraph) -> None:
    body, nearest = obstacle(False), random_nearest(2, static.num_cloth, 0.5)
    graph = build_fixed_graph(lay_out(static, Capacity(50, 40)), body, nearest, RADIUS)
    whole, spare = graph.edge_sets[BODY], graph.num_nodes - 1
    for level in (1, 2):
        part, rows = graph.body_subsets[level].edges, graph.body_subsets[level].rows
        assert rows is not None
        assert len(rows) == part.num_edges < whole.num_edges
        assert torch.equal(whole.senders[rows], part.senders)
        assert torch.equal(whole.receivers[rows], part.receivers)
        cloth = part.receivers[: part.num_edges // 2]
        assert bool((static.node_level[cloth[cloth != spare]] >= level).all())


def test_the_spare_place_stays_free(static: StaticGraph) -> None:
    """Also where there is no room: what is written there must reach no node that counts."""
    body, nearest = obstacle(False), random_nearest(3, static.num_cloth, 0.9)
    for edges, vertices in ((1, 1), (10, 8), (57, 8), (10, 43)):
        graph = build_fixed_graph(lay_out(static, Capacity(edges, vertices)), body, nearest, RADIUS)
        whole, spare = graph.edge_sets[BODY], graph.num_nodes - 1
        for row in (edges - 1, 2 * edges - 1):
            assert int(whole.senders[row]) == int(whole.receivers[row]) == spare
        assert int(graph.num_found[0]) >= 45
        assert graph.num_nodes == static.num_cloth + vertices


def test_shapes_do_not_depend_on_the_positions(static: StaticGraph) -> None:
    layout, body = lay_out(static, Capacity(40, 30)), obstacle(True)

    def shapes(seed: int, share: float) -> list[tuple[int, ...]]:
        graph = build_fixed_graph(layout, body, random_nearest(seed, static.num_cloth, share), RADIUS)
        sets = [graph.edge_sets[BODY], *(subset.edges for subset in graph.body_subsets.values())]
        return [tuple(value.shape) for edges in sets for value in vars(edges).values()] + [tuple(graph.body_vertex.shape)]

    assert shapes(1, 1.0) == shapes(2, 1e-3)


def test_rows_and_their_reverses(static: StaticGraph) -> None:
    body, nearest = obstacle(False), random_nearest(4, static.num_cloth, 0.5)
    edges = build_fixed_graph(lay_out(static, Capacity(57, 43)), body, nearest, RADIUS).edge_sets[BODY]
    assert torch.equal(edges.senders[edges.reverse], edges.receivers)
    assert torch.equal(edges.source[edges.reverse], edges.source)
    assert bool((edges.local_receivers.diff() >= 0).all())


def test_no_body(static: StaticGraph) -> None:
    graph = build_fixed_graph(lay_out(static, Capacity(1, 1)), None, None, RADIUS)
    plain = build_graph(static, StepInput(torch.ones(1)))
    assert graph.num_nodes == plain.num_nodes == static.num_cloth
    assert graph.edge_sets[BODY].num_edges == 0
    assert graph.body_subsets.keys() == plain.body_subsets.keys()


def test_closed_attachments_are_part_of_the_layout(static: StaticGraph) -> None:
    buttons = Attachments(torch.tensor([[0, 55], [1, 54]]), torch.tensor([True, False]))
    layout: StaticLayout = lay_out(static, Capacity(1, 1), buttons)
    plain = build_graph(static, StepInput(torch.ones(1), attachments=buttons))
    for name in ("senders", "receivers", "source", "offsets"):
        assert torch.equal(getattr(layout.edge_sets[MESH], name), getattr(plain.edge_sets[MESH], name))


def test_capacities() -> None:
    assert Capacity(11, 6).holds((10, 5, 0))
    assert not Capacity(11, 6).holds((11, 5, 0))
    assert not Capacity(11, 6).holds((10, 6, 0))
    assert Capacity(11, 6, 2).holds((10, 5, 2))
    assert not Capacity(11, 6, 2).holds((10, 5, 3))
    for counts in ((0, 0, 0), (63, 10, 2), (500, 499, 70), (1000, 700, 900)):
        room = capacity_for(counts, (1000, 700, 900))
        assert room.holds(counts)
        assert room.edges <= 1001
        assert room.vertices <= 701
        assert room.faces == counts[2]
    with pytest.raises(ValueError, match="capacity is 0 edges"):
        Capacity(0, 5)
