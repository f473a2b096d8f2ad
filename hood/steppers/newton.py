"""What a rollout needs of whatever takes the step, and the stepper that needs no network.

Implicit Euler steps of any cloth and obstacle; needs no garment, body or file. Minima are found again with cloth held farther
off, where they leave it in the skin (:mod:`hood.contact.further`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from hood.cloth.cloth import Cloth
from hood.cloth.state import State, StepInput
from hood.contact.contact import Contact
from hood.energies.potential import Potential
from hood.energies.problem import StepProblem
from hood.solver.newton import Iteration, NewtonSettings, Report, minimize
from hood.solver.step_figures import reason_number
from hood.steppers.network import Prediction
from hood.steppers.protocol import Relaxing, Stopwatch, timed


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
        fresh = replace(
            problem,
            state=state,
            step=step,
            contact=found,
            point_contacts=(),
            internal_force=None,
            layers=(),
            second_contact=None,
        )
        now = potential.prepare(fresh)
        pos, report = minimize(potential, now, None if start is None else start(now), settings)
        state = State(pos, state.vel + now.vertex_dt * report.acc, state.origin)
        yield EulerStep(now, state, report)


class Stepper(Protocol):
    """Takes steps: :class:`hood.steppers.network.NetworkStepper` by a network, :class:`NewtonStepper` by minimisation.

    A stepper of your own is a class with these attributes and methods. Some may be there beside them: ``simulator``, the
    :class:`hood.steppers.network.NetworkStepper` that takes its steps; ``solves_to``, the
    :class:`hood.solver.newton.NewtonSettings` that every step is to meet; ``any_precision`` where it computes in the precision
    of the state, whatever that of its gravity is; ``num_coarse``, the coarse levels that it takes as a third argument of
    ``prepare``; ``in_fixed_shapes(mode)``, the same steps by functions of fixed shapes; ``memoryless``, true in a class whose
    steps depend on nothing that was before but what a rollout keeps (:func:`remembers`).
    """

    gravity: Tensor  # (3,) m/s²
    config: dict[str, Any]  # travels into the rollout file
    times: tuple[str, ...]  # parts of a frame's time
    metrics: tuple[str, ...]  # names of the entries of ``Prediction.metrics``

    @property
    def relaxing(self) -> Relaxing:
        """What a rollout makes of the relaxing step."""
        ...

    def prepare(self, cloth: Cloth, rest_pos: Any) -> Any:
        """What is computed once per cloth."""
        ...

    def search(self, problem: StepProblem) -> StepProblem:
        """The problem with the contact, if the step itself needs it: itself where that is there already or not needed."""
        ...

    def predict(self, problem: StepProblem, prepared: Any, watch: Stopwatch | None = None) -> Prediction:
        """Positions at t + 1."""
        ...

    def next_velocity(self, problem: StepProblem, prediction: Prediction) -> Tensor:
        """(V, 3) m/s at t + 1."""
        ...


#: What every stepper has.
_PARTS = ("gravity", "config", "times", "metrics", "relaxing", "prepare", "search", "predict", "next_velocity")


def require_stepper(given: object) -> None:
    """Raise ValueError where an own stepper lacks an attribute or a method of :class:`Stepper`; names them."""
    missing = [name for name in _PARTS if not hasattr(given, name)]
    if missing:
        raise ValueError(
            f"stepper is of type {type(given).__name__}, which has no {', '.join(missing)}; give an option of hood rollout, or "
            "an object with what hood.steppers.newton.Stepper lists"
        )


def remembers(stepper: Stepper) -> bool:
    """Whether a stepper remembers more from step to step than its state and what its goal has learned.

    It does unless its own class says that it is ``memoryless``; classes that inherit from it have to say so again.
    """
    return "memoryless" not in vars(type(stepper)) or not stepper.memoryless  # type: ignore[attr-defined]


class NewtonStepper:
    """Implicit Euler by projected Newton on the same potential that trains the networks; no weights.

    Steps that miss the target accuracy are taken as far as they got and counted in the metrics, with the number of the reason
    (:mod:`hood.solver.step_figures`). What is said holds for the next state as it is kept in a scene of float64; positions
    rounded to float32 leave a force of a few per cent of the weight.
    """

    times: tuple[str, ...] = ("search", "solver", "rest", "total")  # parts of a frame's time
    metrics: tuple[str, ...] = ("solver_iterations", "solver_converged", "solver_reason")  # of every step
    relaxing = Relaxing.SETTLE
    memoryless = True

    def __init__(self, potential: Potential, settings: NewtonSettings | None = None) -> None:
        self.potential, self.settings = potential, settings or NewtonSettings()
        self.gravity = torch.tensor([0.0, -9.81, 0.0])
        held_by_curvature = any(getattr(term, "reach", None) == "curvature" for term in potential.terms.values())
        self._holds_off = held_by_curvature and self.settings.budget_ms is None
        self.config: dict[str, Any] = {"stepper": "newton", **asdict(self.settings)}

    @property
    def solves_to(self) -> NewtonSettings:
        """What every step is to meet."""
        return self.settings

    def in_fixed_shapes(self, mode: str) -> Stepper:
        """The same steps with fixed shapes; ``mode`` is one of :data:`hood.steppers.static_shapes.simulator.MODES`."""
        from hood.steppers.static_shapes.newton import CapturedNewton

        return CapturedNewton(self, mode)

    def prepare(self, cloth: Cloth, rest_pos: Any) -> None:
        """Nothing: the solver keeps its plan of a cloth itself."""

    def search(self, problem: StepProblem) -> StepProblem:
        """The problem with what the potential's terms ask of it."""
        return self.potential.prepare(problem)

    def predict(self, problem: StepProblem, prepared: None, watch: Stopwatch | None = None) -> Prediction:
        """The minimum next to the contact-projected inertial guess; where that lies in skin that its contact did not show, the
        one next to it with that as well, and where it leaves triangles in the skin, the one that holds them farther off."""
        with timed(watch, "search"):
            problem = asked = self.search(problem)
        with timed(watch, "solver"):
            pos, report = minimize(self.potential, problem, settings=self.settings)
            iterations = report.iterations
            for _ in range(MOST_AGAIN if self.settings.budget_ms is None else 0):
                again = problem.with_entered(pos)
                if again is problem:
                    break
                problem = again
                pos, report = minimize(self.potential, problem, pos, self.settings)
                iterations += report.iterations
            if self._holds_off:
                held = minimize_held_off(self.potential, problem, pos, self.settings, report)
                problem, pos, report = held.problem, held.pos, held.report or report
                iterations += held.iterations
        reached = {
            "solver_iterations": float(iterations),
            "solver_converged": float(not any(report.reason)),
            "solver_reason": reason_number(report.reason),
        }
        entered = None if problem.second_contact is asked.second_contact else problem.second_contact
        held_off = None if problem.contact is asked.contact else problem.contact
        return Prediction(pos, report.acc, reached, report.residual, entered=entered, held_off=held_off)

    def next_velocity(self, problem: StepProblem, prediction: Prediction) -> Tensor:
        """(V, 3) m/s at t + 1: (x_{t+1} − x_t) / dt."""
        return problem.state.vel + problem.vertex_dt * prediction.acc


def as_taken(problem: StepProblem, prediction: Prediction) -> StepProblem:
    """The problem with the contact that its step was taken with in the end."""
    problem = problem if prediction.entered is None else replace(problem, second_contact=prediction.entered)
    return problem if prediction.held_off is None else replace(problem, contact=prediction.held_off)


#: So often is a step taken again that has led into skin which its contact did not show.
MOST_AGAIN = 3
#: So often is one taken again with cloth held farther off: by 3, 9, 21 and 45 mm.
MOST_RAISED = 4
#: That ends where so many minima of a scene have been missed.
MOST_MISSES = 2


class HeldOff(NamedTuple):
    """A step with cloth held as far off as it took."""

    problem: StepProblem
    pos: Tensor  # (V, 3) m, its minimum
    report: Report | None  # of that minimum; what was given where nothing is held off
    rounds: int  # so often it was taken again; 0 where few triangles are in the skin, or nothing can be held off
    iterations: int  # that were spent on that


def minimize_held_off(
    potential: Potential, problem: StepProblem, pos: Tensor, settings: NewtonSettings, report: Report | None = None
) -> HeldOff:
    """The problem with cloth held off as far as it took, and its minimum; the problem and ``pos`` themselves where these leave
    no more triangles in the skin than are allowed.

    Of the minima that are found on the way, that with the fewest triangles in the skin counts, scene by scene. What missed
    its minimum is not taken, and a scene that missed two is held off no farther: cloth that is caught between skin and skin
    finds no balance farther off.

    Args:
        problem: prepared by ``potential``.
        pos: (V, 3) m, its minimum.
        report: of ``pos``, which may have missed the minimum; None where it is known to be one.
    """
    best, rounds, spent = HeldOff(problem, pos, report, 0, 0), 0, 0
    again = problem.with_held_off(pos) if MOST_RAISED else problem  # where one minimum has been missed at most
    if again is problem:
        return best
    least = problem.num_in_skin(pos)
    misses = torch.zeros_like(least) if report is None else (~report.converged).to(least)
    unsolved = misses > 0
    while again is not problem:
        problem = again
        pos, found = minimize(potential, problem, pos, settings)
        pos = torch.where(torch.isfinite(pos), pos, best.pos)  # what is no number is missed, and no place to go on from
        rounds, spent = rounds + 1, spent + found.iterations
        met = found.converged.to(misses.device) & (misses < MOST_MISSES)
        misses += ~met
        if bool((misses >= MOST_MISSES).all()):
            break
        count = problem.num_in_skin(pos)
        better = met & (unsolved | (count < least))
        unsolved = unsolved & ~better
        least = torch.where(better, count, least)
        best = _by_scene(better, HeldOff(problem, pos, found, 0, 0), best)
        again = problem.with_held_off(pos, misses < MOST_MISSES) if rounds < MOST_RAISED else problem
    return best._replace(rounds=rounds, iterations=spent)


def _by_scene(better: Tensor, new: HeldOff, old: HeldOff) -> HeldOff:
    """``new`` in the scenes (B,) that are ``better`` by it, ``old`` in the others."""
    if bool(better.all()):
        return new
    if not bool(better.any()):
        return old
    rows = better[new.problem.cloth.vertex_scene]
    known, held = old.problem.contact, new.problem.contact
    assert known is not None
    assert held is not None
    assert held.raised is not None
    before = torch.zeros_like(held.raised) if known.raised is None else known.raised
    contact = replace(held, raised=torch.where(rows, held.raised, before))
    pos = torch.where(rows.unsqueeze(1), new.pos, old.pos)
    report = new.report if old.report is None or new.report is None else _merged(better, rows, new.report, old.report)
    return HeldOff(replace(new.problem, contact=contact), pos, report, 0, 0)


def _merged(better: Tensor, rows: Tensor, new: Report, old: Report) -> Report:
    def chosen(one: Iterable[Any], other: Iterable[Any]) -> list[Any]:
        return [a if taken else b for taken, a, b in zip(better.tolist(), one, other, strict=True)]

    end, then = new.course[-1], old.course[-1]
    end = Iteration(end.seconds, chosen(end.phi, then.phi), chosen(end.relative_gradient, then.relative_gradient))
    acc = torch.where(rows.unsqueeze(1), new.acc, old.acc)
    return replace(new, reason=tuple(chosen(new.reason, old.reason)), acc=acc, course=[*new.course[:-1], end])
