"""The multilayer perceptron used everywhere in the network (MeshGraphNets, appendix A.1)."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class MLP(nn.Module):
    """in → latent → latent → out, ReLU between, LayerNorm on the output unless ``norm`` is False (decoder).

    ``first`` may see the concatenation of several inputs; callers may split its weight by columns, evaluate the parts
    where they are cheapest and continue with :meth:`tail`.
    """

    def __init__(self, in_width: int, latent_dim: int, out_width: int, norm: bool = True) -> None:
        super().__init__()
        self.first = nn.Linear(in_width, latent_dim)
        self.second = nn.Linear(latent_dim, latent_dim)
        self.third = nn.Linear(latent_dim, out_width)
        self.norm = nn.LayerNorm(out_width) if norm else None

    def forward(self, x: Tensor) -> Tensor:
        """(N, in_width) → (N, out_width)."""
        return self.tail(self.first(x))

    def tail(self, hidden: Tensor) -> Tensor:
        """The network from the first layer's output (N, latent_dim), before its ReLU; overwrites ``hidden``."""
        hidden = torch.relu_(self.second(torch.relu_(hidden)))
        out = self.third(hidden)
        return out if self.norm is None else self.norm(out)
