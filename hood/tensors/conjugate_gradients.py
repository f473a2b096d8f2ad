"""Conjugate gradients whose number of steps the sizes of the scenes alone decide.

No shape and no branch depends on a value, so that a CUDA graph can hold them. The scenes of a batch run side by side, each with
its own step lengths and as many steps as alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from hood.tensors.dense import sum_scenes


@dataclass(frozen=True)
class Steps:
    """How many steps a scene takes: their number grows with its width in edges."""

    rate: float  # per square root of its vertices
    least: int

    def __call__(self, num_vertices: int) -> int:
        return max(math.ceil(self.rate * math.sqrt(num_vertices)), self.least)


@dataclass(frozen=True)
class Scenes:
    """Vertices by the scene that they are of."""

    scene: Tensor  # (V,)
    sizes: tuple[int, ...]  # vertices of every scene

    def dot(self, a: Tensor, b: Tensor) -> Tensor:
        """Products of two (V, 3) scene by scene, spread to the vertices: (V, 1), or (1, 1) where there is one scene."""
        if len(self.sizes) == 1:
            return (a * b).sum().view(1, 1)
        sums = sum_scenes((a * b).sum(dim=1), self.scene, len(self.sizes))
        return sums[self.scene].unsqueeze(1)

    def limits(self, steps: Steps) -> Tensor | None:
        """Steps of the scene of every vertex, (V, 1); None where there is one scene. Made on the device: a copy from the host
        could not be captured."""
        count = len(self.sizes)
        if count == 1:
            return None
        sizes = torch.zeros(count, dtype=torch.float64, device=self.scene.device)
        sizes = sizes.index_add(0, self.scene, torch.ones_like(self.scene, dtype=torch.float64))
        return (steps.rate * sizes.sqrt()).ceil().clamp_min(steps.least)[self.scene].unsqueeze(1)


def solve(
    apply: Callable[[Tensor], Tensor], precondition: Callable[[Tensor], Tensor], right: Tensor, scenes: Scenes, steps: Steps
) -> Tensor:
    """Approximate u (V, 3) with A u = ``right`` (V, 3), from u = 0.

    Args:
        apply: x → A x, symmetric positive definite; vertices that do not move are left at 0.
        precondition: r → P r, the same.
    """
    u, r = torch.zeros_like(right), right
    z = precondition(r)
    p, rz = z, scenes.dot(r, z)
    limit = scenes.limits(steps)
    for step in range(max(map(steps, scenes.sizes))):
        q = apply(p)
        length = _ratio(rz, scenes.dot(p, q))
        if limit is not None:
            length = torch.where(step < limit, length, 0.0)
        u = u + length * p
        r = r - length * q
        z = precondition(r)
        before, rz = rz, scenes.dot(r, z)
        p = z + _ratio(rz, before) * p
    return u


def _ratio(above: Tensor, below: Tensor) -> Tensor:
    """above / below; 0 where nothing is left to do."""
    some = below > 0
    return torch.where(some, above / torch.where(some, below, 1.0), 0.0)
