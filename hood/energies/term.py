"""What the potential, the solvers and the commands ask of an energy, and what they refuse of one."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from enum import Enum
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, Self, TypeGuard, runtime_checkable

from torch import Tensor

from hood.energies.problem import StepProblem

if TYPE_CHECKING:
    from hood.contact.contact import Contact
    from hood.contact.sample_points import PointContact


class Role(Enum):
    """What an energy is for; its subclasses inherit it."""

    INERTIA = "inertia"  # against acceleration
    GRAVITY = "gravity"  # weight
    ELASTIC = "elastic"  # of the cloth and what is sewn to it
    DAMPING = "damping"  # of the fabric
    EXTERNAL = "external"  # of the air around
    CONTACT = "contact"  # with the body
    FRICTION = "friction"  # on the body
    SELF_CONTACT = "self_contact"  # of cloth with cloth
    SELF_FRICTION = "self_friction"  # of cloth on cloth
    TRAINING = "training"  # for training alone: the solver takes none of them


#: Roles of what does not press cloth onto the skin, see :attr:`hood.energies.problem.StepProblem.internal_force`.
NOT_INTERNAL = frozenset({Role.INERTIA, Role.GRAVITY, Role.CONTACT, Role.FRICTION, Role.SELF_FRICTION})


class Form(Enum):
    """The kind of an energy's closed-form derivatives, and what :meth:`Energy.closed_form` returns of it."""

    MASS = "mass"  # (V,) kg, that resists acceleration
    WEIGHT = "weight"  # (V, 3) N, constant forces
    PLANES = "planes"  # hood.energies.contact.Walls, one of each contact
    GRIPS = "grips"  # hood.energies.friction.Grip, one of each contact
    DRAG = "drag"  # hood.energies.wind.Drag at the centroids of the faces
    MEMBRANE = "membrane"  # True: the cloth's own
    MEMBRANE_DAMPING = "membrane_damping"  # s, retardation time of the membrane
    HINGES = "hinges"  # hood.energies.bending.HingeForm
    SPRINGS = "springs"  # (A,) N/m, of the step's attachments
    BLOCKS = "blocks"  # BlockForm: any energy, with a bound on its curvature by vertices
    LAYERS = "layers"  # True: the barrier between layers of cloth
    PAIRS = "pairs"  # hood.energies.self_contact.LayerGrips


#: Forms that act on single vertices, those of the solver's matrix, and those that add to it beside its pattern.
VERTEX_FORMS = frozenset({Form.MASS, Form.WEIGHT, Form.PLANES, Form.GRIPS})
LAYER_FORMS = frozenset({Form.LAYERS, Form.PAIRS})
MATRIX_FORMS = frozenset(Form) - LAYER_FORMS


class BlockForm(Protocol):
    """Derivatives of an energy of one step for :attr:`Form.BLOCKS`."""

    def energy(self, pos: Tensor) -> Tensor:
        """Energy [J] (B,) at ``pos`` (V, 3)."""
        ...

    def derivatives(self, pos: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient [N] (V, 3) and one symmetric matrix [N/m] (V, 3, 3) a vertex, positive semi-definite: a bound on the second
        derivative where steps would overshoot without, 0 where other energies are stiffer."""
        ...


class Term(Protocol):
    """An energy as a potential takes it. A new one is a class with these two methods and an entry in the potential's ``terms``;
    files name it by its path, or by its ``kind`` (a class attribute, one word) if it has one. One that has more to say is an
    :class:`Energy`.

    Training ramps the weight of the terms named ``collision`` and ``friction``; such a term is also a :class:`WeightedTerm`.
    """

    def applies(self, problem: StepProblem) -> bool:
        """Whether the energy can be anything but a constant zero for this problem."""
        ...

    def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
        """Energy [J] (B,) at ``next_pos`` (V, 3) [m], reached with acceleration ``acc`` (V, 3) [m/s²]."""
        ...


class Energy(ABC):
    """An energy that says what it is for, and may have its derivatives written out: nobody else asks for its class.

    ``form`` and ``published`` hold for the class that states them alone. A subclass may compute another energy, so it begins
    without: one that keeps the energy says ``form = Form...`` again.

    Attributes:
        kind: name of the class in files.
        role: what the energy is for.
        form: the kind of its closed-form derivatives; None: the solver takes the gradient by autograd and knows no Hessian.
        published: contact and friction as published code has them.
    """

    kind: ClassVar[str]
    role: ClassVar[Role] = Role.ELASTIC
    form: ClassVar[Form | None] = None
    published: ClassVar[bool] = False

    def __init_subclass__(cls, **settings: Any) -> None:
        super().__init_subclass__(**settings)
        if "form" not in vars(cls):
            cls.form = None
        if "published" not in vars(cls):
            cls.published = False

    def applies(self, problem: StepProblem) -> bool:
        """Whether the energy can be anything but a constant zero for this problem."""
        return True

    @abstractmethod
    def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
        """Energy [J] (B,) at ``next_pos`` (V, 3) [m], reached with acceleration ``acc`` (V, 3) [m/s²]."""

    def prepare(self, problem: StepProblem) -> StepProblem:
        """The problem with what the term needs to know of the step; itself when it is there already."""
        return problem

    def is_inactive(self, problem: StepProblem) -> bool:
        """Whether it has no force at x_t, where that is sooner asked than computed."""
        return False

    def is_zero(self, problem: StepProblem, pos: Tensor) -> bool:
        """Whether energy and force are zero at ``pos`` (V, 3), where that is sooner asked than computed."""
        return False

    def needs_internal_force(self, problem: StepProblem) -> bool:
        """Whether it reads :attr:`hood.energies.problem.StepProblem.internal_force`."""
        return False

    def varies_in_time(self) -> bool:
        """Whether it is another function of the problem in every step."""
        return False

    def closed_form(self, problem: StepProblem, passes: Passes | None = None) -> Any:
        """The closed form of the kind ``form`` in a prepared problem, see :class:`Form`.

        Args:
            passes: the compiled pass over a contact, where there is one.
        """
        return None

    def closed_form_at(self, problem: StepProblem, points: PointContact) -> Any:
        """The same at points inside edges and faces, of one place; None where it does not act there."""
        return None

    def out_of_contact(self, problem: StepProblem, pos: Tensor) -> Tensor:
        """Positions (V, 3) as far out of the body, from ``pos`` (V, 3), as a contact term leaves cloth that lies still."""
        return pos


class ContactRows(Protocol):
    """A compiled pass over one contact of a step, see :class:`hood.solver.derivatives.compiled_vertices.ContactPass`."""

    def planes(self, term: Any) -> list[Tensor]:
        """Points [m] (V, 3), normals (V, 3) and distances [m] (V,) of :class:`hood.energies.contact.Walls`."""
        ...

    def grips(self, term: Any) -> list[Tensor]:
        """Normals (V, 3), anchors [m] (V, 3), forces [N] (V,) and limits [m] (V,) of :class:`hood.energies.friction.Grip`."""
        ...


#: The pass over a contact of a step; None where there is none.
Passes = Callable[["Contact"], ContactRows | None]


def is_energy(term: Term) -> TypeGuard[Energy]:
    """Whether a term is an :class:`Energy`; a step asks some hundred times, and ``isinstance`` is slow of abstract classes."""
    return Energy in type(term).__mro__


def role_of(term: Term) -> Role | None:
    """What an energy is for; None of one that does not say."""
    return term.role if is_energy(term) else None


def form_of(term: Term) -> Form | None:
    """The kind of an energy's closed-form derivatives; None of one without."""
    return term.form if is_energy(term) else None


def having(terms: Mapping[str, Term], *wanted: Role | Form) -> dict[str, Any]:
    """The terms, by name, that have one of some roles or forms."""
    return {name: term for name, term in terms.items() if is_energy(term) and (term.role in wanted or term.form in wanted)}


def prepared(term: Term, problem: StepProblem) -> StepProblem:
    """The problem with what a term needs to know of the step; itself where it needs no more."""
    prepare = getattr(term, "prepare", None)
    return problem if prepare is None else prepare(problem)


@runtime_checkable
class WeightedTerm(Protocol):
    """A term whose weight training may change."""

    def with_weight(self, weight: float) -> Self:
        """The same term with another weight [J/m³]; this one stays as it is."""
        ...


def kind_of(term: Term) -> str:
    """What the class of a term is called in files: its own ``kind``, which stays wherever the class moves, else its path.

    A subclass does not inherit it: it may be another energy.
    """
    return str(vars(type(term)).get("kind", _path(term)))


def kind_in_file(text: str) -> str:
    """The kind that a file names; earlier ones named the path of a class."""
    return text.rpartition(".")[2] if text.startswith("hood.losses.") else text


def named(name: str, term: Term) -> str:
    """A term in a sentence: its name and its class."""
    return f"losses.terms.{name} ({_path(term)})"


def _path(term: Term) -> str:
    return f"{type(term).__module__}.{type(term).__qualname__}"


def checked(name: str, term: Term, energy: Tensor, num_scenes: int) -> Tensor:
    """``energy`` of a term.

    Raises:
        ValueError: it is not one number per scene.
    """
    if not isinstance(energy, Tensor) or energy.shape != (num_scenes,):
        found = f"the shape {tuple(energy.shape)}" if isinstance(energy, Tensor) else f"a {type(energy).__name__}"
        raise ValueError(
            f"{named(name, term)} returned {found}; an energy has one number per scene, (B,) = ({num_scenes},): "
            "problem.sum_vertices adds up those of vertices"
        )
    return energy
