"""The decoder of mesh edges, from an edge's latent and those of its two ends."""

from __future__ import annotations

from torch import Tensor, nn

from hood.graph.builder import EdgeSet
from hood.nn.dense import linear
from hood.nn.mlp import MLP


class EdgeDecoder(nn.Module):
    """(N, out_width) for the rows of an edge set, both directions apart: MLP([v_receiver, v_sender, e]).

    The first layer is evaluated in parts: at the nodes, where there are fewer rows than edges, and at the edges.
    """

    def __init__(self, latent_dim: int, out_width: int) -> None:
        super().__init__()
        self.latent_dim = latent_dim
        self.mlp = MLP(3 * latent_dim, latent_dim, out_width, norm=False)

    def forward(self, nodes: Tensor, latent: Tensor, edges: EdgeSet) -> Tensor:
        """
        Args:
            nodes: (V, latent_dim) of the cloth.
            latent: (N, latent_dim) of the rows of ``edges``.
        """
        first = self.mlp.first
        at_receiver, at_sender, own = first.weight.split(self.latent_dim, dim=1)
        hidden = linear(latent[: edges.num_edges], own, first.bias)
        hidden = hidden + linear(nodes, at_receiver).index_select(0, edges.receivers)
        hidden = hidden + linear(nodes, at_sender).index_select(0, edges.senders)
        return self.mlp.tail(hidden)
