"""Held vertices that cloth is in the way of: how far they come in a step before cloth meets cloth."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hood.mesh.layers import Layers

#: Weight of standing still in the turn that fits held vertices: those on a line do not say how they turn about it.
_STEADY = 1e-9


class Followed(NamedTuple):
    """Where held vertices come to in a step."""

    pos: np.ndarray  # (V, 3) m, all vertices on ways on which cloth has met no cloth
    lag: np.ndarray  # (V,) m, how far held ones stop short of their targets
    seconds: float  # of processor time that searches took

    @property
    def late(self) -> bool:
        """Whether any is short of its target."""
        return bool(self.lag.any())


def follow(layers: Layers, pos: np.ndarray, held: np.ndarray, target: np.ndarray) -> Followed:
    """Held vertices on their ways from ``pos`` to their targets, stopped where cloth would meet cloth.

    First all vertices turn and shift as one body with the held ones, and meet nothing. From there the held ones go straight
    to their targets. The others make way: they stay, or go where they fly, and on together with what they would meet. Where
    that is not enough, because held vertices drive layers against each other, these stop short, both sides alike; in the
    next step they go on from there. Nothing is searched for where all moves nearly as one body and no cloth is near any.

    Args:
        layers: of the step, of which nothing else has been asked yet.
        pos: (V, 3) m, where it begins.
        held: (V,) bool, at least one.
        target: (V, 3) m, finite: where held vertices shall go, and others fly.
    """
    along = _as_one_body(pos, held, target)
    there = np.where(held[:, None], target, along)
    if layers.fixed_are_free(along, there):
        return Followed(there, np.zeros(len(pos)), 0.0)
    ways = Layers(layers.mesh, along, held, layers.pressure, layers.between)
    reached, arrived = ways.follow(target)
    lag = np.zeros(len(pos)) if arrived else np.where(held, np.linalg.norm(reached - target, axis=1), 0.0)
    return Followed(reached, lag, ways.work.seconds)


def _as_one_body(pos: np.ndarray, held: np.ndarray, target: np.ndarray) -> np.ndarray:
    """All vertices (V, 3) turned and shifted as the held ones are on the whole."""
    here, there = pos[held].mean(axis=0), target[held].mean(axis=0)
    spread = (target[held] - there).T @ (pos[held] - here)
    left, _, right = np.linalg.svd(spread + (_STEADY * np.abs(spread).sum() + 1e-30) * np.eye(3))
    turn = (left * [1.0, 1.0, np.linalg.det(left @ right)]) @ right
    return there + (pos - here) @ turn.T
