"""How a model is trained: the settings of :class:`hood.training.trainer.Trainer` and what refuses them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from hood.nn.choice import AUTO
from hood.nn.compiled import KERNELS
from hood.nn.model import PRECISIONS
from hood.training.curriculum import CollisionRamp, Horizon, InverseRoot, StepDecay, WarmupCosine, scaled_count
from hood.training.optimiser import OPTIMIZERS


@dataclass(frozen=True)
class TrainerSettings:
    """How a model is trained; defaults are the paper's where it speaks and the reference's where it is silent.

    ``signal``: ``"potential"`` is the plain mean potential; ``"scaled"`` divides each scene's gradient by its e0 and by
    1 + rg / 3, so that one broken scene does not drown the others.
    ``max_skipped``: updates without a finite loss and gradient in a row after which training goes back to the last good
    checkpoint, on other scenes; ``max_rollbacks``: how often it does so without getting any further.
    ``keep_at``: iterations whose weights and checkpoint stay, in the folder ``kept`` of the run; not
    of one whose own update was skipped.
    ``precision``: of the network's latents and products; ``"bf16"`` keeps weights, their gradients and energies in float32.
    ``kernels``: of the network on a CPU, see :meth:`hood.nn.model.MeshGraphNet.use_kernels`; ``auto``: those that train fastest
    here, :mod:`hood.nn.choice`.
    ``time_scale``: factor on the whole schedule, see :meth:`compressed`. ``max_vertices``: batches of garments of similar size,
    :mod:`hood.training.buckets`. ``workers``: processes that make scenes ahead, None for one per idle core.
    ``activation_checkpointing``: keep the latents between processor steps only and compute the rest again when it is needed.
    """

    iterations: int = 150_000
    batch_size: int = 1
    learning_rate: float = 5e-5
    schedule: StepDecay | WarmupCosine | InverseRoot = field(default_factory=StepDecay)
    horizon: Horizon = field(default_factory=Horizon)
    collision: CollisionRamp = field(default_factory=lambda: CollisionRamp(5e3, 5e5, 50_000, 150_000))
    clip_norm: float = 1.0
    signal: str = "potential"
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

    def __post_init__(self) -> None:
        if self.precision not in PRECISIONS:
            raise ValueError(f"trainer.precision {self.precision!r}: give {' or '.join(map(repr, PRECISIONS))}")
        if self.kernels not in (AUTO, *KERNELS):
            raise ValueError(f"trainer.kernels {self.kernels!r}: give {' or '.join(map(repr, (AUTO, *KERNELS)))}")
        if self.optimizer not in OPTIMIZERS:
            raise ValueError(f"trainer.optimizer {self.optimizer!r}: give {' or '.join(map(repr, OPTIMIZERS))}")
        if self.signal not in ("potential", "scaled"):
            raise ValueError(f"trainer.signal {self.signal!r}: give 'potential' or 'scaled'")
        for name in ("iterations", "batch_size", "checkpoint_every", "log_every", "max_skipped"):
            if getattr(self, name) < 1:
                raise ValueError(f"trainer.{name} is {getattr(self, name)}; it must be at least 1")
        for name in ("validate_every", "max_rollbacks", "statistics_iterations"):
            if getattr(self, name) < 0:
                raise ValueError(f"trainer.{name} is {getattr(self, name)}; it must be at least 0")
        object.__setattr__(self, "keep_at", tuple(self.keep_at))  # a list in a config
        if any(not isinstance(iteration, int) or iteration < 1 for iteration in self.keep_at):
            raise ValueError(f"trainer.keep_at is {list(self.keep_at)}; iterations are whole numbers of at least 1")
        for name in ("learning_rate", "clip_norm"):
            if not getattr(self, name) > 0:
                raise ValueError(f"trainer.{name} is {getattr(self, name)}; it must be > 0")
        if not 0 <= self.ema_decay < 1:
            raise ValueError(f"trainer.ema_decay is {self.ema_decay}; it must be at least 0 and below 1")
        if self.time_scale != 1.0:
            self.compressed()  # refused here rather than after the data has been read

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
