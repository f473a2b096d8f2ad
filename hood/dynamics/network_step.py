"""A step as a model's output is given it, and what the output makes of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor

from hood.dynamics.feedback import Feedback
from hood.features.inputs import Inputs
from hood.graph.builder import Graph
from hood.losses.problem import StepProblem
from hood.nn.model import MeshGraphNet


class Held(NamedTuple):
    """What the network does not move."""

    free: Tensor  # (V,) bool, what it does
    fixed: Tensor  # (V, 3) m, where the others are


@dataclass(frozen=True)
class NetworkStep:
    """A network and all that it is shown of a step."""

    network: MeshGraphNet
    problem: StepProblem  # as the network sees it, with its contact where the model needs it
    inputs: Inputs  # of the features
    nodes: Tensor  # (V + W_active, node_width) features
    edges: dict[str, Tensor]  # features by edge set
    base: Tensor  # (V, 3) m, what the output is relative to
    held: Held
    force: Tensor | None = None  # (V, 3) N, −∂Φ/∂x at the base, where there is feedback
    feedback: Feedback | None = None  # what the potential says about other positions

    @property
    def graph(self) -> Graph:
        return self.inputs.graph

    def raw(self) -> Tensor:
        """The network's output (V, width), of a schedule of one pass."""
        return self.network(self.graph, self.nodes, self.edges)


class Moved(NamedTuple):
    """Where a network's output leads."""

    pos: Tensor  # (V, 3) m at t + 1
    #: (V, 3) m from where the state's velocity leads, where it was predicted itself: the acceleration is taken from it,
    #: without the cancellation of x − 2x_t + x_{t−1} in float32. None: the acceleration is that of ``pos``.
    displacement: Tensor | None = None
    #: Of models in several passes: (V, 3) m after every pass but the last, and the forces (V, 3) N there.
    early: tuple[tuple[Tensor, Tensor], ...] = ()
