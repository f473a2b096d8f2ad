"""Self-supervised training: one optimiser update per predicted step, the potential's own gradient as the signal."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.utils import clip_grads_with_norm_, get_total_norm

from hood.assets.files.atomic import write_atomically
from hood.assets.files.said import say
from hood.energies.potential import Potential
from hood.energies.self_contact import for_networks
from hood.model.features.normalizer import RunningNormalizer
from hood.model.network.kernel_choice import AUTO, KernelChoice, choose_for
from hood.steppers.checkpoint import save_simulator
from hood.steppers.network import NetworkStepper
from hood.steppers.protocol import Stopwatch, timed
from hood.steppers.ranges import training_conditions
from hood.training import distributed
from hood.training.callbacks import Callback, Reporter, ValidationWatch
from hood.training.checkpoint import (
    generator_states,
    load_last_good,
    marks_of,
    previous,
    refuse_other,
    refuse_other_garments,
    require_plain,
    save_checkpoint,
    set_aside,
    set_generator_states,
)
from hood.training.log import Clock, Logger, LogWindow
from hood.training.optimiser import Rates, WeightSteps, load_optimizer, make_optimizer
from hood.training.outcome import Signal, Skipped, StartedUpdate, Update, made_behind, read_figures, told
from hood.training.scenes import SceneSampler
from hood.training.settings import TrainerSettings, make_whitening
from hood.training.slots import Slots
from hood.training.updates import Observer, make_captured, plain_update

#: Told the iteration and what was measured; None instead of a report: time passed that was not training.
_Progress = Callable[[int, dict[str, float] | None], None]


class Trainer:
    """Owns the optimisation: slots of running rollouts, optimiser, averaged weights, checkpoints.

    ``simulator``, ``potential``, ``settings`` (the keys of ``trainer``), ``folder``, ``seed`` and ``iteration`` are attributes.
    Files: ``checkpoint.pt``, ``checkpoint.previous.pt`` (resume), ``model.safetensors``, ``best.safetensors`` (best validation
    so far), ``kept/`` (of the iterations ``keep_at``), ``metrics.jsonl``, ``validation/``, TensorBoard events. Process 0 alone
    writes them. A disk that refuses a file ends the training, the last checkpoint intact. ``earlier``: updates of given ones.
    """

    def __init__(
        self,
        simulator: NetworkStepper,
        potential: Potential,
        sampler: SceneSampler,
        settings: TrainerSettings,
        folder: Path,
        seed: int,
        watch: ValidationWatch | None = None,
        earlier: int = 0,
        loggers: Sequence[Logger] | None = None,
        callbacks: Sequence[Callback] = (),
    ) -> None:
        settings = settings.compressed()
        settings.require_updates(simulator.uses_statistics)
        settings.collision.require_its_weight(potential)
        shown = for_networks(potential)
        simulator.use_potential(shown)
        last = settings.collision.apply(shown, settings.count(settings.iterations))
        simulator.trained_for = training_conditions(sampler, last)
        self.simulator, self.potential, self.settings = simulator, potential, settings
        self.folder, self.seed, self.watch = folder, seed, watch
        simulator.network.use_precision(settings.precision)
        self.choice: KernelChoice | None = None  # of kernels, where that was left open
        if settings.kernels == AUTO:
            self.choice = choose_for(simulator.network, settings.precision, simulator.gravity.device, training=True)
        simulator.network.use_kernels(settings.kernels if self.choice is None else self.choice.kernels)
        simulator.network.use_checkpointing(settings.activation_checkpointing)
        ranks, rank = distributed.world_size(), distributed.rank()
        settings.require_unroll(simulator, potential, ranks)
        if settings.batch_size % ranks:
            raise ValueError(f"trainer.batch_size={settings.batch_size} cannot be shared by {ranks} processes; use a multiple")
        longest = settings.horizon.maximum - settings.horizon.with_relaxing
        shares = (rank, ranks, settings.max_vertices, settings.workers)
        rollouts = (settings.by_rollout, settings.relaxed_velocity, settings.torn_strain)
        self.slots = Slots(sampler, simulator, settings.batch_size, seed, longest, *shares, *rollouts)
        self.model: torch.nn.Module = simulator
        self.signal, self.whitening = Signal(settings.signal), make_whitening(simulator, settings.whitening)
        if ranks > 1:
            self.whitening.shared_sum = distributed.all_reduce_sum
            # Statistics are kept equal by their own sums; scenes are drawn by slot, so only other draws need a generator each.
            self.model = distributed.averaging(simulator)
            torch.manual_seed(seed + 7919 * rank)
            for module in simulator.modules():
                if isinstance(module, RunningNormalizer):
                    module.shared_sum = distributed.all_reduce_sum
        self._captured = make_captured(simulator, settings, self.slots.ending_strain, self.slots.most_scenes, ranks)
        self.optimizer = make_optimizer(settings.optimizer, simulator, settings.learning_rate, self._captured is not None)
        self._rates = Rates(settings.schedule, self.optimizer, settings.learning_rate, settings.iterations)
        self.iteration, self.earlier, self.rollbacks, self.best = 0, earlier, 0, math.inf
        self.stopwatch: Stopwatch | None = None  # told where an update's time goes
        self.observe: Observer | None = None
        self._skips, self.stopped = Skipped(), ""  # why a callback ended the training
        self._rollbacks_in_row, self._failed_at, self._saved_at = 0, -1, -1
        self.reporter = Reporter(self, loggers, callbacks)
        self._steps = WeightSteps(simulator, self.optimizer, self.whitening, settings.ema_decay)
        self._begun: list[StartedUpdate] = []  # updates that :meth:`look` has not told of
        self.reporter.call("check")

    @property
    def checkpoint_path(self) -> Path:
        """The file that a training is resumed from."""
        return self.folder / "checkpoint.pt"

    @property
    def skipped(self) -> int:
        """Updates without a finite loss and gradient so far."""
        return self._skips.count

    @property
    def made(self) -> int:
        """Updates that were made and not rolled back."""
        return self._skips.made

    def why_skipped(self) -> str:
        """Why the last of them was, in brackets; all processes must ask."""
        return told(distributed.gather(self._skips.reason))

    def run(self, progress: _Progress | None = None, should_stop: Callable[[], bool] = lambda: False) -> bool:
        """Train up to ``settings.iterations``; True when finished or a callback stopped it, False when ``should_stop`` did.

        Raises:
            OSError: a file could not be written; what was written before is intact.
            ValueError: training does not stay finite, or no update at all was made.
        """
        settings = self.settings
        with ExitStack() as stack:
            stack.callback(self.slots.close)
            distributed.on_main(lambda: self.reporter.open(stack))
            self.reporter.call("begin")
            if self.iteration == 0 and self._saved_at != 0:
                self.save()  # something to go back to, and a full disk shows at once
            clock = Clock(self.iteration)
            while self.iteration < settings.iterations and (self._begun or not self._ends(should_stop)):
                self.begin()
                if self._reads_late and not settings.is_due(self.iteration):
                    continue
                reports, last = self.look(), self.iteration == settings.iterations
                # In the middle of a streak of skipped updates the weights are not known to be good.
                keeping = self.iteration in settings.keep_at
                saving = last or ((keeping or self.iteration % settings.checkpoint_every == 0) and not self._skips.in_row)
                if self._is_lost(saving):
                    self._roll_back()
                    clock = Clock(self.iteration)
                    continue
                self.reporter.add(reports)
                if last or self.iteration % settings.log_every == 0:
                    self.reporter.write_means(clock.rate(self.iteration))
                if progress is not None:
                    progress(self.iteration, reports[-1])
                if self.watch is not None and settings.validate_every and self.iteration % settings.validate_every == 0:
                    with clock.paused():
                        self._validate()
                    if progress is not None:
                        progress(self.iteration, None)
                if saving:
                    self.save()
                if saving and keeping:
                    distributed.on_main(self._keep)
            if self.iteration != self._saved_at and not self._is_lost(True):
                self.save()
            self.reporter.call("end")
        finished = self.iteration >= settings.iterations
        if finished and not self._skips.made:
            raise ValueError(
                f"nothing was trained: {self.skipped} of {self.skipped} updates were skipped{self.why_skipped()}; "
                f"{self.folder / 'model.safetensors'} holds the weights that it began with"
            )
        return finished or bool(self.stopped)

    def stop(self, reason: str) -> None:
        """End the training after this iteration, as finished; for callbacks."""
        self.stopped = self.stopped or reason

    def update(self) -> dict[str, float]:
        """One step of every slot and one optimiser update; returns what was measured."""
        self.begin()
        return self.look()[-1]

    def begin(self) -> None:
        """One update, of which :meth:`look` tells what came of it; the host waits for nothing where the device decides that."""
        settings, simulator = self.settings, self.simulator
        simulator.train()
        count = settings.count(self.iteration)
        potential = settings.collision.apply(self.potential, count)
        simulator.use_potential(for_networks(potential))
        collecting = self.iteration < settings.statistics_iterations and simulator.uses_statistics
        self.optimizer.zero_grad(set_to_none=True)
        with torch.set_grad_enabled(not collecting), self.whitening.around(simulator.network, collecting):
            update = self._take(potential, settings.horizon.after_relaxing(count), collecting)
        begun = StartedUpdate(update, None if collecting else self._answer(update), {"horizon": float(settings.horizon(count))})
        if update.acceptance is None:
            read_figures([begun])
        if begun.norm is not None:
            self._optimise(begun, begun.norm)
        with timed(self.stopwatch, "scenes"):
            if begun.figures is None:
                assert update.acceptance is not None
                begun.taken = self.slots.advance_unread(update.next_pos, update.next_vel, update.acceptance.goes_on)
            else:
                self.slots.advance(update.next_pos, update.next_vel, begun.figures.lost, begun.figures.centres)
        self._rates.advance()
        self.iteration += 1
        self._begun.append(begun)

    def look(self) -> list[dict[str, float]]:
        """What was measured of every update since the last look; waits for the device, once at most."""
        self._settle()
        first, begun, self._begun = self.iteration - len(self._begun), self._begun, []
        return [self._report(number, one) for number, one in enumerate(begun, first + 1)]

    def _settle(self) -> None:
        """Read what the device has decided."""
        unread = [begun for begun in self._begun if begun.figures is None]
        read_figures(unread)
        for one in unread:
            assert one.figures is not None
            if self._captured is not None:
                self._captured.make_room(one.update, one.figures)
            self.slots.settle(one.taken, one.figures.lost, one.figures.centres)
        self._steps.forget(sum(one.norm is not None and not one.made for one in unread))

    def _report(self, iteration: int, begun: StartedUpdate) -> dict[str, float]:
        """Of one update, which is counted."""
        report, figures = begun.report(), begun.figures
        assert figures is not None
        if begun.norm is None:
            return report
        if begun.made:
            self._skips.make()
        elif any(figures.counted):
            self._skips.skip(iteration, {name: report[name] for name in begun.update.energies}, figures.norm)
        return report | {"skipped": float(self.skipped)}

    def _take(self, potential: Potential, horizon: int, collecting: bool) -> Update:
        """The step of all scenes."""
        simulator, clock = self.simulator, self.stopwatch
        if self._captured is not None and not collecting and self.observe is None:
            with timed(clock, "scenes"):
                parts = self.slots.each(horizon)
            try:
                with timed(clock, "network"):
                    return self._captured(parts, potential)
            except (ValueError, RuntimeError) as error:
                if self.settings.step != "auto":
                    raise
                self._settle()
                self._captured = None
                say(f"hood: trainer.step=plain: no CUDA graph of an update could be made ({error})", error=True)
        with timed(clock, "scenes"):
            part = self.slots.batch(horizon)
        if collecting and simulator.output.collects_statistics and self.whitening.fresh:  # else they came with the weights
            simulator.output.observe(self.slots.skinned_accelerations())
        model, unroll = (simulator, 1) if collecting else (self.model, self.settings.unroll)
        ending = self.signal, self.slots.ending_strain
        return plain_update(simulator, model, part, potential, *ending, clock, self.observe, unroll)

    def averaged(self) -> NetworkStepper:
        """The simulator with exponentially averaged weights (the plain ones when averaging is off), in eval mode."""
        clone = self.simulator.clone()
        clone.load_state_dict(self.simulator.state_dict() | (self._steps.average if self.settings.ema_decay > 0 else {}))
        return clone.eval()

    def save(self) -> None:
        """Write the resume checkpoint and the weights, both atomically.

        Raises:
            OSError: no space or no permission; the files that are there stay as they were.
        """
        if self.iteration > self._failed_at:
            self._rollbacks_in_row = 0
        slots = {index: entry for part in distributed.gather(self.slots.state_dict()) for index, entry in part.items()}
        generators = distributed.gather(generator_states(self._device))
        state: dict[str, Any] = {
            "iteration": self.iteration,
            "earlier": self.earlier,
            "seed": self.seed,
            **self._skips.state_dict(),
            "rollbacks": [self.rollbacks, self._rollbacks_in_row, self._failed_at],
            "best": self.best,
            "simulator": self.simulator.state_dict(),
            "average": self._steps.average,
            "optimizer": self.optimizer.state_dict(),
            "rates": self._rates.state_dict(),
            "whitening": self.whitening.state_dict() if self.settings.whitening else None,
            "slots": slots,
            "rng": generators,
            "window": distributed.gather(self.reporter.window.state_dict()),
            "callbacks": self.reporter.callback_states(),
            "model": self.simulator.config,
            "garments": marks_of(self.slots.sampler.garments),
        }
        require_plain("trainer.schedule", state["rates"])
        require_plain("callbacks", state["callbacks"])
        distributed.on_main(lambda: self._write(state))
        self._saved_at = self.iteration
        self.reporter.call("after_checkpoint", self.iteration)

    def resume(self, path: Path) -> None:
        """Go on from a checkpoint of a run with the same model and data, on any number of processes.

        Where the newest checkpoint is missing or damaged the previous one is taken, and a line says so.

        Raises:
            ValueError: the checkpoint is of another model, seed or batch size.
        """
        state, note = distributed.on_main(lambda: load_last_good(path))
        if note and distributed.rank() == 0:
            say(f"hood: {note}", error=True)
            set_aside(path)
        refuse_other(path, state, self.simulator.config, self.seed, self.settings, self.slots.num_slots)
        refuse_other_garments(path, state, self.slots.sampler.garments)
        self._restore(state)
        # A finished run is saved again: it may have been killed between its checkpoint and its weights.
        self._saved_at = self.iteration if note is None and self.iteration < self.settings.iterations else -1
        self.slots.load_state_dict(state["slots"])
        self.best = float(state["best"])
        self.earlier = int(state["earlier"])
        self._skips.load_state_dict(state)
        self.rollbacks, self._rollbacks_in_row, self._failed_at = state["rollbacks"]
        if len(state["rng"]) == distributed.world_size():
            set_generator_states(state["rng"][distributed.rank()], self._device)
            self.reporter.window.load_state_dict(state["window"][distributed.rank()])

    @property
    def _reads_late(self) -> bool:
        return self._captured is not None and self._captured.reads_late

    @property
    def _iterations_in_all(self) -> str:
        """Behind the weights, for the header of their files."""
        return str(self.earlier + self.iteration)

    @property
    def _device(self) -> torch.device:
        return self.simulator.gravity.device

    def _write(self, state: dict[str, Any]) -> None:
        save_checkpoint(self.checkpoint_path, state)
        save_simulator(self.folder / "model.safetensors", self.averaged(), {"iteration": self._iterations_in_all})

    def _keep(self) -> None:
        """Copies of what was just saved, under the iteration's number."""
        folder = self.folder / "kept"
        folder.mkdir(exist_ok=True)
        for source in (self.checkpoint_path, self.folder / "model.safetensors"):
            write_atomically(folder / f"{self.iteration:06d}{source.suffix}", source.read_bytes())

    def _restore(self, state: Mapping[str, Any]) -> None:
        """What is learned, as it was at the checkpoint."""
        self.simulator.load_state_dict(state["simulator"])
        for name, mean in self._steps.average.items():
            mean.copy_(state["average"][name])
        load_optimizer(self.optimizer, state["optimizer"])
        self._rates.load_state_dict(state.get("rates"))
        self.reporter.give_states(state.get("callbacks", ()))
        self.whitening.load_state_dict(state.get("whitening"))
        self.iteration = int(state["iteration"])
        self._skips.made = made_behind(state)

    def _is_lost(self, look: bool) -> bool:
        """Whether training cannot go on from here; ``look`` at the weights also while losses are finite."""
        if self._skips.in_row >= self.settings.max_skipped:
            return True
        if not look and not self._skips.in_row:
            return False
        values = (*self.simulator.state_dict().values(), *self._steps.average.values())
        return not all(bool(torch.isfinite(value).all()) for value in values if value.is_floating_point())

    def _roll_back(self) -> None:
        """Go back to the last good checkpoint, the second time to the one before it, and on with scenes not seen so far."""
        failed = self.iteration
        if self._rollbacks_in_row >= self.settings.max_rollbacks:
            raise ValueError(
                f"training does not stay finite: {self.skipped} updates skipped, {self._rollbacks_in_row} times back to a "
                f"checkpoint without getting past iteration {self._failed_at}{self.why_skipped()}; start again with a lower "
                f"trainer.learning_rate ({self.checkpoint_path} holds the last finite weights)"
            )
        path = self.checkpoint_path if self._rollbacks_in_row == 0 else previous(self.checkpoint_path)
        state, _ = distributed.on_main(lambda: load_last_good(path if path.exists() else self.checkpoint_path))
        self._restore(state)
        self.slots.restart()
        self.optimizer.zero_grad(set_to_none=True)
        self.reporter.window = LogWindow()
        self._skips.in_row = 0
        self.rollbacks, self._rollbacks_in_row = self.rollbacks + 1, self._rollbacks_in_row + 1
        self._failed_at = max(failed, self._failed_at)
        if distributed.rank() == 0:
            say(f"hood: iteration {failed} is not finite; back to iteration {self.iteration}, other scenes", error=True)
        note = {"rolled_back_from": float(failed), "rollbacks": float(self.rollbacks), "skipped": float(self.skipped)}
        self.reporter.write(note, cut=True)

    def _ends(self, should_stop: Callable[[], bool]) -> bool:
        """Whether training ends here although iterations are left."""
        return distributed.any_rank(should_stop() or bool(self.stopped))

    def _validate(self) -> None:
        """Validation rollouts; the weights that did best so far are kept."""
        assert self.watch is not None
        averaged = self.averaged()
        values, strip = self.watch(averaged, self.iteration)
        record = self.reporter.write({f"validation_{name}": value for name, value in values.items()}, picture=strip)
        if values["score"] < self.best:
            self.best = values["score"]
            header = {"iteration": self._iterations_in_all, "validation": json.dumps(values)}
            distributed.on_main(lambda: save_simulator(self.folder / "best.safetensors", averaged, header))
        self._rates.judge(values["score"])
        self.reporter.call("after_validation", self.iteration, record)

    def _answer(self, update: Update) -> Tensor:
        """The norm () of the update's gradients before it is shortened, which also tells infinite ones."""
        if update.backward is not None:
            with timed(self.stopwatch, "backward"):
                update.backward()
        with timed(self.stopwatch, "optimiser"):
            self.whitening.pull()
            return get_total_norm([value.grad for value in self.simulator.parameters() if value.grad is not None])

    def _optimise(self, begun: StartedUpdate, norm: Tensor) -> None:
        """One step of the optimiser, if energies and the gradients' ``norm`` () are finite."""
        settings, acceptance = self.settings, begun.update.acceptance
        begun.settings["learning_rate"] = self._rates.put(self.iteration)
        with timed(self.stopwatch, "optimiser"):
            clip_grads_with_norm_(self.simulator.parameters(), settings.clip_norm, norm)
            if acceptance is not None:
                self._steps.take(self.iteration, acceptance.usable & (norm < math.inf))
            elif distributed.any_rank(not begun.made):
                begun.made = False
            else:
                self._steps.take(self.iteration)
