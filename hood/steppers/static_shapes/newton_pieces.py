"""Newton's method in pieces of fixed shapes: nothing in a piece waits for the device, so that a CUDA graph can hold each.

The rules are those of :mod:`hood.solver.newton` in torch, and so is the decision when to stop: between the pieces, where the
host reads a few numbers. What there is a loop until something holds is here a piece with a mask, called until the host sees
that it holds: a piece that is called once too often changes nothing.

All pieces of a step with a number of iterations that is known before are one function, which torch.compile sees whole. Its
matrix is positive definite, without a share of the indefinite part, which would gain digits in iterations that frames of so
few do not come to: γ after five iterations of a walking dress is 0.0027 in the median of ten states at 1,000 vertices and
0.0046 at 4,400, the plain step's 0.0021 and 0.0040.
"""

from __future__ import annotations

import copy
from collections.abc import Callable

import torch
from torch import Tensor

from hood.energies.potential import Potential, keeps_both_sides
from hood.energies.problem import STANDARD_GRAVITY, StepProblem, sum_per_scene
from hood.native import features as native
from hood.solver.newton import NewtonSettings
from hood.solver.system.iterate import Iterate, Unknowns, first_iterate, in_double, rounded
from hood.solver.system.line_search import ARMIJO, BACKTRACKS, Stop, shorter
from hood.solver.system.linear import FIRST_SHARPNESS, LEAST_SHARPNESS, by_blocks, invert_blocks
from hood.solver.system.plan import ModelBuilder, QuadraticModel, SolverPlan
from hood.steppers.static_shapes.problem import problem_from, with_fixed_contact
from hood.tensors.conjugate_gradients import block_cg, block_rows
from hood.tensors.dense import sum_rows

#: Conjugate gradient iterations of a piece: between two looks of the host.
CG_PIECE = 8

MaskedStep = Callable[[], None]


class Pieces:
    """What a step of Newton's method is made of. Pieces hand tensors over as attributes.

    Args:
        potential: settled, all terms with a closed form.
        like: a problem with its contact.
        plan: of the problem's cloth, as is everything else that problems are like.
    """

    def __init__(
        self, potential: Potential, like: StepProblem, plan: SolverPlan, cg_iterations: int, double: bool = True
    ) -> None:
        self._potential, self._plan, self._double, self._cg_iterations = potential, plan, double, cg_iterations
        self._tables(like)

    # ---- memory ------------------------------------------------------------------------------------------------------

    @torch.no_grad()
    def _tables(self, like: StepProblem) -> None:
        """Constants of the cloth."""
        like = in_double(like) if self._double else like
        plan, pos, num_scenes = self._plan, like.state.pos, like.num_scenes
        pattern, device = plan.pattern, pos.device
        self._num_scenes, self._scene = num_scenes, plan.scene
        self._cols, self._starts = (torch.as_tensor(table, device=device) for table in (pattern.indices, pattern.indptr))
        self._diagonal = pattern.diagonal.to(device).reshape(-1)
        self._triple_scene = plan.scene[torch.as_tensor(pattern.triple_rows // 3, device=device)]
        self._identity = pos.new_zeros(pattern.num_triples, 3)
        self._identity[self._diagonal] = torch.eye(3, dtype=pos.dtype, device=device).repeat(len(plan.vertices), 1)
        gravity = float(like.gravity.norm()) or STANDARD_GRAVITY
        weight = like.cloth.free * like.cloth.mass * gravity
        self._weight = like.sum_vertices(weight**2).sqrt()
        self._free, self._like_pos = like.cloth.free.to(pos.dtype), pos
        self._memory()

    def _memory(self) -> None:
        """Make the memory that pieces write to."""
        pos, plan, num_scenes = self._like_pos, self._plan, self._num_scenes
        none = torch.zeros(num_scenes, dtype=torch.bool, device=pos.device)
        self._active, self._pending, self._running, self._searching = (none.clone() for _ in range(4))
        self._indefinite, self._halved, self._moved = (none.clone() for _ in range(3))
        number = pos.new_zeros(num_scenes)
        self._phi, self._noise, self._sharpness, self._rz, self._limit = (number.clone() for _ in range(5))
        self._length, self._taken = number.clone(), number.clone()
        self._pos, self._acc, self._start = pos.clone(), torch.zeros_like(pos), pos.clone()
        rows = pos.new_zeros(len(plan.vertices), 3)
        self._solution, self._x, self._r, self._p = (rows.clone() for _ in range(4))

    def _keep(self, iterate: Iterate) -> None:
        for memory, value in zip((self._pos, self._acc, self._phi, self._noise), vars(iterate).values(), strict=True):
            memory.copy_(value)

    @property
    def _now(self) -> Iterate:
        return Iterate(self._pos, self._acc, self._phi, self._noise)

    # ---- pieces ------------------------------------------------------------------------------------------------------

    @torch.no_grad()
    def _take_problem(self, problem: StepProblem) -> None:
        self._problem = in_double(problem) if self._double else problem
        self._unknowns = Unknowns(self._potential, self._problem)
        self._build = ModelBuilder(self._unknowns.terms, self._plan)

    @torch.no_grad()
    def _guess(self) -> None:
        self._keep(first_iterate(self._unknowns))

    @torch.no_grad()
    def _take_up(self) -> None:
        self._keep(self._unknowns.at(self._start))

    @torch.no_grad()
    def _assemble(self) -> None:
        self._model: QuadraticModel = self._build(self._pos, self._acc)
        force_sq = self._sum(self._free * self._model.gradient.square().sum(dim=1), self._problem.cloth.vertex_scene)
        movable = self._weight > 0
        self._residual = torch.where(movable, force_sq.sqrt() / torch.where(movable, self._weight, 1.0), 0.0)

    @torch.no_grad()
    def _direct(self) -> None:
        """Right-hand side and preconditioner of the scenes that move."""
        model, moving = self._model, self._spread(self._active)
        self._rhs = torch.where(moving, -model.gradient.index_select(0, self._plan.vertices), 0.0)
        triples = self._idle(model.triples, self._active)
        self._inverse = invert_blocks(triples.index_select(0, self._diagonal).view(-1, 3, 3))
        self._tolerance = self._residual.nan_to_num(0.0).sqrt().clamp(1e-3, 0.1)
        self._pending.copy_(self._active)
        self._halved.zero_()
        self._solution.zero_()

    @torch.no_grad()
    def _sharpen(self) -> None:
        """The matrix with its share of the indefinite part, and where conjugate gradients begin."""
        share = self._sharpness.index_select(0, self._triple_scene).unsqueeze(1)
        self._triples = self._idle(torch.addcmul(self._model.triples, self._model.indefinite_part, share), self._pending)
        rhs = torch.where(self._spread(self._pending), self._rhs, 0.0)
        z = by_blocks(self._inverse)(rhs)
        rz = self._dot(rhs, z)
        for memory, value in ((self._r, rhs), (self._p, z), (self._rz, rz), (self._limit, self._tolerance**2 * rz)):
            memory.copy_(value)
        for memory in (self._x, self._taken, self._indefinite):
            memory.zero_()
        self._running.copy_(self._rz > self._limit)

    @torch.no_grad()
    def _solve(self) -> None:
        """Some iterations of :func:`hood.solver.system.linear.conjugate_gradients`."""
        x, r, p, rz, running, indefinite = self._x, self._r, self._p, self._rz, self._running, self._indefinite
        for _ in range(CG_PIECE):
            running = running & (self._taken < self._cg_iterations)
            self._taken.add_(1.0)
            q = self._apply(p)
            curvature = self._dot(p, q)
            curved = running & (curvature > 0)
            indefinite = indefinite | (running & ~curved)
            moving, length = self._spread(curved), self._spread(rz / curvature)
            x = torch.where(moving, torch.addcmul(x, length, p), x)
            r = torch.where(moving, torch.addcmul(r, length, q, value=-1.0), r)
            z = by_blocks(self._inverse)(r)
            before, rz = rz, torch.where(curved, self._dot(r, z), rz)
            running = curved & (rz > self._limit)
            p = torch.where(self._spread(running), torch.addcmul(z, self._spread(rz / before), p), p)
        after = (x, r, p, rz, running, indefinite)
        for memory, value in zip((self._x, self._r, self._p, self._rz, self._running, self._indefinite), after, strict=True):
            memory.copy_(value)

    @torch.no_grad()
    def _judge(self) -> None:
        """Take solutions over; scenes whose matrix is not positive definite try again with half the share of the
        indefinite part."""
        failed = self._indefinite & self._pending & (self._sharpness > 0)
        found = self._spread(self._pending & ~failed)
        self._solution.copy_(torch.where(found, self._x, self._solution))
        smaller = torch.where(self._sharpness > LEAST_SHARPNESS, 0.5 * self._sharpness, 0.0)
        self._sharpness.copy_(torch.where(failed, smaller, self._sharpness))
        self._halved.logical_or_(failed)
        self._pending.copy_(failed)

    @torch.no_grad()
    def _aim(self) -> None:
        """The path of the line search."""
        plan, now = self._plan, self._now
        self._sharpness.copy_(torch.where(self._halved, self._sharpness, (2.0 * self._sharpness).clamp(FIRST_SHARPNESS, 1.0)))
        moving = self._spread(self._active)
        direction = torch.zeros_like(now.pos).index_copy(0, plan.vertices, torch.where(moving, self._solution, 0.0))
        slope = self._sum((self._model.gradient * direction).sum(dim=1), self._problem.cloth.vertex_scene)
        self._from, self._slope = Iterate(*(value.clone() for value in vars(now).values())), slope
        self._step, self._stops = direction / self._unknowns.dt_sq, list[tuple[Stop, Tensor]]()
        for wall in self._unknowns.terms.vertices.walls:
            deepest = torch.maximum(wall.depth(now.pos), wall.depth(now.pos + direction)).index_select(0, plan.vertices)
            self._stops.append((Stop(wall, now.pos, self._inverse, plan.vertices), deepest > 0))
        self._length.fill_(1.0)
        self._moved.zero_()
        self._searching.copy_(self._active & (slope < 0))

    @torch.no_grad()
    def _attempt(self) -> None:
        """One try of :func:`hood.solver.system.line_search.backtrack`."""
        unknowns, start, searching = self._unknowns, self._from, self._searching
        length = self._length * searching
        acc = start.acc + length.index_select(0, unknowns.scene).unsqueeze(1) * self._step
        rows = self._plan.vertices
        for stop, touching in self._stops:
            there = unknowns.place_free(rows, acc.index_select(0, rows))
            push = torch.where(touching.unsqueeze(1), stop.correction(there), 0.0)
            acc = acc.index_add(0, rows, push / unknowns.dt_sq.index_select(0, rows))
        trial = unknowns.evaluate(acc)
        accepted = searching & (trial.phi <= start.phi + ARMIJO * self._length * self._slope + start.noise)
        self._keep(unknowns.select(accepted, trial, self._now))
        left = searching & ~accepted
        shorter_length = shorter(self._length, self._slope, trial.phi - start.phi)
        self._length.copy_(torch.where(left, shorter_length, self._length))
        self._moved.logical_or_(accepted)
        self._searching.copy_(left)

    # ---- arithmetic --------------------------------------------------------------------------------------------------

    def _idle(self, triples: Tensor, active: Tensor) -> Tensor:
        return torch.where(active.index_select(0, self._triple_scene).unsqueeze(1), triples, self._identity)

    def _apply(self, x: Tensor) -> Tensor:
        return sum_rows(x.reshape(-1, 1), self._cols, self._starts, self._triples.reshape(-1)).view(-1, 3)

    def _spread(self, values: Tensor) -> Tensor:
        """From scenes (B,) to their vertices (N, 1); of one scene it stays one value, (1, 1)."""
        return values.view(1, 1) if self._num_scenes == 1 else values.index_select(0, self._scene).unsqueeze(1)

    def _dot(self, a: Tensor, b: Tensor) -> Tensor:
        return (a * b).sum().reshape(1) if self._num_scenes == 1 else self._sum((a * b).sum(dim=1), self._scene)

    def _sum(self, values: Tensor, scene: Tensor) -> Tensor:
        return sum_per_scene(values, scene, self._num_scenes)


class FixedSystem(Pieces):
    """The unknowns of a step in such pieces; see :class:`hood.solver.newton.System`.

    Recorded one after the other, as they are below, pieces read and write the same memory in every replay.

    Args:
        potential: settled, all terms with a closed form.
        read: the present problem, with its contact; what it reads may change its values, not its shapes.
        plan: of the problem's cloth, as is everything else that a problem is like.
        record: makes a piece that does the same, faster; None leaves them as they are.
    """

    def __init__(
        self,
        potential: Potential,
        read: Callable[[], StepProblem],
        plan: SolverPlan,
        cg_iterations: int,
        double: bool = True,
        record: Callable[[MaskedStep], MaskedStep] | None = None,
    ) -> None:
        super().__init__(potential, read(), plan, cg_iterations, double)
        self._read, self._used = read, 0
        named = ("enter", "guess", "take_up", "assemble", "direct", "sharpen", "solve", "judge", "aim", "attempt")
        self.pieces: dict[str, MaskedStep] = {}
        for name in named:
            piece: MaskedStep = getattr(self, f"_{name}")
            self.pieces[name] = piece if record is None else record(piece)
            if record is not None:
                # To record computes nothing: what the next piece reads has to be there when it is tried out.
                self.pieces[name]()

    def _enter(self) -> None:
        self._take_problem(self._read())

    # ---- what the host does ------------------------------------------------------------------------------------------

    def enter(self) -> None:
        """Take up the present problem; the state is undefined until :meth:`begin`."""
        self.pieces["enter"]()
        self._used = 0
        self._sharpness.zero_()

    def begin(self, start: Tensor | None) -> None:
        """Take up positions (V, 3), or the better of the two first guesses."""
        if start is None:
            self.pieces["guess"]()
            return
        self._start.copy_(start)
        self.pieces["take_up"]()

    @property
    def phi(self) -> list[float]:
        """(B) J."""
        return [float(value) for value in self._phi.tolist()]

    @property
    def used(self) -> int:
        """Conjugate gradient iterations so far, those of the last piece that changed nothing included."""
        return self._used

    def model(self) -> list[float]:
        """Make the quadratic model of the state; the relative gradients (B)."""
        self.pieces["assemble"]()
        return [float(value) for value in self._residual.tolist()]

    def move(self, residual: list[float], active: list[bool]) -> list[bool]:
        """Take a Newton step in the scenes ``active`` (B); which of them moved (B)."""
        self._active.copy_(torch.tensor(active))
        self.pieces["direct"]()
        while bool(self._pending.any()):
            self.pieces["sharpen"]()
            for _ in range(-(-self._cg_iterations // CG_PIECE)):
                self.pieces["solve"]()
                self._used += CG_PIECE
                if not bool(self._running.any()):
                    break
            self.pieces["judge"]()
        self.pieces["aim"]()
        for _ in range(BACKTRACKS):
            if not bool(self._searching.any()):
                break
            self.pieces["attempt"]()
        return [bool(value) for value in self._moved.tolist()]

    def state(self) -> tuple[Tensor, Tensor]:
        """Positions (V, 3) and the accelerations (V, 3) that lead there."""
        return self._pos.clone(), self._acc.clone()


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
