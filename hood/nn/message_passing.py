"""One processor step: every active edge set updates its edges, then one node network updates all nodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import cast

from torch import Tensor, nn

from hood.graph.builder import Subset
from hood.nn.dense import linear, pad_rows, wants_padding
from hood.nn.edge_update import update_edges
from hood.nn.mlp import MLP


class ProcessorStep(nn.Module):
    """e' = e + MLP_s([v_receiver, v_sender, e]) in every set s; v' = v + MLP([v, Σ_s1, Σ_s2, …]), where Σ_s is the
    sum of the edge networks' outputs (before their residual) over the incoming edges of s (paper, section 4.2).

    Nodes without an edge in s receive zeros from it; every node is updated.

    Args:
        sets: edge sets in the order of the node network's input.
        latent_dim: width of all latents.
        aggregation: ``sum`` (the paper's formula) or ``mean`` (its prose).
    """

    def __init__(self, sets: Sequence[str], latent_dim: int, aggregation: str = "sum") -> None:
        super().__init__()
        if aggregation not in ("sum", "mean"):
            raise ValueError(f"aggregation is {aggregation!r}; choose 'sum' or 'mean'")
        self.sets = tuple(sets)
        self.latent_dim = latent_dim
        self.aggregation = aggregation
        self.edge_mlps = nn.ModuleDict({name: MLP(3 * latent_dim, latent_dim, latent_dim) for name in self.sets})
        self.node_mlp = MLP((1 + len(self.sets)) * latent_dim, latent_dim, latent_dim)

    def forward(
        self, nodes: Tensor, edges: Mapping[str, Tensor], subsets: Mapping[str, Subset], overwrite: bool = False
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Nodes (N, latent_dim) and edge latents by set; ``subsets`` says which rows of a set take part.

        With ``overwrite`` the edge latents given may be used for the new ones where no gradient is asked for.
        """
        # The node network's first layer by columns: aggregates exist only at the nodes that have an edge in the set.
        first = self.node_mlp.first
        own, *parts = first.weight.split(self.latent_dim, dim=1)
        updated, low = dict(edges), nodes.to(next(iter(edges.values())).dtype)
        hidden = linear(low, own, first.bias)
        for name, weight in zip(self.sets, parts, strict=True):
            subset = subsets[name]
            if subset.edges.num_edges == 0:
                continue
            updated[name], received = self._update_set(name, low, edges[name], subset, overwrite)
            received, rows = linear(received, weight), subset.edges.nodes.shape[0]
            hidden.index_add_(0, subset.edges.nodes, received if len(received) == rows else received[:rows])
        return self.node_mlp.tail(hidden, nodes), updated

    def _update_set(self, name: str, nodes: Tensor, latent: Tensor, subset: Subset, overwrite: bool) -> tuple[Tensor, Tensor]:
        """New latents of a set, and the aggregate at the nodes that have an edge in it (and in rows of no meaning)."""
        mlp, edges, rows = cast(MLP, self.edge_mlps[name]), subset.edges, subset.rows
        padded = wants_padding(nodes)
        present = nodes.index_select(0, pad_rows(edges.nodes) if padded else edges.nodes)
        if rows is None:
            latent, received = update_edges(mlp, present, latent, edges, overwrite)
        else:
            part, received = update_edges(mlp, present, latent.index_select(0, rows), edges, overwrite=True)
            latent = latent.index_copy_(0, rows, part) if overwrite else latent.index_copy(0, rows, part)
        if self.aggregation == "mean":
            degree = edges.offsets.diff()
            degree = (pad_rows(degree) if padded else degree).clamp_min(1)
            received = received / degree.unsqueeze(1).to(received.dtype)
        return latent, received
