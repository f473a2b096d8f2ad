"""Vertices that are held and let go during a rollout: pins that come and go.

Rows of fasteners (buttons, zippers, seams) of a scene, and when they are opened and closed during a rollout.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hood.assets.files.said import say
from hood.cloth.cloth import Cloth
from hood.cloth.state import Attachments

#: Speed [m/s] at which the two sides of a pair that is closed come together.
SPEED = 0.25
#: A pair is closed when its distance is within this [m] of the one that it is held at.
CLOSED = 1e-3
#: What has to be together by a frame comes no faster than this [m/s]; a pair is drawn by 50 N then, at 30 frames a second.
FASTEST = 1.5
#: Of the time up to that frame this share, and so many seconds at most, is left for the last millimetre.
_SPARE, _SPARE_SECONDS = 0.2, 0.1


def steps_left(start: int, by: int, frame: int, dt: float) -> int:
    """Steps of ``dt`` [s] from ``frame`` on in which that arrives which comes together from ``start`` on, to be there ``by`` a
    frame."""
    spare = min(round(_SPARE * (by - start)), round(_SPARE_SECONDS / dt))
    return max(by - spare - frame, 1)


def needed_speed(off: Tensor, steps: int, dt: float) -> Tensor:
    """Speed [m/s] of what is ``off`` [m] now and is to be there in so many steps: each its own, so that all arrive together."""
    return (off / (steps * dt)).clamp_max(FASTEST)


def _tell(what: str, off: Tensor, start: int, by: int, dt: float) -> None:
    """Say how fast what is ``off`` (N,) [m] at ``start`` comes together; warns where that is too fast."""
    if not len(off) or not bool(torch.isfinite(off).all()):
        return
    least, most = (float(edge) for edge in torch.aminmax(off))
    when, needed = f"by {by * dt:.2f} s (frame {by})", most / ((by - start) * dt)
    if needed <= FASTEST:
        low, high = (float(needed_speed(torch.tensor(far), steps_left(start, by, start, dt), dt)) for far in (least, most))
        say(f"{what} from {start * dt:.2f} s (frame {start}) on, {when}, at {low:.2f} to {high:.2f} m/s")
        return
    later = start + math.ceil(most / (FASTEST * dt) - 1e-3) + 1
    warnings.warn(
        f"{what} {when}: up to {most:.2f} m apart in frame {start}, which needs {needed:.2f} m/s, {needed - FASTEST:.2f} m/s "
        f"more than the {FASTEST:g} m/s that is the most, so it is late; give by: frame {later} ({later * dt:.2f} s), or begin "
        "earlier",
        stacklevel=2,
    )


@dataclass(frozen=True)
class Event:
    """A row of fasteners that is opened, or closed, by the step from ``frame`` on."""

    frame: int  # the first step that it concerns begins there
    name: str  # of the row
    closes: bool  # False: it opens
    speed: float = SPEED  # m/s at which the two sides come together, where it closes
    by: int | None = None  # the frame in which all of it is closed, at the speed that this takes; None: at ``speed``


@dataclass(frozen=True)
class Fastening:
    """Named rows of pairs of vertices, each at the distance that it has at rest, and what happens to them.

    A row is closed from frame 0 on, unless the first event that concerns it closes it. What is active in a step depends on the
    frame alone, so a rollout may begin anywhere.
    """

    names: tuple[str, ...]  # of the rows
    row: Tensor  # (A,) int64, the row that a pair belongs to
    pairs: Attachments  # all of them closed
    events: tuple[Event, ...] = ()  # in the order of their frames
    _known: dict[Any, Attachments] = field(default_factory=dict, repr=False, compare=False)

    def with_events(self, events: Sequence[Event]) -> Fastening:
        """The same rows with these events, in any order."""
        return Fastening(self.names, self.row, self.pairs, tuple(sorted(events, key=lambda event: event.frame)))

    def still(self, frame: int) -> Fastening:
        """The same rows as they are at ``frame``, without events from there on."""
        state = zip(self.names, self.closed(frame), self.speeds(frame), strict=True)
        kept = [Event(-1, name, closed, speed) for name, closed, speed in state]
        return replace(self, events=tuple(kept), _known={})

    def closed(self, frame: int) -> tuple[bool, ...]:
        """Whether each row is closed in the step ``frame`` → ``frame + 1``."""
        state = []
        for name in self.names:
            own = [event for event in self.events if event.name == name]
            passed = [event.closes for event in own if event.frame <= frame]
            state.append(passed[-1] if passed else not (own and own[0].closes))
        return tuple(state)

    def speeds(self, frame: int) -> tuple[float, ...]:
        """Of each row the speed [m/s] at which its pairs come together in that step: that of the event that has closed it, or
        of the first that will."""
        found = []
        for name in self.names:
            closing = [event for event in self.events if event.name == name and event.closes]
            passed = [event.speed for event in closing if event.frame <= frame]
            found.append(passed[-1] if passed else closing[0].speed if closing else SPEED)
        return tuple(found)

    def at(self, frame: int, pos: Tensor | None = None, dt: float = 0.0) -> Attachments:
        """The attachments of the step ``frame`` → ``frame + 1``: always the same edges, those of open rows inactive.

        Args:
            pos: (V, 3) m at ``frame``, from which the speeds of rows follow that are to be closed by a frame; None: as if they
                were to be closed by none.
            dt: s, of a step.
        """
        key = self.closed(frame), self.speeds(frame)
        if key not in self._known:
            assert self.pairs.length is not None
            state = torch.tensor(key[0], dtype=torch.bool, device=self.row.device)
            speed = torch.tensor(key[1], dtype=self.pairs.length.dtype, device=self.row.device)
            self._known[key] = replace(self.pairs, active=state[self.row], speed=speed[self.row])
        return self._known[key] if pos is None else self._timed(self._known[key], frame, pos, dt)

    def _timed(self, pairs: Attachments, frame: int, pos: Tensor, dt: float) -> Attachments:
        """``pairs`` with the speeds of rows that are to be closed by a frame: of each pair what its distance takes."""
        acting = {event.name: event for event in self.events if event.frame <= frame}
        timed = [(self.names.index(name), event) for name, event in acting.items() if event.by is not None]
        if not timed:
            return pairs
        length, speed = pairs.length, pairs.speed
        assert length is not None
        assert speed is not None
        ends = pos.detach()[pairs.edges]
        off = (torch.linalg.vector_norm(ends[:, 0] - ends[:, 1], dim=1) - length).abs()
        for number, event in timed:
            own, by = self.row == number, event.by or 0
            speed = torch.where(own, needed_speed(off, steps_left(event.frame, by, frame, dt), dt).to(speed), speed)
            if frame == event.frame and event not in self._known:
                self._known[event] = pairs  # it is said once
                _tell(f"{event.name}: closes", off[own], frame, by, dt)
        return replace(pairs, speed=speed)


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


@dataclass(frozen=True)
class Grasp:
    """Vertices that are held from the step of ``frame`` on, or let go by it."""

    frame: int  # the first step that it concerns begins there
    vertices: Tensor  # (V,) bool
    holds: bool  # False: it lets go
    speed: float = SPEED  # m/s at which they come to where they are held
    by: int | None = None  # the frame in which all are there, at the speed that this takes; None: at ``speed``


@dataclass(frozen=True)
class Holding:
    """Which vertices are held in which step: those that the cloth has pinned at first, and what ``grasps`` make of that.

    Held vertices go where the skinned garment has them, as pins do. Those that are taken hold of elsewhere come to it at
    the speed of their grasp beside the motion of the body. What is let go moves on as it was moved.
    """

    grasps: tuple[Grasp, ...]  # by frame
    _known: dict[int, tuple[Cloth, Cloth]] = field(default_factory=dict, repr=False, compare=False)
    _said: set[int] = field(default_factory=set, repr=False, compare=False)  # places of grasps

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

    def let_go(self, frame: int, vertices: Tensor) -> Tensor:
        """Which of ``vertices`` (V,) bool a grasp has let go by the step of ``frame``, (V,) bool."""
        free = torch.zeros_like(vertices)
        for grasp in self.grasps[: self._passed(frame)]:
            free = free & ~grasp.vertices if grasp.holds else free | grasp.vertices
        return free & vertices

    def targets(self, frame: int, here: Tensor, there: Tensor, pos: Tensor, dt: float) -> Tensor:
        """Where held vertices go in the step of ``frame``, (V, 3) m: ``there``, and those that a grasp holds nearer to it by
        what the speed allows, from ``pos`` (V, 3) with the skinned garment ``here`` at the start of the step."""
        grasped = self.grasped(frame)
        if grasped is None:
            return there
        off = pos - here
        far = torch.linalg.vector_norm(off, dim=1, keepdim=True)
        left = (far - (self._speed(frame, far, dt) * dt).to(far)).clamp_min(0.0) / torch.where(far > 0, far, 1.0)
        return torch.where(grasped.unsqueeze(1) & (left > 0), there + left * off, there)

    def _speed(self, frame: int, far: Tensor, dt: float) -> Tensor:
        """(V, 1) float64 m/s of the last grasp that holds a vertex, which is ``far`` (V, 1) [m] off; 0 where none does."""
        speed = torch.zeros_like(far, dtype=torch.float64)
        for place, grasp in enumerate(self.grasps[: self._passed(frame)]):
            if not grasp.holds:
                continue
            own = far[grasp.vertices]
            speed[grasp.vertices] = grasp.speed
            if grasp.by is not None:
                speed[grasp.vertices] = needed_speed(own.double(), steps_left(grasp.frame, grasp.by, frame, dt), dt)
                if frame == grasp.frame and place not in self._said:
                    self._said.add(place)
                    _tell(f"{len(own)} vertices: attached", own, frame, grasp.by, dt)
        return speed

    def _passed(self, frame: int) -> int:
        return sum(grasp.frame <= frame for grasp in self.grasps)
