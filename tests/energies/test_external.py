from dataclasses import replace

import numpy as np
import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.cloth.state import Attachments
from hood.energies.contact import Collision
from hood.energies.friction import Friction, WeightFriction
from hood.energies.laws import mollified_norm
from hood.energies.mass_points import Attachment, Gravity, Inertia
from hood.energies.potential import Potential
from hood.testing import grid, make_problem, plane_contact, random_rotation

F64 = torch.float64
DT = 1 / 30


def sheet(height=0.0, isolated=False):
    pos, faces = grid(4, 4, 0.5)
    if isolated:
        pos = np.concatenate([pos, [[0.2, 0.0, 0.2]]])
    cloth = build_cloth(pos, faces, Material(), dtype=F64)
    return cloth, cloth.rest_pos + torch.tensor([0.0, height, 0.0], dtype=F64)


def gradient(term, problem, pos):
    return Potential({"term": term}).gradient(problem, pos)[0]


def test_inertia_and_gravity_by_hand():
    cloth, pos = sheet()
    problem = make_problem(cloth, pos)
    mass = float(cloth.mass.sum())
    acc = torch.tensor([1.0, 2.0, -2.0], dtype=F64).expand_as(pos)
    assert float(Inertia()(problem, pos, acc)) == pytest.approx(0.5 * mass * DT**2 * 9.0)
    lifted = pos + torch.tensor([5.0, 2.0, 1.0], dtype=F64)
    assert float(Gravity()(problem, lifted, acc) - Gravity()(problem, pos, acc)) == pytest.approx(mass * 9.81 * 2.0)


def test_free_fall_step_is_the_minimum_of_inertia_and_gravity():
    rng = np.random.default_rng(0)
    cloth, pos = sheet()
    problem = make_problem(cloth, pos, rng.normal(size=pos.shape))
    potential = Potential({"inertia": Inertia(), "gravity": Gravity()})
    fall = pos + DT * problem.state.vel + DT**2 * problem.gravity
    residual, _ = potential.gradient(problem, fall)
    assert float(residual.abs().max()) < 1e-12 * float(cloth.mass.max()) * 9.81 / DT
    lowest = float(potential.total(problem, fall))
    for _ in range(3):
        other = fall + 1e-4 * torch.as_tensor(rng.normal(size=pos.shape))
        assert float(potential.total(problem, other)) > lowest


def test_collision_force_is_cubic_in_depth_along_the_normal():
    rng = np.random.default_rng(1)
    cloth, pos = sheet()
    normal = torch.as_tensor(random_rotation(rng)[0])
    weight, epsilon = 3e5, 2e-3
    contact = plane_contact(pos, normal)
    depth = torch.linspace(-1e-3, 4e-3, len(pos), dtype=F64)
    next_pos = contact.next_point + (epsilon - depth).unsqueeze(1) * normal
    problem = make_problem(cloth, pos, contact=contact)
    force = gradient(Collision(weight, epsilon), problem, next_pos)
    expected = -3 * weight * depth.clamp_min(0).square().unsqueeze(1) * normal
    torch.testing.assert_close(force, expected, rtol=1e-9, atol=1e-12)
    energy = float(Collision(weight, epsilon)(problem, next_pos, next_pos))
    assert energy == pytest.approx(float(weight * depth.clamp_min(0).pow(3).sum()), rel=1e-9)


def test_contact_terms_ignore_invalid_matches_and_isolated_vertices():
    cloth, pos = sheet(height=-1e-3, isolated=True)
    contact = plane_contact(pos)
    valid = contact.valid.clone()
    valid[3] = False
    far = contact.dist.clone()
    far[3] = float("nan")
    point = contact.next_point.clone()
    point[3] = float("inf")
    contact = replace(contact, valid=valid, dist=far, next_point=point)
    problem = make_problem(cloth, pos, contact=contact)
    moved = pos + torch.tensor([1e-2, 0.0, 0.0], dtype=F64)
    for term in (Collision(), Friction()):
        force = gradient(term, problem, moved)
        assert torch.isfinite(force).all()
        assert (force[3] == 0).all()
        assert (force[-1] == 0).all()
        assert (force[[0, 1, 2]].norm(dim=1) > 0).all()


def test_collision_weight_can_be_ramped():
    cloth, pos = sheet(height=-1e-3)
    problem = make_problem(cloth, pos, contact=plane_contact(pos))
    low, high = Collision(5e3), Collision(5e3).with_weight(5e5)
    assert high.epsilon == low.epsilon
    assert float(high(problem, pos, pos)) == pytest.approx(100 * float(low(problem, pos, pos)))


def test_friction_force_is_at_most_coulomb_and_opposes_the_slip():
    rng = np.random.default_rng(2)
    cloth, pos = sheet(height=1e-3)
    normal = torch.tensor([0.0, 1.0, 0.0], dtype=F64)
    body = torch.tensor([0.01, 0.005, -0.02], dtype=F64)
    contact = plane_contact(pos, motion=body)
    problem = make_problem(cloth, pos, contact=contact)
    term = Friction(coefficient=0.3)
    limit = 0.3 * 3 * term.weight * (term.epsilon - 1e-3) ** 2
    slip = torch.as_tensor(rng.normal(size=pos.shape)) * torch.logspace(-6, -1, len(pos), dtype=F64).unsqueeze(1)
    force = gradient(term, problem, pos + body + slip)
    tangential = slip - (slip @ normal).unsqueeze(1) * normal
    size = tangential.norm(dim=1)
    assert float(force.norm(dim=1).max()) <= limit * (1 + 1e-9)
    assert float((force @ normal).abs().max()) < 1e-12
    sliding = size > term.slip_speed * DT
    assert 0 < int(sliding.sum()) < len(pos)
    expected = limit * tangential / size.unsqueeze(1)
    torch.testing.assert_close(force[sliding], expected[sliding])
    aligned = (force * tangential).sum(dim=1) / (force.norm(dim=1) * size)
    torch.testing.assert_close(aligned, torch.ones_like(aligned))


@pytest.mark.parametrize("term", [Friction(0.3), WeightFriction(0.3)])
def test_the_fabric_multiplies_the_coefficient_where_it_lies(term):
    cloth, pos = sheet(height=1e-3)
    factor = torch.linspace(0.0, 2.0, len(pos), dtype=F64)
    rest, faces = cloth.rest_pos.numpy(), cloth.faces.numpy()
    both = [build_cloth(rest, faces, Material(friction=field), dtype=F64) for field in (1.0, factor.numpy())]
    slid = pos + torch.tensor([1e-2, 0.0, 0.0], dtype=F64)
    usual, own = (gradient(term, make_problem(cloth, pos, contact=plane_contact(pos)), slid) for cloth in both)
    assert float(usual.abs().sum(dim=1).min()) > 0
    torch.testing.assert_close(own, factor[:, None] * usual)


def test_friction_is_finite_and_zero_when_moving_along_and_absent_when_apart():
    cloth, pos = sheet(height=1e-3)
    body = torch.tensor([0.01, 0.0, 0.0], dtype=F64)
    problem = make_problem(cloth, pos, contact=plane_contact(pos, motion=body))
    assert float(gradient(Friction(), problem, pos + body).abs().max()) < 1e-9
    cloth, apart = sheet(height=5e-3)
    problem = make_problem(cloth, apart, contact=plane_contact(apart, motion=body))
    assert float(gradient(Friction(), problem, apart).abs().max()) == 0.0


def test_mollified_norm_is_continuously_differentiable():
    limit = torch.tensor(1e-3, dtype=F64)
    ends = [limit * (1 - 1e-9), limit * (1 + 1e-9)]
    for y in ends:
        squared = (y * y).clone().requires_grad_(True)
        value = mollified_norm(squared, limit)
        value.backward()
        assert float(value.detach()) == pytest.approx(1e-3, rel=1e-6)
        assert float(2 * y * squared.grad) == pytest.approx(1.0, rel=1e-6)


def test_external_gradients_match_finite_differences():
    rng = np.random.default_rng(3)
    cloth, pos = sheet(height=1e-3)
    problem = make_problem(cloth, pos, rng.normal(size=pos.shape), contact=plane_contact(pos))
    edges = torch.tensor([[0, 5], [2, 15]])
    step = replace(problem.step, attachments=Attachments(edges, torch.tensor([True, True])))
    problem = replace(problem, step=step)
    state = (pos + 1e-3 * torch.as_tensor(rng.normal(size=pos.shape))).requires_grad_(True)
    for term in (Inertia(), Gravity(), Collision(), Friction(), Attachment()):
        energy = lambda x, t=term: t(problem, x, problem.acceleration(x))  # noqa: E731
        assert torch.autograd.gradcheck(energy, state, eps=1e-7, atol=1e-6, rtol=1e-4), type(term).__name__


def test_attachment_pulls_closed_pairs_only():
    cloth, pos = sheet()
    problem = make_problem(cloth, pos)
    assert float(Attachment()(problem, pos, pos)) == 0.0
    edges = torch.tensor([[0, 5], [2, 15]])
    problem = replace(problem, step=replace(problem.step, attachments=Attachments(edges, torch.tensor([False, True]))))
    gap = pos[2] - pos[15]
    assert float(Attachment(200.0)(problem, pos, pos)) == pytest.approx(100.0 * float(gap @ gap))
    force = gradient(Attachment(200.0), problem, pos)
    torch.testing.assert_close(force[2], 200.0 * gap)
    torch.testing.assert_close(force[15], -200.0 * gap)
    assert (force[[0, 5]] == 0).all()


@pytest.mark.parametrize(
    ("term", "arguments"),
    [(Collision, {"epsilon": 0.0}), (Collision, {"weight": -1.0}), (Friction, {"coefficient": -0.1}),
     (Friction, {"slip_speed": 0.0}), (Attachment, {"stiffness": -1.0})],
)  # fmt: skip
def test_impossible_parameters_are_refused(term, arguments):
    with pytest.raises(ValueError, match=next(iter(arguments))):
        term(**arguments)
