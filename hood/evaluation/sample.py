"""Steps kept out of a rollout, for measurements after it."""

from __future__ import annotations

import torch

from hood.dynamics.simulator import Prediction
from hood.losses.problem import StepProblem


class StepSample:
    """Observer of :func:`hood.dynamics.rollout.simulate` that keeps ``count`` steps, spread evenly over ``frames``.

    Steps are kept instead of measured on the spot: what runs between two frames slows the next one down. Steps that
    lead to positions that are not finite have no gap and are passed over.
    """

    def __init__(self, frames: range, count: int) -> None:
        # The middles of equal stretches.
        self.wanted = {frames[(2 * i + 1) * len(frames) // (2 * count)] for i in range(count if len(frames) else 0)}
        self.steps: list[tuple[StepProblem, Prediction]] = []

    def __call__(self, frame: int, problem: StepProblem, prediction: Prediction) -> None:
        """Keep the step to ``frame`` if it is one of those wanted."""
        if frame in self.wanted and bool(torch.isfinite(prediction.next_pos).all()):
            self.steps.append((problem, prediction))
