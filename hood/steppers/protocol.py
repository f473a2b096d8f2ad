"""How a state enters the network and leaves it: the project's own rules, and those that earlier weights were trained with.

The defaults change nothing: a step lasts its dt, pinned vertices are where they are at t, velocities are those of the state.

Where a frame's time goes: search, features, network, rest.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from enum import Enum

import torch
from torch import Tensor

from hood.cloth.state import State
from hood.energies.problem import StepProblem
from hood.scene.scene import RELAXING_DT

VELOCITIES = ("displacement", "carried")


class Relaxing(Enum):
    """What a rollout makes of the relaxing first step, the one that is told a dt of 1/3 s."""

    #: The body stands still in frame 0. The step is taken only where it helps; frame 0 has the skinned garment's velocity.
    SETTLE = "settle"
    #: The body stands still in frame 0. The rollout goes on from the step as it is, its displacement included: that is the
    #: velocity of frame 0.
    CARRY = "carry"
    #: The body moves: the step leads from frame 0, at rest, to frame 1. There the cloth is at rest again.
    RESTART = "restart"


@dataclass(frozen=True)
class FrameRules:
    """Conventions of a model about time, pinned vertices and velocities.

    Args:
        frame_dt: [s] a step is one frame of this length whatever its dt: velocities and accelerations are displacements per
            frame, and dt is the timestep feature alone. None: a step lasts its dt.
        pins_ahead: pinned vertices stand at their targets, the positions at t + 1, when the graph is built.
        velocity: ``displacement`` x_t − x_{t−1}, of pinned vertices that stand ahead the motion to their targets; or
            ``carried``, the velocity the last step predicted, which is 0 for pinned vertices.

    The two also say what becomes of the relaxing step, see :attr:`relaxing`.
    """

    frame_dt: float | None = None
    pins_ahead: bool = False
    velocity: str = "displacement"

    def __post_init__(self) -> None:
        if self.frame_dt is not None and not self.frame_dt > 0:
            raise ValueError(f"model.frame_dt is {self.frame_dt!r}; it must be > 0, or null for steps that last their dt")
        if self.velocity not in VELOCITIES:
            raise ValueError(f"model.velocity is {self.velocity!r}; choose {' or '.join(VELOCITIES)}")

    @property
    def relaxing(self) -> Relaxing:
        """What a rollout makes of the relaxing step.

        Models in frames were trained with either of two loops. One that carries velocities (postcvpr) holds the body still
        during the step and carries its displacement on. One that takes differences of positions (cvpr, Fine15, Fine48) lets
        the body move, and drops the displacement, which 1/3 s of a step says nothing about.
        """
        if self.frame_dt is None:
            return Relaxing.SETTLE
        return Relaxing.CARRY if self.velocity == "carried" else Relaxing.RESTART

    def enter(self, problem: StepProblem) -> StepProblem:
        """The step as the network sees it."""
        if self.frame_dt is not None:
            self.check(problem.step.dt)
            step = replace(problem.step, dt=torch.full_like(problem.step.dt, self.frame_dt))
            problem = replace(problem, step=step)
        return self.stand(problem)

    def check(self, dt: Tensor) -> None:
        """Raise ValueError if the model cannot take steps of ``dt`` (B,) [s]."""
        if self.frame_dt is not None:
            _check_dt(dt, self.frame_dt)

    def stand(self, problem: StepProblem) -> StepProblem:
        """The problem with pinned vertices where the model has them; contact stays what it was at t."""
        return _pins_ahead(problem, self.velocity) if self.pins_ahead else problem

    def acceleration(self, problem: StepProblem, displacement: Tensor) -> Tensor:
        """Acceleration [m/s²] (V, 3) over the step's own dt of a ``displacement`` [m] from where the state's velocity leads."""
        dt = problem.vertex_dt
        if self.frame_dt is None:
            return displacement / dt**2
        return (displacement + (self.frame_dt - dt) * problem.state.vel) / dt**2

    def judged(self, problem: StepProblem) -> StepProblem:
        """The step as energies see it: x_t − x_{t−1}, of which the network is told in frames, is dt v in a step of any dt.

        The problem itself for models whose steps last their dt, and for steps that begin at rest or last a frame.
        """
        state = problem.state
        if self.frame_dt is None or not bool(state.vel.any()):
            return problem
        frames = torch.full_like(problem.vertex_dt, self.frame_dt) / problem.vertex_dt
        if bool((frames == 1.0).all()):
            return problem
        return replace(problem, state=State(state.pos, state.vel * frames, state.origin))

    def next_velocity(self, problem: StepProblem, acc: Tensor) -> Tensor:
        """(V, 3) m/s at t + 1 of a step with acceleration ``acc``: (x_{t+1} − x_t) over the duration of the step; 0 after a
        relaxing step from which the model restarts."""
        dt = problem.vertex_dt
        vel = problem.state.vel + dt * acc
        if self.frame_dt is not None:
            vel = vel * (dt / torch.full_like(dt, self.frame_dt))
            if self.relaxing is Relaxing.RESTART:
                relaxed = (dt - RELAXING_DT).abs() < (dt - self.frame_dt).abs()
                vel = torch.where(relaxed, 0.0, vel)
        return torch.where(problem.cloth.pinned.unsqueeze(1), 0.0, vel) if self.velocity == "carried" else vel


def _check_dt(dt: Tensor, frame_dt: float) -> None:
    known = dt.new_tensor([frame_dt, RELAXING_DT])
    strange = (dt.unsqueeze(1) - known).abs().amin(dim=1) > 1e-3 * frame_dt
    if bool(strange.any()):
        scene = int(strange.long().argmax())
        raise ValueError(
            f"this model counts in frames of 1/{1 / frame_dt:g} s, the step of scene {scene} lasts {float(dt[scene]):g} s; "
            f"use fps={1 / frame_dt:g}"
        )


def _pins_ahead(problem: StepProblem, velocity: str) -> StepProblem:
    """The problem with pinned vertices at their targets; contact stays what it was at t."""
    cloth, state, step = problem.cloth, problem.state, problem.step
    pinned = cloth.pinned.unsqueeze(1)
    target = state.pos if step.pin_target is None else step.pin_target
    pos = torch.where(pinned, target, state.pos)
    vel = state.vel
    if velocity == "displacement":
        vel = torch.where(pinned, (pos - state.pos) / problem.vertex_dt, vel)
    return replace(problem, state=State(pos, vel, state.origin))


class Stopwatch:
    """Accumulates milliseconds by part; ``lap`` hands them out and starts the next frame.

    ``clock`` tells the seconds; by default those on the wall.
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock
        self._parts: dict[str, float] = {}
        self._asides: dict[str, float] = {}
        self._start = clock()

    def part(self, name: str) -> AbstractContextManager[None]:
        """Count the time of the block as ``name``. On CUDA the block, and what was begun before it, is waited for."""
        return self._counted(self._parts, name)

    def aside(self, name: str) -> AbstractContextManager[None]:
        """The block is no part of the frame: its time is kept apart, for :meth:`spent_aside`."""
        return self._counted(self._asides, name)

    def spent_aside(self, name: str) -> float:
        """Milliseconds since the last lap in blocks set aside as ``name``."""
        return self._asides.get(name, 0.0)

    def elapsed(self) -> float:
        """Milliseconds since the last lap, without what was set aside. On CUDA, what was begun is waited for."""
        _wait()
        return 1e3 * (self._clock() - self._start) - sum(self._asides.values())

    def lap(self) -> dict[str, float]:
        """Milliseconds since the last lap: each part, ``rest`` and ``total``, which leaves out what was set aside."""
        _wait()
        now = self._clock()
        total = 1e3 * (now - self._start) - sum(self._asides.values())
        parts, self._start = dict(self._parts), now
        self._parts.clear()
        self._asides.clear()
        return {**parts, "rest": max(total - sum(parts.values()), 0.0), "total": total}

    @contextmanager
    def _counted(self, times: dict[str, float], name: str) -> Iterator[None]:
        _wait()
        begin = self._clock()
        yield
        _wait()
        times[name] = times.get(name, 0.0) + 1e3 * (self._clock() - begin)


def _wait() -> None:
    if torch.cuda.is_initialized():  # where nothing was computed on a GPU there is nothing to wait for
        torch.cuda.synchronize()


def timed(watch: Stopwatch | None, name: str) -> AbstractContextManager[None]:
    """``watch.part(name)``, or nothing without a watch."""
    return nullcontext() if watch is None else watch.part(name)
