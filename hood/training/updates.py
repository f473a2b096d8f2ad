"""What the weights of a network are told by one update: gradients and measures, operation by operation or as one recorded
function of fixed shapes."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor, nn
from torch.func import functional_call

from hood.cloth.cloth import Cloth
from hood.cloth.state import centres_of
from hood.energies.potential import Potential, relative_gradient
from hood.energies.problem import StepProblem
from hood.energies.self_contact import for_networks
from hood.model.features.inputs import Inputs
from hood.model.features.normalizer import RunningNormalizer
from hood.model.graph.static_shapes import Capacity, StaticLayout, lay_out
from hood.native import features as native
from hood.solver.vertex.block_jacobi import incidence_of
from hood.steppers.network import NetworkStepper, Prediction, Prepared
from hood.steppers.protocol import Stopwatch, timed
from hood.steppers.static_shapes.cuda_graph import CudaGraph, InputMemory, Run, has_graphs, trace
from hood.steppers.static_shapes.problem import altered, problem_from, settled_potential, step_inputs, step_shape
from hood.steppers.static_shapes.simulator import first_capacity, more_capacity, see
from hood.tensors.precision import products
from hood.training.curriculum import CollisionRamp, contact_weight, with_weight_on_device
from hood.training.log import output_spread
from hood.training.settings import Signal, TrainerSettings
from hood.training.slots import TrainingStep, is_lost

#: Told of an update: what had to be solved, by which potential, the prediction, and its residual (B,).
Observer = Callable[[StepProblem, Potential, Prediction, Tensor], None]


class Figures(NamedTuple):
    """What the host is told of an update."""

    measured: dict[str, float]  # means of the energies, then what :data:`MEASURED` says
    lost: list[bool]  # by scene: rollouts that end here
    centres: Tensor  # (B, 3) m: means of the vertices of a scene where it leads
    norm: float  # of the gradients; NaN: none were given
    num_found: list[tuple[int, int, int]]  # by scene, see :class:`hood.steppers.static_shapes.simulator.StepResult`


@dataclass(frozen=True)
class Update:
    """Where an update leads its scenes, and what was measured; the gradients are with the parameters."""

    next_pos: Tensor  # (V, 3) m
    next_vel: Tensor  # (V, 3) m/s
    measured: Tensor  # (M,) means of the energies in the order of ``energies``, then what :data:`MEASURED` says
    energies: tuple[str, ...]
    told: Tensor  # (B, 4) :func:`outcome_of`, or (B, 7) with what was found
    backward: Callable[[], None] | None = None  # computes the gradients, where that is not done
    holds: Callable[[Figures], bool] = lambda figures: True  # False: there was no room; the update is to be taken again

    def read(self, norm: Tensor | None = None) -> Figures:
        """The figures, with the ``norm`` () of the gradients; waits for the device, once."""
        given = [self.told.flatten(), self.measured, *([] if norm is None else [norm.reshape(1)])]
        values, count = torch.cat([value.to(self.measured) for value in given]).cpu(), self.told.numel()
        told, measured = values[:count].reshape(self.told.shape), values[count:].tolist()
        found = [cast(tuple[int, int, int], tuple(map(int, row))) for row in told[:, 4:].tolist()]
        return Figures(
            dict(zip((*self.energies, *MEASURED), measured, strict=False)),
            (told[:, 0] > 0).tolist(),
            told[:, 1:4],
            math.nan if norm is None else measured[-1],
            found,
        )


#: What is measured of an update beside the energies: the mean loss of its scenes, the median of their rg, and the spread of the
#: output; of scenes that are updated one after the other the means of these.
MEASURED = ("loss", "relative_gradient", "output_spread")


def figures_of(
    problem: StepProblem, energies: Mapping[str, Tensor], acc: Tensor, output: Tensor, residual: Tensor, signal: Signal
) -> Tensor:
    """:attr:`Update.measured` (M,).

    Args:
        energies: (B,) [J] by name.
        acc: (V, 3) m/s² of the step; ``output`` those that the network gives.
        residual: (B,), the relative gradient.
    """
    means = [value.mean() for value in energies.values()]
    loss = signal.loss(problem, energies, acc, residual).mean()
    return torch.stack([*means, loss, residual.median(), output_spread(output, problem.cloth.free).to(loss)])


def outcome_of(cloth: Cloth, next_pos: Tensor, torn_strain: float) -> Tensor:
    """(B, 4): whether a rollout ends here (:func:`hood.training.slots.is_lost`), and the centre of its cloth [m]."""
    lost = is_lost(cloth, next_pos, torn_strain)
    return torch.cat([lost.to(next_pos).unsqueeze(1), centres_of(next_pos, cloth.vertex_scene, len(lost))], dim=1)


def surrogate_of(problem: StepProblem, prediction: Prediction, gradient: Tensor, residual: Tensor, signal: Signal) -> Tensor:
    """A number () whose gradient is that of the training signal: the energies' own is put in at the output, so that no graph
    through them is kept.

    Args:
        gradient: (V, 3) N, of the energies at the prediction; zero at vertices that are not free.
        residual: (B,), the relative gradient.
    """
    scene = problem.cloth.vertex_scene
    weight = signal.weight(problem, residual)
    surrogate = (prediction.next_pos * (gradient * weight[scene].unsqueeze(1))).sum()
    for pos, force in prediction.early:  # every pass answers for where it leads itself
        weight = signal.weight(problem, relative_gradient(problem, force))
        surrogate = surrogate - (pos * (force * weight[scene].unsqueeze(1))).sum()
    return surrogate


def plain_update(
    simulator: NetworkStepper,
    model: nn.Module,
    part: TrainingStep,
    potential: Potential,
    signal: Signal,
    torn_strain: float,
    clock: Stopwatch | None = None,
    observe: Observer | None = None,
) -> Update:
    """One step of all scenes of ``part``, operation by operation.

    Args:
        model: the simulator, or what processes that share a batch have around it.
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

    def backward() -> None:
        surrogate = surrogate_of(problem, prediction, gradient, residual, signal)
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


#: Scenes of an update that graphs take one after the other, unless asked for. To start the 6,000 kernels of a plain update
#: takes about as long as eight graphs of 1,000 vertices are computed; that follows from counts and was not measured.
MOST_SCENES = 8


class CapturedUpdates:
    """Takes the updates of plain scenes with fixed shapes: search, features, network, energies and the way back to the weights
    are one function of tensors, which waits for nothing on the host.

    One is made for every garment, and again for its mirror image: what is drawn anew (size, fabric, body) is among its inputs.
    The scenes of a batch take it one after the other. What comes out is what :func:`plain_update` gives, up to rounding.

    Args:
        simulator: one that :func:`refusal` has nothing against.
        mode: ``fixed``: one operation after the other; ``captured``, on CUDA: a graph of them, replayed at once.
        torn_strain: see :func:`hood.training.slots.is_lost`.
    """

    def __init__(self, simulator: NetworkStepper, signal: Signal, torn_strain: float, mode: str) -> None:
        self.simulator, self.signal, self.torn_strain, self.mode = simulator, signal, torn_strain, mode
        self._plans: dict[Any, _Plan] = {}
        self._capacities: dict[Any, Capacity] = {}
        self._statistics = list(_statistics(simulator).values())
        self._before = [value.clone() for value in self._statistics]

    def __call__(self, parts: Sequence[TrainingStep], potential: Potential) -> Update:
        """One update of the scenes, one after the other; the gradients of their mean are with the parameters.

        Args:
            potential: the same in every update, but for its weight of contact.

        Raises:
            ValueError: a scene or the potential has no form of fixed shapes; the message says what to use.
        """
        if self._statistics:
            torch._foreach_copy_(self._before, self._statistics)
        asked = [self._made_ready(part, potential) for part in parts]
        outcomes = [plan.take(problem, potential, len(parts) == 1) for plan, problem in asked]
        for parameter, *given in zip(self.simulator.parameters(), *(outcome.gradients for outcome in outcomes), strict=True):
            parameter.grad = given[0] if len(given) == 1 else torch.stack(given).mean(dim=0)
        count = len(outcomes[0].energies) + len(MEASURED)
        told = torch.stack([outcome.numbers[count:] for outcome in outcomes])

        def holds(figures: Figures) -> bool:
            """Room is made where there was none, and the statistics are those of before."""
            found: dict[_Plan, tuple[int, int, int]] = {}
            for (plan, _), counts in zip(asked, figures.num_found, strict=True):
                found[plan] = cast(tuple[int, int, int], tuple(map(max, counts, found.get(plan, counts))))
            short = [plan for plan, counts in found.items() if not plan.layout.capacity.holds(counts)]
            for plan in short:
                self._capacities[plan.key] = more_capacity(found[plan], plan.like)
                self._plans.pop(plan.key)
            if short:
                asked.clear()  # memory of plans is free before there are others
            if short and self._statistics:
                torch._foreach_copy_(self._statistics, self._before)
            return not short

        return Update(
            torch.cat([outcome.next_pos for outcome in outcomes]),
            torch.cat([outcome.next_vel for outcome in outcomes]),
            torch.stack([outcome.numbers[:count] for outcome in outcomes]).mean(dim=0),
            outcomes[0].energies,
            told,
            holds=holds,
        )

    def _made_ready(self, part: TrainingStep, potential: Potential) -> tuple[_Plan, StepProblem]:
        problem = StepProblem(part.cloth, part.state, part.step, gravity=self.simulator.gravity)
        if problem.num_scenes > 1 or problem.step.attachments is not None:
            raise ValueError("scenes with fasteners have no update of fixed shapes: use trainer.step=plain")
        key = (part.kind, _shape(problem))
        if key not in self._plans:
            capacity = self._capacities.get(key) or first_capacity(self.simulator, problem)
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
    numbers: Tensor  # (M + 7,): Update.measured, then a row of Update.told
    energies: tuple[str, ...]
    gradients: tuple[Tensor, ...]


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
        simulator, self.key, self.like = owner.simulator, key, problem
        self.layout: StaticLayout = lay_out(prepared.static, capacity, None)
        self._simulator = simulator
        self._inputs = InputMemory(self._read(problem, potential))
        self._statistics = list(_statistics(simulator).values())
        function = _Function(owner, self.layout, problem, settled_potential(potential, problem))
        self._energies, self._num_parameters = function.energies, len(function.parameters)
        memory = [*self._inputs.tensors, *simulator.parameters(), *self._statistics]
        self._memory, self.pool = memory, owner.pool
        run: Run = function
        if owner.mode == "captured":
            with products(simulator.network.precision):
                run = CudaGraph(trace(run, memory, fold=False), memory, self.pool)
            self.pool = run.pool
        self._run = run

    def take(self, problem: StepProblem, potential: Potential, alone: bool) -> _Outcome:
        """The update; ``alone``: its gradients are used before the next one is computed."""
        self._inputs.load(self._read(problem, potential))
        with products(self._simulator.network.precision):
            next_pos, next_vel, numbers, *rest = self._run(*self._memory)
        gradients = rest[: self._num_parameters]
        if self._statistics:
            torch._foreach_copy_(self._statistics, rest[self._num_parameters :])
        return _Outcome(
            next_pos.clone(),  # the next update writes to the same memory
            next_vel.clone(),
            numbers if alone else numbers.clone(),
            self._energies,
            tuple(gradients) if alone else tuple(gradient.clone() for gradient in gradients),
        )

    def _read(self, problem: StepProblem, potential: Potential) -> list[Tensor]:
        weight = problem.state.pos.new_full((), contact_weight(potential))
        return [weight, *_values(problem.cloth).values(), *step_inputs(problem, surface=True)]


class _Function:
    """``next_pos, next_vel, numbers, *gradients, *statistics = function(*inputs)``.

    ``numbers`` are :attr:`Update.measured`, then a row of :attr:`Update.told`.
    """

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
        statistics = [value.clone() for value in given[len(given) - len(self._statistics) :]]
        del given[len(given) - len(self._statistics) :]
        parameters = [value.detach().requires_grad_() for value in given[len(given) - count :]]
        del given[len(given) - count :]
        state = {f"simulator.{name}": value for name, value in zip(self.parameters, parameters, strict=True)}
        state |= {f"simulator.{name}": value for name, value in zip(self._statistics, statistics, strict=True)}
        with native.in_torch(), torch.enable_grad():
            surrogate, found = functional_call(self._module, state, tuple(given))
            gradients = torch.autograd.grad(surrogate, parameters, allow_unused=True, materialize_grads=True)
        return (*found, *gradients, *statistics)

    def look(self, simulator: NetworkStepper, weight: Tensor, *values: Tensor) -> tuple[Tensor, tuple[Tensor, ...]]:
        """The number whose gradient trains, and what is not a gradient."""
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
        numbers = torch.cat([measured, outcome.to(measured), num_found.to(measured)])
        return surrogate, (next_pos, simulator.next_velocity(problem, prediction).detach(), numbers)


class _Signal(nn.Module):
    """:meth:`_Function.look` of a simulator whose parameters and statistics are other tensors for the moment."""

    def __init__(self, function: _Function) -> None:
        super().__init__()
        self.simulator, self._function = function._owner.simulator, function

    def forward(self, *values: Tensor) -> tuple[Tensor, tuple[Tensor, ...]]:
        return self._function.look(self.simulator, *values)


def make_captured(
    simulator: NetworkStepper, settings: TrainerSettings, torn_strain: float, scenes: int = 1, ranks: int = 1
) -> CapturedUpdates | None:
    """Who takes the updates that have a form of fixed shapes, by ``trainer.step``; None: nobody does.

    By itself that is a CUDA graph, where there are graphs, the model has such updates, and one has few ``scenes``.

    Raises:
        ValueError: what is asked for cannot be had.
    """
    mode, refused = settings.step, refusal(simulator, settings.collision)
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
