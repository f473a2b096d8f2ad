"""How a model is trained: the settings of :class:`hood.training.trainer.Trainer` and what refuses them."""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, cast

import torch
from torch import nn
from torch.optim.lr_scheduler import LRScheduler, ReduceLROnPlateau

from hood.energies.potential import Potential
from hood.energies.self_contact import for_networks
from hood.model.features.normalizer import RunningNormalizer, Whitening
from hood.model.kernels.block import KERNELS
from hood.model.network.kernel_choice import AUTO
from hood.model.network.mlp import MLP
from hood.model.network.model import PRECISIONS
from hood.steppers.network import NetworkStepper
from hood.training.curriculum import CollisionRamp, Horizon, StepDecay, scaled_count
from hood.training.optimiser import OPTIMIZERS, Schedule, dotted_name
from hood.training.slots import RELAXED_VELOCITIES, TORN_STRAIN

#: What an update is led by, see :class:`TrainerSettings`.
SIGNALS = ("potential", "scaled", "scaled_by_frame")


def make_whitening(simulator: NetworkStepper, on: bool) -> Whitening:
    """For the edge encoders of a model and the relative places among their features; a model that has no statistics yet is not
    trained yet either.

    Raises:
        ValueError: the features have no relative places that are normalised by statistics.
    """
    places, network, statistics = simulator.features.places, simulator.network, simulator.features.edge_normalizer
    if on and not (places["mesh"] and statistics is not None):
        raise ValueError("trainer.whitening: of all features only paper has relative places with statistics")
    names = {id(module): name for name, module in network.edge_encoders.named_children()}
    sets = (*network.edge_set_names, *network.world_sets) if on else ()
    encoders = {name: names[id(network.edge_encoder(name))] for name in sets}
    layers = {name: cast(MLP, network.edge_encoders[name]).first for name in encoders.values()}
    columns = {name: places["coarse" if name.startswith("coarse") else name] for name in sets}
    fresh = statistics is None or not (statistics.frozen or statistics.num_updates)
    return Whitening(layers, encoders, columns, fresh)


@contextmanager
def uncounted(module: nn.Module) -> Iterator[None]:
    """Normalisers in ``module`` count nothing in here, in training mode as well."""
    counting = [part for part in module.modules() if isinstance(part, RunningNormalizer) and part.training]
    for part in counting:
        part.training = False
    try:
        yield
    finally:
        for part in counting:
            part.training = True


#: How an update is computed: operation by operation, with fixed shapes, or as a CUDA graph of them; by itself the last.
_STEPS = ("auto", "plain", "fixed", "captured")


@dataclass(frozen=True)
class TrainerSettings:
    """How a model is trained; defaults are the paper's where it speaks and the reference's where it is silent.

    ``signal``: ``"potential"`` is the plain mean potential; ``"scaled"`` divides each scene's gradient by its e0 and by
    1 + rg / 3, so that one broken scene does not drown the others.
    ``"scaled_by_frame"`` gives the relaxing step the e0 of a frame of 1/30 s, a hundredth of its own: the gradients of both
    kinds of steps are then of one size.
    ``optimizer``: a word, or a class with its arguments, ``partial(torch.optim.AdamW, weight_decay=1e-2)``; ``schedule``: a
    function of the iteration, or a scheduler in the same form; see :mod:`hood.training.optimiser`.
    ``whitening``: see :class:`hood.model.features.normalizer.Whitening`.
    ``max_skipped``: updates without a finite loss and gradient in a row after which training goes back to the last good
    checkpoint, on other scenes; ``max_rollbacks``: how often it does so without getting any further.
    ``by_rollout``: ``horizon`` and ``collision`` count training rollouts, what the released code calls iterations, see
    :meth:`count`; a rollout then has all steps of the horizon with which it began, torn or not.
    ``relaxed_velocity``: with which a rollout goes on from the relaxing step, see :class:`hood.training.slots.Slots`.
    ``torn_strain``: a rollout ends where 1% of its edges are strained more than this, however long the horizon is. A low value
    lets long horizons grow with what the network can do: no updates go to debris.
    ``keep_at``: iterations whose weights and checkpoint stay, in the folder ``kept`` of the run; not
    of one whose own update was skipped.
    ``precision``: of the network's latents and products; ``"bf16"`` keeps weights, their gradients and energies in float32.
    ``kernels``: of the network on a CPU, see :meth:`hood.model.network.model.MeshGraphNet.use_kernels`; ``auto``: those that
    train fastest here, :mod:`hood.model.network.kernel_choice`.
    ``time_scale``: factor on the whole schedule, see :meth:`compressed`. ``max_vertices``: batches of garments of similar size,
    :mod:`hood.training.slots`. ``workers``: processes that make scenes ahead, None for one per idle core.
    ``step``: how an update is computed, :class:`hood.training.updates.CapturedUpdates`.
    ``unroll``: steps that the loss of an update looks at, see :func:`hood.training.updates.further_loss`; rollouts go on by
    one.
    ``activation_checkpointing``: keep the latents between processor steps only and compute the rest again when it is needed.
    """

    iterations: int = 150_000
    batch_size: int = 1
    learning_rate: float = 5e-5
    schedule: Schedule | partial[Any] = field(default_factory=StepDecay)
    horizon: Horizon = field(default_factory=Horizon)
    collision: CollisionRamp = field(default_factory=lambda: CollisionRamp(5e3, 5e5, 50_000, 150_000))
    by_rollout: bool = False
    relaxed_velocity: str = "skinned"
    torn_strain: float = TORN_STRAIN
    clip_norm: float = 1.0
    signal: str = "potential"
    whitening: bool = False
    optimizer: str | partial[Any] = "adam"
    ema_decay: float = 0.0
    precision: str = "fp32"
    kernels: str = "torch"
    statistics_iterations: int = 100
    checkpoint_every: int = 500
    keep_at: Sequence[int] = ()
    log_every: int = 20
    validate_every: int = 0
    max_skipped: int = 20
    max_rollbacks: int = 3
    time_scale: float = 1.0
    max_vertices: int | None = None
    workers: int | None = 0
    activation_checkpointing: bool = False
    step: str = "auto"
    unroll: int = 1

    def __post_init__(self) -> None:
        if self.precision not in PRECISIONS:
            raise ValueError(f"trainer.precision {self.precision!r}: give {' or '.join(map(repr, PRECISIONS))}")
        if self.kernels not in (AUTO, *KERNELS):
            raise ValueError(f"trainer.kernels {self.kernels!r}: give {' or '.join(map(repr, (AUTO, *KERNELS)))}")
        if self.step not in _STEPS:
            raise ValueError(f"trainer.step {self.step!r}: give {' or '.join(map(repr, _STEPS))}")
        _check_optimizer(self.optimizer)
        _check_schedule(self.schedule, self.validate_every > 0)
        if self.signal not in SIGNALS:
            raise ValueError(f"trainer.signal {self.signal!r}: give {' or '.join(map(repr, SIGNALS))}")
        if self.whitening and self.statistics_iterations == 0:
            raise ValueError("trainer.whitening needs statistics: give trainer.statistics_iterations of at least 1, say 100")
        if self.relaxed_velocity not in RELAXED_VELOCITIES:
            names = " or ".join(map(repr, RELAXED_VELOCITIES))
            raise ValueError(f"trainer.relaxed_velocity {self.relaxed_velocity!r}: give {names}")
        if self.by_rollout and self.torn_strain != TORN_STRAIN:
            raise ValueError(
                f"trainer.torn_strain={self.torn_strain:g}: with trainer.by_rollout=true torn rollouts go on; drop one"
            )
        if self.unroll > 1 and self.step not in ("auto", "plain"):
            raise ValueError(
                f"trainer.step={self.step} with trainer.unroll={self.unroll}: further steps are taken operation by operation; "
                "give trainer.step=plain or trainer.unroll=1"
            )
        for name in ("iterations", "batch_size", "checkpoint_every", "log_every", "max_skipped", "unroll"):
            if getattr(self, name) < 1:
                raise ValueError(f"trainer.{name} is {getattr(self, name)}; it must be at least 1")
        for name in ("validate_every", "max_rollbacks", "statistics_iterations"):
            if getattr(self, name) < 0:
                raise ValueError(f"trainer.{name} is {getattr(self, name)}; it must be at least 0")
        object.__setattr__(self, "keep_at", tuple(self.keep_at))  # a list in a config
        if any(not isinstance(iteration, int) or iteration < 1 for iteration in self.keep_at):
            raise ValueError(f"trainer.keep_at is {list(self.keep_at)}; iterations are whole numbers of at least 1")
        for name in ("learning_rate", "clip_norm", "torn_strain"):
            if not getattr(self, name) > 0:
                raise ValueError(f"trainer.{name} is {getattr(self, name)}; it must be > 0")
        if not 0 <= self.ema_decay < 1:
            raise ValueError(f"trainer.ema_decay is {self.ema_decay}; it must be at least 0 and below 1")
        if self.time_scale != 1.0:
            self.compressed()  # refused here rather than after the data has been read

    def count(self, iteration: int) -> int:
        """What ``horizon`` and ``collision`` count, at an iteration: iterations, or with ``by_rollout`` rollouts.

        One that breaks off at what is no number is counted with all its steps: schedules are functions of the iteration.
        """
        return self.horizon.rollout(iteration) if self.by_rollout else iteration

    def require_updates(self, uses_statistics: bool) -> None:
        """Raise ValueError where all iterations would only collect the statistics of a model that has some."""
        if uses_statistics and self.iterations <= self.statistics_iterations:
            raise ValueError(
                f"trainer.iterations={self.iterations}: the first {self.statistics_iterations} only collect "
                "statistics, so nothing would be trained; give more, or fewer trainer.statistics_iterations=…"
            )

    def require_unroll(self, simulator: NetworkStepper, potential: Potential, ranks: int) -> None:
        """Raise ValueError where gradients cannot go through the state from step to step."""
        reasons = {
            "several processes that share a batch take one step alone": ranks > 1,
            "the passes of a further step have no loss of their own": len(simulator.network.passes) > 1,
            "the model counts in frames": simulator.rules.frame_dt is not None,
            "layers of cloth are not followed": simulator.layer_radius is not None
            or len(for_networks(potential).terms) < len(potential.terms),
            "contact at edges or faces is not followed": any(
                getattr(term, "contact", "vertices") != "vertices" for term in potential.terms.values()
            ),
        }
        refused = next((reason for reason, holds in reasons.items() if holds), None)
        if self.unroll > 1 and refused is not None:
            raise ValueError(f"trainer.unroll={self.unroll}: {refused}; use trainer.unroll=1")

    def is_due(self, iteration: int) -> bool:
        """Whether something follows an iteration for which it must be known what came of the updates so far."""
        every = (self.log_every, self.checkpoint_every, self.validate_every)
        due = iteration == self.iterations or iteration in self.keep_at
        return due or any(number and iteration % number == 0 for number in every)

    def compressed(self) -> TrainerSettings:
        """The same with ``time_scale`` 1 and everything that is counted from the start of the schedule multiplied by it:
        iterations, curriculum, learning-rate decay or warm-up, collision ramp.

        What serves the statistics is a number of samples and stays: ``statistics_iterations`` and the decay of the normalisers.
        """
        if self.time_scale == 1.0:
            return self
        iterations = scaled_count("trainer.iterations", self.iterations, self.time_scale)
        if iterations <= self.statistics_iterations:
            raise ValueError(
                f"trainer.time_scale={self.time_scale:g} leaves {iterations} iterations, of which the first "
                f"{self.statistics_iterations} only collect statistics; raise it"
            )
        scale = getattr(self.schedule, "scaled", None)
        if scale is None:
            name = dotted_name(self.schedule.func if isinstance(self.schedule, partial) else type(self.schedule))
            raise ValueError(
                f"trainer.time_scale={self.time_scale:g}: trainer.schedule is of {name}, which has no method scaled(factor); "
                "give trainer.time_scale=1"
            )
        return replace(
            self,
            time_scale=1.0,
            iterations=iterations,
            schedule=scale(self.time_scale),
            horizon=self.horizon.scaled(self.time_scale),
            collision=self.collision.scaled(self.time_scale),
        )


def _check_optimizer(choice: str | partial[Any]) -> None:
    """Raise ValueError where ``trainer.optimizer`` is neither a word nor the class of an optimiser that a training can use."""
    if isinstance(choice, str):
        if choice not in OPTIMIZERS:
            raise ValueError(
                f"trainer.optimizer {choice!r}: give {' or '.join(map(repr, OPTIMIZERS))}, or a class, such as "
                "{_target_: torch.optim.AdamW}"
            )
        return
    kind = _class_of("trainer.optimizer", choice, torch.optim.Optimizer)
    if "lr" in choice.keywords:
        raise ValueError("trainer.optimizer.lr: the rate is trainer.learning_rate, times trainer.schedule; leave lr out")
    closure = inspect.signature(kind.step).parameters.get("closure")
    if kind is torch.optim.SparseAdam or (closure is not None and closure.default is inspect.Parameter.empty):
        needed = "sparse gradients" if kind is torch.optim.SparseAdam else "to compute the loss several times in a step"
        raise ValueError(f"trainer.optimizer: {dotted_name(kind)} needs {needed}; give another one, such as torch.optim.AdamW")


def _check_schedule(choice: Schedule | partial[Any], validates: bool) -> None:
    """Raise ValueError where ``trainer.schedule`` says no rates to a training, which ``validates`` or not."""
    if not isinstance(choice, partial):
        if not callable(choice):
            raise ValueError(f"trainer.schedule: {dotted_name(type(choice))} has no method __call__(iteration, num_iterations)")
        return
    if issubclass(_class_of("trainer.schedule", choice, LRScheduler), ReduceLROnPlateau) and not validates:
        raise ValueError("trainer.schedule: ReduceLROnPlateau reads the score of validations; give trainer.validate_every")


def _class_of(key: str, choice: partial[Any], base: type) -> Any:
    """The class of a part, which must be one of ``base``."""
    if not (inspect.isclass(choice.func) and issubclass(choice.func, base)):
        raise ValueError(f"{key}: {dotted_name(choice.func)} is no class of {base.__module__}.{base.__qualname__}")
    return choice.func
