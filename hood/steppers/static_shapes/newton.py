"""The solver's step with fixed shapes: on CUDA a few graphs, between which the host reads how far it has come, or, with a
number of iterations that is known before, one compiled function that asks nobody."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from hood.cloth.cloth import Cloth
from hood.energies.potential import Potential, keeps_both_sides
from hood.energies.problem import StepProblem
from hood.solver.derivatives.vertices import terms_without_form
from hood.solver.newton import Iteration, NewtonSettings, Report, reason_of, run
from hood.solver.step_figures import MOST_ITERATIONS, reason_number
from hood.solver.system.iterate import Proceed, rounded
from hood.solver.system.plan import plan_for
from hood.steppers.network import Prediction
from hood.steppers.protocol import Relaxing, Stopwatch, timed
from hood.steppers.static_shapes.cuda_graph import CudaGraph, InputMemory, Run, has_graphs, trace
from hood.steppers.static_shapes.newton_pieces import FixedSystem, MaskedStep, NewtonFrame
from hood.steppers.static_shapes.problem import (
    Constants,
    problem_from,
    settled_potential,
    step_inputs,
    step_shape,
    with_fixed_contact,
)
from hood.tensors.dense import has_triton, whole_arrays

if TYPE_CHECKING:
    from hood.steppers.newton import NewtonStepper

#: How the solver's step of fixed shapes is taken.
_MODES = ("fixed", "captured", "compiled")
#: A compiled step takes all iterations it is made for; more than these make no frame worth compiling.
MOST, MOST_CG = 20, 200


class CapturedNewton:
    """Takes the steps of a :class:`hood.steppers.newton.NewtonStepper` in pieces of fixed shapes, the search included.

    Args:
        mode: ``fixed``: one operation after the other; ``captured``: a CUDA graph for every piece; ``compiled``: all of
            ``solver.max_iterations`` with at most ``solver.cg_iterations`` each, as one function through torch.compile, and on
            CUDA captured as well.

    Raises:
        ValueError: another mode, ``captured`` without CUDA, or settings that have no such form.
    """

    times: tuple[str, ...] = ("solver", "rest", "total")
    relaxing = Relaxing.SETTLE
    memoryless = True

    def __init__(self, stepper: NewtonStepper, mode: str = "captured") -> None:
        if mode not in _MODES:
            raise ValueError(f"step={mode} is none of the solver's; choose plain, {' or '.join(_MODES)}")
        if mode == "captured" and not has_graphs(stepper.gravity.device):
            raise ValueError("step=captured needs device=cuda, a CPU has no graphs to replay; use step=fixed or step=plain")
        settings = stepper.settings
        require_pieces(settings)
        if mode == "compiled" and (settings.max_iterations > MOST or settings.cg_iterations > MOST_CG):
            raise ValueError(
                f"step=compiled takes all of solver.max_iterations={settings.max_iterations} and cg_iterations="
                f"{settings.cg_iterations} whatever a step needs: give at most {MOST} and {MOST_CG}, such as "
                "solver.max_iterations=5 solver.cg_iterations=75"
            )
        device = stepper.gravity.device
        if mode == "compiled" and device.type == "cuda" and not has_triton(device):
            raise ValueError("step=compiled of the solver needs Triton and a GPU from 2020 on (Ampere); use step=captured")
        self.stepper, self.mode = stepper, mode
        self.gravity, self.config, self.metrics = stepper.gravity, stepper.config, stepper.metrics
        self.solves_to = stepper.solves_to
        self._minimize = FixedMinimizer(mode)

    def prepare(self, cloth: Cloth, rest_pos: Any) -> None:
        """Nothing: what is known of a cloth is kept with the step."""

    def search(self, problem: StepProblem) -> StepProblem:
        """The problem as it is: the search is part of the step."""
        return problem

    @torch.no_grad()
    def predict(self, problem: StepProblem, prepared: None, watch: Stopwatch | None = None) -> Prediction:
        """The minimum next to the contact-projected inertial guess."""
        with timed(watch, "solver"):
            pos, report = self._minimize(self.stepper.potential, problem, settings=self.stepper.settings)
        reached = {
            "solver_iterations": float(report.iterations),
            "solver_converged": float(not any(report.reason)),
            "solver_reason": reason_number(report.reason),
        }
        return Prediction(pos, report.acc, reached, report.residual)

    def next_velocity(self, problem: StepProblem, prediction: Prediction) -> Tensor:
        """(V, 3) m/s at t + 1: (x_{t+1} − x_t) / dt."""
        return self.stepper.next_velocity(problem, prediction)


def require_pieces(settings: NewtonSettings) -> None:
    """Raise ValueError where they have no form of fixed shapes."""
    if settings.linear != "cg":
        raise ValueError(f"solver.linear={settings.linear} has no form of fixed shapes; use cg or step=plain")


class FixedMinimizer:
    """:func:`hood.solver.newton.minimize` in pieces of fixed shapes, the search for contact included.

    What is made for a problem is kept, and made anew for one of other shapes, another cloth, potential or settings.

    Args:
        mode: as :class:`CapturedNewton` has it; a compiled function starts from the inertial guess and asks nobody.
    """

    def __init__(self, mode: str) -> None:
        self.mode = mode
        self._plan: _Plan | _Frame | None = None

    @torch.no_grad()
    def __call__(
        self,
        potential: Potential,
        problem: StepProblem,
        start: Tensor | None = None,
        settings: NewtonSettings | None = None,
        *,
        proceed: Proceed | None = None,
    ) -> tuple[Tensor, Report]:
        """Positions (V, 3) m at t + 1 and what was reached, as :func:`hood.solver.newton.minimize`.

        Args:
            potential: what is minimised; its search for contact is part of the pieces.
            start: (V, 3) m, free vertices are taken from it; None: the contact-projected inertial guess.
            settings: default ``NewtonSettings()``.
            proceed: asked before every iteration; default always.

        Raises:
            ValueError: the potential has no such form.
        """
        began, settings, places = time.perf_counter(), settings or NewtonSettings(), 0
        plan = self._plan
        if plan is not None and plan.is_stale(problem, potential, settings):
            plan = None
        while plan is None or (places := plan.enter(problem)) > plan.places:
            self._plan = plan = None  # its memory is free before there is another
            given = potential, settings, problem, places
            self._plan = plan = _Frame(*given) if self.mode == "compiled" else _Plan(*given, self.mode == "captured")
        pos, report = plan.minimize(problem, began, start, proceed)
        return pos, replace(report, acc=report.acc.to(pos.dtype))


def minimizer_for(mode: str, settings: NewtonSettings, device: torch.device) -> FixedMinimizer | None:
    """What takes iterations after a network whose steps are taken in ``mode``; None: nothing of fixed shapes. A compiled
    function holds the network's step alone, and the iterations after it are graphs where there are any.

    Raises:
        ValueError: settings that have no such form.
    """
    require_pieces(settings)
    if mode == "compiled":
        return FixedMinimizer("captured") if has_graphs(device) else None
    return FixedMinimizer(mode)


class _Fixed:
    """What is known of problems of one shape, and the memory of their inputs."""

    def __init__(self, potential: Potential, settings: NewtonSettings, problem: StepProblem, places: int) -> None:
        self.places, self._settings, self._like = places, settings, problem
        self._constants, self._shape = Constants(problem, potential), step_shape(problem, surface=True)
        self._inputs = InputMemory(step_inputs(problem, surface=True))
        self._potential, self._known = settled_potential(potential, problem), problem.with_fold()
        others = terms_without_form(self._potential, self._known)
        if others is not None:
            raise ValueError(
                f"losses.terms.{next(iter(others.terms))}: its second derivatives are not written out, which steps of fixed "
                "shapes need: use step=plain"
            )

    def is_stale(self, problem: StepProblem, potential: Potential, settings: NewtonSettings) -> bool:
        """Whether a problem needs another plan."""
        same = step_shape(problem, surface=True) == self._shape and settings == self._settings
        return not same or not self._constants.hold(problem, potential)


class _Frame(_Fixed):
    """The whole step as one compiled function."""

    def __init__(self, potential: Potential, settings: NewtonSettings, problem: StepProblem, places: int) -> None:
        super().__init__(potential, settings, problem, places)
        memory, given = self._inputs.tensors, (self._potential, self._known, plan_for(self._known), places, settings)
        with whole_arrays():
            NewtonFrame(*given)(*memory)  # what is made once per cloth is made now: a trace has no values for it
        frame = NewtonFrame(*given, dense=True)
        self._run: Run = torch.compile(trace(frame, memory), fullgraph=True, dynamic=False)
        if has_graphs(memory[0].device):
            self._run = CudaGraph(self._run, memory)

    def enter(self, problem: StepProblem) -> int:
        """Take the step of a problem; the number of body faces that need a place."""
        *self._reached, faces = self._run(*self._inputs.load(step_inputs(problem, surface=True)))
        return int(faces)

    def minimize(
        self, problem: StepProblem, began: float, start: Tensor | None, proceed: Proceed | None
    ) -> tuple[Tensor, Report]:
        """Positions (V, 3) m at t + 1 of the problem whose step has been taken; its potential is not known, and of conjugate
        gradients the most that there can have been."""
        assert start is proceed is None, "all iterations are one function"
        settings, (pos, acc, residual) = self._settings, (value.clone() for value in self._reached)
        reached: list[float] = residual.tolist()
        left = [(math.isfinite(value), value > settings.target_rg) for value in reached]
        reason = tuple(reason_of(finite, wanted, False, MOST_ITERATIONS) for finite, wanted in left)
        used = settings.max_iterations * settings.cg_iterations
        end = Iteration(time.perf_counter() - began, [math.nan] * len(reached), reached)
        return pos, Report(settings.max_iterations, used, reason, acc, [end])


class _Plan(_Fixed):
    """The pieces for problems of one shape."""

    def __init__(
        self, potential: Potential, settings: NewtonSettings, problem: StepProblem, places: int, captured: bool
    ) -> None:
        super().__init__(potential, settings, problem, places)
        self._folds, record = keeps_both_sides(self._potential), _recorded if captured else None
        self._system = FixedSystem(
            self._potential, self._read, plan_for(self._known), settings.cg_iterations, settings.double, record
        )

    def enter(self, problem: StepProblem) -> int:
        """Take up a problem; the number of body faces that need a place."""
        self._inputs.load(step_inputs(problem, surface=True))
        self._system.enter()
        return int(self._faces)

    def minimize(
        self, problem: StepProblem, began: float, start: Tensor | None, proceed: Proceed | None
    ) -> tuple[Tensor, Report]:
        """Positions (V, 3) at t + 1 of the problem that has been taken up."""
        self._system.begin(start)
        like = problem.state.pos.double() if self._settings.double else problem.state.pos
        pos, report = run(self._system, like, self._settings, began, proceed)
        return rounded(problem, pos), report

    def _read(self) -> StepProblem:
        problem, incidence = problem_from(self._like, self._inputs.tensors)
        problem, self._faces = with_fixed_contact(problem, incidence, self.places, self._folds)
        return self._potential.with_internal_force(problem, compiled=False)


def _recorded(piece: MaskedStep) -> MaskedStep:
    def run_piece() -> tuple[Tensor, ...]:
        piece()
        return ()

    graph = CudaGraph(run_piece, ())

    def replay() -> None:
        graph()

    return replay
