"""Watching a model while it trains: validation rollouts shared by all processes, and a strip of frames to look at."""

from __future__ import annotations

import io
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from hood.assets.files.atomic import write_atomically
from hood.assets.files.said import say
from hood.evaluation.validation import Validation, summarise_validation
from hood.rollouts.frames import KeptFrames
from hood.steppers.network import NetworkStepper
from hood.training import distributed

#: Pixels of one picture of a strip.
_WIDTH, _HEIGHT = 240, 336


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
