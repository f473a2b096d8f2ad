"""A whole step of Newton's method with a number of iterations that is known before: one function of tensors of fixed shapes.

Nothing is read on the host from the first operation to the last, so that torch.compile sees all of it and a CUDA graph holds
it. What :mod:`hood.solver.newton` decides on the way is decided by masks: iterations that a scene does not need change nothing.
The matrix is positive definite, without a share of the indefinite part, which would gain digits in iterations that frames of so
few do not come to: γ after five iterations of a walking dress is 0.0027 in the median of ten states at 1,000 vertices and
0.0046 at 4,400, the plain step's 0.0021 and 0.0040.
"""

from __future__ import annotations

import copy

import torch
from torch import Tensor

from hood.energies.potential import Potential, keeps_both_sides
from hood.energies.problem import StepProblem
from hood.native import features as native
from hood.solver.newton import NewtonSettings
from hood.solver.system.iterate import rounded
from hood.solver.system.plan import SolverPlan
from hood.steppers.static_shapes.newton_pieces import Pieces
from hood.steppers.static_shapes.problem import problem_from, with_fixed_contact
from hood.tensors.conjugate_gradients import block_cg, block_rows


class NewtonFrame(Pieces):
    """``pos, acc, residual, faces = frame(*inputs)`` with ``inputs = step_inputs(problem, surface=True)``
    (:mod:`hood.steppers.static_shapes.problem`), for problems like the one it was made for.

    That are positions (V, 3) at t + 1 in the problem's type, the accelerations (V, 3) that lead there, the relative gradients
    (B) there, and the number (1,) of body faces that need one of ``places``.

    Args:
        potential: settled, all terms with a closed form.
        like: such a problem, with its contact; what is not an input is read from it.
        plan: of its cloth.
        places: for body faces that every cloth vertex is tested against.
        settings: all of ``max_iterations`` are taken, with at most ``cg_iterations`` each.
        dense: search all pairs on a CPU too: what is traced must not leave torch.
    """

    def __init__(
        self,
        potential: Potential,
        like: StepProblem,
        plan: SolverPlan,
        places: int,
        settings: NewtonSettings,
        dense: bool = False,
    ) -> None:
        super().__init__(potential, like, plan, settings.cg_iterations, settings.double)
        self._settings, self._given, self._places, self._dense = settings, like, places, dense
        self._folds = keeps_both_sides(potential)
        self._rows = block_rows(plan.pattern.cols, plan.pattern.starts, plan.scene, self._num_scenes)

    def __call__(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        now = copy.copy(self)  # pieces hand tensors over as attributes, and those of a trace must not stay
        with native.in_torch(), torch.no_grad():
            return now._frame(inputs)

    def _frame(self, inputs: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        problem, incidence = problem_from(self._given, inputs)
        problem, faces = with_fixed_contact(problem, incidence, self._places, self._folds, self._dense)
        problem = self._potential.with_internal_force(problem, compiled=False)
        self._memory()
        self._take_problem(problem)
        self._guess()
        length = torch.ones_like(self._length)
        for _ in range(self._settings.max_iterations):
            self._assemble()
            self._active.copy_(self._residual > self._settings.target_rg)
            self._direct()
            self._solve_all()
            self._aim()
            # One try of the line search: where it fails, the next iteration goes the same way, less far.
            self._length.copy_(length)
            self._attempt()
            length = torch.where(self._moved, 1.0, self._length)
        self._assemble()
        return rounded(problem, self._pos), self._acc.to(problem.state.pos.dtype), self._residual, faces

    def _solve_all(self) -> None:
        """The Newton direction of the positive matrix alone: it never has to be asked for another one."""
        # In half the bytes, as on a CPU: every iteration reads the matrix, whose rounding turns the direction by 1e-7.
        triples = self._idle(self._model.triples, self._active).float()
        rows, most = list(self._rows), self._cg_iterations
        self._solution.copy_(block_cg(triples, self._inverse, self._rhs, self._tolerance, rows, most)[0])
