"""The energies of HOOD's published code: by hand, against the default ones, and in the solver."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from hood.app.settings.compose import build
from hood.app.settings.rollout_settings import RolloutSettings
from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.cloth.state import Obstacle
from hood.contact.contact import CentroidContact, find_contact
from hood.energies import contact as collision_module
from hood.energies.bending import CurrentLengthBending
from hood.energies.contact import CentroidCollision, Collision
from hood.energies.friction import Friction, WeightFriction
from hood.energies.potential import Potential, default_potential, reference_potential
from hood.testing import assert_nearest, grid, make_problem, plane_contact, sphere

F64 = torch.float64
DT = 1 / 30


def obstacle(pos, faces, motion=(0.0, 0.0, 0.0), dtype=F64):
    now = torch.as_tensor(np.asarray(pos, dtype=np.float64)).to(dtype)
    move = torch.tensor(motion, dtype=dtype)
    tri = torch.as_tensor(np.asarray(faces))
    return Obstacle(now, now + move, now - move, tri, torch.zeros(len(now)).long(), torch.zeros(len(tri)).long())


def problem_on(body, height, dtype=F64, n=4, size=0.05):
    """A small sheet ``height`` above y = 0 and the body's contact with it."""
    pos, faces = grid(n, n, size)
    cloth = build_cloth(pos - [size / 2, -height, size / 2], faces, Material(), dtype=dtype)
    problem = make_problem(cloth)
    contact = find_contact(problem.state.pos, cloth.vertex_scene, body)
    return replace(problem, step=replace(problem.step, obstacle=body), contact=contact)


def slope_body(angle, motion=(0.0, 0.0, 0.0)):
    """One large triangle through the origin, turned by ``angle`` about z."""
    flat = np.array([[-3.0, 0, -2.0], [-3.0, 0, 4.0], [3.0, 0, -2.0]])
    flat -= flat.mean(axis=0)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    return obstacle(flat @ turn.T, [[0, 1, 2]], motion)


def test_configured_and_built_in_are_the_same():
    configured, built_in = build(RolloutSettings.from_words(["losses=reference"]).losses), reference_potential()
    assert configured.terms.keys() == built_in.terms.keys()
    for name, term in built_in.terms.items():
        assert type(configured.terms[name]) is type(term)
        assert vars(configured.terms[name]) == vars(term)


def test_collision_with_a_slanted_moving_face_by_hand():
    angle, motion = 0.3, (0.0, 0.004, 0.0)
    term = CentroidCollision(weight=3e5, epsilon=2e-3)
    problem = term.prepare(problem_on(slope_body(angle, motion), 1e-3))
    normal = torch.tensor([-np.sin(angle), np.cos(angle), 0.0], dtype=F64)
    pos = problem.state.pos
    depth = (2e-3 - (pos - torch.tensor(motion, dtype=F64)) @ normal).clamp_min(0.0)
    assert 0 < int((depth > 0).sum()) < len(pos)
    assert float(term(problem, pos, pos)) == pytest.approx(3e5 * float((depth**3).sum()), rel=1e-9)
    force = Potential({"term": term}).gradient(problem, pos)[0]
    torch.testing.assert_close(force, -9e5 * depth.square()[:, None] * normal, rtol=1e-8, atol=1e-10)


def test_the_plane_is_that_of_the_nearest_centroid_however_far():
    """A wall of two large faces beside a floor of small ones: another face than the closest, and no cap."""
    floor, floor_faces = grid(9, 9, 0.08)
    wall = np.array([[0.081, 0, 0.0], [0.081, 0, 0.08], [0.081, 3, 0.04]])
    body = obstacle(np.concatenate([floor, wall]), np.concatenate([floor_faces, [[81, 82, 83]]]))
    points = np.array([[0.079, 0.3, 0.04], [0.079, 0.35, 0.04], [0.06, 0.3, 0.04]])
    cloth = build_cloth(points, np.array([[0, 1, 2]]), Material(), dtype=F64)
    problem = make_problem(cloth)
    contact = find_contact(cloth.rest_pos, cloth.vertex_scene, body, cap=0.1)
    problem = replace(problem, step=replace(problem.step, obstacle=body), contact=contact)
    assert contact.face.tolist()[:2] == [len(floor_faces)] * 2  # the wall, 2 mm away
    prepared = CentroidCollision().prepare(problem)
    assert isinstance(prepared.contact, CentroidContact)
    centroids = body.pos[body.faces].mean(dim=1)
    assert_nearest(cloth.rest_pos, centroids, prepared.contact.centroid_face)
    assert int(prepared.contact.centroid_face.max()) < len(floor_faces)
    assert bool(prepared.contact.facing.all())
    for name, value in vars(contact).items():
        kept = getattr(prepared.contact, name)  # what the features read stays
        assert kept is None if value is None else torch.equal(kept, value)


def test_both_collisions_agree_on_a_flat_body():
    pos, faces = grid(6, 6, 0.3)
    body = obstacle(pos - [0.15, 0, 0.15], faces, (0.002, 0.001, 0.0))
    problem = problem_on(body, 1e-3)
    prepared = CentroidCollision().prepare(problem)
    problem = Collision().prepare(problem)
    for shift in (0.0, 5e-4):
        here = problem.state.pos + shift
        energy, other = Collision()(problem, here, here), CentroidCollision()(prepared, here, here)
        assert float(energy) > 0
        torch.testing.assert_close(other, energy, rtol=1e-9, atol=0)


def test_one_search_per_step_and_none_for_the_default(monkeypatch):
    calls = []
    search = collision_module.find_centroid_contact
    monkeypatch.setattr(collision_module, "find_centroid_contact", lambda *a: calls.append(1) or search(*a))
    problem = problem_on(slope_body(0.1), 1e-3)
    plain = default_potential().prepare(problem)
    assert plain.contact is problem.contact
    assert default_potential().prepare(plain) is plain
    potential = reference_potential()
    prepared = potential.prepare(problem)
    assert potential.prepare(prepared) is prepared
    for _ in range(3):
        potential.gradient(prepared, prepared.state.pos)
    assert len(calls) == 1
    with pytest.raises(ValueError, match=r"Potential\.prepare"):
        potential.total(problem, problem.state.pos)
    with pytest.raises(ValueError, match="obstacle"):
        potential.prepare(replace(problem, step=replace(problem.step, obstacle=None)))
    free = replace(problem, contact=None, step=replace(problem.step, obstacle=None))
    assert potential.prepare(free) is free
    assert "collision" not in potential.energies(free, free.state.pos)


@pytest.mark.parametrize("angle", [0.0, 0.4, 1.2, np.pi - 0.3])
def test_friction_by_weight_on_a_slope(angle):
    """N = m g cos(angle), nothing under an overhang; sliding beyond the mollifier feels μ N along the slope."""
    cloth = build_cloth(*grid(3, 3, 0.1), Material(), dtype=F64)
    normal = torch.tensor([-np.sin(angle), np.cos(angle), 0.0], dtype=F64)
    along = torch.tensor([np.cos(angle), np.sin(angle), 0.0], dtype=F64)
    body = torch.tensor([0.01, -0.02, 0.005], dtype=F64)
    contact = plane_contact(cloth.rest_pos, normal, motion=body)
    near = torch.arange(9) < 6
    contact = replace(contact, dist=torch.where(near, 2.9e-3, 3.1e-3).to(F64), valid=torch.arange(9) > 0)
    problem = make_problem(cloth, contact=contact)
    term = WeightFriction(coefficient=0.4)
    expected = cloth.mass * 9.81 * max(np.cos(angle), 0.0) * (near & contact.valid)
    torch.testing.assert_close(term.normal_force(problem, contact), expected, rtol=1e-6, atol=1e-15)
    next_pos = cloth.rest_pos + body + 0.03 * along + 0.01 * normal
    force = Potential({"term": term}).gradient(problem, next_pos)[0]
    torch.testing.assert_close(force, 0.4 * expected[:, None] * along, rtol=1e-6, atol=1e-12)
    still = Potential({"term": term}).gradient(problem, cloth.rest_pos + body)[0]
    assert float(still.abs().max()) < 1e-9


def test_friction_by_weight_turns_with_gravity():
    pos, faces = grid(3, 3, 0.1)
    cloth = build_cloth(pos[:, [2, 0, 1]], faces, Material(), dtype=F64)
    problem = make_problem(cloth, contact=plane_contact(cloth.rest_pos, torch.tensor([0.0, 0.0, 1.0])))
    term = WeightFriction()
    assert float(term(problem, cloth.rest_pos + 0.1, cloth.rest_pos)) == pytest.approx(0.0)
    along_z = replace(problem, gravity=torch.tensor([0.0, 0.0, -9.81], dtype=F64))
    torch.testing.assert_close(term.normal_force(along_z, along_z.contact), cloth.mass * 9.81)
    weightless = replace(problem, gravity=torch.zeros(3, dtype=F64))
    assert not bool(term.normal_force(weightless, problem.contact).any())


def test_frictions_differ_where_they_must():
    """Cloth that hovers 2.5 mm above the body: weight grips, contact does not; the other way round when pressed."""
    cloth = build_cloth(*grid(3, 3, 0.1), Material(), dtype=F64)
    for height, weight_grips_more in ((2.5e-3, True), (0.5e-3, False)):
        pos = cloth.rest_pos + torch.tensor([0.0, height, 0.0], dtype=F64)
        problem = make_problem(cloth, pos, contact=plane_contact(pos))
        by_weight, by_contact = (t.normal_force(problem, problem.contact).sum() for t in (WeightFriction(), Friction()))
        assert bool(by_weight > by_contact) is weight_grips_more


def test_a_ramp_changes_only_what_has_a_collision_weight():
    term = CentroidCollision(5e3, 1e-3).with_weight(5e5)
    assert (type(term), term.weight, term.epsilon) == (CentroidCollision, 5e5, 1e-3)
    friction = WeightFriction()
    assert friction.with_weight(1.0) is friction
    with pytest.raises(ValueError, match="radius"):
        WeightFriction(radius=0.0)


def test_gradients_match_finite_differences():
    body = obstacle(*sphere(2, 0.3))
    pos, faces = grid(4, 4, 0.1)
    cloth = build_cloth(pos + [-0.05, 0.293, -0.05], faces, Material(bending_stiffness=1e-3), dtype=F64)
    problem = make_problem(cloth)
    contact = find_contact(problem.state.pos, cloth.vertex_scene, body)
    problem = replace(problem, step=replace(problem.step, obstacle=body), contact=contact)
    potential = reference_potential()
    problem = potential.prepare(problem)
    state = cloth.rest_pos + 1e-3 * torch.as_tensor(np.random.default_rng(0).normal(size=pos.shape))
    for name, term in potential.terms.items():
        if isinstance(term, (CurrentLengthBending, CentroidCollision, WeightFriction)):
            x = state.clone().requires_grad_(True)
            energy = lambda y, t=term: t(problem, y, y)  # noqa: E731
            assert float(energy(x).detach()) > 0, name
            assert torch.autograd.gradcheck(energy, x, eps=1e-7, atol=1e-6, rtol=1e-4), name
