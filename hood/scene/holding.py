"""Vertices that are held and let go during a rollout: pins that come and go."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from hood.scene.cloth import Cloth


@dataclass(frozen=True)
class Grasp:
    """Vertices that are held from the step of ``frame`` on, or let go by it."""

    frame: int
    vertices: Tensor  # (V,) bool
    holds: bool


@dataclass(frozen=True)
class Holding:
    """Which vertices are held in which step: those that the cloth has pinned at first, and what ``grasps`` make of that.

    Held vertices go where the skinned garment has them, as pins do. Those that are taken hold of elsewhere come to it at
    ``speed`` [m/s] beside the motion of the body. What is let go moves on as it was moved.
    """

    grasps: tuple[Grasp, ...]  # by frame
    speed: float
    _known: dict[int, tuple[Cloth, Cloth]] = field(default_factory=dict, repr=False, compare=False)

    def cloth(self, cloth: Cloth, frame: int) -> Cloth:
        """``cloth`` with what is held in the step of ``frame``: the same object as long as nothing changes."""
        passed = self._passed(frame)
        if passed == 0:
            return cloth
        if passed not in self._known or self._known[passed][0] is not cloth:
            pinned = cloth.pinned
            for grasp in self.grasps[:passed]:
                pinned = pinned | grasp.vertices if grasp.holds else pinned & ~grasp.vertices
            self._known[passed] = cloth, replace(cloth, pinned=pinned)
        return self._known[passed][1]

    def grasped(self, frame: int) -> Tensor | None:
        """Vertices (V,) that a grasp holds in the step of ``frame``; None where none does."""
        held: Tensor | None = None
        for grasp in self.grasps[: self._passed(frame)]:
            if grasp.holds:
                held = grasp.vertices if held is None else held | grasp.vertices
            elif held is not None:
                held = held & ~grasp.vertices
        return held if held is not None and bool(held.any()) else None

    def targets(self, frame: int, here: Tensor, there: Tensor, pos: Tensor, dt: float) -> Tensor:
        """Where held vertices go in the step of ``frame``, (V, 3) m: ``there``, and those that a grasp holds nearer to it by
        what the speed allows, from ``pos`` (V, 3) with the skinned garment ``here`` at the start of the step."""
        grasped = self.grasped(frame)
        if grasped is None:
            return there
        off = pos - here
        far = torch.linalg.vector_norm(off, dim=1, keepdim=True)
        left = (far - self.speed * dt).clamp_min(0.0) / torch.where(far > 0, far, 1.0)
        return torch.where(grasped.unsqueeze(1) & (left > 0), there + left * off, there)

    def _passed(self, frame: int) -> int:
        return sum(grasp.frame <= frame for grasp in self.grasps)
