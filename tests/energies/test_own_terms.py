"""Energies of somebody's own: subclasses of hood's keep what they are, and what returns no energy is refused."""

from __future__ import annotations

import importlib
import pkgutil

import pytest
import torch
from torch import Tensor
from torch.fx.experimental.proxy_tensor import make_fx

from hood import energies
from hood.assets.material import Material
from hood.cloth.cloth import build_cloth, concatenate_cloths
from hood.energies.contact import CentroidCollision, Collision
from hood.energies.friction import CodedFriction, Friction, WeightFriction
from hood.energies.potential import default_potential
from hood.energies.problem import StepProblem
from hood.energies.term import kind_in_file
from hood.testing import grid, make_problem
from hood.training.curriculum import CollisionRamp


class SoftCollision(Collision):
    """Contact with a setting of its own, which its constructor takes first."""

    def __init__(self, softness: float, weight: float = 5e5) -> None:
        super().__init__(weight, epsilon=1e-3, reach="constant", sides="nearest")
        self.softness = softness


class DryFriction(Friction):
    """The same of friction."""

    def __init__(self, dryness: float) -> None:
        super().__init__(coefficient=0.3, epsilon=1e-3)
        self.dryness = dryness


class Bare:
    """An energy of vertices, with a fault or without one."""

    def __init__(self, shape: str = "scenes") -> None:
        self.shape = shape

    def applies(self, problem: StepProblem) -> bool:
        return True

    def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor | float:
        energy = problem.cloth.mass * next_pos[:, 0] ** 2
        if self.shape == "number":
            return 1.0
        return {"scenes": problem.sum_vertices(energy), "scalar": energy.sum(), "vertices": energy}[self.shape]


@pytest.mark.parametrize("term", [SoftCollision(2.0), DryFriction(0.7), CentroidCollision(5e3, 1e-3, lagged=True), Friction()])
def test_another_weight_changes_nothing_else(term: Collision | Friction) -> None:
    before = dict(vars(term))
    found = term.with_weight(3.0)
    assert type(found) is type(term)
    assert vars(found) == before | {"weight": 3.0}
    assert vars(term) == before


@pytest.mark.parametrize("kind", [WeightFriction, CodedFriction])
def test_friction_without_a_collision_weight_stays_what_it_is(kind: type[WeightFriction]) -> None:
    term = kind()
    assert term.with_weight(3.0) is term


def test_training_ramps_own_terms_and_refuses_those_without_a_weight() -> None:
    potential = default_potential().with_terms(collision=SoftCollision(2.0), friction=DryFriction(0.7))
    ramped = CollisionRamp(5e3, 5e5, 0, 100).apply(potential, 0)
    collision, friction = ramped.terms["collision"], ramped.terms["friction"]
    assert isinstance(collision, SoftCollision)
    assert isinstance(friction, DryFriction)
    assert (collision.weight, collision.softness) == (5e3, 2.0)
    assert (friction.weight, friction.dryness) == (5e3, 0.7)
    with pytest.raises(ValueError, match=r"losses.terms.collision \(test_own_terms.Bare\): training ramps .* with_weight"):
        CollisionRamp().apply(default_potential().with_terms(collision=Bare()), 0)
    assert "other" in CollisionRamp().apply(default_potential().with_terms(other=Bare()), 0).terms


def problem_of(scenes: int) -> StepProblem:
    cloth = build_cloth(*grid(4, 4), Material(), dtype=torch.float64)
    batch = concatenate_cloths([cloth] * scenes)
    return make_problem(batch, batch.rest_pos)


@pytest.mark.parametrize("scenes", [1, 2])
@pytest.mark.parametrize(
    "shape, words", [("scalar", r"the shape \(\)"), ("vertices", r"the shape \(\d+,\)"), ("number", "a float")]
)
def test_what_is_no_energy_per_scene_is_refused(scenes: int, shape: str, words: str) -> None:
    problem = problem_of(scenes)
    sentence = rf"losses.terms.own \(test_own_terms.Bare\) returned {words}; .* \(B,\) = \({scenes},\)"
    potential = default_potential().with_terms(own=Bare(shape))
    for function in (potential.energies, potential.gradient, potential.total):
        with pytest.raises(ValueError, match=sentence):
            function(problem, problem.state.pos)
    assert default_potential().with_terms(own=Bare()).energies(problem, problem.state.pos)["own"].shape == (scenes,)


def test_the_shape_is_checked_where_a_step_is_traced_too() -> None:

    problem = problem_of(1)
    good, bad = (default_potential().with_terms(own=Bare(shape)).settled(problem) for shape in ("scenes", "vertices"))
    graph = make_fx(lambda pos: good.total(problem, pos))(problem.state.pos)
    torch.testing.assert_close(graph(problem.state.pos), good.total(problem, problem.state.pos))
    with pytest.raises(ValueError, match="losses.terms.own"):
        make_fx(lambda pos: bad.total(problem, pos))(problem.state.pos)


def test_files_name_an_energy_by_a_word_that_stays() -> None:
    """A subclass is another energy and is named by its path; files from before name that of every class."""
    settings = default_potential().with_terms(collision=SoftCollision(2.0)).settings
    assert settings["friction"]["term"] == "Friction"
    assert settings["collision"]["term"] == f"{__name__}.SoftCollision"
    assert kind_in_file("hood.losses.friction.Friction") == "Friction"
    assert kind_in_file(f"{__name__}.SoftCollision") == f"{__name__}.SoftCollision"


def test_every_energy_of_the_package_has_its_own_word() -> None:
    found = [
        kind
        for module in pkgutil.iter_modules(energies.__path__)
        for kind in vars(importlib.import_module(f"hood.energies.{module.name}")).values()
        if isinstance(kind, type)
        and kind.__module__ == f"hood.energies.{module.name}"
        and hasattr(kind, "applies")
        and not getattr(kind, "_is_protocol", False)
    ]
    own = {kind.__name__: vars(kind).get("kind") for kind in found}
    assert own.pop("LaggedFriction") is None  # what three energies share
    assert own.pop("Energy") is None
    assert len(own) >= 17
    assert all(word == name for name, word in own.items())
    assert len(set(own.values())) == len(own)
