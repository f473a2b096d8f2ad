"""The published code's energies against a transcription of what is known of it (``tests/coded_energies.py``)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from coded_energies import TRANSCRIPTION, Case, collision, stretching

from hood.app.settings.compose import build, load_config
from hood.app.settings.rollout_settings import RolloutSettings
from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.assets.motion.sequence import PoseSequence
from hood.cloth.state import State
from hood.contact.contact import LaggedContact, find_contact
from hood.energies.contact import CentroidCollision
from hood.energies.friction import CodedFriction, WeightFriction
from hood.energies.potential import coded_potential
from hood.energies.problem import StepProblem
from hood.scene.scene import build_scene

#: Garment, first frame of the walk, frame of the window, noise [m] and stretch about the middle.
KINDS = {
    "shirt, walking": ("tshirt", 60, 2e-3, 1.0),
    "skirt, walking, rumpled": ("skirt", 60, 2e-3, 1.0),
    "tank, off the body and stretched": ("tank", 20, 1e-3, 1.15),
}
STATES = {f"{kind}, frame {frame}": (*values, frame) for kind, values in KINDS.items() for frame in range(2, 9)}


@pytest.fixture(scope="module", params=STATES)
def case(request: pytest.FixtureRequest, garments: dict[str, Garment], body: Body, walk: PoseSequence) -> Case:
    name, first, noise, stretch, frame = STATES[request.param]
    garment = garments[name]
    scene = build_scene(garment, body, walk.window(first, first + 12), dtype=torch.float64)
    rng = np.random.default_rng(len(name))
    state = scene.start(frame)
    shaken = state.pos + noise * torch.as_tensor(rng.normal(size=state.pos.shape))
    state = State(shaken, state.vel, state.origin)
    step = scene.step_input(frame, state)
    problem = StepProblem(scene.cloth, state, step)
    pos = shaken + step.dt * state.vel + noise * torch.as_tensor(rng.normal(size=shaken.shape))
    centre = pos.mean(dim=0)
    obstacle = step.obstacle
    assert obstacle is not None
    surfaces = (obstacle.prev_pos, obstacle.pos, obstacle.next_pos)
    return Case(problem, garment.rest_pos, garment.faces, body.faces, surfaces, centre + stretch * (pos - centre))


@pytest.mark.parametrize("lagged", [False, True], ids=["postcvpr", "cvpr"])
def test_energies_and_gradients_are_those_of_the_transcription(case: Case, lagged: bool) -> None:
    potential = coded_potential(collision_lagged=lagged)
    problem = potential.prepare(case.problem)
    x = case.pos.clone().requires_grad_(True)
    expected = {name: term(case, x) for name, term in TRANSCRIPTION.items()} | {"collision": collision(case, x, lagged)}
    energies = potential.energies(problem, case.pos)
    assert energies.keys() == expected.keys()
    for name, energy in expected.items():
        assert float(energy.detach()) != 0, name
        assert float(energies[name]) == pytest.approx(float(energy.detach()), rel=1e-6), name
        (slope,) = torch.autograd.grad(energy, x)
        mine = type(potential)({name: potential.terms[name]}).gradient(problem, case.pos)[0]
        assert float((mine - slope).abs().max()) <= 1e-6 * float(slope.abs().max()), name


def test_the_membrane_of_the_fine_weights_has_almost_no_lambda(case: Case) -> None:
    """λ times the bending stiffness: 1.76 Pa in place of 44,400 Pa; the fabric that a network is shown stays."""
    potential = build(load_config("train", ["losses=released_fine"]).losses)
    problem = potential.prepare(case.problem)
    assert potential.prepare(problem) is problem
    x = case.pos.clone().requires_grad_(True)
    soft, full = (stretching(case, x, lame_lambda) for lame_lambda in (44400.0 * 3.9626e-5, 44400.0))
    (slope,) = torch.autograd.grad(soft, x)
    alone = type(potential)({"stretching": potential.terms["stretching"]})
    for asked in (problem, case.problem):  # it does not have to be prepared
        mine, energies = alone.gradient(asked, case.pos)
        assert float(energies["stretching"]) == pytest.approx(float(soft.detach()), rel=1e-6)
        assert float((mine - slope).abs().max()) <= 1e-6 * float(slope.abs().max())
    assert float(full.detach()) > 1.1 * float(soft.detach())
    assert problem.cloth.vertex_fabric is case.problem.cloth.vertex_fabric
    assert float(problem.cloth.lame_lambda.mean()) == pytest.approx(1.7594, rel=1e-4)
    again = potential.prepare(StepProblem(case.problem.cloth, case.problem.state, case.problem.step))
    assert again.cloth is problem.cloth  # so that what was computed from it is found again
    copied = potential.prepare(replace(problem, cloth=replace(problem.cloth)))
    torch.testing.assert_close(copied.cloth.lame_lambda, problem.cloth.lame_lambda)  # and not softened twice


def test_the_two_frictions_and_the_two_collisions_differ(case: Case) -> None:
    """What is told apart is not nothing: the comparison above would notice either."""
    problem = coded_potential().prepare(case.problem)
    contact = problem.contact
    assert isinstance(contact, LaggedContact)
    coded = CodedFriction().greatest(problem, case.pos) > 0
    meant = WeightFriction().normal_force(problem, contact) > 0
    assert int(coded.sum()) >= 5 * int(meant.sum())
    now, behind = (float(CentroidCollision(lagged=lagged)(problem, case.pos, case.pos)) for lagged in (False, True))
    assert abs(now - behind) > 1e-3 * max(now, behind)


def test_a_shirt_is_held_all_over(garments: dict[str, Garment], body: Body, walk: PoseSequence) -> None:
    """Known of the published code: it acts on nearly every vertex of a shirt, few of which touch the skin."""
    scene = build_scene(garments["tshirt"], body, walk.window(0, 3))
    state = scene.start(0)
    step = scene.step_input(0, state)
    problem = coded_potential().prepare(StepProblem(scene.cloth, state, step))
    assert problem.contact is not None
    held = CodedFriction().greatest(problem, state.pos) > 0
    assert float(held.double().mean()) > 0.99
    assert step.obstacle is not None
    dist = find_contact(state.pos, scene.cloth.vertex_scene, step.obstacle).dist
    assert float((dist < 3e-3).double().mean()) < 0.1


@pytest.mark.parametrize("lagged", [False, True])
def test_configured_and_built_in_are_the_same(lagged: bool) -> None:
    words = ["losses=reference_as_coded", f"losses.terms.collision.lagged={str(lagged).lower()}"]
    configured, built_in = build(RolloutSettings.from_words(words).losses), coded_potential(collision_lagged=lagged)
    assert configured.terms.keys() == built_in.terms.keys()
    for name, term in built_in.terms.items():
        assert type(configured.terms[name]) is type(term)
        assert vars(configured.terms[name]) == vars(term)


def test_searched_once_and_demanded(case: Case) -> None:
    potential = coded_potential(collision_lagged=True)
    with pytest.raises(ValueError, match=r"Potential\.prepare"):
        potential.total(case.problem.with_contact(), case.pos)
    prepared = potential.prepare(case.problem)
    assert potential.prepare(prepared) is prepared
    nowhere = replace(case.problem, step=replace(case.problem.step, obstacle=None))
    assert potential.prepare(nowhere) is nowhere
    assert not {"collision", "friction"} & potential.energies(nowhere, case.pos).keys()
    ramped = CentroidCollision(5e3, 1e-3, lagged=True).with_weight(5e5)
    assert (ramped.weight, ramped.epsilon, ramped.lagged) == (5e5, 1e-3, True)
    assert CodedFriction().with_weight(1.0).radius == 3e-3
    with pytest.raises(ValueError, match="radius"):
        CodedFriction(radius=0.0)


def test_what_the_solver_is_given_of_the_coded_friction(case: Case) -> None:
    """Its gradient is that of autograd, its matrices are no less than the second derivative, vertex by vertex."""
    term = CodedFriction()
    problem = coded_potential().prepare(case.problem)
    x = case.pos.clone().requires_grad_(True)
    (slope,) = torch.autograd.grad(term(problem, x, x).sum(), x, create_graph=True)
    form = term.closed_form(problem)
    gradient, matrix = form.derivatives(case.pos)
    torch.testing.assert_close(form.energy(case.pos), term(problem, case.pos, case.pos))
    torch.testing.assert_close(gradient, slope.detach(), rtol=1e-9, atol=1e-12)
    rows = [torch.autograd.grad(slope[:, axis].sum(), x, retain_graph=True)[0] for axis in range(3)]
    left = torch.linalg.eigvalsh(matrix - torch.stack(rows, dim=1))
    assert float(left.min()) >= -1e-9 * float(matrix.abs().max())
