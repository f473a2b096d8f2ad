"""Self-supervised training: one optimiser update per predicted step, the potential's own gradient as the signal."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.parallel import DistributedDataParallel

from hood.dynamics.output import AccelerationOutput
from hood.dynamics.simulator import Simulator, save_simulator
from hood.losses.potential import Potential, relative_gradient, scale
from hood.losses.problem import StepProblem
from hood.nn.model import PRECISIONS
from hood.scene.dataset import SceneSampler
from hood.training import distributed
from hood.training.checkpoint import load_checkpoint, save_checkpoint
from hood.training.curriculum import CollisionRamp, Horizon, StepDecay, WarmupCosine
from hood.training.metrics_log import MetricsLog
from hood.training.slots import Slots

#: Non-finite updates in a row after which training stops: the last checkpoint is then the better start.
_MAX_SKIPPED = 50


@dataclass(frozen=True)
class TrainerSettings:
    """How a model is trained; defaults are the paper's where it speaks and the reference's where it is silent.

    ``signal``: ``"potential"`` is the plain mean potential; ``"scaled"`` divides each scene's gradient by its e0 and by
    1 + rg / 3, so that one broken scene does not drown the others.
    ``precision``: of the network's latents and products; ``"bf16"`` keeps weights, their gradients and energies in float32.
    """

    iterations: int = 150_000
    batch_size: int = 1
    learning_rate: float = 5e-5
    schedule: StepDecay | WarmupCosine = field(default_factory=StepDecay)
    horizon: Horizon = field(default_factory=Horizon)
    collision: CollisionRamp = field(default_factory=lambda: CollisionRamp(5e3, 5e5, 50_000, 150_000))
    clip_norm: float = 1.0
    signal: str = "potential"
    ema_decay: float = 0.0
    precision: str = "fp32"
    statistics_iterations: int = 100
    checkpoint_every: int = 500
    log_every: int = 20
    validate_every: int = 0

    def __post_init__(self) -> None:
        if self.precision not in PRECISIONS:
            raise ValueError(f"trainer.precision {self.precision!r}: give {' or '.join(map(repr, PRECISIONS))}")
        if self.signal not in ("potential", "scaled"):
            raise ValueError(f"trainer.signal {self.signal!r}: give 'potential' or 'scaled'")
        for name in ("iterations", "batch_size", "checkpoint_every", "log_every"):
            if getattr(self, name) < 1:
                raise ValueError(f"trainer.{name} is {getattr(self, name)}; it must be at least 1")
        if self.learning_rate <= 0 or self.clip_norm <= 0:
            raise ValueError("trainer.learning_rate and trainer.clip_norm must be > 0")


Validation = Callable[[Simulator], dict[str, float]]
Progress = Callable[[int, dict[str, float]], None]


class Trainer:
    """Owns the optimisation: slots of running rollouts, optimiser, averaged weights, checkpoints.

    Files in ``folder``: ``checkpoint.pt`` (resume), ``model.safetensors`` (use), ``metrics.jsonl``, TensorBoard events.
    """

    def __init__(
        self,
        simulator: Simulator,
        potential: Potential,
        sampler: SceneSampler,
        settings: TrainerSettings,
        folder: Path,
        seed: int,
        validation: Validation | None = None,
    ) -> None:
        self.simulator, self.potential, self.settings = simulator, potential, settings
        self.folder, self.seed, self.validation = folder, seed, validation
        simulator.network.use_precision(settings.precision)
        ranks, rank = distributed.world_size(), distributed.rank()
        if settings.batch_size % ranks:
            raise ValueError(f"trainer.batch_size={settings.batch_size} cannot be shared by {ranks} processes; use a multiple")
        mine = range(rank, settings.batch_size, ranks)
        self.slots = Slots(sampler, simulator, settings.batch_size, seed, settings.horizon.maximum, mine)
        self.model: torch.nn.Module = DistributedDataParallel(simulator) if ranks > 1 else simulator
        self.optimizer = torch.optim.Adam(simulator.parameters(), lr=settings.learning_rate)
        self.iteration = 0
        self.skipped = 0
        self._skipped_in_row = 0
        self._average = {name: value.detach().clone() for name, value in simulator.named_parameters()}

    @property
    def checkpoint_path(self) -> Path:
        return self.folder / "checkpoint.pt"

    def run(self, progress: Progress | None = None, should_stop: Callable[[], bool] = lambda: False) -> bool:
        """Train up to ``settings.iterations``; True when finished, False when ``should_stop`` ended it early."""
        settings = self.settings
        self.folder.mkdir(parents=True, exist_ok=True)
        begun, first = time.monotonic(), self.iteration
        main = distributed.rank() == 0
        with MetricsLog(self.folder, self.iteration) if main else nullcontext() as log:
            while self.iteration < settings.iterations and not distributed.any_rank(should_stop()):
                report = self.update()
                done = self.iteration
                if log and (done % settings.log_every == 0 or done == settings.iterations):
                    rate = (done - first) / max(time.monotonic() - begun, 1e-9)
                    log.write(done, {**report, "iterations_per_second": rate})
                if progress is not None:
                    progress(done, report)
                if log and settings.validate_every and self.validation and done % settings.validate_every == 0:
                    log.write(done, {f"validation_{k}": v for k, v in self.validation(self.averaged()).items()})
                if done % settings.checkpoint_every == 0:
                    self.save()
        self.save()
        return self.iteration >= settings.iterations

    def update(self) -> dict[str, float]:
        """One step of every slot and one optimiser update; returns what was measured."""
        settings, simulator = self.settings, self.simulator
        simulator.train()
        horizon = settings.horizon(self.iteration)
        cloth, prepared, state, step = self.slots.batch(horizon)
        contact = simulator.find_contact(cloth, state, step)
        potential = settings.collision.apply(self.potential, self.iteration)
        problem = potential.prepare(StepProblem(cloth, state, step, contact, simulator.gravity))
        collecting = self.iteration < settings.statistics_iterations and simulator.uses_statistics
        if collecting and isinstance(simulator.output, AccelerationOutput):
            simulator.output.observe(self.slots.skinned_accelerations())
        with torch.set_grad_enabled(not collecting):
            prediction = simulator(problem, prepared) if collecting else self.model(problem, prepared)
        gradient, energies = potential.gradient(problem, prediction.next_pos.detach(), prediction.acc.detach())
        gradient = gradient * cloth.free.unsqueeze(1)
        residual = relative_gradient(problem, gradient)
        report = {name: float(value.mean()) for name, value in energies.items()}
        report |= {
            "total": sum(report.values()),
            "relative_gradient": float(residual.median()),
            "horizon": float(horizon),
        }
        if not collecting:
            weight = self._weight(problem, residual)
            # The analytic gradient is injected at the output: no graph through the energies is kept.
            surrogate = (prediction.next_pos * (gradient * weight[cloth.vertex_scene].unsqueeze(1))).sum()
            if self.model is not simulator:
                # A share without body edges leaves their networks out; all processes must reduce the same parameters.
                surrogate = surrogate + 0.0 * sum(p.sum() for p in simulator.parameters())
            report |= self._optimise(surrogate)
        self.slots.advance(prediction.next_pos, simulator.next_velocity(problem, prediction))
        self.iteration += 1
        return report

    def averaged(self) -> Simulator:
        """The simulator with exponentially averaged weights (the plain ones when averaging is off), in eval mode."""
        clone = self.simulator.clone()
        clone.load_state_dict(self.simulator.state_dict() | (self._average if self.settings.ema_decay > 0 else {}))
        return clone.eval()

    def save(self) -> None:
        """Write the resume checkpoint and the weights, both atomically."""
        slots = {index: entry for part in distributed.gather(self.slots.state_dict()) for index, entry in part.items()}
        if distributed.rank() != 0:
            return
        state: dict[str, Any] = {
            "iteration": self.iteration,
            "seed": self.seed,
            "skipped": self.skipped,
            "simulator": self.simulator.state_dict(),
            "average": self._average,
            "optimizer": self.optimizer.state_dict(),
            "slots": slots,
            "rng": torch.get_rng_state(),
            "model": self.simulator.config,
        }
        save_checkpoint(self.checkpoint_path, state)
        save_simulator(self.folder / "model.safetensors", self.averaged(), {"iteration": str(self.iteration)})

    def resume(self, path: Path) -> None:
        """Go on from a checkpoint of a run with the same model and data.

        Raises:
            ValueError: the checkpoint is of another model, seed or batch size.
        """
        state = load_checkpoint(path)
        if state["model"] != self.simulator.config:
            raise ValueError(f"{path}: trained with model {state['model']}, this run has {self.simulator.config}")
        if state["seed"] != self.seed:
            raise ValueError(f"{path}: trained with seed {state['seed']}; pass seed={state['seed']} to resume it")
        if len(state["slots"]) != self.settings.batch_size:
            raise ValueError(f"{path}: trained with trainer.batch_size={len(state['slots'])}; pass the same to resume it")
        self.simulator.load_state_dict(state["simulator"])
        for name, mean in self._average.items():
            mean.copy_(state["average"][name])
        self.optimizer.load_state_dict(state["optimizer"])
        self.slots.load_state_dict(state["slots"])
        self.iteration, self.skipped = int(state["iteration"]), int(state["skipped"])
        torch.set_rng_state(state["rng"])

    def _weight(self, problem: StepProblem, residual: Tensor) -> Tensor:
        count = problem.num_scenes
        if self.settings.signal == "potential":
            return torch.full_like(residual, 1.0 / count)
        return 1.0 / (scale(problem) * (1.0 + residual / 3.0) * count)

    def _optimise(self, surrogate: Tensor) -> dict[str, float]:
        settings = self.settings
        factor = settings.schedule(self.iteration, settings.iterations)
        for group in self.optimizer.param_groups:
            group["lr"] = settings.learning_rate * factor
        self.optimizer.zero_grad(set_to_none=True)
        surrogate.backward()
        norm = float(torch.nn.utils.clip_grad_norm_(self.simulator.parameters(), settings.clip_norm))
        if math.isfinite(norm):
            self.optimizer.step()
            self._update_average()
            self._skipped_in_row = 0
        else:
            self.skipped += 1
            self._skipped_in_row += 1
            if self._skipped_in_row >= _MAX_SKIPPED:
                raise ValueError(
                    f"{_MAX_SKIPPED} updates in a row were not finite (iteration {self.iteration}); lower "
                    f"trainer.learning_rate and resume from {self.checkpoint_path}"
                )
        return {
            "parameter_gradient_norm": norm,
            "learning_rate": settings.learning_rate * factor,
            "skipped": float(self.skipped),
        }

    def _update_average(self) -> None:
        decay = self.settings.ema_decay
        if decay <= 0:
            return
        # Early averages forget faster, so that the first checkpoints are not the untrained weights.
        decay = min(decay, (1 + self.iteration) / (10 + self.iteration))
        with torch.no_grad():
            torch._foreach_lerp_(list(self._average.values()), list(self.simulator.parameters()), 1 - decay)
