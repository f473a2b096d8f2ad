"""Looking at a model while it trains: callbacks, which may end the training, and validation rollouts shared by all processes,
with a strip of frames to look at."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hood.assets.files.atomic import write_atomically
from hood.assets.files.library import unknown
from hood.assets.files.said import say
from hood.evaluation.validation import Validation, summarise_validation
from hood.rollouts.frames import KeptFrames
from hood.steppers.network import NetworkStepper
from hood.training import distributed
from hood.training.log import Logger, LogWindow, MetricsLog
from hood.training.optimiser import dotted_name
from hood.training.outcome import MEASURED, ConstantOutput

if TYPE_CHECKING:
    from hood.training.trainer import Trainer

#: Pixels of one picture of a strip.
_WIDTH, _HEIGHT = 240, 336


class Callback:
    """What looks at a training, and may end it by ``trainer.stop("why")``. A class of one's own overrides what it needs::

        class Ended(Callback):
            def after_log(self, trainer, iteration, record):
                if record["loss"] < 1.1:
                    trainer.stop("the loss is below 1.1")

    All processes call it; records and validations are the same on each, reports of updates are its own. What it keeps goes
    into the checkpoint by :meth:`state_dict`, so that a resumed training ends where an uninterrupted one does.
    """

    def check(self, trainer: Trainer) -> None:
        """Raise ValueError where it does not fit this training; called before a file is written."""

    def begin(self, trainer: Trainer) -> None:
        """Training begins, or goes on from a checkpoint, whose state is loaded."""

    def after_update(self, trainer: Trainer, iteration: int, report: Mapping[str, float]) -> None:
        """What was measured of an update; on a GPU those since the last line of the log come together."""

    def after_log(self, trainer: Trainer, iteration: int, record: Mapping[str, float]) -> None:
        """A line of ``metrics.jsonl``: the means since the last one."""

    def after_validation(self, trainer: Trainer, iteration: int, record: Mapping[str, float]) -> None:
        """A validation, as ``metrics.jsonl`` has it: ``validation_score`` and the others."""

    def after_checkpoint(self, trainer: Trainer, iteration: int) -> None:
        """``trainer.checkpoint_path`` and the weights beside it are written."""

    def end(self, trainer: Trainer) -> None:
        """The last iteration is over, or the training was stopped; all files are written."""

    def state_dict(self) -> dict[str, Any]:
        """Numbers, texts, lists, tables and tensors that a resumed training needs."""
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Back to what :meth:`state_dict` gave."""


class EarlyStopping(Callback):
    """Ends a training whose ``measure`` has not become better in ``patience`` records in a row.

    Args:
        measure: a figure of ``metrics.jsonl``, of validations (``validation_…``) or of updates (``loss``).
        patience: records, that is validations or lines of the log.
        least_change: a smaller improvement does not count.
        larger_is_better: otherwise less is.

    Raises:
        ValueError: a number that no training can have.
    """

    def __init__(
        self,
        measure: str = "validation_score",
        patience: int = 5,
        least_change: float = 0.0,
        larger_is_better: bool = False,
    ) -> None:
        if not (isinstance(patience, int) and patience >= 1 and isinstance(least_change, (int, float)) and least_change >= 0):
            raise ValueError(
                f"callbacks: EarlyStopping has patience={patience!r} and least_change={least_change!r}; give a whole "
                "number of at least 1, and a number of at least 0"
            )
        self.measure, self.patience, self.least_change = measure, patience, least_change
        self._sign = -1.0 if larger_is_better else 1.0
        self._best, self._waited = math.inf, 0

    def check(self, trainer: Trainer) -> None:
        if self._of_validations and not trainer.settings.validate_every:
            raise ValueError(
                f"callbacks: EarlyStopping reads {self.measure}, and trainer.validate_every is 0; give it, or measure=loss"
            )
        known = ["total", *trainer.potential.terms, *MEASURED, "parameter_gradient_norm"]
        if not self._of_validations and self.measure not in known:
            raise ValueError(f"callbacks: EarlyStopping: {unknown('measure', self.measure, known)}")

    def begin(self, trainer: Trainer) -> None:
        self._decide(trainer)

    def after_log(self, trainer: Trainer, iteration: int, record: Mapping[str, float]) -> None:
        if not self._of_validations:
            self._look(trainer, record)

    def after_validation(self, trainer: Trainer, iteration: int, record: Mapping[str, float]) -> None:
        if self._of_validations:
            self._look(trainer, record)

    def state_dict(self) -> dict[str, Any]:
        return {"best": self._best, "waited": self._waited}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self._best, self._waited = float(state["best"]), int(state["waited"])

    @property
    def _of_validations(self) -> bool:
        return self.measure.startswith("validation_")

    def _look(self, trainer: Trainer, record: Mapping[str, float]) -> None:
        if self.measure not in record:
            raise ValueError(f"callbacks: EarlyStopping: {unknown('measure', self.measure, list(record))}")
        value = self._sign * record[self.measure]
        if value < self._best - self.least_change:
            self._best, self._waited = value, 0
        else:
            self._waited += 1
        self._decide(trainer)

    def _decide(self, trainer: Trainer) -> None:
        if self._waited >= self.patience:
            best = self._sign * self._best
            trainer.stop(f"{self.measure} has not become better than {best:.4g} in {self._waited} records")


class Reporter:
    """What is recorded of a training and told to its callbacks.

    Args:
        loggers: None: TensorBoard; process 0 alone has some.

    Attributes:
        window: reports of the updates since the last record.
    """

    def __init__(self, trainer: Trainer, loggers: Sequence[Logger] | None, callbacks: Sequence[Callback]) -> None:
        self._trainer, self._loggers, self._callbacks = trainer, loggers, tuple(callbacks)
        self._metrics: MetricsLog | None = None
        self._constant = ConstantOutput(trainer.settings.learning_rate)
        self.window = LogWindow()

    def open(self, stack: ExitStack) -> None:
        """Begin to write into the folder of the run, until the end of the ``stack``."""
        trainer = self._trainer
        trainer.folder.mkdir(parents=True, exist_ok=True)
        self._metrics = stack.enter_context(MetricsLog(trainer.folder, trainer.iteration, self._loggers))

    def call(self, hook: str, *values: Any) -> None:
        """A method of all callbacks."""
        for callback in self._callbacks:
            getattr(callback, hook)(self._trainer, *values)

    def add(self, reports: Sequence[dict[str, float]]) -> None:
        """What was measured of the last updates."""
        for number, report in enumerate(reports, self._trainer.iteration - len(reports) + 1):
            self.window.add(report)
            self.call("after_update", number, report)

    def write_means(self, rate: float) -> None:
        """A record of the updates since the last one, and of iterations per second."""
        means = self.window.close()
        record = self.write({**means, "iterations_per_second": rate})
        if distributed.rank() == 0:
            self._constant.look(self._trainer.iteration, means["output_spread"])
        self.call("after_log", self._trainer.iteration, record)

    def write(self, report: dict[str, float], cut: bool = False, picture: np.ndarray | None = None) -> dict[str, float]:
        """One record of what all processes measured, which is returned; ``cut`` drops those of later iterations. With it a
        picture of the validation."""
        report, iteration = distributed.mean(report), self._trainer.iteration

        def write() -> None:
            assert self._metrics is not None
            if cut:
                self._metrics.cut(iteration)
            self._metrics.write(iteration, report)
            if picture is not None:
                self._metrics.picture(iteration, "validation", picture)

        distributed.on_main(write)
        return report

    def callback_states(self) -> list[dict[str, Any]]:
        """What callbacks keep, for a checkpoint."""
        return [{"callback": dotted_name(type(one)), "state": one.state_dict()} for one in self._callbacks]

    def give_states(self, states: Sequence[Mapping[str, Any]]) -> None:
        """The inverse: each has the first state of its class that none before it has; one that is new begins without."""
        left = list(states)
        for callback in self._callbacks:
            found = next(
                (number for number, entry in enumerate(left) if entry["callback"] == dotted_name(type(callback))), None
            )
            if found is not None:
                callback.load_state_dict(left.pop(found)["state"])


@dataclass
class ValidationWatch:
    """Validates a model in training; draws ``pictures`` frames of the first garment as one row.

    Files: ``validation/strip_ITERATION.png`` in ``folder``. Without the picture libraries there is no strip, said once.
    """

    validation: Validation
    folder: Path
    pictures: int = 8
    _said: bool = field(default=False, init=False)

    def __call__(self, simulator: NetworkStepper, iteration: int) -> tuple[dict[str, float], np.ndarray | None]:
        """Figures over all validation rollouts, the same on every process, and on process 0 the strip (H, W, 3) uint8.

        Raises:
            OSError: the strip cannot be written.
        """
        film = KeptFrames()
        mine = range(distributed.rank(), len(self.validation.garments), distributed.world_size())
        rollouts = {}
        for index in mine:
            shown = film.see if index == 0 and self.pictures else None
            rollouts[index] = self.validation.rollout(simulator, index, shown)
        together = {index: item for part in distributed.gather(rollouts) for index, item in part.items()}
        values = summarise_validation([together[index] for index in sorted(together)])
        strip = self._draw(film)
        distributed.on_main(lambda: None if strip is None else self._write(strip, iteration))
        return values, strip

    def _draw(self, film: KeptFrames) -> np.ndarray | None:
        if not film.cloth:
            return None
        try:
            from hood.media.film import Film

            return Film(film.data(), _WIDTH, _HEIGHT).sheet(self.pictures, self.pictures)
        except ImportError as error:
            if not self._said:
                say(f"hood: no validation pictures: {error}", error=True)
            self._said = True
            return None

    def _write(self, strip: np.ndarray, iteration: int) -> None:
        from PIL import Image

        (self.folder / "validation").mkdir(exist_ok=True)
        packed = io.BytesIO()
        Image.fromarray(strip).save(packed, format="PNG")
        write_atomically(self.folder / "validation" / f"strip_{iteration:06d}.png", packed.getvalue())
