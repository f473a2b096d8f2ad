"""How a state enters the network and leaves it: the project's own rules, and those that earlier weights were trained with.

The defaults change nothing: a step lasts its dt, pinned vertices are where they are at t, velocities are those of the state.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from hood.losses.problem import StepProblem
from hood.scene.scene import RELAXING_DT
from hood.scene.state import State

VELOCITIES = ("displacement", "carried")


@dataclass(frozen=True)
class FrameRules:
    """Conventions of a model about time, pinned vertices and velocities.

    Args:
        frame_dt: [s] a step is one frame of this length whatever its dt: velocities and accelerations are displacements per
            frame. dt is then the timestep feature alone, and the velocity of the relaxing first step goes on into the
            rollout. None: a step lasts its dt.
        pins_ahead: pinned vertices stand at their targets, the positions at t + 1, when the graph is built.
        velocity: ``displacement`` x_t − x_{t−1}, of pinned vertices that stand ahead the motion to their targets; or
            ``carried``, the velocity the last step predicted, which is 0 for pinned vertices.
    """

    frame_dt: float | None = None
    pins_ahead: bool = False
    velocity: str = "displacement"

    def __post_init__(self) -> None:
        if self.frame_dt is not None and not self.frame_dt > 0:
            raise ValueError(f"model.frame_dt is {self.frame_dt!r}; it must be > 0, or null for steps that last their dt")
        if self.velocity not in VELOCITIES:
            raise ValueError(f"model.velocity is {self.velocity!r}; choose {' or '.join(VELOCITIES)}")

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

    def next_velocity(self, problem: StepProblem, acc: Tensor) -> Tensor:
        """(V, 3) m/s at t + 1 of a step with acceleration ``acc``: (x_{t+1} − x_t) over the duration of the step."""
        dt = problem.vertex_dt
        vel = problem.state.vel + dt * acc
        if self.frame_dt is not None:
            vel = vel * (dt / torch.full_like(dt, self.frame_dt))
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
