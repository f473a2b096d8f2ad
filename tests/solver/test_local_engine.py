"""Forces and local steps by the compiled solver's energies against those in torch."""

from dataclasses import replace

import pytest
import torch
from test_local import problem_of

from hood.cloth.state import Attachments
from hood.energies.bending import CurrentLengthBending
from hood.energies.contact import CentroidCollision
from hood.energies.damping import BendDamping, StretchDamping
from hood.energies.friction import WeightFriction
from hood.energies.mass_points import Attachment
from hood.energies.potential import Potential, default_potential
from hood.energies.problem import StepProblem
from hood.energies.wind import Wind
from hood.native.build import BuildError
from hood.scene.scene import Scene
from hood.solver.compiled import newton
from hood.solver.system.iterate import in_double
from hood.solver.vertex import compiled as local_engine
from hood.solver.vertex.block_jacobi import LocalTerms
from hood.solver.vertex.compiled import EngineTerms, local_terms
from hood.testing import with_weave


def compiler_is_missing() -> bool:
    try:
        newton.library()
    except BuildError:
        return True
    return False


needs_compiler = pytest.mark.skipif(compiler_is_missing(), reason="no C++ compiler")


def errors(potential: Potential, problem: StepProblem, pos: torch.Tensor) -> list[tuple[float, float]]:
    """Relative errors of force and step, compiled and in torch, of the torch form in float64."""
    exact = LocalTerms(potential, in_double(problem))(pos.double())
    views = EngineTerms(potential, problem)(pos), LocalTerms(potential, problem)(pos)
    pairs = [
        [float((getattr(view, name) - getattr(exact, name)).norm() / getattr(exact, name).norm()) for view in views]
        for name in ("force", "step")
    ]
    return [(compiled, plain) for compiled, plain in pairs]


@needs_compiler
@pytest.mark.parametrize("name", ["tank_scene", "band_scene"])
def test_views_are_nearer_to_the_exact_ones_than_those_of_torch_in_float32(name: str, request: pytest.FixtureRequest) -> None:
    problem, pos = problem_of(request.getfixturevalue(name))
    for compiled, plain in errors(default_potential(), problem, pos):
        assert compiled < 2e-5
        assert compiled < 2 * plain
    view = EngineTerms(default_potential(), problem)(pos)
    assert not view.force[~problem.cloth.free].any()
    assert not view.step[~problem.cloth.free].any()


@needs_compiler
def test_cloth_with_warp_and_weft(band_scene: Scene) -> None:
    problem, pos = problem_of(band_scene)
    for compiled, _ in errors(default_potential(), replace(problem, cloth=with_weave(problem.cloth)), pos):
        assert compiled < 2e-5


@needs_compiler
@pytest.mark.parametrize(
    "terms",
    [
        {"bending": CurrentLengthBending()},
        {"collision": CentroidCollision(), "friction": WeightFriction()},
        {"wind": Wind([3.0, 0.0, -4.0], gusts=0.2), "stretch_damping": StretchDamping(5e-3), "bend_damping": BendDamping(5e-3)},
    ],
    ids=["current length", "published contact", "wind and damping"],
)
def test_other_terms(terms: dict, band_scene: Scene) -> None:
    potential = default_potential().with_terms(**terms)
    problem, pos = problem_of(band_scene)
    for compiled, _ in errors(potential, potential.prepare(problem), pos):
        assert compiled < 2e-5


@needs_compiler
def test_springs(band_scene: Scene) -> None:
    potential = default_potential().with_terms(attachment=Attachment())
    problem, pos = problem_of(band_scene)
    edges = torch.tensor([[0, 9], [5, 30], [2, 40]])
    attachments = Attachments(edges, torch.tensor([True, True, False]))
    closed = replace(problem, step=replace(problem.step, attachments=attachments))
    for compiled, _ in errors(potential, closed, pos):
        assert compiled < 2e-5
    assert not torch.equal(EngineTerms(potential, closed)(pos).force, EngineTerms(potential, problem)(pos).force)


@needs_compiler
def test_the_same_bits_in_every_run_whoever_was_before(band_scene: Scene, tank_scene: Scene) -> None:
    problem, pos = problem_of(band_scene)
    first = EngineTerms(default_potential(), problem)(pos)
    other, there = problem_of(tank_scene)
    EngineTerms(default_potential(), other)(there)
    again = EngineTerms(default_potential(), problem)(pos)
    assert torch.equal(first.force, again.force)
    assert torch.equal(first.step, again.step)


def test_what_the_library_does_not_know_goes_to_torch(band_scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    problem, _ = problem_of(band_scene)
    potential = default_potential()
    assert type(local_terms(potential, in_double(problem))) is LocalTerms
    assert type(local_terms(potential, problem, compiled=False)) is LocalTerms

    def missing(*_: object) -> None:
        raise BuildError("no C++ compiler")

    monkeypatch.setattr(local_engine, "EngineTerms", missing)
    assert type(local_terms(potential, problem)) is LocalTerms
