"""The multi-level graph network: encoders, processor, decoder (paper, section 4.2)."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from hood.graph.builder import BODY, Graph, Subset
from hood.nn.message_passing import ProcessorStep
from hood.nn.mlp import MLP
from hood.nn.schedule import edge_set_names, finest_level, parse_schedule


class MeshGraphNet(nn.Module):
    """Raw decoder output per cloth node from node and edge features.

    One encoder for all nodes and one per edge set; processor steps as the schedule says, each with its own networks;
    body edges take part in every step, restricted to cloth nodes on the step's levels. Cloth and body nodes share the
    node networks; body nodes receive nothing from cloth edges.

    Args:
        node_width: width of the node features.
        edge_widths: width of the edge features: ``{"mesh": 12, "coarse": 12, "body": 9}``. A coarse set is looked up by
            its own name first and by ``coarse`` then; a missing ``coarse`` means the mesh's width.
        latent_dim: width of all latents (paper: 128).
        schedule: name or text for :func:`hood.nn.schedule.parse_schedule`.
        out_width: width of the output.
        aggregation: ``sum`` or ``mean`` of the messages at a node.
        output_init: factor on the decoder's last layer at initialisation; small values start near zero output.
    """

    def __init__(
        self,
        node_width: int,
        edge_widths: Mapping[str, int],
        latent_dim: int = 128,
        schedule: str = "ours",
        out_width: int = 3,
        aggregation: str = "sum",
        output_init: float = 1.0,
    ) -> None:
        super().__init__()
        self.schedule = parse_schedule(schedule)
        self.edge_set_names = edge_set_names(self.schedule)
        widths = {name: _edge_width(name, edge_widths) for name in (*self.edge_set_names, BODY)}
        self.node_encoder = MLP(node_width, latent_dim, latent_dim)
        self.edge_encoders = nn.ModuleDict({n: MLP(w, latent_dim, latent_dim) for n, w in widths.items()})
        self.steps = nn.ModuleList(ProcessorStep((*sets, BODY), latent_dim, aggregation) for sets in self.schedule)
        self.decoder = MLP(latent_dim, latent_dim, out_width, norm=False)
        with torch.no_grad():
            self.decoder.third.weight.mul_(output_init)
            self.decoder.third.bias.mul_(output_init)

    def forward(self, graph: Graph, node_features: Tensor, edge_features: Mapping[str, Tensor]) -> Tensor:
        """(V, out_width) for the cloth nodes.

        Args:
            graph: needs every set of :attr:`edge_set_names`.
            node_features: (V + W_active, node_width), cloth rows first.
            edge_features: by set, rows as in ``graph.edge_sets``.
        """
        nodes = self.node_encoder(node_features)
        edges = {name: encoder(edge_features[name]) for name, encoder in self.edge_encoders.items()}
        whole = {name: Subset(graph.edge_sets[name], None) for name in self.edge_set_names}
        for sets, step in zip(self.schedule, self.steps, strict=True):
            subsets = {name: whole[name] for name in sets}
            subsets[BODY] = graph.body_subsets[finest_level(sets)]
            nodes, edges = step(nodes, edges, subsets)
        return self.decoder(nodes[: graph.num_cloth])

    def num_parameters(self) -> int:
        """Trainable parameters; embeddings live in the feature set and count there."""
        return sum(p.numel() for p in self.parameters() if p.requires_grad)


def _edge_width(name: str, widths: Mapping[str, int]) -> int:
    for key in (name, "coarse" if name.startswith("coarse") else name, "mesh"):
        if key in widths and (key != "mesh" or name != BODY):
            return widths[key]
    raise ValueError(f"edge_widths has no entry for {name!r} (given: {', '.join(widths)})")
