"""An energy of somebody's own that is a subclass of one of the package gets the derivatives of its own energy, not those that
the package has written out for its parent."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from torch import Tensor

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.energies.damping import BendDamping, StretchDamping
from hood.energies.potential import default_potential, relative_gradient
from hood.energies.problem import StepProblem
from hood.energies.term import Energy, Form, Term, form_of, having, role_of
from hood.energies.wind import Wind
from hood.solver.derivatives.vertices import energies_and_gradient, total_energy
from hood.solver.newton import NewtonSettings, minimize
from hood.testing import grid, make_problem, plane_contact

POTENTIAL = default_potential().with_terms(
    air=Wind((3.0, 0.0, 1.0)), stretch_damping=StretchDamping(1e-2), bend_damping=BendDamping(1e-2)
)
NAMES = [name for name in POTENTIAL.terms if name not in ("attachment", "layers", "layer_friction")]


def doubled(term: Term) -> Term:
    """A subclass with twice the energy and nothing else of its own."""
    own = copy.copy(term)

    def energy(self: Term, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
        return 2.0 * type(term).__call__(self, problem, next_pos, acc)

    own.__class__ = type(f"Doubled{type(term).__name__}", (type(term),), {"__call__": energy})
    return own


@pytest.fixture(scope="module")
def sliding() -> StepProblem:
    """A bent sheet, partly in a plane on which it slides."""
    rng = np.random.default_rng(1)
    cloth = build_cloth(*grid(6, 5, 0.4), Material(), dtype=torch.float64)
    noise = torch.as_tensor(rng.normal(size=cloth.rest_pos.shape))
    pos = cloth.rest_pos * torch.tensor([1.0, 0.0, 1.0], dtype=torch.float64) + 1e-3 * noise
    return make_problem(cloth, pos, 0.1 * noise.numpy(), 1 / 30, plane_contact(pos))


@pytest.mark.parametrize("name", NAMES)
def test_energies_and_forces_are_its_own(name: str, sliding: StepProblem) -> None:
    potential = POTENTIAL.with_terms(**{name: doubled(POTENTIAL.terms[name])})
    problem = potential.prepare(sliding)
    pos = problem.state.pos + 1e-3 * torch.as_tensor(np.random.default_rng(2).normal(size=problem.state.pos.shape))
    expected, energies = potential.gradient(problem, pos)
    gradient, found = energies_and_gradient(potential, problem, pos)
    torch.testing.assert_close(found[name], energies[name], rtol=1e-12, atol=1e-20)
    torch.testing.assert_close(gradient, expected, rtol=1e-10, atol=1e-12 * float(expected.abs().max()))
    torch.testing.assert_close(total_energy(potential, problem, pos), potential.total(problem, pos), rtol=1e-12, atol=1e-20)
    plain = POTENTIAL.gradient(POTENTIAL.prepare(sliding), pos)[1]
    torch.testing.assert_close(energies[name], 2.0 * plain[name], rtol=1e-12, atol=1e-20)


@pytest.mark.parametrize("engine", ["auto", "torch"])
@pytest.mark.parametrize("name", NAMES)
def test_the_solver_tells_how_far_its_minimum_is(name: str, engine: str, sliding: StepProblem) -> None:
    """Of stiff energies it knows the slope alone, which may not be enough to arrive; it says so."""
    potential = POTENTIAL.with_terms(**{name: doubled(POTENTIAL.terms[name])})
    problem = potential.prepare(sliding)
    pos, report = minimize(potential, problem, settings=NewtonSettings(target_rg=1e-4, max_iterations=60, engine=engine))
    assert report.relative_gradient is not None
    true = relative_gradient(problem, potential.gradient(problem, pos)[0])
    torch.testing.assert_close(report.relative_gradient, true, rtol=1e-6, atol=1e-9)
    assert bool(report.converged.all()) or name in ("stretching", "collision", "friction")


@pytest.mark.parametrize("name", NAMES)
def test_a_subclass_begins_without_the_form_of_its_parent(name: str) -> None:
    parent = POTENTIAL.terms[name]
    own = doubled(parent)
    assert form_of(parent) is not None
    assert form_of(own) is None
    assert role_of(own) is role_of(parent)
    assert not having({name: own}, *Form)


def test_a_subclass_may_say_that_it_keeps_the_energy() -> None:
    class Windier(Wind):
        form = Form.DRAG

    class Renamed(Windier):
        pass

    assert form_of(Windier()) is Form.DRAG
    assert form_of(Renamed()) is None


def test_what_a_plugin_leaves_out_has_its_defaults(sliding: StepProblem) -> None:
    """Two methods are enough, with or without the base class."""

    class Bare:
        def applies(self, problem: StepProblem) -> bool:
            return True

        def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
            return problem.sum_vertices(next_pos[:, 0])

    class Based(Energy):
        def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
            return problem.sum_vertices(next_pos[:, 0])

    found = []
    for term in (Bare(), Based()):
        assert form_of(term) is None
        potential = default_potential().with_terms(own=term)
        problem = potential.prepare(sliding)
        found.append((problem.internal_force, potential.gradient(problem, problem.state.pos)[0]))
    for one, other in zip(*found, strict=True):
        assert one is not None
        torch.testing.assert_close(one, other, rtol=0, atol=0)
    assert float((found[0][0] - default_potential().prepare(sliding).internal_force).abs().max()) > 0.5  # it presses, too


class Refuses(Energy):
    """An energy that computes nothing after its first calls."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
        self.calls += 1
        if self.calls > 3:
            raise ZeroDivisionError("no more")
        return 0.0 * problem.sum_vertices(next_pos[:, 0])


@pytest.mark.parametrize("engine", ["compiled", "torch"])
def test_what_an_energy_raises_is_raised(engine: str, sliding: StepProblem) -> None:
    potential = default_potential().with_terms(own=Refuses())
    with pytest.raises(ZeroDivisionError, match="no more"):
        minimize(potential, sliding, settings=NewtonSettings(target_rg=1e-9, engine=engine))


def test_an_energy_without_form_runs_in_the_compiled_solver(sliding: StepProblem) -> None:
    potential = default_potential().with_terms(air=doubled(Wind((3.0, 0.0, 1.0))))
    found, same = (
        minimize(potential, sliding, settings=NewtonSettings(target_rg=1e-8, engine=engine))[0]
        for engine in ("compiled", "torch")
    )
    torch.testing.assert_close(found, same, rtol=0.0, atol=1e-8)
