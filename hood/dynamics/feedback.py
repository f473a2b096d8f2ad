"""What the potential of a step says about positions, as a network is told it."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from hood.features.inputs import Inputs
from hood.features.local import WIDE_ROUNDS
from hood.losses.potential import Potential
from hood.losses.problem import StepProblem
from hood.mesh.diffusion import Diffusion, neighbours_of
from hood.native import features as native
from hood.nn.fixed_gradients import Steps
from hood.solver.global_step import STEPS
from hood.solver.local_engine import local_terms

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
        self.terms = local_terms(potential, problem, self._compiled or compiled)
        self._together, self._steps = together, steps
        self._diffusion = None if self._compiled else Diffusion(cloth.edges, cloth.num_vertices)

    @torch.no_grad()
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
