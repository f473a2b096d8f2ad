"""Propagation radius of a network, measured: how far a node's input reaches in one step."""

from __future__ import annotations

import copy
from functools import partial
from typing import cast

import numpy as np
import torch
from scipy import sparse
from scipy.sparse.csgraph import shortest_path
from torch import Tensor

from hood.assets.material import Material
from hood.dynamics.simulator import Simulator
from hood.graph.builder import LAYERS, Graph, build_graph, build_static
from hood.graph.hierarchy import build_hierarchy
from hood.nn.model import MeshGraphNet
from hood.scene.cloth import Cloth, build_cloth
from hood.scene.state import StepInput

_LENGTH = 128  # edges along the strip: its diameter must exceed twice the largest radius
_TRIES = 4  # inputs per node; a ReLU may block a path for one input


def measured_radius(simulator: Simulator, seed: int = 0) -> int:
    """Farthest mesh-hop distance between nodes i and j at which ∂a_j/∂(velocity feature of i) is not zero.

    Float64 autograd on a strip of diameter > 100 without body edges; random features; maximum over nodes of every level, the
    coarsest among them. The farthest path of a multi-level schedule may start on any level. Of a network of several passes it
    is the reach of all its steps together; what the potential tells it between two passes is not counted.
    """
    network = copy.deepcopy(simulator.network).double().eval()
    network.use_precision("fp32")  # of products in float64: as they come
    network.use_kernels("torch")
    columns = simulator.velocity_columns
    cloth = _strip()
    edges = cloth.edges.numpy()
    hierarchy = build_hierarchy(cloth.num_vertices, edges, cloth.rest_pos.numpy(), simulator.num_coarse)
    static = build_static(cloth, hierarchy, network.edge_set_names)
    apart = static.mesh_edges[:0] if LAYERS in network.world_sets else None
    graph = build_graph(static, StepInput(dt=torch.full((1,), 1.0 / 30.0, dtype=torch.float64)), layers=apart)
    hops = _hops(cloth.num_vertices, edges)
    generator = torch.Generator().manual_seed(seed)
    targets = _targets(hierarchy.node_level)
    farthest = 0
    for _ in range(_TRIES):
        features = _random_features(network, graph, generator)
        nodes = features.pop("nodes").requires_grad_(True)
        output = network(graph, nodes, features, partial(_unseen, network, graph))
        for target in targets:
            (gradient,) = torch.autograd.grad(output[target].sum(), nodes, retain_graph=True)
            reached = gradient[:, columns].abs().amax(dim=1) > 0
            # A dead ReLU may cut a target off altogether; it then says nothing about the reach.
            farthest = max(farthest, int(hops[target][reached.numpy()].max(initial=0)))
    return farthest


def _targets(node_level: Tensor) -> list[int]:
    """First, middle and last node of every level."""
    chosen = []
    for level in node_level.unique():
        nodes = torch.nonzero(node_level == level).squeeze(1)
        chosen += [int(nodes[0]), int(nodes[len(nodes) // 2]), int(nodes[-1])]
    return sorted(set(chosen))


def _strip() -> Cloth:
    """A strip of ``_LENGTH`` × 1 squares, each split into two triangles."""
    columns = np.arange(_LENGTH + 1)
    pos = np.array([[0.01 * i, 0.01 * j, 0.0] for i in columns for j in (0, 1)])
    quads = [(2 * i, 2 * i + 1, 2 * i + 2, 2 * i + 3) for i in range(_LENGTH)]
    faces = np.array([triangle for a, b, c, d in quads for triangle in ((a, c, b), (b, c, d))])
    return build_cloth(pos, faces, Material(), dtype=torch.float64)


def _hops(num_vertices: int, edges: np.ndarray) -> np.ndarray:
    ones = np.ones(len(edges))
    graph = sparse.csr_matrix((ones, (edges[:, 0], edges[:, 1])), shape=(num_vertices, num_vertices))
    return shortest_path(graph, directed=False, unweighted=True).astype(int)


def _unseen(network: MeshGraphNet, graph: Graph, index: int, raw: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
    """Instead of what the pass after ``index`` is shown of the cloth: nothing, so that steps alone carry."""

    def nothing(rows: int, encoder: torch.nn.Module) -> Tensor:
        return raw.new_zeros(rows, next(encoder.parameters()).shape[1])

    edge_looks = cast(torch.nn.ModuleDict, network.edge_looks[index])
    edges = {name: nothing(graph.edge_sets[name].num_edges, encoder) for name, encoder in edge_looks.items()}
    return nothing(graph.num_cloth, network.node_looks[index]), edges


def _random_features(network: MeshGraphNet, graph: Graph, generator: torch.Generator) -> dict[str, Tensor]:
    def draw(rows: int, encoder: torch.nn.Module) -> Tensor:
        width = next(encoder.parameters()).shape[1]
        return torch.randn(rows, width, generator=generator, dtype=torch.float64)

    features = {"nodes": draw(graph.num_nodes, network.node_encoder)}
    for name in (*network.edge_set_names, *network.world_sets):
        features[name] = draw(graph.edge_sets[name].num_edges, network.edge_encoder(name))
    return features
