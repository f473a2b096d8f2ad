"""Rows of fasteners (buttons, zippers, seams) of a scene, and when they are opened and closed during a rollout."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from hood.scene.state import Attachments

#: Speed [m/s] at which the two sides of a pair that is closed come together.
SPEED = 0.25
#: A pair is closed when its distance is within this [m] of the one that it is held at.
CLOSED = 1e-3


@dataclass(frozen=True)
class Event:
    """A row of fasteners that is opened, or closed, by the step from ``frame`` on."""

    frame: int
    name: str
    closes: bool


@dataclass(frozen=True)
class Fastening:
    """Named rows of pairs of vertices, each at the distance that it has at rest, and what happens to them.

    A row is closed from frame 0 on, unless the first event that concerns it closes it. What is active in a step depends on the
    frame alone, so a rollout may begin anywhere.
    """

    names: tuple[str, ...]
    row: Tensor  # (A,) int64, the row that a pair belongs to
    pairs: Attachments  # all of them closed
    events: tuple[Event, ...] = ()
    _known: dict[tuple[bool, ...], Attachments] = field(default_factory=dict, repr=False, compare=False)

    def with_events(self, events: Sequence[Event], speed: float = SPEED) -> Fastening:
        """The same rows with these events, in any order; pairs come together at ``speed`` [m/s]."""
        assert self.pairs.length is not None
        pairs = replace(self.pairs, speed=torch.full_like(self.pairs.length, speed))
        return Fastening(self.names, self.row, pairs, tuple(sorted(events, key=lambda event: event.frame)))

    def still(self, frame: int) -> Fastening:
        """The same rows as they are at ``frame``, without events from there on."""
        kept = [Event(-1, name, closed) for name, closed in zip(self.names, self.closed(frame), strict=True)]
        return replace(self, events=tuple(kept), _known={})

    def closed(self, frame: int) -> tuple[bool, ...]:
        """Whether each row is closed in the step ``frame`` → ``frame + 1``."""
        state = []
        for name in self.names:
            own = [event for event in self.events if event.name == name]
            passed = [event.closes for event in own if event.frame <= frame]
            state.append(passed[-1] if passed else not (own and own[0].closes))
        return tuple(state)

    def at(self, frame: int) -> Attachments:
        """The attachments of the step ``frame`` → ``frame + 1``: always the same edges, those of open rows inactive."""
        key = self.closed(frame)
        if key not in self._known:
            state = torch.tensor(key, dtype=torch.bool, device=self.row.device)
            self._known[key] = replace(self.pairs, active=state[self.row])
        return self._known[key]


def fastening_of(fasteners: Mapping[str, np.ndarray] | None, rest_pos: Tensor) -> Fastening | None:
    """Rows of pairs (P, 2) by name as attachments of a cloth with ``rest_pos`` (V, 3) m; None without any."""
    if not fasteners:
        return None
    names = tuple(sorted(fasteners))
    edges = torch.as_tensor(np.concatenate([fasteners[name] for name in names]).astype(np.int64)).to(rest_pos.device)
    row = np.repeat(np.arange(len(names)), [len(fasteners[name]) for name in names])
    length = (rest_pos[edges[:, 0]] - rest_pos[edges[:, 1]]).norm(dim=1)
    active = torch.ones(len(edges), dtype=torch.bool, device=rest_pos.device)
    pairs = Attachments(edges, active, length, torch.full_like(length, SPEED))
    return Fastening(names, torch.as_tensor(row).to(rest_pos.device), pairs)


def first_step(seconds: float, dt: float) -> int:
    """The frame from which on a step is taken with what happens at a time [s]: the first one at that time or later."""
    return max(0, math.ceil(seconds / dt - 1e-6))
