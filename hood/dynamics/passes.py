"""A step in several passes: the network predicts, the potential says what is wrong with it, the network goes on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor

from hood.dynamics.feedback import Feedback
from hood.dynamics.network_step import Held, Moved, NetworkStep
from hood.features import compiled
from hood.features.inputs import Inputs
from hood.features.local import look
from hood.losses.problem import StepProblem


@dataclass(frozen=True)
class Pass:
    """Where a pass starts."""

    problem: StepProblem
    index: int
    inputs: Inputs  # with the view from there
    last: Tensor  # (V, 3) m, the place itself
    before: Tensor | None  # (V, 3) m, the displacement of the pass before
    force: Tensor  # (V, 3) N, −∂Φ/∂x there
    held: Held
    feedback: Feedback


class Leads(Protocol):
    """An output that can be taken in several passes."""

    def lead(self, raw: Tensor, start: Pass) -> Tensor:
        """Positions (V, 3) [m] that the raw output of a pass leads to."""
        ...


class Passes:
    """The passes of one step: turns each raw output into positions and shows the next pass what they look like.

    A pass starts from what the pass before led to, without a gradient: it answers for its own correction.
    """

    def __init__(self, output: Leads, step: NetworkStep) -> None:
        assert step.feedback is not None, "several passes need features that look at the potential"
        assert step.force is not None
        self._output, self._network, self._feedback = output, step.network, step.feedback
        self._start = Pass(step.problem, 0, step.inputs, step.base, None, step.force, step.held, step.feedback)
        self.positions: list[Tensor] = []  # (V, 3) m after every pass
        self.forces: list[Tensor] = []  # (V, 3) N there, but for the last

    def take(self, raw: Tensor) -> Tensor:
        """Positions (V, 3) [m] after the pass with this output."""
        pos = self._output.lead(raw, self._start)
        self.positions.append(pos)
        before, last = pos.detach() - self._start.last, pos.detach()
        self._start = replace(self._start, index=len(self.positions), before=before, last=last)
        return pos

    def look(self, index: int, raw: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """What the next pass sees of the prediction of pass ``index``."""
        self.take(raw)
        inputs, force = self._feedback(self._start.inputs, self._start.last)
        self._start = replace(self._start, inputs=inputs, force=force)
        self.forces.append(force)
        with torch.no_grad():
            see = compiled.look if compiled.applies(inputs) else look
            return see(inputs, self._network.pass_sets(index + 1))


def take_passes(output: Leads, step: NetworkStep) -> Moved:
    """Where the passes of a step lead."""
    passes = Passes(output, step)
    pos = passes.take(step.network(step.graph, step.nodes, step.edges, passes.look))
    return Moved(pos, early=tuple(zip(passes.positions[:-1], passes.forces, strict=True)))
