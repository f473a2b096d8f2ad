"""How the network's raw output becomes next positions: the paper's accelerations, or corrections to a moving base.

Forces predicted, positions solved for.

Positions that are predicted vertex by vertex differ a little from one vertex to the next, and stiff cloth answers every such
difference with a large force. Here the network corrects the *force* on every vertex, and one linear solve with the potential's
positive matrix says where all vertices go together. Stiffness resists what differs from vertex to vertex: errors of the forces
hardly move the cloth, while long waves pass.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple, Protocol, Self

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from hood.contact.contact import Contact
from hood.energies.problem import StepProblem, inertial_guess
from hood.model.features.compiled import planes_of
from hood.model.features.local import GLOBAL_LOOK_WIDTHS, LOOK_WIDTHS, neighbours_of
from hood.model.features.normalizer import RunningNormalizer
from hood.model.readout.network_step import Dirichlet, Moved, NetworkStep, Pass, take_passes
from hood.native import features as native
from hood.solver.vertex.block_jacobi import STEPS
from hood.tensors.conjugate_gradients import Steps
from hood.tensors.dense import RowSums, is_followed

_SMOOTHING_ROUNDS = 16
#: A body this far away [m] has a quarter of the say over a vertex's base motion.
_REACH = 0.03
#: Cloth may be pressed this deep [m] into the contact zone: 3 w p² is then some seventy times a vertex's weight.
DEEPEST = 3e-4
#: Local steps are shortened to this [m]: far from a minimum they mean little.
_LONGEST_STEP = 5e-3


class OutputSettings(NamedTuple):
    """The arguments of :func:`hood.steppers.network.build_simulator` that concern outputs."""

    scale: float
    late_scale: float
    decay: float
    divisor_floor: float | None


class Output(ABC, nn.Module):
    """Turns raw network output into positions, by displacements [m] from a base if it does not say otherwise.

    What a model with this output needs is said by the attributes of the class. An output of your own is a class with a base and
    a displacement, or with a :meth:`move` of its own.
    """

    needs_contact: ClassVar[bool] = False  # of the problem that ``base`` is asked for
    width: ClassVar[int] = 3  # columns of the raw output of vertices
    edge_width: ClassVar[int] = 0  # and of mesh edges
    #: Feature sets that tell the network enough (:data:`hood.model.parts.SETS`).
    feature_sets: ClassVar[tuple[str, ...]] = ("paper", "physical", "local")
    #: Whether schedules of several passes can be taken, and columns of nodes and edges that are seen between them.
    several_passes: ClassVar[bool] = False
    look_widths: ClassVar[tuple[int, int]] = LOOK_WIDTHS
    #: Whether features=local shows it what all vertices together would do as well.
    sees_global_step: ClassVar[bool] = False
    #: Steps of conjugate gradients in that.
    view_steps: ClassVar[Steps] = STEPS
    #: Whether the displacement is an acceleration per frame², from x_t + dt v_t.
    predicts_acceleration: ClassVar[bool] = False
    #: Whether it counts statistics (:meth:`observe`) before training starts.
    collects_statistics: ClassVar[bool] = False

    @classmethod
    def from_settings(cls, settings: OutputSettings, options: Mapping[str, Any]) -> Self:
        """The output of a model with these settings; ``options`` are arguments of the class."""
        return cls(**options)

    @abstractmethod
    def base(self, problem: StepProblem) -> Tensor:
        """Base positions (V, 3) [m]: what zero output means."""

    @abstractmethod
    def displacement(self, raw: Tensor) -> Tensor:
        """Displacement (V, 3) [m] from the base for raw output (V, width)."""

    def held_back(self, problem: StepProblem, base: Tensor) -> Tensor:
        """How much vertices (V,) [N/m] are held back in the global step that the network is shown of the base (V, 3) [m]."""
        return torch.zeros_like(base[:, 0])

    def move(self, step: NetworkStep) -> Moved:
        """Where the network's output leads; vertices that are not free stay where they are held."""
        displacement, (free, fixed) = self.displacement(step.raw()), step.held
        pos = torch.where(free.unsqueeze(1), step.base + displacement, fixed)
        return Moved(pos, displacement if self.predicts_acceleration else None)

    def observe(self, displacement: Tensor) -> None:
        """Collect statistics from skinned accelerations x⁺ − 2x + x⁻ (V, 3) [m per frame²]: there is nothing to count."""


class AccelerationOutput(Output):
    """The paper's output (section 4.2): acceleration per frame², de-normalised by running statistics; the base is the
    inertial guess x_t + dt v_t."""

    feature_sets = ("paper",)
    predicts_acceleration = True
    collects_statistics = True

    def __init__(self, decay: float = 0.999, divisor_floor: float | None = None) -> None:
        super().__init__()
        self.normalizer = RunningNormalizer(3, decay, divisor_floor=divisor_floor)

    @classmethod
    def from_settings(cls, settings: OutputSettings, options: Mapping[str, Any]) -> Self:
        return cls(settings.decay, settings.divisor_floor, **options)

    def base(self, problem: StepProblem) -> Tensor:
        return inertial_guess(problem.state, problem.step, problem.cloth.vertex_scene)

    def displacement(self, raw: Tensor) -> Tensor:
        return self.normalizer.inverse(raw)

    def observe(self, displacement: Tensor) -> None:
        """Collect statistics from skinned accelerations x⁺ − 2x + x⁻ (V, 3) [m per frame²]."""
        self.normalizer.update(displacement)


class VelocityBaseOutput(Output):
    """Corrections of ``scale`` [m] to a base that moves with the body and stays outside it.

    The base is x_t plus the motion of the nearest body surface, averaged over the garment with trust falling with
    distance, then pushed ``clearance`` [m] out of the body at t + 1. Unlike x_t + dt v_t it does not carry the velocity's
    errors on, so that a rollout cannot feed them back.
    """

    needs_contact = True
    feature_sets: ClassVar[tuple[str, ...]] = ("paper", "physical")  # those that tell the network enough

    def __init__(self, scale: float = 5e-3, clearance: float = 2e-3) -> None:
        super().__init__()
        self.scale, self.clearance = scale, clearance

    @classmethod
    def from_settings(cls, settings: OutputSettings, options: Mapping[str, Any]) -> Self:
        """The output of a model with these settings; ``options`` are arguments of the class."""
        return cls(settings.scale, **options)

    def base(self, problem: StepProblem) -> Tensor:
        """Base positions (V, 3) [m]: what zero output means."""
        state, contact, cloth = problem.state, problem.contact, problem.cloth
        if contact is None:
            return inertial_guess(state, problem.step, cloth.vertex_scene)
        target = problem.step.pin_target
        if native.applies(state.pos, contact.point, target):
            return self._compiled_base(problem, contact)
        trust = 1.0 / (1.0 + 3.0 * (contact.dist.clamp_min(0.0) / _REACH) ** 2)
        motion = contact.next_point - contact.point
        if target is not None:
            pinned = cloth.pinned
            motion = torch.where(pinned.unsqueeze(1), target - state.pos, motion)
            trust = torch.where(pinned, torch.ones_like(trust), trust)
        base = state.pos + _smooth(motion, trust, cloth.edges)
        depth = (self.clearance - contact.next_dist(base)).clamp_min(0.0) * contact.valid
        return base + depth.unsqueeze(1) * contact.next_normal

    def _compiled_base(self, problem: StepProblem, contact: Contact) -> Tensor:
        cloth, target = problem.cloth, problem.step.pin_target
        pos = problem.state.pos.contiguous()
        neighbours = neighbours_of(cloth.edges, cloth.num_vertices)
        pins = (cloth.pinned, None if target is None else target.contiguous())
        base, memory = torch.empty_like(pos), pos.new_empty(3, len(pos), 4)
        body, far = planes_of(contact), (_REACH, self.clearance)
        native.call("base", neighbours.pointers(), body, pos, *pins, *far, _SMOOTHING_ROUNDS, base, memory)
        return base

    def displacement(self, raw: Tensor) -> Tensor:
        """Displacement (V, 3) [m] from the base for raw output (V, 3)."""
        return self.scale * raw

    def outside(self, problem: StepProblem, pos: Tensor) -> Tensor:
        """``pos`` (V, 3) taken out of the body at t + 1, up to the depth in the contact zone that cloth's forces reach."""
        contact = problem.contact
        if contact is None:
            return pos
        depth = (self.least_distance(problem, contact) - contact.next_dist(pos)).clamp_min(0.0) * contact.valid
        return pos + depth.unsqueeze(1) * contact.next_normal

    def least_distance(self, problem: StepProblem, contact: Contact) -> Tensor | float:
        """Distance [m] from the body that vertices, all or each of them (V,), are left at least."""
        return self.clearance - DEEPEST


class LocalStepOutput(VelocityBaseOutput):
    """Corrections in several passes, each with a share of the vertices' own steps down the potential.

    The raw output of a pass (V, 5) is a displacement in units of ``scale`` (``late_scale`` after the first pass), the share of
    the local step that is taken (:mod:`hood.solver.vertex.block_jacobi`; ``gain`` more after the first pass) and the share of
    the pass before: the network says how far, the physics where to. After every pass the cloth is taken out of the body.
    """

    width = 5
    feature_sets = ("local",)
    several_passes = True

    def __init__(self, scale: float = 5e-3, clearance: float = 2e-3, late_scale: float = 1e-3, gain: float = 0.3) -> None:
        super().__init__(scale, clearance)
        self.late_scale, self.gain = late_scale, gain

    @classmethod
    def from_settings(cls, settings: OutputSettings, options: Mapping[str, Any]) -> Self:
        return cls(settings.scale, late_scale=settings.late_scale, **options)

    def move(self, step: NetworkStep) -> Moved:
        return take_passes(self, step)

    def lead(self, raw: Tensor, start: Pass) -> Tensor:
        """Positions (V, 3) [m] after a pass."""
        step = start.inputs.local_step
        assert step is not None
        return self.take(start.problem, raw, start.index, step, start.before, start.last, start.held)

    def correction(self, raw: Tensor, index: int, step: Tensor, before: Tensor | None) -> Tensor:
        """Displacement (V, 3) [m] of pass ``index``, with the local steps (V, 3) [m] at its start and the displacement of the
        pass before."""
        first = index == 0
        step = step * (_LONGEST_STEP / step.norm(dim=1, keepdim=True).clamp_min(_LONGEST_STEP))
        moved = (self.scale if first else self.late_scale) * raw[:, :3] + (raw[:, 3:4] + (0.0 if first else self.gain)) * step
        return moved if before is None else moved + raw[:, 4:5] * before

    def take(
        self, problem: StepProblem, raw: Tensor, index: int, step: Tensor, before: Tensor | None, last: Tensor, held: Dirichlet
    ) -> Tensor:
        """Positions (V, 3) after pass ``index`` from where the one before left off: its :meth:`correction`, then
        :meth:`outside`; vertices that are not free where they are held."""
        contact, (free, fixed) = problem.contact, held
        if not native.applies(raw, step, before, last, fixed, None if contact is None else contact.next_point):
            there = self.outside(problem, last + self.correction(raw, index, step, before))
            return torch.where(free.unsqueeze(1), there, fixed)
        scale, gain = (self.scale, 0.0) if index == 0 else (self.late_scale, self.gain)
        pos, body = torch.empty_like(last), planes_of(contact)
        tables = (None if table is None else table.contiguous() for table in (raw, step, before, last))
        limits = (scale, gain, _LONGEST_STEP, self.clearance - DEEPEST)
        native.call("take", body, *tables, free, fixed.contiguous(), len(pos), *limits, pos)
        return pos


def _smooth(values: Tensor, trust: Tensor, edges: Tensor) -> Tensor:
    """Trust-weighted averages of ``values`` (V, 3) over growing neighbourhoods: untrusted vertices take their neighbours'
    values, trusted ones keep theirs."""
    start, end = edges.unbind(dim=1)
    senders, receivers = torch.cat([start, end]), torch.cat([end, start])
    weight = trust.unsqueeze(1)
    total = torch.cat([values * weight, weight], dim=1)
    degree = torch.zeros_like(weight).index_add(0, receivers, torch.ones_like(weight[senders])).clamp_min(1.0)
    smooth, sums = total, RowSums(receivers, senders, len(total))
    for _ in range(_SMOOTHING_ROUNDS):
        spread = sums(smooth) / degree
        # A vertex keeps its own say in every round, in proportion to its trust.
        smooth = weight * total + (1.0 - 0.5 * weight) * spread
    return smooth[:, :3] / smooth[:, 3:].clamp_min(1e-12)


#: One unit of output is this force per mass [m/s²].
_PUSH = 9.81
#: Damping of a vertex in units of its inertia m / dt², and the logarithm up to which outputs change it.
_DAMPING, _RANGE = 0.01, 12.0
#: Global steps are shortened to this [m].
_LONGEST = 2e-2


class Solver(Protocol):
    """Who solves for the global step, see :meth:`hood.solver.vertex.block_jacobi.LocalTerms.solve`."""

    def solve(self, pos: Tensor, force: Tensor, damping: Tensor) -> Tensor: ...


class GlobalStepOutput(VelocityBaseOutput):
    """Corrections to the forces at the base, or at what the pass before led to, and the global step under them.

    The raw output (V, 4) is a force in units of the weight, and the logarithm of how much more than a hundredth of its inertia
    holds a vertex back. At last the cloth is taken out of the body. Zero output is a step of Newton's method without a line
    search.
    """

    width = 4
    feature_sets = ("local",)
    several_passes = True
    look_widths = GLOBAL_LOOK_WIDTHS
    sees_global_step = True

    @classmethod
    def from_settings(cls, settings: OutputSettings, options: Mapping[str, Any]) -> Self:
        return cls(**options)

    def move(self, step: NetworkStep) -> Moved:
        return take_passes(self, step)

    def lead(self, raw: Tensor, start: Pass) -> Tensor:
        """Positions (V, 3) [m] after a pass."""
        return self.positions(start.problem, raw, start.last, start.force, start.held, start.feedback.terms)

    def positions(
        self, problem: StepProblem, raw: Tensor, last: Tensor, force: Tensor, held: Dirichlet, solver: Solver
    ) -> Tensor:
        """Positions (V, 3) [m] after a pass.

        Args:
            raw: (V, 4).
            last: (V, 3) m, where the pass starts.
            force: (V, 3) N, −∂Φ/∂x there.
        """
        mass = problem.cloth.mass
        push = force + _PUSH * mass.unsqueeze(1) * raw[:, :3]
        inertia = mass / problem.vertex_dt.squeeze(1) ** 2
        damping = _DAMPING * inertia * torch.exp((2.0 * raw[:, 3]).clamp(-_RANGE, _RANGE))
        moved: Tensor = solver.solve(last, push, damping) if is_followed() else _Solve.apply(push, damping, last, solver)
        moved = moved * (_LONGEST / moved.norm(dim=1, keepdim=True).clamp_min(_LONGEST))
        return torch.where(held.free.unsqueeze(1), self.outside(problem, last + moved), held.fixed)


class _Solve(torch.autograd.Function):
    """The solve, with the derivative it would have if it were exact: the matrix is symmetric and a constant."""

    @staticmethod
    def forward(ctx: Any, force: Tensor, damping: Tensor, pos: Tensor, solver: Solver) -> Tensor:
        moved = solver.solve(pos, force, damping)
        ctx.save_for_backward(damping, pos, moved)
        ctx.solver = solver
        return moved

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        damping, pos, moved = ctx.saved_tensors
        adjoint = ctx.solver.solve(pos, grad, damping)
        # ∂A/∂d_i = 1 at (i, i): dd = −λ·u.
        return adjoint, -(adjoint * moved).sum(dim=1), None, None
