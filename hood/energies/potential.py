"""The incremental potential: one function for the training loss, the solver and the reported gap."""

from __future__ import annotations

import weakref
from collections.abc import Mapping
from dataclasses import replace
from operator import is_
from typing import Any

import torch
from torch import Tensor

from hood.energies.bending import Bending, CurrentLengthBending
from hood.energies.compiled_elements import energies_and_gradient
from hood.energies.contact import CentroidCollision, Collision
from hood.energies.friction import CodedFriction, Friction, WeightFriction
from hood.energies.mass_points import Attachment, Gravity, Inertia, SoftPins
from hood.energies.membrane import Stretching
from hood.energies.problem import STANDARD_GRAVITY, StepProblem, sum_per_scene
from hood.energies.term import NOT_INTERNAL, checked, is_energy, kind_of, prepared
from hood.energies.term import Term as Term
from hood.tensors.batch import made_of


class Potential:
    """Sum of energies whose minimum over the next positions is the implicit Euler step (HOOD paper, section
    3.3).

    ``next_pos`` and ``acc`` are two views of the same unknown, next_pos = x_t + dt v_t + dt² acc; terms use
    the one that is exact for them. A term that is None is left out: a config's way to have none.

    Args:
        terms: the energies by name, each of :class:`Term`.

    Attributes:
        terms: those that are not None.
    """

    def __init__(self, terms: Mapping[str, Term | None]) -> None:
        self.terms: dict[str, Term] = {name: term for name, term in terms.items() if term is not None}

    def with_terms(self, **terms: Term) -> Potential:
        """The same potential with some terms replaced or added."""
        return Potential({**self.terms, **terms})

    @property
    def settings(self) -> dict[str, dict[str, Any]]:
        """Kind and plain values of every term, by its name: what tells two potentials apart, and can be written down."""
        return {
            name: {"term": kind_of(term)}
            | {key: value for key, value in vars(term).items() if isinstance(value, (bool, int, float, str))}
            for name, term in self.terms.items()
        }

    def prepare(self, problem: StepProblem) -> StepProblem:
        """The problem with what the terms found out about it, once per step: call it before the first energy.

        The problem itself where no term asks for more than it holds; contact that is there already is not searched again.
        """
        known = made_of(problem).get("prepared")
        if known is not None and known[0]() is problem and self.is_as(known[1]):
            return problem
        for term in self.terms.values():
            problem = prepared(term, problem)
        problem = self.with_internal_force(problem)
        made_of(problem)["prepared"] = weakref.ref(problem), self.parts()
        return problem

    def parts(self) -> list[Any]:
        """The terms and what they hold, for :meth:`is_as`."""
        return [value for term in self.terms.values() for value in (term, *getattr(term, "__dict__", {}).values())]

    def is_as(self, parts: list[Any]) -> bool:
        """Whether the terms are the same objects as when ``parts`` were asked for, and hold the same."""
        own = self.parts()
        return len(own) == len(parts) and all(map(is_, own, parts))

    @torch.no_grad()
    def with_internal_force(self, problem: StepProblem, compiled: bool = True) -> StepProblem:
        """The problem with the forces at x_t of all terms but inertia, gravity, contact and friction, if a friction by the
        contact's own force asks for them; itself where that is done, there is no contact or nobody asks.

        Args:
            compiled: may leave torch; False where a graph is recorded or traced.
        """
        pulling = self.asked_internal(problem)
        if pulling is None:
            return problem
        pos = problem.state.pos
        by = energies_and_gradient if compiled else Potential.gradient
        return replace(problem, internal_force=-by(pulling, problem, pos)[0].to(pos.dtype))

    def asked_internal(self, problem: StepProblem) -> Potential | None:
        """The terms whose forces at x_t :meth:`with_internal_force` is asked for; None where that is done or nobody asks."""
        if problem.internal_force is not None or not any(_needs_internal_force(term, problem) for term in self.terms.values()):
            return None
        return Potential({name: term for name, term in self.terms.items() if _counts_as_internal(term, problem)})

    def active(self, problem: StepProblem) -> dict[str, Term]:
        """The terms that can be anything but a constant zero for a prepared ``problem``."""
        return {name: term for name, term in self.terms.items() if term.applies(problem)}

    def settled(self, problem: StepProblem) -> Potential:
        """The terms that play a role in a prepared ``problem`` as a potential that does not ask again: to ask may wait for the
        device, which a captured graph must not."""
        return _Settled(self.active(problem))

    def only(self, terms: Mapping[str, Term]) -> Potential:
        """Some of the terms, by name, as a potential of the same kind."""
        return type(self)(terms)

    def energies(self, problem: StepProblem, next_pos: Tensor, acc: Tensor | None = None) -> dict[str, Tensor]:
        """Energies [J] (B,) by term; terms that the scene does not need are left out.

        Args:
            next_pos: (V, 3) m, local frame.
            acc: (V, 3) m/s²; by default computed from ``next_pos``, with the precision that allows.

        Raises:
            ValueError: when ``next_pos`` is in half precision, or a term returns something else than (B,).
        """
        if next_pos.dtype in (torch.float16, torch.bfloat16):
            raise ValueError(f"energies cannot be computed in {next_pos.dtype}; give positions in float32 or float64")
        acc = problem.acceleration(next_pos) if acc is None else acc
        active, count = self.active(problem), problem.num_scenes
        return {name: checked(name, term, term(problem, next_pos, acc), count) for name, term in active.items()}

    def total(self, problem: StepProblem, next_pos: Tensor, acc: Tensor | None = None) -> Tensor:
        """Potential Φ [J] per scene (B,)."""
        energies = self.energies(problem, next_pos, acc)
        return sum(energies.values(), start=next_pos.new_zeros(problem.num_scenes))

    def gradient(self, problem: StepProblem, next_pos: Tensor, acc: Tensor | None = None) -> tuple[Tensor, dict[str, Tensor]]:
        """∂Φ/∂x [N] (V, 3) at ``next_pos``, and the energies [J] there; both detached.

        ``acc`` is as in :meth:`energies`; given or not, it follows the positions in the derivative.
        """
        with torch.enable_grad():
            pos = next_pos.detach().requires_grad_(True)
            if acc is not None:
                # Zero in value, one over dt² in slope: keeps the precision of the given acceleration.
                acc = acc.detach() + (pos - pos.detach()) / problem.vertex_dt**2
            energies = self.energies(problem, pos, acc)
            total = sum(energies.values(), start=pos.sum() * 0.0)
            (gradient,) = torch.autograd.grad(total.sum(), pos)
        return gradient, {name: energy.detach() for name, energy in energies.items()}


class _Settled(Potential):
    """A potential all of whose terms play a role in every problem that it is asked about."""

    def active(self, problem: StepProblem) -> dict[str, Term]:
        return self.terms


def with_soft_pins(potential: Potential) -> Potential:
    """The potential with springs to the places of soft pins, where steps have any."""
    return potential.with_terms(soft_pins=SoftPins())


def keeps_both_sides(potential: Potential) -> bool:
    """Whether a term keeps the cloth off both sides of folds of the body."""
    return any(getattr(term, "sides", "nearest") == "both" for term in potential.terms.values())


def _counts_as_internal(term: Term, problem: StepProblem) -> bool:
    if not is_energy(term):
        return True
    return not (term.role in NOT_INTERNAL or term.is_inactive(problem))


def _needs_internal_force(term: Term, problem: StepProblem) -> bool:
    return is_energy(term) and term.needs_internal_force(problem)


def default_potential(
    collision_weight: float = 5e5,
    collision_epsilon: float = 2e-3,
    friction_coefficient: float = 0.5,
    friction_slip_speed: float = 5e-3,
    attachment_stiffness: float = 1e3,
    contact: str = "vertices",
    reach: str = "curvature",
    sides: str = "both",
) -> Potential:
    """The paper's potential in safe forms: contact with triangles, friction by normal force, rest angles.

    Args:
        collision_weight: of contact [J/m³], whose energy is cubic in the depth.
        collision_epsilon: distance from the skin at which contact begins [m].
        friction_coefficient: of Coulomb friction between cloth and body; 0: none.
        friction_slip_speed: speed [m/s] below which friction counts as static.
        attachment_stiffness: of the springs [N/m] that close attachments, such as buttons.
        contact: where contact acts: ``vertices``, ``edges`` or ``strict``.
        reach: ``curvature`` sets contact off farther where long edges meet a bulge, ``constant`` does not.
        sides: ``both`` keeps cloth off both sides of a fold of the body, ``nearest`` off the nearer one.

    Raises:
        ValueError: a value out of range.

    Examples:
        >>> import hood
        >>> sorted(hood.default_potential().terms)
        ['attachment', 'bending', 'collision', 'friction', 'gravity', 'inertia', 'stretching']
    """
    collision = collision_weight, collision_epsilon, contact, reach, sides
    return Potential(
        {
            "stretching": Stretching(),
            "bending": Bending(),
            "inertia": Inertia(),
            "gravity": Gravity(),
            "collision": Collision(*collision),
            "friction": Friction(friction_coefficient, friction_slip_speed, *collision),
            "attachment": Attachment(attachment_stiffness),
        }
    )


def reference_potential(
    collision_weight: float = 5e5,
    collision_epsilon: float = 2e-3,
    friction_coefficient: float = 0.5,
    friction_slip_speed: float = 5e-3,
    friction_radius: float = 3e-3,
    attachment_stiffness: float = 1e3,
) -> Potential:
    """The energies of HOOD's published code as they are meant, where they differ from :func:`default_potential`: for
    comparisons. Its friction computes something else, see :func:`coded_potential`."""
    return default_potential(collision_weight, collision_epsilon, attachment_stiffness=attachment_stiffness).with_terms(
        bending=CurrentLengthBending(),
        collision=CentroidCollision(collision_weight, collision_epsilon),
        friction=WeightFriction(friction_coefficient, friction_slip_speed, friction_radius),
    )


def coded_potential(
    collision_weight: float = 5e5,
    collision_epsilon: float = 2e-3,
    collision_lagged: bool = False,
    friction_coefficient: float = 0.5,
    friction_radius: float = 3e-3,
    attachment_stiffness: float = 1e3,
) -> Potential:
    """The energies that HOOD's published code computes: :func:`reference_potential` with its friction as coded, and with
    ``collision_lagged`` its ``cvpr`` collision."""
    return reference_potential(attachment_stiffness=attachment_stiffness).with_terms(
        collision=CentroidCollision(collision_weight, collision_epsilon, collision_lagged),
        friction=CodedFriction(friction_coefficient, friction_radius),
    )


def scale(problem: StepProblem, longest: float | None = None) -> Tensor:
    """Reference energy e0 = ½ M g² dt² [J] (B,): what free fall over one step is worth, the unit of the gap.

    Standard gravity stands in where the problem has none. ``longest`` [s]: a longer step counts as one of that length.
    """
    mass = problem.sum_vertices(problem.cloth.mass)
    dt = problem.step.dt.to(mass)
    return 0.5 * mass * (_gravity_norm(problem) * (dt if longest is None else dt.clamp_max(longest))) ** 2


def relative_gradient(problem: StepProblem, gradient: Tensor) -> Tensor:
    """Residual rg = ‖∂Φ/∂x‖₂ / ‖M g‖₂ (B,) over free vertices of ``gradient`` (V, 3); 0 is an exact step.

    Standard gravity stands in where the problem has none; a scene without free vertices has 0.
    """
    cloth = problem.cloth
    free = cloth.free.to(gradient.dtype)
    # A product with ones: a sum over so short an axis would be slow.
    force_sq = problem.sum_vertices(free * torch.mv(gradient * gradient, gradient.new_ones(3)))
    weight_sq = sum_per_scene(free * (cloth.mass * _gravity_norm(problem)) ** 2, cloth.vertex_scene, cloth.num_scenes)
    movable = weight_sq > 0
    return torch.where(movable, (force_sq / torch.where(movable, weight_sq, 1.0)).sqrt(), 0.0)


def weight_norms(problem: StepProblem) -> list[float]:
    """‖M g‖₂ [N] (B) over free vertices, what :func:`relative_gradient` divides by; kept as long as the cloth is what it is."""
    cloth, gravity = problem.cloth, problem.gravity.tolist()
    made, version = made_of(cloth), None if cloth.mass.is_inference() else cloth.mass._version
    known = made.get("weight")
    if known is None or version is None or known[0] != (version, gravity):
        weight = cloth.free * cloth.mass * float(_gravity_norm(problem))
        known = made["weight"] = (version, gravity), problem.sum_vertices(weight**2).sqrt().tolist()
    norms: list[float] = known[1]
    return norms


def _gravity_norm(problem: StepProblem) -> Tensor:
    norm = problem.gravity.norm()
    return torch.where(norm > 0, norm, STANDARD_GRAVITY)
