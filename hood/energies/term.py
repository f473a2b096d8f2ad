"""What the potential asks of an energy, and what it refuses of one."""

from __future__ import annotations

from typing import Protocol, Self, runtime_checkable

from torch import Tensor

from hood.energies.problem import StepProblem


class Term(Protocol):
    """An energy. A new one is a class with these two methods and an entry in the potential's ``terms``; files name it by its
    path, or by its ``kind`` (a class attribute, one word) if it has one.

    Training ramps the weight of the terms named ``collision`` and ``friction``; such a term is also a :class:`WeightedTerm`.
    """

    def applies(self, problem: StepProblem) -> bool:
        """Whether the energy can be anything but a constant zero for this problem."""
        ...

    def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
        """Energy [J] (B,) at ``next_pos`` (V, 3) [m], reached with acceleration ``acc`` (V, 3) [m/s²]."""
        ...


@runtime_checkable
class PreparedTerm(Protocol):
    """A term that needs to know more about a step than every step tells."""

    def prepare(self, problem: StepProblem) -> StepProblem:
        """The problem with what the term needs; itself when it is there already."""
        ...


@runtime_checkable
class RestingTerm(Protocol):
    """A term whose force is often zero where a step begins, which is sooner asked than computed."""

    def rests(self, problem: StepProblem) -> bool:
        """Whether it has no force at x_t."""
        ...


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
