"""The network as a function on graphs: parameter counts, equations, symmetries, gradients."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth, concatenate_cloths
from hood.cloth.state import Obstacle, StepInput
from hood.contact.contact import Contact
from hood.model.features import feature_set
from hood.model.graph.builder import Graph, Subset, build_graph, build_static, edge_set
from hood.model.graph.hierarchy import build_hierarchy, concatenate_hierarchies
from hood.model.network.message_passing import ProcessorStep
from hood.model.network.mlp import MLP
from hood.model.network.model import MeshGraphNet
from hood.tensors import dense
from hood.testing import Mesh, grid, plane_contact, strip

WIDTHS = {"mesh": 4, "coarse": 4, "body": 3}
SHORT = "(mesh+coarse0) (coarse0+coarse1) (coarse1) (mesh+coarse0)"


@dataclass
class Case:
    """A graph with random features."""

    graph: Graph
    nodes: Tensor
    edges: dict[str, Tensor]


def body_contact(vertex: Tensor, near: Tensor, num_body: int) -> tuple[Obstacle, Contact]:
    pos, scene = torch.zeros(num_body, 3), torch.zeros(num_body, dtype=torch.int64)
    obstacle = Obstacle(pos, pos, pos, torch.zeros(0, 3, dtype=torch.int64), scene, scene[:0], scene.bool())
    plane = plane_contact(torch.zeros(len(vertex), 3))
    return obstacle, Contact(**{**vars(plane), "vertex": vertex, "vertex_dist": torch.where(near, 0.01, 1.0)})


def make_graph(mesh: Mesh, vertex: Tensor | None = None, num_body: int = 10, names=("mesh", "coarse0", "coarse1")) -> Graph:
    """Every second cloth vertex has a body edge, to ``vertex`` (V,) if given."""
    cloth = build_cloth(*mesh, Material(), dtype=torch.float64)
    hierarchy = build_hierarchy(cloth.num_vertices, cloth.edges.numpy(), cloth.rest_pos.numpy(), 2)
    index = torch.arange(cloth.num_vertices)
    obstacle, contact = body_contact(index % num_body if vertex is None else vertex, index % 2 == 0, num_body)
    step = StepInput(torch.full((1,), 1 / 30, dtype=torch.float64), obstacle)
    return build_graph(build_static(cloth, hierarchy, names), step, contact)


def undirected_key(graph: Graph, name: str, labels: Tensor) -> Tensor:
    """A number per directed edge that depends on the labels of its ends only."""
    edges = graph.edge_sets[name]
    return labels[edges.senders] * 10007 + labels[edges.receivers]


def make_case(graph: Graph, labels: Tensor | None = None) -> Case:
    """Features that are functions of node labels: relabelled graphs get the features of the same nodes and edges."""
    labels = torch.arange(graph.num_nodes) if labels is None else labels
    nodes = torch.sin(labels.double().unsqueeze(1) * torch.arange(1, 6) + 0.3)
    edges = {}
    for name in graph.edge_sets:
        columns = torch.arange(1, WIDTHS["body" if name == "body" else "mesh"] + 1)
        edges[name] = torch.cos(undirected_key(graph, name, labels).double().unsqueeze(1) * columns * 0.71)
    return Case(graph, nodes, edges)


def make_net(schedule: str = SHORT, latent_dim: int = 8, **options) -> MeshGraphNet:
    torch.manual_seed(0)
    return MeshGraphNet(5, WIDTHS, latent_dim, schedule, **options).double()


@pytest.mark.parametrize(
    "schedule, num_levels, expected", [("ours", 3, 5_111_904), ("fine15", 1, 3_854_164), ("fine48", 1, 12_027_604)]
)
def test_parameter_counts_at_latent_128(schedule, num_levels, expected):
    with torch.device("meta"):
        features = feature_set.paper(num_levels)
        network = MeshGraphNet(features.node_width, features.edge_widths, 128, schedule)
    assert network.num_parameters() + sum(p.numel() for p in features.parameters()) == expected


def concatenated(mlp: MLP, *inputs: Tensor) -> Tensor:
    """The network written as in the paper: one input, one layer after the other."""
    layers = nn.Sequential(mlp.first, nn.ReLU(), mlp.second, nn.ReLU(), mlp.third, mlp.norm)
    return layers(torch.cat(inputs, dim=1))


def reference_step(step: ProcessorStep, nodes: Tensor, edges: dict[str, Tensor], subsets: dict[str, Subset]):
    """One processor step by its formulas, with index_add and without splitting or blocks."""
    new_edges, parts = dict(edges), [nodes]
    for name in step.sets:
        rows, topology = subsets[name].rows, subsets[name].edges
        rows = torch.arange(topology.num_edges) if rows is None else rows
        message = concatenated(step.edge_mlps[name], nodes[topology.receivers], nodes[topology.senders], edges[name][rows])
        parts.append(torch.zeros_like(nodes).index_add(0, topology.receivers, message))
        if step.aggregation == "mean":
            degree = torch.bincount(topology.receivers, minlength=len(nodes)).clamp_min(1)
            parts[-1] = parts[-1] / degree.unsqueeze(1)
        new_edges[name] = edges[name].index_add(0, rows, message)
    return nodes + concatenated(step.node_mlp, *parts), new_edges


@pytest.mark.parametrize("aggregation", ["sum", "mean"])
@pytest.mark.parametrize("level", [0, 1])
def test_step_follows_its_formulas_in_value_and_gradient(aggregation, level, monkeypatch):
    monkeypatch.setattr(dense, "BLOCK_BYTES", 0)  # 256 rows: the mesh set takes several blocks
    graph = make_graph(grid(14, 14))
    step = ProcessorStep(("coarse0", "mesh", "body"), 8, aggregation).double()
    generator = torch.Generator().manual_seed(0)
    counts = {name: s.num_edges for name, s in graph.edge_sets.items()}
    assert counts["mesh"] > 2 * 256
    nodes = torch.randn(graph.num_nodes, 8, generator=generator, dtype=torch.float64, requires_grad=True)
    edges = {
        name: torch.randn(count, 8, generator=generator, dtype=torch.float64, requires_grad=True)
        for name, count in counts.items()
    }
    subsets = {name: Subset(s, None) for name, s in graph.edge_sets.items()} | {"body": graph.body_subsets[level]}
    inputs = [nodes, *(edges[name] for name in step.sets), *step.parameters()]
    results = []
    for function in (step, lambda *a: reference_step(step, *a)):
        new_nodes, new_edges = function(nodes, edges, subsets)
        outputs = [new_nodes, *(new_edges[name] for name in step.sets)]
        loss = sum((out * torch.cos(torch.arange(out.numel()).view_as(out))).sum() for out in outputs)
        results.append((outputs, torch.autograd.grad(loss, inputs)))
    for mine, expected in zip(results[0][0] + list(results[0][1]), results[1][0] + list(results[1][1]), strict=True):
        torch.testing.assert_close(mine, expected, atol=1e-10, rtol=1e-9)


def test_gradient_of_the_network_is_that_of_finite_differences():
    case, network = make_case(make_graph(grid(3, 4), num_body=3)), make_net("(mesh+coarse0) (coarse0)", 4)
    names = [*network.edge_set_names, "body"]
    tables = [case.edges[name].clone().requires_grad_(True) for name in names]

    def run(nodes: Tensor, *edges: Tensor) -> Tensor:
        return network(case.graph, nodes, dict(zip(names, edges, strict=True)))

    assert torch.autograd.gradcheck(run, (case.nodes.requires_grad_(True), *tables), atol=1e-6)


def test_evaluation_without_gradients_gives_the_same_output(monkeypatch):
    monkeypatch.setattr(dense, "BLOCK_BYTES", 0)
    case, network = make_case(make_graph(grid(14, 14))), make_net()
    with torch.no_grad():
        quiet = network(case.graph, case.nodes, case.edges)
    torch.testing.assert_close(quiet, network(case.graph, case.nodes, case.edges), atol=1e-12, rtol=0)


def test_relabelled_vertices_give_relabelled_outputs():
    pos, faces = grid(9, 8)
    rng = np.random.default_rng(0)
    order = rng.permutation(len(pos))
    index = torch.arange(len(pos))
    network, labels = make_net(), torch.as_tensor(order)
    # Body edges of the relabelled cloth: the same vertices reach the same body vertices.
    original = make_graph((pos, faces), index % 10)
    cloth = build_cloth(pos[order], np.argsort(order)[faces], Material(), dtype=torch.float64)
    hierarchy = build_hierarchy(len(pos), cloth.edges.numpy(), cloth.rest_pos.numpy(), 2)
    obstacle, contact = body_contact(labels % 10, labels % 2 == 0, 10)
    static = build_static(cloth, hierarchy, network.edge_set_names)
    graph = build_graph(static, StepInput(torch.full((1,), 1 / 30), obstacle), contact)
    assert torch.equal(graph.body_vertex, original.body_vertex)
    old = make_case(original)
    new = make_case(graph, torch.cat([labels, torch.arange(len(pos), graph.num_nodes)]))
    expected = network(original, old.nodes, old.edges)[labels]
    torch.testing.assert_close(network(graph, new.nodes, new.edges), expected, atol=1e-10, rtol=0)


def test_batch_equals_singles():
    meshes, network = [grid(9, 8), strip(14), strip(2)], make_net()
    cases = [make_case(make_graph(mesh)) for mesh in meshes]
    cloths = [build_cloth(*mesh, Material(), dtype=torch.float64) for mesh in meshes]
    counts = [c.num_vertices for c in cloths]
    hierarchies = [build_hierarchy(n, c.edges.numpy(), c.rest_pos.numpy(), 2) for n, c in zip(counts, cloths, strict=True)]
    index = [torch.arange(n) for n in counts]
    vertex = torch.cat([i % 10 + 10 * k for k, i in enumerate(index)])
    obstacle, contact = body_contact(vertex, torch.cat(index) % 2 == 0, 30)
    static = build_static(concatenate_cloths(cloths), concatenate_hierarchies(hierarchies, counts), network.edge_set_names)
    graph = build_graph(static, StepInput(torch.full((3,), 1 / 30), obstacle), contact)
    parts = list(zip(cases, counts, strict=True))
    nodes = torch.cat([c.nodes[:n] for c, n in parts] + [c.nodes[n:] for c, n in parts])
    cloth_sets = {name: torch.cat([c.edges[name] for c in cases]) for name in network.edge_set_names}
    rows = [c.graph.edge_sets["body"].num_edges // 2 for c in cases]  # receivers: cloth first, then body
    halves = [c.edges["body"].split([n, n]) for c, n in zip(cases, rows, strict=True)]
    body = torch.cat([half[0] for half in halves] + [half[1] for half in halves])
    together = network(graph, nodes, cloth_sets | {"body": body})
    alone = torch.cat([network(c.graph, c.nodes, c.edges) for c in cases])
    torch.testing.assert_close(together, alone, atol=1e-12, rtol=0)


def test_body_nodes_without_edges_have_no_effect():
    graph, network = make_graph(grid(9, 8)), make_net()
    case = make_case(graph)
    wider = Graph(**{**vars(graph), "body_vertex": torch.cat([graph.body_vertex, torch.tensor([99, 100])])})
    nodes = torch.cat([case.nodes, torch.full((2, 5), 7.0, dtype=torch.float64)])
    expected = network(graph, case.nodes, case.edges)
    torch.testing.assert_close(network(wider, nodes, case.edges), expected, atol=1e-13, rtol=0)


def test_network_runs_without_body_edges():
    graph, network = make_graph(grid(9, 8), num_body=1), make_net()
    bare = edge_set(torch.zeros(0, 2, dtype=torch.int64))
    subsets = dict.fromkeys(graph.body_subsets, Subset(bare, None))
    graph = Graph(**{**vars(graph), "body_vertex": graph.body_vertex[:0], "body_subsets": subsets,
                     "edge_sets": graph.edge_sets | {"body": bare}})  # fmt: skip
    case = make_case(graph)
    assert torch.isfinite(network(graph, case.nodes, case.edges)).all()


def test_body_edges_of_finer_nodes_rest_on_coarse_steps():
    graph, network = make_graph(grid(9, 8)), make_net("(coarse1)")
    case = make_case(graph)
    body = graph.edge_sets["body"]
    cloth_end = torch.minimum(body.senders, body.receivers)
    fine = graph.node_level[cloth_end] < 2
    changed = case.edges["body"].clone()
    changed[fine] += 1.0
    expected = network(graph, case.nodes, case.edges)
    assert torch.equal(network(graph, case.nodes, case.edges | {"body": changed}), expected)
    changed[~fine] += 1.0
    assert not torch.equal(network(graph, case.nodes, case.edges | {"body": changed}), expected)


def test_small_output_at_initialisation():
    case = make_case(make_graph(grid(5, 5)))
    large, small = make_net(), make_net(output_init=1e-3)
    run = [net(case.graph, case.nodes, case.edges) for net in (large, small)]
    torch.testing.assert_close(run[1], 1e-3 * run[0])


def test_bad_settings_are_refused():
    with pytest.raises(ValueError, match="choose 'sum' or 'mean'"):
        make_net(aggregation="max")
    with pytest.raises(ValueError, match="no entry for 'body'"):
        MeshGraphNet(5, {"mesh": 4}, 8, "fine15")
