"""How a model is trained: the settings of :class:`hood.training.trainer.Trainer` and what refuses them.

Optimisers for networks whose loss is ill-conditioned: orthogonalised momentum for matrices, Adam for the rest.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, cast

import torch
from torch import Tensor

from hood.model.features.normalizer import Whitening
from hood.model.kernels.block import KERNELS
from hood.model.network.kernel_choice import AUTO
from hood.model.network.mlp import MLP
from hood.model.network.model import PRECISIONS
from hood.steppers.network import NetworkStepper
from hood.training.curriculum import CollisionRamp, Horizon, InverseRoot, StepDecay, WarmupCosine, scaled_count
from hood.training.slots import RELAXED_VELOCITIES, TORN_STRAIN

#: Coefficients of the quintic Newton-Schulz iteration towards the nearest orthogonal matrix (Jordan et al., "Muon", 2024).
_QUINTIC = (3.4445, -4.7750, 2.0315)
#: Root mean square of Adam's updates in units of its rate, about: both parts then share one rate (Liu et al., 2025).
_ADAM_RMS = 0.2


#: Names for :func:`make_optimizer`.
OPTIMIZERS = ("adam", "muon")
#: What an update is led by, see :class:`TrainerSettings`.
SIGNALS = ("potential", "scaled", "scaled_by_frame")


def make_optimizer(
    name: str, simulator: NetworkStepper, learning_rate: float, on_device: bool = False
) -> torch.optim.Optimizer:
    """``adam``, or ``muon`` for the matrices between latents with Adam for encoders' inputs, outputs, biases and norms.

    Args:
        on_device: the steps of Adam are counted beside the weights, where there is a device beside the CPU.
    """
    if name == "adam":
        on_device &= simulator.gravity.device.type != "cpu"
        return torch.optim.Adam(simulator.parameters(), lr=learning_rate, capturable=on_device)
    width = int(simulator.config["latent_dim"])
    inner = [p for p in simulator.parameters() if p.dim() == 2 and p.shape[0] == width and p.shape[1] % width == 0]
    chosen = {id(p) for p in inner}
    rest = [p for p in simulator.parameters() if id(p) not in chosen]
    return MuonAdam([{"params": inner, "matrices": True}, {"params": rest, "matrices": False}], learning_rate)


def load_optimizer(optimizer: torch.optim.Optimizer, state: Mapping[str, Any]) -> None:
    """The state of a checkpoint; where steps are counted stays as it is."""
    own = [{name: group[name] for name in ("capturable",) if name in group} for group in optimizer.param_groups]
    groups = [{**given, **kept} for given, kept in zip(state["param_groups"], own, strict=True)]
    optimizer.load_state_dict({**state, "param_groups": groups})


class MuonAdam(torch.optim.Optimizer):
    """Muon for groups marked ``matrices``, Adam for the others, at one learning rate.

    The matrices (d, k d) of a group are taken apart into k square blocks: a first layer sees k latents, one beside the
    other. All blocks are orthogonalised together and in float32; torch's own Muon takes a matrix at a time, whole.
    """

    def __init__(
        self,
        groups: Iterable[dict[str, Any]],
        lr: float,
        betas: tuple[float, float] = (0.9, 0.999),
        momentum: float = 0.95,
        eps: float = 1e-8,
    ) -> None:
        super().__init__(groups, {"lr": lr, "betas": betas, "momentum": momentum, "eps": eps, "matrices": False})

    @torch.no_grad()
    def step(self, closure: Any = None) -> None:  # type: ignore[override]
        """One update of every parameter that has a gradient."""
        for group in self.param_groups:
            present = [p for p in group["params"] if p.grad is not None]
            if group["matrices"]:
                self._orthogonal(group, present)
            else:
                self._adam(group, present)

    def _orthogonal(self, group: dict[str, Any], params: list[Tensor]) -> None:
        if not params:
            return
        momentum, grads = group["momentum"], [cast(Tensor, p.grad) for p in params]
        kept = self._kept("momentum", params)
        torch._foreach_lerp_(kept, grads, 1.0 - momentum)
        ahead = torch._foreach_lerp(grads, kept, momentum)
        blocks = orthogonal(torch.stack([block for one in ahead for block in one.split(one.shape[0], dim=1)]))
        places = [block for p in params for block in p.split(p.shape[0], dim=1)]
        torch._foreach_add_(places, list(blocks.unbind()), alpha=-group["lr"] * _ADAM_RMS * blocks.shape[1] ** 0.5)

    def _adam(self, group: dict[str, Any], params: list[Tensor]) -> None:
        if not params:
            return
        (first, second), grads = group["betas"], [cast(Tensor, p.grad) for p in params]
        means, squares = self._kept("first", params), self._kept("second", params)
        for p in params:
            self.state[p]["step"] = self.state[p].get("step", 0) + 1
        counts = [self.state[p]["step"] for p in params]
        torch._foreach_lerp_(means, grads, 1.0 - first)
        torch._foreach_mul_(squares, second)
        torch._foreach_addcmul_(squares, grads, grads, value=1.0 - second)
        roots = torch._foreach_div(squares, [1.0 - second**count for count in counts])
        torch._foreach_sqrt_(roots)
        torch._foreach_add_(roots, group["eps"])
        torch._foreach_addcdiv_(params, means, roots, [-group["lr"] / (1.0 - first**count) for count in counts])

    def _kept(self, name: str, params: list[Tensor]) -> list[Tensor]:
        """What is kept of every parameter under a name, zero at first."""
        for p in params:
            if name not in self.state[p]:
                self.state[p][name] = torch.zeros_like(p)
        return [self.state[p][name] for p in params]


def orthogonal(blocks: Tensor, rounds: int = 5) -> Tensor:
    """Near-orthogonal matrices with the singular directions of ``blocks`` (K, d, d)."""
    a, b, c = _QUINTIC
    x = blocks / blocks.norm(dim=(1, 2), keepdim=True).clamp_min(1e-20)
    for _ in range(rounds):
        gram = x @ x.mT
        x = a * x + (b * gram + c * gram @ gram) @ x
    return x


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


#: How an update is computed: operation by operation, with fixed shapes, or as a CUDA graph of them; by itself the last.
_STEPS = ("auto", "plain", "fixed", "captured")


@dataclass(frozen=True)
class TrainerSettings:
    """How a model is trained; defaults are the paper's where it speaks and the reference's where it is silent.

    ``signal``: ``"potential"`` is the plain mean potential; ``"scaled"`` divides each scene's gradient by its e0 and by
    1 + rg / 3, so that one broken scene does not drown the others.
    ``"scaled_by_frame"`` gives the relaxing step the e0 of a frame of 1/30 s, a hundredth of its own: the gradients of both
    kinds of steps are then of one size.
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
    ``activation_checkpointing``: keep the latents between processor steps only and compute the rest again when it is needed.
    """

    iterations: int = 150_000
    batch_size: int = 1
    learning_rate: float = 5e-5
    schedule: StepDecay | WarmupCosine | InverseRoot = field(default_factory=StepDecay)
    horizon: Horizon = field(default_factory=Horizon)
    collision: CollisionRamp = field(default_factory=lambda: CollisionRamp(5e3, 5e5, 50_000, 150_000))
    by_rollout: bool = False
    relaxed_velocity: str = "skinned"
    torn_strain: float = TORN_STRAIN
    clip_norm: float = 1.0
    signal: str = "potential"
    whitening: bool = False
    optimizer: str = "adam"
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

    def __post_init__(self) -> None:
        if self.precision not in PRECISIONS:
            raise ValueError(f"trainer.precision {self.precision!r}: give {' or '.join(map(repr, PRECISIONS))}")
        if self.kernels not in (AUTO, *KERNELS):
            raise ValueError(f"trainer.kernels {self.kernels!r}: give {' or '.join(map(repr, (AUTO, *KERNELS)))}")
        if self.step not in _STEPS:
            raise ValueError(f"trainer.step {self.step!r}: give {' or '.join(map(repr, _STEPS))}")
        if self.optimizer not in OPTIMIZERS:
            raise ValueError(f"trainer.optimizer {self.optimizer!r}: give {' or '.join(map(repr, OPTIMIZERS))}")
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
        for name in ("iterations", "batch_size", "checkpoint_every", "log_every", "max_skipped"):
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
        return replace(
            self,
            time_scale=1.0,
            iterations=iterations,
            schedule=self.schedule.scaled(self.time_scale),
            horizon=self.horizon.scaled(self.time_scale),
            collision=self.collision.scaled(self.time_scale),
        )
