"""The propagation radius of Table 1, measured by differentiation."""

import pytest
import torch
from scipy.sparse import csgraph

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.cloth.state import StepInput
from hood.model.graph.builder import build_graph, build_static, radius
from hood.model.graph.hierarchy import adjacency, build_hierarchy
from hood.model.network.model import MeshGraphNet
from hood.testing import strip


@pytest.mark.parametrize("schedule, expected", [("fine15", 15), ("fine48", 48), ("ours", 48)])
def test_output_depends_on_inputs_up_to_the_radius_and_no_farther(schedule, expected):
    cloth = build_cloth(*strip(120), Material(), dtype=torch.float64)
    hierarchy = build_hierarchy(cloth.num_vertices, cloth.edges.numpy(), cloth.rest_pos.numpy(), 2)
    hops = torch.as_tensor(csgraph.shortest_path(adjacency(cloth.num_vertices, cloth.edges.numpy()), unweighted=True))
    assert hops.max() > 110
    torch.manual_seed(0)
    network = MeshGraphNet(6, {"mesh": 3, "coarse": 3, "body": 3}, 16, schedule).double()
    graph = build_graph(build_static(cloth, hierarchy, network.edge_set_names), StepInput(torch.full((1,), 1 / 30)))
    edges = {name: torch.randn(s.num_edges, 3, dtype=torch.float64) for name, s in graph.edge_sets.items()}
    # Three c0 edges lead from a level-1 node to a level-2 node, so the longest paths start and end on level 1, not on the
    # coarsest level.
    level = hierarchy.node_level
    targets = [0, 61, *(int((level == k).nonzero()[i]) for k in (1, 2) for i in (3, 7, 20))]
    farthest = 0
    for _ in range(3):  # a ReLU may block the longest path for one input
        velocity = torch.randn(cloth.num_vertices, 3, dtype=torch.float64, requires_grad=True)
        nodes = torch.cat([velocity, torch.randn(cloth.num_vertices, 3, dtype=torch.float64)], dim=1)
        output = network(graph, nodes, edges)
        for target in targets:
            (gradient,) = torch.autograd.grad(output[target].sum(), velocity, retain_graph=True)
            farthest = max(farthest, int(hops[target][gradient.abs().sum(dim=1) > 0].max()))
    assert farthest == expected == radius(network.schedule)
