"""A simulator whose step has fixed shapes: taken operation by operation, as a CUDA graph, or compiled."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from hood.dynamics.fixed_step import FixedStep, StepResult, check_model, step_inputs, step_shape
from hood.dynamics.frames import Relaxing
from hood.dynamics.refine import unrefined
from hood.dynamics.simulator import Prediction, Prepared, Simulator
from hood.dynamics.stepper import Stepper
from hood.dynamics.stopwatch import Stopwatch, timed
from hood.dynamics.trace import trace
from hood.graph.fixed import Capacity, Layout, capacity_for, lay_out
from hood.losses.problem import StepProblem
from hood.nn import triton_edge
from hood.nn.precision import check_precision, products
from hood.scene.cloth import Cloth
from hood.scene.contact import find_nearest
from hood.scene.state import Attachments

#: How a step of fixed shapes is taken.
MODES = ("fixed", "captured", "compiled")
#: Steps of different shapes (cloths, with and without pins) that are kept ready.
_MAX_PLANS = 4
#: Runs before a capture, in which libraries choose their kernels and take their memory.
_WARM_UP = 3

Run = Callable[..., tuple[Tensor, ...]]


@dataclass(frozen=True)
class StepPrediction(Prediction):
    """A prediction that comes with its velocity: integration is part of the step."""

    next_vel: Tensor | None = None  # (V, 3) m/s


class CapturedSimulator:
    """Takes the steps of ``simulator`` with fixed shapes; its positions are the simulator's own up to rounding.

    Body edges get the places that the first step needs and a quarter more. A step that finds no room is repeated with
    more of them: their number is read at the end of the step, with the result, never inside. Weights and cloth are read
    when the step of a cloth is first taken; make a new one after changing them.

    Args:
        simulator: in evaluation mode, of paper features.
        mode: ``fixed``: one operation after the other; ``captured``: a CUDA graph of them, replayed at once; ``compiled``:
            through torch.compile, and on CUDA captured as well.
        capacity: places to begin with.

    Raises:
        ValueError: an unknown mode, ``captured`` without CUDA, ``compiled`` of compiled kernels, or a model whose step has no
            form of fixed shapes.
    """

    times: tuple[str, ...] = ("step", "rest", "total")

    def __init__(self, simulator: Simulator, mode: str = "captured", capacity: Capacity | None = None) -> None:
        if mode not in MODES:
            raise ValueError(f"step is {mode!r}; choose plain, {', '.join(MODES[:-1])} or {MODES[-1]}")
        if mode == "captured" and simulator.gravity.device.type != "cuda":
            raise ValueError("step=captured needs device=cuda, a CPU has no graphs to replay; use step=fixed or step=plain")
        if mode == "compiled" and simulator.network.kernels != "torch":
            raise ValueError("step=compiled compiles torch's operations and needs kernels=torch; or use step=plain")
        check_model(simulator)
        check_precision(simulator.network.precision, simulator.gravity.device)
        self.simulator, self.mode = simulator, mode
        self.gravity, self.config, self.metrics = simulator.gravity, simulator.config, simulator.metrics
        self._capacity = capacity
        self._plans: dict[Any, _Plan] = {}

    @property
    def relaxing(self) -> Relaxing:
        return self.simulator.relaxing

    def prepare(self, cloth: Cloth, rest_pos: Any) -> Prepared:
        """As :meth:`hood.dynamics.simulator.Simulator.prepare`."""
        return self.simulator.prepare(cloth, rest_pos)

    def search(self, problem: StepProblem) -> StepProblem:
        """The problem as it is: the search is part of the step."""
        return problem

    @torch.no_grad()
    def predict(self, problem: StepProblem, prepared: Prepared, watch: Stopwatch | None = None) -> StepPrediction:
        """Positions, accelerations and velocities at t + 1."""
        with timed(watch, "step"):
            self.simulator.rules.check(problem.step.dt)
            plan = self._plan(problem, prepared)
            result = plan.take(problem)
            counts = _read(result.num_found)
            while not plan.layout.capacity.holds(counts):
                plan = self._make_plan(problem, prepared, capacity_for(counts, _limits(problem)))
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
        plan = self._plans.get(_key(problem))
        if plan is None or plan.is_stale(problem, prepared, self.simulator.network.precision):
            plan = self._make_plan(problem, prepared, self._capacity or self._first_capacity(problem))
        return plan

    def _make_plan(self, problem: StepProblem, prepared: Prepared, capacity: Capacity) -> _Plan:
        self._plans.pop(_key(problem), None)
        while len(self._plans) >= _MAX_PLANS:
            del self._plans[next(iter(self._plans))]
        plan = _Plan(self.simulator, problem, prepared, capacity, self.mode)
        self._plans[_key(problem)] = plan
        return plan

    def _first_capacity(self, problem: StepProblem) -> Capacity:
        obstacle = problem.step.obstacle
        if obstacle is None:
            return Capacity(1, 1)
        seen = self.simulator.rules.enter(problem)
        nearest = find_nearest(seen.cloth, seen.state.pos, obstacle, self.simulator.body_radius)
        near = torch.isfinite(nearest.dist)
        return capacity_for((int(near.sum()), len(nearest.vertex[near].unique())), _limits(problem))


def network_of(stepper: Stepper) -> Simulator | None:
    """The simulator that takes a stepper's steps, refined or not, in fixed shapes or not; None where a solver does."""
    stepper = unrefined(stepper)
    if isinstance(stepper, CapturedSimulator):
        return stepper.simulator
    return stepper if isinstance(stepper, Simulator) else None


class _Plan:
    """A step made ready for problems of one shape: its input and output memory and how it is run."""

    def __init__(self, simulator: Simulator, problem: StepProblem, prepared: Prepared, capacity: Capacity, mode: str) -> None:
        assert prepared.static is not None
        self._prepared, self._cloth, self._precision = prepared, problem.cloth, simulator.network.precision
        attachments = problem.step.attachments
        self._attachments = None if attachments is None else (attachments.edges.clone(), attachments.active.clone())
        self.layout: Layout = lay_out(prepared.static, capacity, attachments)
        self._inputs = [value.clone() for value in step_inputs(problem)]
        self._given: list[tuple[Tensor, float]] = [(value, torch.nan) for value in self._inputs]
        on_cuda = self._inputs[0].device.type == "cuda"
        self._step = FixedStep(simulator, self.layout, problem, dense=mode == "compiled")
        run: Run = self._step
        if mode == "compiled" or (mode == "captured" and not _has_fused_edges(simulator, self._inputs[0])):
            run = trace(run, self._inputs)
        if mode == "compiled":
            run = torch.compile(run, fullgraph=True, dynamic=False)
        if mode != "fixed" and on_cuda:
            with products(self._precision):
                run = _CudaGraph(run, self._inputs)
        self._run = run

    def is_stale(self, problem: StepProblem, prepared: Prepared, precision: str) -> bool:
        """Whether a problem of the same shape needs another plan after all."""
        same = problem.cloth is self._cloth and prepared is self._prepared and precision == self._precision
        return not same or not _same_attachments(self._attachments, problem.step.attachments)

    def take(self, problem: StepProblem) -> StepResult:
        """The step's result, in memory that the next call writes to."""
        values = step_inputs(problem)
        for memory, value, (given, version) in zip(self._inputs, values, self._given, strict=True):
            if value is not given or _version(value) != version:
                memory.copy_(value)
        self._given = [(value, _version(value)) for value in values]
        with products(self._precision):
            return StepResult(*self._run(*self._inputs))


class _CudaGraph:
    """A function of tensors that stay in place, recorded once: a call starts all of its kernels at once."""

    def __init__(self, function: Run, inputs: Sequence[Tensor]) -> None:
        # Kept for the memory it holds, which the graph reads without knowing of.
        self._function, self._inputs = function, list(inputs)
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(_WARM_UP):
                function(*self._inputs)
        torch.cuda.current_stream().wait_stream(stream)
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph):
            self._outputs = function(*self._inputs)

    def __call__(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        same = all(a is b for a, b in zip(inputs, self._inputs, strict=True))
        assert same, "a CUDA graph reads the memory it was recorded with"
        self._graph.replay()
        return self._outputs


def _has_fused_edges(simulator: Simulator, like: Tensor) -> bool:
    """Whether edges are updated by kernels of our own, which a graph can hold and a trace cannot look into."""
    precision = torch.bfloat16 if simulator.network.precision == "bf16" else like.dtype
    return triton_edge.applies(like.new_empty(1, simulator.config["latent_dim"], dtype=precision))


def _version(value: Tensor) -> float:
    """Changes with what the tensor holds; of tensors that keep no count, unequal to itself."""
    return torch.nan if value.is_inference() else value._version


def _key(problem: StepProblem) -> tuple[Any, ...]:
    return (id(problem.cloth), *step_shape(problem))


def _same_attachments(known: tuple[Tensor, Tensor] | None, now: Attachments | None) -> bool:
    if known is None or now is None:
        return known is None and now is None
    return torch.equal(known[0], now.edges) and torch.equal(known[1], now.active)


def _limits(problem: StepProblem) -> tuple[int, int]:
    num_cloth = problem.cloth.num_vertices
    obstacle = problem.step.obstacle
    return num_cloth, min(num_cloth, 0 if obstacle is None else len(obstacle.pos))


def _read(counts: Tensor) -> tuple[int, int]:
    edges, vertices = counts.tolist()
    return edges, vertices
