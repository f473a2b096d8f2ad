"""A step as a model's output is given it, and what the output makes of it.

What the potential of a step says about positions, as a network is told it.

A step in several passes: the network predicts, the potential says what is wrong with it, the network goes on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from hood.energies.potential import Potential
from hood.energies.problem import StepProblem
from hood.model.features import compiled
from hood.model.features.inputs import Inputs
from hood.model.features.local import WIDE_ROUNDS, Diffusion, look_local, neighbours_of
from hood.model.graph.builder import Graph
from hood.model.network.model import MeshGraphNet
from hood.native import features as native
from hood.solver.vertex.block_jacobi import STEPS
from hood.solver.vertex.compiled import local_terms
from hood.tensors.conjugate_gradients import Steps
from hood.tensors.dense import is_followed, unfollowed

_ROUNDS = torch.tensor(WIDE_ROUNDS)


class Feedback:
    """What the potential of one step says about positions, as features read it; constants of the step are gathered once.

    Args:
        together: with the global step.
        steps: of conjugate gradients in it.
        compiled: ask the compiled solver where it knows the potential, though the rest goes by torch: what the network is
            shown has no gradient, and a global step takes twenty times as long in torch.
    """

    def __init__(
        self,
        potential: Potential,
        problem: StepProblem,
        together: bool = False,
        compiled: bool = False,
        steps: Steps = STEPS,
    ) -> None:
        self.potential = potential
        self._cloth = cloth = problem.cloth
        self._mass = cloth.mass.clamp_min(1e-12).unsqueeze(1)
        self._compiled = native.applies(problem.state.pos, self._mass)
        self.terms = local_terms(potential, problem, self._compiled or (compiled and not is_followed()))
        self._together, self._steps = together, steps
        self._diffusion = None if self._compiled else Diffusion(cloth.edges, cloth.num_vertices)

    @unfollowed
    def __call__(self, inputs: Inputs, pos: Tensor, held_back: Tensor | None = None) -> tuple[Inputs, Tensor]:
        """The inputs with the view from positions (V, 3), and the forces −∂Φ/∂x (V, 3) [N] there; ``held_back`` (V,) [N/m] is
        the damping of the global step."""
        view, damping = self.terms(pos), torch.zeros_like(pos[:, 0]) if held_back is None else held_back
        together = self.terms.solve(pos, view.force, damping, self._steps) if self._together else None
        residual, wide = (self._compiled_residuals if self._compiled else self._residuals)(view.force)
        rows, step = inputs.edges, view.step
        seen = replace(inputs, edge_rows=rows, base_pos=pos, residual=residual, local_step=step, wide_residual=wide)
        return replace(seen, global_step=together), view.force

    def _residuals(self, force: Tensor) -> tuple[Tensor, Tensor]:
        """Accelerations (V, 3) that forces ask for, and those of neighbourhoods (V, 6)."""
        # Forces and masses of a neighbourhood are added up; its residual is their ratio.
        diffusion = self._diffusion
        assert diffusion is not None
        spread, wide, done = torch.cat([force, self._mass], dim=1), [], 0
        for rounds in WIDE_ROUNDS:
            spread, done = diffusion.spread(spread, rounds - done), rounds
            wide.append(spread[:, :3] / spread[:, 3:])
        return force / self._mass, torch.cat(wide, dim=1)

    def _compiled_residuals(self, force: Tensor) -> tuple[Tensor, Tensor]:
        neighbours, count = neighbours_of(self._cloth.edges, len(force)), len(WIDE_ROUNDS)
        residual, wide = torch.empty_like(force), force.new_empty(len(force), 3 * count)
        tables = (neighbours.pointers(), force, self._mass, _ROUNDS)
        native.call("residuals", *tables, count, residual, wide, force.new_empty(3, len(force), 4))
        return residual, wide


class Dirichlet(NamedTuple):
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
    held: Dirichlet
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


@dataclass(frozen=True)
class Pass:
    """Where a pass starts."""

    problem: StepProblem
    index: int
    inputs: Inputs  # with the view from there
    last: Tensor  # (V, 3) m, the place itself
    before: Tensor | None  # (V, 3) m, the displacement of the pass before
    force: Tensor  # (V, 3) N, −∂Φ/∂x there
    held: Dirichlet
    feedback: Feedback


class Leads(Protocol):
    """An output that can be taken in several passes."""

    def lead(self, raw: Tensor, start: Pass) -> Tensor:
        """Positions (V, 3) [m] that the raw output of a pass leads to."""
        ...


class CorrectionPasses:
    """The passes of one step: turns each raw output into positions and shows the next pass what they look like.

    A pass starts from what the pass before led to, in training without a gradient: it answers for its own correction.
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
        last = pos if is_followed() else pos.detach()
        before = last - self._start.last
        self._start = replace(self._start, index=len(self.positions), before=before, last=last)
        return pos

    def look(self, index: int, raw: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """What the next pass sees of the prediction of pass ``index``."""
        self.take(raw)
        inputs, force = self._feedback(self._start.inputs, self._start.last)
        self._start = replace(self._start, inputs=inputs, force=force)
        self.forces.append(force)
        return _seen(inputs, self._network.pass_sets(index + 1))


@unfollowed
def _seen(inputs: Inputs, sets: Sequence[str]) -> tuple[Tensor, dict[str, Tensor]]:
    return (compiled.look if compiled.applies(inputs) else look_local)(inputs, sets)


def take_passes(output: Leads, step: NetworkStep) -> Moved:
    """Where the passes of a step lead."""
    passes = CorrectionPasses(output, step)
    pos = passes.take(step.network(step.graph, step.nodes, step.edges, passes.look))
    return Moved(pos, early=tuple(zip(passes.positions[:-1], passes.forces, strict=True)))
