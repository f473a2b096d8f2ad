"""A simulator whose step has fixed shapes: taken operation by operation, as a CUDA graph, or compiled.

A whole step of a simulator (search, features, network, integration) as a function of tensors of fixed shapes.

It waits for nothing on the host and no shape in it depends on a value, so that a CUDA graph can hold it and a compiler
needs to see it once. Its result is that of :meth:`hood.steppers.network.NetworkStepper.predict` up to rounding.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from hood.cloth.cloth import Cloth
from hood.contact.contact import find_nearest
from hood.energies.potential import Potential, keeps_both_sides
from hood.energies.problem import StepProblem
from hood.mesh.closest_point.search import Incidence
from hood.model.features.inputs import EdgeRows, Inputs
from hood.model.graph.static_shapes import Capacity, FixedGraph, StaticLayout, build_fixed_graph, capacity_for, lay_out
from hood.native import features as native
from hood.solver.vertex.block_jacobi import incidence_of
from hood.steppers.network import NetworkStepper, Prediction, Prepared
from hood.steppers.newton import Stepper
from hood.steppers.protocol import Relaxing, Stopwatch, timed
from hood.steppers.refined import unrefined
from hood.steppers.static_shapes.cuda_graph import CudaGraph, InputMemory, Run, has_graphs, trace
from hood.steppers.static_shapes.problem import (
    Constants,
    altered,
    problem_from,
    settled_potential,
    step_inputs,
    step_shape,
    with_fixed_contact,
)
from hood.tensors.dense import check_precision, products


class StepResult(NamedTuple):
    """What a step leaves on the device."""

    next_pos: Tensor  # (V, 3) m
    acc: Tensor  # (V, 3) m/s²
    next_vel: Tensor  # (V, 3) m/s
    #: (3,) body edges, active body vertices, and body faces that every cloth vertex is tested against; a step with more than
    #: it has places for is to be repeated.
    num_found: Tensor


class FixedStep:
    """``StepResult(*step(*inputs))`` with ``inputs = step_inputs(problem, simulator.needs_contact)``
    (:mod:`hood.steppers.static_shapes.problem`) for problems like the one it was made for: same cloth, same attachments, same
    gravity, same fields, same shapes.

    Everything else (weights, statistics, the cloth) is read when the step is made or later, and must not change.

    Args:
        simulator: in evaluation mode.
        layout: sizes of its graphs.
        like: such a problem.
        dense: search all pairs on a CPU too, as on any other device: what is traced there must not leave torch.
        potential: what the model is told of, by
            :func:`hood.steppers.static_shapes.problem.settled_potential`; needed where ``simulator.looks_at_potential``.

    Raises:
        ValueError: the simulator counts statistics, or its graph has edges between layers of cloth.
    """

    def __init__(
        self,
        simulator: NetworkStepper,
        layout: StaticLayout,
        like: StepProblem,
        dense: bool = False,
        potential: Potential | None = None,
    ) -> None:
        check_model(simulator)
        assert potential is not None or not simulator.looks_at_potential, "the model looks at a potential"
        self.simulator, self.layout, self.dense = simulator, layout, dense
        self._like, self._potential = like, potential
        self._rows = self._edge_rows()
        self._incidence = incidence_of(like.cloth)
        assert like.cloth.scene_sizes  # known to the host before anything is captured

    def __call__(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """The fields of :class:`StepResult`."""
        with native.in_torch():
            return self._step(*problem_from(self._like, inputs))

    def _step(self, problem: StepProblem, incidence: Incidence | None) -> tuple[Tensor, ...]:
        simulator = self.simulator
        problem, seen, graph, num_found = see(simulator, self.layout, problem, incidence, self._potential, self.dense)
        sight = simulator.look(problem, seen, graph, self._potential, self._rows)
        prediction = simulator.advance(problem, seen, sight, *simulator.features(sight.inputs))
        velocity = simulator.next_velocity(problem, prediction)
        return prediction.next_pos, prediction.acc, velocity, num_found

    @torch.no_grad()
    def _edge_rows(self) -> EdgeRows:
        """Kept by the step, with the columns that stay the same: the memory that a CUDA graph reads must not be given back,
        and what is computed for the first time while a function is traced has no values."""
        like = self._like
        graph = build_fixed_graph(self.layout, None, None, self.simulator.body_radius)
        here = like.state.pos
        given = Inputs(like.cloth, like.state, like.step, None, graph, base_pos=here, global_step=torch.zeros_like(here))
        given = replace(given, edge_rows=given.make_edge_rows())
        for group in self.simulator.features.edge:
            group(given)
        return given.edges


def see(
    simulator: NetworkStepper,
    layout: StaticLayout,
    problem: StepProblem,
    incidence: Incidence | None,
    potential: Potential | None,
    dense: bool,
) -> tuple[StepProblem, StepProblem, FixedGraph, Tensor]:
    """The problem with its contact, as the simulator sees it, its graph, and what :attr:`StepResult.num_found` holds.

    Args:
        potential: settled; None where nobody looks at one.
        dense: see :class:`FixedStep`.
    """
    folds = potential is not None and keeps_both_sides(potential)
    problem, num_faces = with_fixed_contact(problem, incidence, layout.capacity.faces, folds, dense)
    if potential is not None:
        problem = potential.with_internal_force(problem, compiled=False)
    seen = simulator.rules.stand(_in_frames(simulator, problem))
    obstacle, nearest = seen.step.obstacle, None
    if obstacle is not None and seen.contact is not None and seen.state is problem.state:
        nearest = seen.contact.nearest
    elif obstacle is not None:
        nearest = find_nearest(seen.cloth, seen.state.pos, obstacle, simulator.body_radius, dense)
    graph = build_fixed_graph(layout, obstacle, nearest, simulator.body_radius)
    return problem, seen, graph, torch.cat([graph.num_found, num_faces])


def _in_frames(simulator: NetworkStepper, problem: StepProblem) -> StepProblem:
    frame_dt = simulator.rules.frame_dt
    if frame_dt is None:
        return problem
    return altered(problem, step=altered(problem.step, dt=torch.full_like(problem.step.dt, frame_dt)))


def check_model(simulator: NetworkStepper) -> None:
    """Raise ValueError if the simulator's step has no form of fixed shapes."""
    if simulator.training:
        raise ValueError("fixed-shape steps are for inference: call simulator.eval() first")
    if simulator.layer_radius is not None:
        raise ValueError(
            f"the model has edges between layers of cloth (model.layer_radius={simulator.layer_radius:g}), as many as a step "
            "finds: use step=plain"
        )


#: How a step of fixed shapes is taken.
MODES = ("fixed", "captured", "compiled")
#: Steps of different shapes (cloths, with and without pins) that are kept ready.
_MAX_PLANS = 4


@dataclass(frozen=True)
class StepPrediction(Prediction):
    """A prediction that comes with its velocity: integration is part of the step."""

    next_vel: Tensor | None = None  # (V, 3) m/s


class CapturedSimulator:
    """Takes the steps of ``simulator`` with fixed shapes; its positions are the simulator's own up to rounding.

    Body edges get the places that the first step needs and a quarter more. A step that finds no room is repeated with
    more of them: their number is read at the end of the step, with the result, never inside. Weights, cloth and gravity are
    read when the step of a cloth is first taken; make a new one after changing them.

    Args:
        simulator: in evaluation mode.
        mode: ``fixed``: one operation after the other; ``captured``: a CUDA graph of them, replayed at once; ``compiled``:
            through torch.compile, and on CUDA captured as well.
        capacity: places to begin with.
        or_plain: where a step has no such form, or it cannot be made here, take the simulator's own; a warning says why.

    Raises:
        ValueError: an unknown mode, ``captured`` without CUDA, or ``compiled`` of compiled kernels.
    """

    times: tuple[str, ...] = ("step", "rest", "total")
    memoryless = True

    def __init__(
        self, simulator: NetworkStepper, mode: str = "captured", capacity: Capacity | None = None, or_plain: bool = False
    ) -> None:
        if mode not in MODES:
            raise ValueError(f"step is {mode!r}; choose plain, {', '.join(MODES[:-1])} or {MODES[-1]}")
        if mode == "captured" and not has_graphs(simulator.gravity.device):
            raise ValueError("step=captured needs device=cuda, a CPU has no graphs to replay; use step=fixed or step=plain")
        if mode == "compiled" and simulator.network.kernels != "torch":
            raise ValueError("step=compiled compiles torch's operations and needs kernels=torch; or use step=plain")
        check_model(simulator)
        check_precision(simulator.network.precision, simulator.gravity.device)
        self.simulator, self.mode = simulator, mode
        self.gravity, self.config, self.metrics = simulator.gravity, simulator.config, simulator.metrics
        self._capacity, self._or_plain, self._gave_up = capacity, or_plain, False
        self._plans: dict[Any, _Plan] = {}

    @property
    def relaxing(self) -> Relaxing:
        return self.simulator.relaxing

    def prepare(self, cloth: Cloth, rest_pos: Any) -> Prepared:
        """As :meth:`hood.steppers.network.NetworkStepper.prepare`."""
        return self.simulator.prepare(cloth, rest_pos)

    def search(self, problem: StepProblem) -> StepProblem:
        """The problem as it is: the search is part of the step."""
        return problem

    @torch.no_grad()
    def predict(self, problem: StepProblem, prepared: Prepared, watch: Stopwatch | None = None) -> Prediction:
        """Positions, accelerations and velocities at t + 1."""
        with timed(watch, "step"):
            self.simulator.rules.check(problem.step.dt)
            if not self._gave_up:
                try:
                    return self._take(problem, prepared)
                except (ValueError, RuntimeError) as error:
                    if not self._or_plain:
                        raise
                    self._gave_up = True
                    self._plans.clear()
                    warnings.warn(f"step=plain: no CUDA graph of a step could be made ({error})", stacklevel=2)
            return self.simulator.predict(self.simulator.search(problem), prepared)

    def _take(self, problem: StepProblem, prepared: Prepared) -> StepPrediction:
        plan = self._plan(problem, prepared)
        result = plan.take(problem)
        counts = _read(result.num_found)
        while not plan.layout.capacity.holds(counts):
            plan = self._make_plan(problem, prepared, more_capacity(counts, problem))
            result = plan.take(problem)
            counts = _read(result.num_found)
        # The next step writes to the same memory.
        next_pos, acc, next_vel = (value.clone() for value in result[:3])
        return StepPrediction(next_pos, acc, next_vel=next_vel)

    def next_velocity(self, problem: StepProblem, prediction: Prediction) -> Tensor:
        """(V, 3) m/s at t + 1."""
        if isinstance(prediction, StepPrediction) and prediction.next_vel is not None:
            return prediction.next_vel
        return self.simulator.next_velocity(problem, prediction)

    def _plan(self, problem: StepProblem, prepared: Prepared) -> _Plan:
        plan = self._plans.get(self._key(problem))
        if plan is None or plan.is_stale(problem, prepared):
            plan = self._make_plan(problem, prepared, self._capacity or first_capacity(self.simulator, problem))
        return plan

    def _make_plan(self, problem: StepProblem, prepared: Prepared, capacity: Capacity) -> _Plan:
        self._plans.pop(self._key(problem), None)
        while len(self._plans) >= _MAX_PLANS:
            del self._plans[next(iter(self._plans))]
        plan = _Plan(self.simulator, problem, prepared, capacity, self.mode)
        self._plans[self._key(problem)] = plan
        return plan

    def _key(self, problem: StepProblem) -> tuple[Any, ...]:
        return (id(problem.cloth), *step_shape(problem, self.simulator.needs_contact))


def first_capacity(simulator: NetworkStepper, problem: StepProblem) -> Capacity:
    """Places to begin with: what the step needs, and a quarter more."""
    obstacle = problem.step.obstacle
    if obstacle is None:
        return Capacity(1, 1)
    seen = simulator.rules.enter(problem)
    nearest = find_nearest(seen.cloth, seen.state.pos, obstacle, simulator.body_radius)
    near = torch.isfinite(nearest.dist)
    return more_capacity((int(near.sum()), len(nearest.vertex[near].unique()), 0), problem)


def more_capacity(num_found: tuple[int, int, int], problem: StepProblem) -> Capacity:
    """Places for what a step has found, and a quarter more."""
    num_cloth, obstacle = problem.cloth.num_vertices, problem.step.obstacle
    num_body, num_faces = (0, 0) if obstacle is None else (len(obstacle.pos), len(obstacle.faces))
    return capacity_for(num_found, (num_cloth, min(num_cloth, num_body), num_faces))


def network_of(stepper: Stepper) -> NetworkStepper | None:
    """The simulator that takes a stepper's steps, refined or not, in fixed shapes or not; None where a solver does."""
    stepper = unrefined(stepper)
    simulator: NetworkStepper | None = getattr(stepper, "simulator", None)
    return simulator


class _Plan:
    """A step made ready for problems of one shape: its input and output memory and how it is run."""

    def __init__(
        self, simulator: NetworkStepper, problem: StepProblem, prepared: Prepared, capacity: Capacity, mode: str
    ) -> None:
        assert prepared.static is not None
        self._simulator, self._prepared, self._precision = simulator, prepared, simulator.network.precision
        potential = self._potential()
        self._constants = Constants(problem, potential)
        self.layout: StaticLayout = lay_out(prepared.static, capacity, problem.step.attachments)
        self._inputs = InputMemory(self._read(problem))
        memory = self._inputs.tensors
        settled = None if potential is None else settled_potential(potential, problem)
        run: Run = FixedStep(simulator, self.layout, problem, dense=mode == "compiled", potential=settled)
        if mode != "fixed":
            run(*memory)  # what is computed once per cloth is computed now: a trace has no values for it
            run = trace(run, memory)
        if mode == "compiled":
            run = torch.compile(run, fullgraph=True, dynamic=False)
        if mode != "fixed" and has_graphs(memory[0].device):
            with products(self._precision):
                run = CudaGraph(run, memory)
        self._run = run

    def is_stale(self, problem: StepProblem, prepared: Prepared) -> bool:
        """Whether a problem of the same shape needs another plan after all."""
        same = prepared is self._prepared and self._simulator.network.precision == self._precision
        return not same or not self._constants.hold(problem, self._potential())

    def take(self, problem: StepProblem) -> StepResult:
        """The step's result, in memory that the next call writes to."""
        memory = self._inputs.load(self._read(problem))
        with products(self._precision):
            return StepResult(*self._run(*memory))

    def _potential(self) -> Potential | None:
        return self._simulator.potential if self._simulator.looks_at_potential else None

    def _read(self, problem: StepProblem) -> list[Tensor]:
        return step_inputs(problem, self._simulator.needs_contact)


def _read(counts: Tensor) -> tuple[int, int, int]:
    edges, vertices, faces = counts.tolist()
    return edges, vertices, faces
