"""The implicit step without a network: projected Newton on the incremental potential.

The solver's way on from a place, iteration by iteration, for those who look at the way and not at its end.
"""

from __future__ import annotations

import math
import time
import warnings
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import TYPE_CHECKING, NamedTuple, Protocol

import torch
from torch import Tensor

from hood.energies.potential import Potential, relative_gradient
from hood.energies.self_contact import without_layers
from hood.energies.term import Role, having
from hood.native.build import BuildError
from hood.solver.compiled import newton as compiled_newton
from hood.solver.compiled.system import CompiledSystem
from hood.solver.derivatives.self_contact import approached, free_way, grips_of, layers_of, touching
from hood.solver.step_figures import CONVERGED, LATE, MOST_ITERATIONS, NOT_FINITE, STOPPED, STUCK
from hood.solver.system.iterate import Proceed, Progress, Unknowns, fixed_positions, in_double, rounded
from hood.solver.system.line_search import Path, backtrack
from hood.solver.system.linear import Directions
from hood.solver.system.plan import ModelBuilder, SolverPlan, plan_for

if TYPE_CHECKING:
    from hood.energies.problem import StepProblem

#: Forms of the solver.
ENGINES = ("auto", "compiled", "torch")


@dataclass(frozen=True)
class NewtonSettings:
    """How far and how :func:`minimize` goes.

    Args:
        target_rg: relative gradient to reach, see :func:`hood.energies.potential.relative_gradient`.
        max_iterations: Newton iterations; ordinary steps take about 10, those of cloth a thousand times stiffer about 100.
        budget_ms: stop after the iteration that passes this time [ms]; None for no limit.
        linear: ``cg`` (conjugate gradients, preconditioned by Gauss-Seidel sweeps, in torch by blocks) or ``direct`` (band
            Cholesky, in torch, on the CPU).
        cg_iterations: at most as many per Newton iteration. Ordinary cloth takes as many Newton iterations with 100. Of cloth a
            thousand times stiffer, most steps miss the target with 100.
        double: compute in float64 whatever the problem's type. In float32 the potential of a garment is known to
            1e-7 of its value, which stops a line search early; the result comes back in the problem's type anyway.
        engine: ``compiled`` (C++, compiled at its first use, on a CPU), ``torch``, or ``auto``: compiled where there is a
            compiler. Settings and terms that the compiled form does not know go to torch whatever is said here.
    """

    target_rg: float = 1e-3
    max_iterations: int = 300
    budget_ms: float | None = None
    linear: str = "cg"
    cg_iterations: int = 1000
    double: bool = True
    engine: str = "auto"

    def __post_init__(self) -> None:
        if not self.target_rg > 0 or self.max_iterations < 0 or self.cg_iterations < 1:
            raise ValueError(
                f"solver: target_rg is {self.target_rg}, max_iterations {self.max_iterations}, cg_iterations "
                f"{self.cg_iterations}; give target_rg > 0, max_iterations >= 0 and cg_iterations >= 1"
            )
        if self.engine not in ENGINES:
            raise ValueError(f"solver: engine is {self.engine!r}; choose {', '.join(ENGINES)}")
        if self.linear not in ("cg", "direct"):
            raise ValueError(f"solver: linear is {self.linear!r}; choose cg or direct")


class Iteration(NamedTuple):
    """Where a minimisation stood before an iteration, and where it ended: numbers of the scenes (B)."""

    seconds: float
    phi: list[float]  # J
    relative_gradient: list[float]

    def on(self, device: torch.device) -> Progress:
        """The same in tensors (B,), float64."""
        return Progress(self.seconds, *(torch.tensor(row, dtype=torch.float64, device=device) for row in self[1:]))


@dataclass(frozen=True)
class Report:
    """What :func:`minimize` reached, scene by scene."""

    iterations: int
    cg_iterations: int
    reason: tuple[str, ...]  # (B) of :mod:`hood.solver.step_figures`
    acc: Tensor  # (V, 3) m/s² that leads to the positions, without their cancellation in float32
    course: list[Iteration]  # before every iteration, and at the end

    @property
    def residual(self) -> float:
        """The largest relative gradient of the scenes, NaN where one is."""
        return max(self.course[-1].relative_gradient, key=lambda value: (math.isnan(value), value))

    @property
    def phi(self) -> Tensor:
        """(B,) J."""
        return self.course[-1].on(self.acc.device).phi

    @property
    def relative_gradient(self) -> Tensor:
        """(B,)."""
        return self.course[-1].on(self.acc.device).relative_gradient

    @property
    def converged(self) -> Tensor:
        """(B,) bool."""
        return torch.tensor([not reason for reason in self.reason], device=self.acc.device)

    @cached_property
    def history(self) -> list[Progress]:
        """``course`` in tensors."""
        return [place.on(self.acc.device) for place in self.course]


@torch.no_grad()
def minimize(
    potential: Potential,
    problem: StepProblem,
    start: Tensor | None = None,
    settings: NewtonSettings | None = None,
    plan: SolverPlan | None = None,
    proceed: Proceed | None = None,
) -> tuple[Tensor, Report]:
    """Positions (V, 3) at t + 1 that minimise ``potential``: one step of implicit Euler.

    Newton's method with as much of the Hessian as is positive definite (:class:`hood.solver.system.linear.Directions`) and an
    Armijo line search along paths that respect contact (:class:`hood.solver.system.line_search.Path`), both scene by scene; the
    scenes of a batch do not touch each other. Pinned vertices are at their targets exactly, massless ones
    stay. The potential never rises beyond rounding; the minimum is a local one. A scene that is not finite at
    the start is left there and reported.

    Args:
        start: (V, 3) m, free vertices are taken from it; default :func:`hood.solver.system.iterate.first_iterate`.
        settings: default ``NewtonSettings()``.
        plan: of the problem's cloth; default from a cache.
        proceed: asked before every iteration but the one that nothing is left for; default always.
    """
    began = time.perf_counter()
    settings = settings or NewtonSettings()
    problem = potential.prepare(problem)
    work = in_double(problem) if settings.double else problem
    plan = plan or plan_for(work)
    if start is not None:
        start = start.detach().to(work.state.pos.dtype)
    layers = layers_of(potential, work)
    if layers and proceed is None and not touching(layers, work.state.pos):
        # Most cloth meets none: the step is taken without, and that is the step where it turns out to have met none.
        system = system_of(without_layers(potential), work, plan, settings)
        system.begin(start)
        pos, report = run(system, work.state.pos, settings, began, proceed)
        if free_way(layers, work.state.pos, pos):
            return _in_type_of(problem, work, pos, report)
    system = system_of(potential, work, plan, settings)
    system.begin(start)
    pos, report = run(system, work.state.pos, settings, began, proceed)
    return _in_type_of(problem, work, pos, report)


def _in_type_of(problem: StepProblem, work: StepProblem, pos: Tensor, report: Report) -> tuple[Tensor, Report]:
    """What was computed of ``work`` in the type of ``problem``."""
    if work is problem:  # fixed vertices are where it says
        return pos, report
    return rounded(problem, pos), replace(report, acc=report.acc.to(problem.state.pos.dtype))


@torch.no_grad()
def first_guess(
    potential: Potential, problem: StepProblem, settings: NewtonSettings | None = None, crossing: bool = False
) -> tuple[Tensor, Tensor]:
    """Where :func:`minimize` starts by default, positions (V, 3) m and the accelerations (V, 3) m/s² that lead there, in the
    problem's type; see :func:`hood.solver.system.iterate.first_iterate`.

    Args:
        crossing: the way there may cross cloth where the step begins with no cloth near cloth, as :func:`minimize` starts: it
            looks at the way to where it ends.
    """
    problem = potential.prepare(problem)
    work = in_double(problem)
    if crossing and not touching(layers_of(potential, work), work.state.pos):
        potential = without_layers(potential)
    system = system_of(potential, work, plan_for(work), settings or NewtonSettings())
    system.begin(None)
    pos, acc = system.state()
    return rounded(problem, pos), acc.to(problem.state.pos.dtype)


@torch.no_grad()
def plan_ahead(potential: Potential, problem: StepProblem, settings: NewtonSettings | None = None) -> None:
    """Make what :func:`minimize` needs once per cloth, so that it is no part of a step's time."""
    plan = plan_for(problem)
    if "ahead" not in plan.cache:
        plan.cache["ahead"] = True
        system_of(potential, in_double(potential.prepare(problem)), plan, settings or NewtonSettings())


class System(Protocol):
    """The unknowns of a step: where they are, the model there, and the way on. :func:`minimize` decides when to stop."""

    def begin(self, start: Tensor | None) -> None:
        """Take up positions (V, 3); None: the default of :func:`minimize`."""
        ...

    @property
    def phi(self) -> list[float]:
        """(B) J."""
        ...

    @property
    def used(self) -> int:
        """Conjugate gradient iterations so far."""
        ...

    def model(self) -> list[float]:
        """Make the quadratic model of the state; the relative gradients (B)."""
        ...

    def move(self, residual: list[float], active: list[bool]) -> list[bool]:
        """Take a Newton step in the scenes ``active`` (B); which of them moved (B)."""
        ...

    def state(self) -> tuple[Tensor, Tensor]:
        """Positions (V, 3) and the accelerations (V, 3) that lead there."""
        ...


class TorchSystem:
    """The unknowns in torch's operations: the reference, on any device."""

    def __init__(self, potential: Potential, problem: StepProblem, plan: SolverPlan, settings: NewtonSettings) -> None:
        self.problem, self.plan = problem, plan
        self.unknowns = Unknowns(potential, problem)
        self.directions = Directions(plan, problem.num_scenes, settings.linear, settings.cg_iterations)
        self._build = ModelBuilder(self.unknowns.terms, plan, self.unknowns.layers, grips_of(potential, problem))

    def begin(self, start: Tensor | None) -> None:
        self._now = self.unknowns.begin(start)

    @property
    def phi(self) -> list[float]:
        return [float(value) for value in self._now.phi.tolist()]

    @property
    def used(self) -> int:
        return self.directions.used

    def model(self) -> list[float]:
        self._model = self._build(self._now.pos, self._now.acc)
        return [float(value) for value in relative_gradient(self.problem, self._model.gradient).tolist()]

    def move(self, residual: list[float], active: list[bool]) -> list[bool]:
        now, model = self._now, self._model
        searching = torch.tensor(active, device=now.phi.device)
        direction, inverse = self.directions(model, now.phi.new_tensor(residual), searching)
        slope = self.problem.sum_vertices((model.gradient * direction).sum(1))
        path, self._direction = Path(self.unknowns, now, direction, inverse, self.plan.vertices), direction
        self._now, moved = backtrack(self.unknowns, path, now, slope, searching)
        return [bool(value) for value in moved.tolist()]

    def state(self) -> tuple[Tensor, Tensor]:
        return self._now.pos, self._now.acc

    def direction(self) -> Tensor:
        """(V, 3) m: the last Newton step, before contact and the line search took less of it."""
        return self._direction


def system_of(
    potential: Potential, problem: StepProblem, plan: SolverPlan, settings: NewtonSettings
) -> TorchSystem | CompiledSystem:
    """The fastest form of the solver that does what ``settings`` ask for.

    Raises:
        ValueError: a term is for training alone.
    """
    for name in having(potential.terms, Role.TRAINING):
        raise ValueError(
            f"losses.terms.{name} is for training: where it sets in the solver does not converge; layers of cloth are kept "
            "apart by cloth_contact=on"
        )
    if (
        settings.engine != "torch"
        and settings.double
        and settings.linear == "cg"
        and compiled_newton.applies(potential, problem)
    ):
        try:
            return CompiledSystem(potential, problem, plan, settings.cg_iterations)
        except BuildError as error:
            if settings.engine == "compiled":
                raise BuildError(f"solver.engine=compiled: {error} or use solver.engine=torch") from error
            _say_once(f"the solver runs in torch, about six times slower than compiled: {error}")
    return TorchSystem(potential, problem, plan, settings)


@cache
def _say_once(sentence: str) -> None:
    warnings.warn(sentence, stacklevel=4)


def run(system: System, like: Tensor, settings: NewtonSettings, began: float, proceed: Proceed | None) -> tuple[Tensor, Report]:
    """The iterations of ``system``: positions (V, 3) and a report, float64, on the device of ``like``."""
    phi = system.phi
    finite, stuck, why = [math.isfinite(value) for value in phi], [False] * len(phi), MOST_ITERATIONS
    course: list[Iteration] = []
    iteration = 0
    while True:
        residual = system.model()
        finite = [sound and math.isfinite(value) for sound, value in zip(finite, residual, strict=True)]
        wanted = [sound and value > settings.target_rg for sound, value in zip(finite, residual, strict=True)]
        active = [scene and not halted for scene, halted in zip(wanted, stuck, strict=True)]
        course.append(Iteration(time.perf_counter() - began, system.phi, residual))
        late = settings.budget_ms is not None and 1e3 * course[-1].seconds > settings.budget_ms
        if late or iteration >= settings.max_iterations or not any(active):
            why = LATE if late else why
            break
        if proceed is not None and not proceed(course[-1].on(like.device), system.state()[0]):
            why = STOPPED
            break
        moved = system.move(residual, active)
        stuck = [halted or (scene and not went) for halted, scene, went in zip(stuck, active, moved, strict=True)]
        iteration += 1
    reason = tuple(reason_of(*scene, otherwise=why) for scene in zip(finite, wanted, stuck, strict=True))
    pos, acc = system.state()
    return pos, Report(iteration, system.used, reason, acc, course)


def reason_of(finite: bool, wanted: bool, stuck: bool, otherwise: str) -> str:
    """Why the iterations of a scene ended, of :mod:`hood.solver.step_figures`."""
    if not finite:
        return NOT_FINITE
    return CONVERGED if not wanted else STUCK if stuck else otherwise


class Further:
    """Iterations from ``start`` (V, 3) m, as :func:`hood.solver.newton.minimize` takes them, in float64.

    Where cloth would have to cross cloth on the straight way from the step's beginning to ``start``, layers are kept apart as
    they lie at ``start``. What is remembered of them for the next step does not change.

    Args:
        problem: prepared by ``potential``.
    """

    def __init__(
        self, potential: Potential, problem: StepProblem, start: Tensor, settings: NewtonSettings | None = None
    ) -> None:
        start, work = start.double(), in_double(problem)
        layers = layers_of(potential, work)
        if layers:
            start = torch.where(work.cloth.free.unsqueeze(1), start, fixed_positions(work))
            if not torch.equal(approached(layers, start), start):
                work = work.with_ways_from(start)
        self._system = system_of(potential, work, plan_for(work), settings or NewtonSettings())
        self._system.begin(start)
        self._residual: list[float] | None = None

    @property
    def residual(self) -> float:
        """Relative gradient where the way has got to, the largest over the scenes."""
        return max(self._modelled())

    def move(self) -> bool:
        """Take an iteration, from a :attr:`residual` that is finite; whether it led anywhere."""
        residual = self._modelled()
        self._residual = None if any(self._system.move(residual, [value > 0.0 for value in residual])) else residual
        return self._residual is None

    @property
    def pos(self) -> Tensor:
        """(V, 3) m, where the way has got to."""
        return self._system.state()[0]

    @property
    def direction(self) -> Tensor:
        """(V, 3) m: the last Newton step, before contact and the line search took less of it."""
        return self._system.direction()

    def _modelled(self) -> list[float]:
        if self._residual is None:
            with torch.no_grad():
                self._residual = self._system.model()
        return self._residual
