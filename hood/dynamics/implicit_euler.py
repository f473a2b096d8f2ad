"""Implicit Euler steps of any cloth and obstacle; needs no garment, body or file."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

from torch import Tensor

from hood.losses.potential import Potential
from hood.losses.problem import StepProblem
from hood.scene.contact import Contact
from hood.scene.state import State, StepInput
from hood.solver.newton import NewtonSettings, Report, minimize


@dataclass(frozen=True)
class EulerStep:
    """A step taken: what it solved, where it led and how well."""

    problem: StepProblem
    state: State
    report: Report


def implicit_euler(
    potential: Potential,
    problem: StepProblem,
    num_steps: int,
    settings: NewtonSettings | None = None,
    step_input: Callable[[int], StepInput] | None = None,
    contact: Callable[[int, State], Contact | None] | None = None,
    start: Callable[[StepProblem], Tensor] | None = None,
) -> Iterator[EulerStep]:
    """Implicit Euler steps from the state of ``problem``, one by one; v_{t+1} = v_t + dt a = (x_{t+1} - x_t) / dt.

    Steps that miss the target accuracy are taken as far as they got: read ``report.converged``. The frame of the state
    stays, so obstacles and pins are all given in the one of ``problem``.

    Args:
        step_input: by step; default the one of ``problem`` in every step.
        contact: by step and state; default, and where it gives None, one search per step against the step's obstacle.
        start: (V, 3) m, where a step's minimisation starts; default that of :func:`hood.solver.newton.minimize`.
    """
    state = problem.state
    for index in range(num_steps):
        step = problem.step if step_input is None else step_input(index)
        found = None if contact is None else contact(index, state)
        fresh = replace(problem, state=state, step=step, contact=found, point_contacts=(), pull=None, layers=(), fold=None)
        now = potential.prepare(fresh)
        pos, report = minimize(potential, now, None if start is None else start(now), settings)
        state = State(pos, state.vel + now.vertex_dt * report.acc, state.origin)
        yield EulerStep(now, state, report)
