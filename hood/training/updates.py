"""What the weights of a network are told by one update: gradients and measures, operation by operation or as one recorded
function of fixed shapes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.func import functional_call

from hood.cloth.cloth import Cloth
from hood.cloth.state import State
from hood.energies.potential import Potential, relative_gradient
from hood.energies.problem import StepProblem
from hood.energies.self_contact import for_networks
from hood.model.features.inputs import Inputs
from hood.model.features.normalizer import RunningNormalizer
from hood.model.graph.static_shapes import Capacity, StaticLayout, lay_out
from hood.native import features as native
from hood.rollouts.adjoint import following, step_gap
from hood.solver.newton import NewtonSettings
from hood.solver.vertex.block_jacobi import incidence_of
from hood.steppers.network import NetworkStepper, Prediction, Prepared
from hood.steppers.protocol import Stopwatch, timed
from hood.steppers.static_shapes.cuda_graph import CudaGraph, InputMemory, Run, has_graphs, trace
from hood.steppers.static_shapes.problem import altered, problem_from, settled_potential, step_inputs, step_shape
from hood.steppers.static_shapes.simulator import first_capacity, more_capacity, see
from hood.tensors.dense import inputs_followed, products
from hood.training.curriculum import CollisionRamp, contact_weight, with_weight_on_device
from hood.training.optimiser import can_be_taken_back
from hood.training.outcome import TOLD, Acceptance, Figures, Signal, Update, figures_of, outcome_of, surrogate_of
from hood.training.settings import TrainerSettings, uncounted
from hood.training.slots import TrainingStep, is_lost

#: Told of an update: what had to be solved, by which potential, the prediction, and its residual (B,).
Observer = Callable[[StepProblem, Potential, Prediction, Tensor], None]


def plain_update(
    simulator: NetworkStepper,
    model: nn.Module,
    part: TrainingStep,
    potential: Potential,
    signal: Signal,
    torn_strain: float,
    clock: Stopwatch | None = None,
    observe: Observer | None = None,
    unroll: int = 1,
) -> Update:
    """One step of all scenes of ``part``, operation by operation.

    Args:
        model: the simulator, or what processes that share a batch have around it.
        unroll: steps that the loss looks at, this one included.
        torn_strain: see :func:`hood.training.slots.is_lost`.
    """
    cloth, state = part.cloth, part.state
    with timed(clock, "search"):
        asked = StepProblem(cloth, state, part.step, gravity=simulator.gravity)
        problem = potential.prepare(simulator.rules.judged(asked))
    shown = problem if problem.state is state else replace(problem, state=state)
    prediction = model(shown, part.prepared, clock)
    next_pos = prediction.next_pos.detach()
    acc = prediction.acc.detach() if shown is problem else problem.acceleration(next_pos)
    with timed(clock, "losses"):
        gradient, energies = potential.gradient(problem, next_pos, acc)
        gradient = gradient * cloth.free.unsqueeze(1)
        residual = relative_gradient(problem, gradient)
    if observe is not None:
        observe(problem, potential, prediction, residual)
    further = None
    if unroll > 1:
        further = further_loss(simulator, part, potential, signal, torn_strain, (problem, prediction), unroll - 1, clock)

    def backward() -> None:
        surrogate = surrogate_of(problem, prediction, gradient, residual, signal)
        if further is not None:
            surrogate = surrogate + further
        if model is not simulator:
            # A share without body edges leaves their networks out; all processes must reduce the same parameters.
            surrogate = surrogate + 0.0 * sum(p.sum() for p in simulator.parameters())
        surrogate.backward()

    return Update(
        next_pos,
        simulator.next_velocity(shown, prediction).detach(),
        figures_of(problem, energies, acc, prediction.acc.detach(), residual, signal),
        tuple(energies),
        outcome_of(cloth, next_pos, torn_strain),
        backward,
    )


#: How near the minimum is come to that a further step is measured from.
_NEAR = NewtonSettings(target_rg=1e-2, max_iterations=50)


def further_loss(
    simulator: NetworkStepper,
    part: TrainingStep,
    potential: Potential,
    signal: Signal,
    torn_strain: float,
    first: tuple[StepProblem, Prediction],
    num_steps: int,
    clock: Stopwatch | None = None,
) -> Tensor:
    """The loss () of the steps that follow the ``first`` one, each from the state that the network itself came to.

    Positions and velocities carry gradients from step to step. A minimum of the potential depends on the state that a step
    begins with: to lower it would be to come to other states, not to better steps. So a further step has its gap as loss, see
    :func:`hood.rollouts.adjoint.step_gap`, weighed by the signal; that of an exact network is zero, and so is its
    gradient. Rollouts go on by the first step alone, and statistics count that alone. Scenes that are lost, or whose motion
    ends, have no further loss.
    """
    cloth, assumed = part.cloth, part.ahead
    assert assumed is not None
    problem, prediction = first
    pos, vel = prediction.next_pos, assumed.velocity(simulator.next_velocity(problem, prediction))
    total, goes_on = pos.new_zeros(()), torch.ones(part.cloth.num_scenes, dtype=torch.bool, device=pos.device)
    with uncounted(simulator):
        for number in range(1, num_steps + 1):
            step, there = assumed.step(number, pos)
            goes_on = goes_on & there & ~is_lost(cloth, pos.detach(), torn_strain)
            if not bool(goes_on.any()) or not bool(pos.isfinite().all()):
                break
            state = State(pos, vel, part.state.origin)
            with timed(clock, "search"):
                taken, followed = following(potential, StepProblem(cloth, state, step, gravity=simulator.gravity))
            with inputs_followed():
                prediction = simulator.predict(followed, part.prepared, clock)
            pos, vel = prediction.next_pos, simulator.next_velocity(followed, prediction)
            with timed(clock, "losses"):
                gradient, _ = potential.gradient(taken, pos.detach())
                weight = signal.weight(taken, relative_gradient(taken, gradient * cloth.free.unsqueeze(1)))
                above = step_gap(potential, taken, followed, pos, _NEAR)
                total = total + torch.where(goes_on & above.isfinite(), weight * above, 0.0).sum()
    return total


#: Scenes of an update that graphs take one after the other, unless asked for. To start the 6,000 kernels of a plain update
#: takes about as long as eight graphs of 1,000 vertices are computed; that follows from counts and was not measured.
MOST_SCENES = 8


class CapturedUpdates:
    """Takes the updates of plain scenes with fixed shapes: search, features, network, energies and the way back to the weights
    are one function of tensors, which waits for nothing on the host.

    One is made for every garment, and again for its mirror image: what is drawn anew (size, fabric, body) is among its inputs.
    The scenes of a batch take it one after the other. What comes out is what :func:`plain_update` gives, up to rounding; but
    it is for the device to say what becomes of it. A rollout that is lost, or that finds more than there are places for, stays
    where it was and gives no gradient until the host has read of it and begins the next one.

    Args:
        simulator: one that :func:`refusal` has nothing against.
        mode: ``fixed``: one operation after the other; ``captured``, on CUDA: a graph of them, replayed at once.
        torn_strain: see :func:`hood.training.slots.is_lost`.
    """

    def __init__(self, simulator: NetworkStepper, signal: Signal, torn_strain: float, mode: str) -> None:
        self.simulator, self.signal, self.torn_strain, self.mode = simulator, signal, torn_strain, mode
        self._plans: dict[Any, _Plan] = {}
        self._found: dict[Any, tuple[int, int, int]] = {}  # most of an update, where there was no room for it
        self.running = torch.ones((), dtype=torch.bool, device=simulator.gravity.device)

    @property
    def reads_late(self) -> bool:
        """Whether many updates are begun before the host reads what came of them."""
        return self.mode == "captured"

    def __call__(self, parts: Sequence[TrainingStep], potential: Potential) -> Update:
        """One update of the scenes, one after the other; the gradients of their mean are with the parameters, finite always.

        Args:
            potential: the same in every update, but for its weight of contact.

        Raises:
            ValueError: a scene or the potential has no form of fixed shapes; the message says what to use.
        """
        asked = [(*self._made_ready(part, potential), self.running if part.runs is None else part.runs) for part in parts]
        outcomes = [plan.take(problem, potential, runs, len(parts) == 1) for plan, problem, runs in asked]
        numbers, verdicts, gradient = (
            _stacked([getattr(one, name) for one in outcomes]) for name in ("numbers", "acceptance", "gradient")
        )
        (goes_on, used, counts), measured = verdicts.unbind(dim=1), numbers[:, :-TOLD]
        if len(outcomes) > 1:
            gradient = gradient.sum(dim=0) / used.sum().clamp_min(1)
            measured = torch.where(counts.unsqueeze(1), measured, 0.0).sum(dim=0) / counts.sum()
            usable = (used == counts).all() & used.any()
        else:
            gradient, measured, usable = gradient[0], measured[0], used[0]
        parameters = list(self.simulator.parameters())
        for parameter, values in zip(parameters, gradient.split([p.numel() for p in parameters]), strict=True):
            parameter.grad = values.view_as(parameter)
        return Update(
            _joined([one.next_pos for one in outcomes]),
            _joined([one.next_vel for one in outcomes]),
            measured,
            outcomes[0].energies,
            numbers[:, -TOLD:],
            acceptance=Acceptance(goes_on, usable),
            plans=[plan for plan, _, _ in asked],
        )

    def make_room(self, update: Update, figures: Figures) -> None:
        """More places where an update found more than there were."""
        for plan, counts in zip(update.plans, figures.num_found, strict=True):
            if not plan.layout.capacity.holds(counts):
                most = map(max, counts, self._found.get(plan.key, counts))
                self._found[plan.key] = cast(tuple[int, int, int], tuple(most))
                self._plans = {key: known for key, known in self._plans.items() if known is not plan}

    def _made_ready(self, part: TrainingStep, potential: Potential) -> tuple[_Plan, StepProblem]:
        problem = StepProblem(part.cloth, part.state, part.step, gravity=self.simulator.gravity)
        if problem.num_scenes > 1 or problem.step.attachments is not None:
            raise ValueError("scenes with fasteners have no update of fixed shapes: use trainer.step=plain")
        key = (part.kind, _shape(problem))
        if key not in self._plans:
            found = self._found.get(key)
            capacity = first_capacity(self.simulator, problem) if found is None else more_capacity(found, problem)
            self._plans[key] = _Plan(self, key, problem, part.prepared, potential, capacity)
        return self._plans[key], problem

    @property
    def pool(self) -> Any:
        """Memory that the graphs have in common: no two of them run at once."""
        return next((plan.pool for plan in self._plans.values() if plan.pool is not None), None)


@dataclass(frozen=True)
class _Outcome:
    next_pos: Tensor
    next_vel: Tensor
    numbers: Tensor  # (M + 9,): Update.measured, then a row of Update.told
    acceptance: Tensor  # (3,) bool: whether the rollout goes on, whether its gradient is used, whether the scene counts
    gradient: Tensor  # (P,) of all parameters, one after the other; zero where it is not used
    energies: tuple[str, ...]


class _Plan:
    """The update made ready for scenes of one shape."""

    def __init__(
        self,
        owner: CapturedUpdates,
        key: Any,
        problem: StepProblem,
        prepared: Prepared,
        potential: Potential,
        capacity: Capacity,
    ) -> None:
        assert prepared.static is not None
        simulator, self.key = owner.simulator, key
        self.layout: StaticLayout = lay_out(prepared.static, capacity, None)
        self._simulator = simulator
        self._inputs = InputMemory(self._read(problem, potential, owner.running))
        self._statistics = list(_statistics(simulator).values())
        function = _Function(owner, self.layout, problem, settled_potential(potential, problem))
        self._energies = function.energies
        memory = [*self._inputs.tensors, *simulator.parameters(), *self._statistics]
        self._memory, self.pool = memory, owner.pool
        run: Run = function
        if owner.mode == "captured":
            with products(simulator.network.precision):
                run = CudaGraph(trace(run, memory, fold=False), memory, self.pool)
            self.pool = run.pool
        self._run = run

    def take(self, problem: StepProblem, potential: Potential, runs: Tensor, alone: bool) -> _Outcome:
        """The update.

        Args:
            runs: () bool: the rollout is not one that waits for the next.
            alone: the gradient is used before the next update is computed.
        """
        self._inputs.load(self._read(problem, potential, runs))
        with products(self._simulator.network.precision):
            found = self._run(*self._memory)
        if self._statistics:
            torch._foreach_copy_(self._statistics, found[5:])
        # The next update writes to the same memory.
        next_pos, next_vel, numbers, acceptance = (value.clone() for value in found[:4])
        return _Outcome(next_pos, next_vel, numbers, acceptance, found[4] if alone else found[4].clone(), self._energies)

    def _read(self, problem: StepProblem, potential: Potential, runs: Tensor) -> list[Tensor]:
        weight = problem.state.pos.new_full((), contact_weight(potential))
        return [runs, weight, *_values(problem.cloth).values(), *step_inputs(problem, surface=True)]


class _Function:
    """``next_pos, next_vel, numbers, acceptance, gradient, *statistics = function(*inputs)``, see :class:`_Outcome`."""

    def __init__(self, owner: CapturedUpdates, layout: StaticLayout, like: StepProblem, potential: Potential) -> None:
        simulator = owner.simulator
        self.energies, self._owner, self._layout, self._like = tuple(potential.terms), owner, layout, like
        self._potential, self._looks = potential, simulator.looks_at_potential
        self.parameters, self._statistics = dict(simulator.named_parameters()), _statistics(simulator)
        self._values = list(_values(like.cloth))
        self._module = _Signal(self)
        # Tables that are kept with the cloth's faces are made now: a trace has no values for them.
        self._incidence = incidence_of(like.cloth)

    def __call__(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        given, count = list(inputs), len(self.parameters)
        before = given[len(given) - len(self._statistics) :]
        statistics = [value.clone() for value in before]
        del given[len(given) - len(self._statistics) :]
        parameters = [value.detach().requires_grad_() for value in given[len(given) - count :]]
        del given[len(given) - count :]
        state = {f"simulator.{name}": value for name, value in zip(self.parameters, parameters, strict=True)}
        state |= {f"simulator.{name}": value for name, value in zip(self._statistics, statistics, strict=True)}
        with native.in_torch(), torch.enable_grad():
            surrogate, found = functional_call(self._module, state, tuple(given[1:]))
            gradients = torch.autograd.grad(surrogate, parameters, allow_unused=True, materialize_grads=True)
        next_pos, next_vel, measured, outcome, num_found = found
        gradient, energies = torch.cat([value.flatten() for value in gradients]), measured[: len(self.energies)]
        counts = given[0] & self._has_room(num_found)
        used = counts & gradient.isfinite().all() & energies.sum().isfinite()
        goes_on = counts & (outcome[0] == 0)
        began = given[2 + len(self._values) :][:2]  # positions and velocities before the step
        pos, vel = (torch.where(goes_on, new, old) for new, old in zip((next_pos, next_vel), began, strict=True))
        acceptance = torch.stack([goes_on, used, counts])
        numbers = torch.cat([value.to(measured) for value in (measured, outcome, acceptance[1:].flip(0), num_found)])
        kept = [torch.where(used, new, old) for new, old in zip(statistics, before, strict=True)]
        return (pos, vel, numbers, acceptance, torch.where(used, gradient, 0.0), *kept)

    def _has_room(self, num_found: Tensor) -> Tensor:
        """() bool: :meth:`hood.model.graph.static_shapes.Capacity.holds` what was found (3,)."""
        edges, vertices, faces = num_found.unbind()
        capacity = self._layout.capacity
        return (edges < capacity.edges) & (vertices < capacity.vertices) & (faces <= capacity.faces)

    def look(self, simulator: NetworkStepper, weight: Tensor, *values: Tensor) -> tuple[Tensor, tuple[Tensor, ...]]:
        """The number whose gradient trains; positions, velocities, what was measured, how it ends, and what was found."""
        names, owner = self._values, self._owner
        cloth = _with_values(self._like.cloth, dict(zip(names, values[: len(names)], strict=True)))
        problem, incidence = problem_from(altered(self._like, cloth=cloth), values[len(names) :])
        potential = self._potential if self._looks else with_weight_on_device(self._potential, weight)
        shown = for_networks(potential) if self._looks else None
        dense = owner.mode != "fixed"
        problem, seen, graph, num_found = see(simulator, self._layout, problem, incidence, potential, dense)
        rows = Inputs(cloth, problem.state, problem.step, None, graph).make_edge_rows()
        sight = simulator.look(problem, seen, graph, shown, rows)
        prediction = simulator.advance(problem, seen, sight, *simulator.features(sight.inputs))
        next_pos, acc = prediction.next_pos.detach(), prediction.acc.detach()
        gradient, energies = potential.gradient(problem, next_pos, acc)
        gradient = gradient * cloth.free.unsqueeze(1)
        residual = relative_gradient(problem, gradient)
        surrogate = surrogate_of(problem, prediction, gradient, residual, owner.signal)
        measured = figures_of(problem, energies, acc, acc, residual, owner.signal)
        (outcome,) = outcome_of(cloth, next_pos, owner.torn_strain)
        return surrogate, (next_pos, simulator.next_velocity(problem, prediction).detach(), measured, outcome, num_found)


class _Signal(nn.Module):
    """:meth:`_Function.look` of a simulator whose parameters and statistics are other tensors for the moment."""

    def __init__(self, function: _Function) -> None:
        super().__init__()
        self.simulator, self._function = function._owner.simulator, function

    def forward(self, *values: Tensor) -> tuple[Tensor, tuple[Tensor, ...]]:
        return self._function.look(self.simulator, *values)


def _stacked(values: list[Tensor]) -> Tensor:
    return torch.stack(values) if len(values) > 1 else values[0].unsqueeze(0)


def _joined(values: list[Tensor]) -> Tensor:
    return torch.cat(values) if len(values) > 1 else values[0]


def make_captured(
    simulator: NetworkStepper, settings: TrainerSettings, torn_strain: float, scenes: int = 1, ranks: int = 1
) -> CapturedUpdates | None:
    """Who takes the updates that have a form of fixed shapes, by ``trainer.step``; None: nobody does.

    By itself that is a CUDA graph, where there are graphs, the model has such updates, and one has few ``scenes``.

    Raises:
        ValueError: what is asked for cannot be had.
    """
    mode, refused = settings.step, refusal(simulator, settings.collision)
    if not can_be_taken_back(settings.optimizer):
        refused = "steps of trainer.optimizer must be undone on the device, which adam, muon, torch.optim.Adam and AdamW can"
    if settings.unroll > 1:
        refused = "further steps (trainer.unroll) are taken operation by operation"
    if ranks > 1 or settings.activation_checkpointing:
        refused = "several processes and trainer.activation_checkpointing have updates operation by operation alone"
    if mode == "auto":
        mode = "captured" if has_graphs(simulator.gravity.device) and not refused and scenes <= MOST_SCENES else "plain"
    if mode == "plain":
        return None
    if mode == "captured" and not has_graphs(simulator.gravity.device):
        raise ValueError("trainer.step=captured needs device=cuda, a CPU has no graphs to replay; use fixed or plain")
    if refused:
        raise ValueError(f"trainer.step={mode}: {refused}; use trainer.step=plain")
    return CapturedUpdates(simulator, Signal(settings.signal), torn_strain, mode)


def refusal(simulator: NetworkStepper, ramp: CollisionRamp) -> str | None:
    """Why a training has no updates of fixed shapes; None where it has."""
    if simulator.layer_radius is not None:
        return "the model has edges between layers of cloth, as many as a step finds"
    if simulator.rules.frame_dt is not None:
        return "the model counts in frames"
    if simulator.network.kernels != "torch":
        return "trainer.kernels=compiled computes outside of torch (trainer.kernels=torch does not)"
    if simulator.looks_at_potential and ramp.start != ramp.end:
        return "the model looks at a potential whose weight of contact rises"
    return None


def _statistics(simulator: NetworkStepper) -> dict[str, Tensor]:
    """What normalisers count, by its name."""
    return {
        f"{name}.{key}": value
        for name, module in simulator.named_modules()
        if isinstance(module, RunningNormalizer)
        for key, value in module.named_buffers()
    }


def _values(cloth: Cloth) -> dict[str, Tensor]:
    """What differs between cloths of one garment: all but the topology."""
    given = {field.name: getattr(cloth, field.name) for field in fields(cloth)}
    return {
        name: value
        for name, value in given.items()
        if isinstance(value, Tensor) and (value.is_floating_point() or name == "pinned")
    }


def _with_values(like: Cloth, values: Mapping[str, Tensor]) -> Cloth:
    """The cloth with other values, and without what was derived from its own."""
    made = object.__new__(Cloth)
    for field in fields(like):
        object.__setattr__(made, field.name, values.get(field.name, getattr(like, field.name)))
    return made


def _shape(problem: StepProblem) -> tuple[Any, ...]:
    values = _values(problem.cloth)
    return (*step_shape(problem, surface=True), tuple(values), tuple(value.shape for value in values.values()))
