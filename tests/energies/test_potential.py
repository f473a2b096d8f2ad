import copy
from dataclasses import replace

import numpy as np
import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth, concatenate_cloths
from hood.cloth.state import Attachments, Obstacle, State, StepInput, concatenate_states
from hood.energies.contact import Collision
from hood.energies.potential import Potential, default_potential, relative_gradient, scale
from hood.energies.problem import StepProblem, inertial_guess
from hood.testing import concatenate_contacts, cylinder, grid, make_problem, plane_contact, sphere

F64 = torch.float64


def sheet_problem(seed=0, dtype=F64, dt=1 / 30, pinned=None):
    rng = np.random.default_rng(seed)
    mesh = grid(5, 4, 0.3) if seed % 2 == 0 else cylinder(6, 3, 0.1, 0.2)
    cloth = build_cloth(*mesh, Material(), pinned=pinned, dtype=dtype)
    pos = cloth.rest_pos + 0.002 * torch.as_tensor(rng.normal(size=mesh[0].shape)).to(dtype)
    return make_problem(cloth, pos, 0.1 * rng.normal(size=mesh[0].shape), dt, plane_contact(pos))


def concatenate_problems(problems: list[StepProblem]) -> StepProblem:
    contact = concatenate_contacts([problem.contact for problem in problems])
    return StepProblem(
        concatenate_cloths([problem.cloth for problem in problems]),
        concatenate_states([problem.state for problem in problems]),
        StepInput(dt=torch.cat([problem.step.dt for problem in problems])),
        contact,
        problems[0].gravity,
    )


def test_total_is_the_sum_and_gradient_its_derivative():
    problem = sheet_problem()
    potential = default_potential()
    pos = inertial_guess(problem.state, problem.step)
    energies = potential.energies(problem, pos)
    torch.testing.assert_close(potential.total(problem, pos), sum(energies.values()))
    gradient, values = potential.gradient(problem, pos)
    assert values.keys() == energies.keys()
    direction = torch.as_tensor(np.random.default_rng(1).normal(size=pos.shape))
    h = 1e-7
    difference = (potential.total(problem, pos + h * direction) - potential.total(problem, pos - h * direction)) / (2 * h)
    assert float(difference) == pytest.approx(float((gradient * direction).sum()), rel=1e-5)


def test_batch_equals_singles_with_different_time_steps():
    potential = default_potential()
    problems = [sheet_problem(0), sheet_problem(1, dt=1 / 3), sheet_problem(2, dt=1 / 240)]
    together = concatenate_problems(problems)
    pos = inertial_guess(together.state, together.step, together.cloth.vertex_scene)
    gradient, energies = potential.gradient(together, pos)
    alone = [potential.gradient(p, inertial_guess(p.state, p.step)) for p in problems]
    torch.testing.assert_close(gradient, torch.cat([g for g, _ in alone]), rtol=1e-12, atol=1e-14)
    for name, value in energies.items():
        torch.testing.assert_close(value, torch.cat([e[name] for _, e in alone]), rtol=1e-12, atol=1e-16)
    for function in (scale, lambda p: relative_gradient(p, potential.gradient(p, p.state.pos)[0])):
        torch.testing.assert_close(function(together), torch.cat([function(p) for p in problems]), rtol=1e-12, atol=0)


def test_terms_without_effect_are_left_out():
    problem = sheet_problem()
    assert "attachment" not in default_potential().energies(problem, problem.state.pos)
    free = replace(problem, contact=None, gravity=torch.zeros(3, dtype=F64))
    assert set(default_potential().energies(free, free.state.pos)) == {"stretching", "bending", "inertia"}
    frictionless = default_potential(friction_coefficient=0.0)
    assert "friction" not in frictionless.energies(problem, problem.state.pos)
    buttoned = replace(problem.step, attachments=Attachments(torch.tensor([[0, 1]]), torch.tensor([True])))
    assert "attachment" in default_potential().energies(replace(problem, step=buttoned), problem.state.pos)


def test_contact_is_searched_for_where_a_term_needs_it_and_demanded_there():
    """Energies of a problem with a body must not be those of one without: forgetting to prepare it is an error."""
    cloth = build_cloth(*grid(3, 3, 0.1), Material(), dtype=F64)
    ball, faces = (torch.as_tensor(array) for array in sphere(2, 0.1))
    zeros = torch.zeros(len(ball), dtype=torch.int64)
    body = Obstacle(ball, ball, ball, faces, zeros, torch.zeros(len(faces), dtype=torch.int64))
    bare = make_problem(cloth, cloth.rest_pos + 0.05)
    problem = replace(bare, step=replace(bare.step, obstacle=body))
    potential = default_potential()
    with pytest.raises(ValueError, match=r"contact not searched for yet; pass the problem through Potential\.prepare"):
        potential.total(problem, problem.state.pos)
    prepared = potential.prepare(problem)
    assert potential.prepare(prepared) is prepared
    assert problem.contact is None
    assert float(potential.energies(prepared, problem.state.pos)["collision"]) > 0
    shape = Potential({name: potential.terms[name] for name in ("stretching", "inertia")})
    assert shape.prepare(problem) is problem
    assert potential.prepare(bare) is bare


def test_replacing_a_term_leaves_the_original_untouched():
    potential = default_potential()
    ramped = potential.with_terms(collision=Collision(5e3))
    assert ramped.terms["collision"].weight == 5e3
    assert potential.terms["collision"].weight == 5e5


def test_given_acceleration_keeps_precision_that_positions_lose():
    """At 1 m and 1/240 s the difference of float32 positions loses digits that the acceleration has."""
    dt = 1 / 240
    exact = sheet_problem(0, F64, dt)
    rough = sheet_problem(0, torch.float32, dt)
    shift = 1.0
    potential = default_potential()
    acc = torch.as_tensor(np.random.default_rng(1).normal(size=exact.state.pos.shape))
    errors = []
    for use_acc in (True, False):
        state = replace(rough.state, pos=rough.state.pos + shift)
        problem = replace(rough, state=state, contact=None)
        next_pos = state.pos + dt * state.vel + dt**2 * acc.float()
        value = potential.energies(problem, next_pos, acc.float() if use_acc else None)["inertia"]
        expected = potential.energies(replace(exact, contact=None), exact.state.pos, acc)["inertia"]
        errors.append(abs(float(value / expected) - 1))
    assert errors[0] < 1e-6
    assert errors[1] > 10 * errors[0]


def test_gradient_with_a_given_acceleration_is_the_same_derivative():
    problem = sheet_problem()
    acc = torch.as_tensor(np.random.default_rng(2).normal(size=problem.state.pos.shape))
    dt = problem.vertex_dt
    pos = problem.state.pos + dt * problem.state.vel + dt**2 * acc
    given, derived = (default_potential().gradient(problem, pos, a)[0] for a in (acc, None))
    torch.testing.assert_close(given, derived, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_refused(dtype):
    problem = sheet_problem()
    with pytest.raises(ValueError, match="float32"):
        default_potential().energies(problem, problem.state.pos.to(dtype))
    for term in default_potential().terms.values():
        if term.applies(problem):
            half = replace(problem, cloth=_to(problem.cloth, dtype), step=StepInput(problem.step.dt.to(dtype)))
            half = replace(half, state=_to(problem.state, dtype), contact=_to(problem.contact, dtype))
            with pytest.raises(ValueError, match="float32"):
                term(half, half.state.pos, half.state.vel)


def test_isolated_and_massless_vertices_contribute_nothing():
    pos, faces = grid(4, 4, 0.3)
    with_isolated = np.concatenate([pos, [[0.1, -0.5, 0.1]]])
    problems = []
    for points in (pos, with_isolated):
        cloth = build_cloth(points, faces, Material(), dtype=F64)
        problems.append(make_problem(cloth, contact=plane_contact(cloth.rest_pos)))
    plain, extra = (default_potential().gradient(problem, problem.state.pos) for problem in problems)
    for name, value in plain[1].items():
        torch.testing.assert_close(extra[1][name], value, rtol=1e-14, atol=0)
    assert (extra[0][-1] == 0).all()


def test_scale_and_relative_gradient_by_hand():
    pinned = np.arange(20) < 4
    problem = sheet_problem(pinned=pinned)
    mass = problem.cloth.mass
    assert float(scale(problem)) == pytest.approx(0.5 * float(mass.sum()) * 9.81**2 / 900)
    weight = mass.unsqueeze(1) * problem.gravity
    weight[:4] = 1e6
    assert float(relative_gradient(problem, weight)) == pytest.approx(1.0)
    assert float(relative_gradient(problem, 0 * weight)) == 0.0


def test_hanging_at_rest_has_a_relative_gradient_of_one():
    problem = replace(sheet_problem(), contact=None)
    state = State(problem.cloth.rest_pos, 0 * problem.state.vel, problem.state.origin)
    problem = replace(problem, state=state)
    gradient, _ = default_potential().gradient(problem, state.pos)
    assert float(relative_gradient(problem, gradient)) == pytest.approx(1.0, rel=1e-9)


def _to(item, dtype):
    values = {name: getattr(item, name) for name in item.__dataclass_fields__}
    real = {n: v.to(dtype) for n, v in values.items() if isinstance(v, torch.Tensor) and v.is_floating_point()}
    return replace(item, **real)


def test_a_prepared_problem_is_not_prepared_again():
    asked = []

    class Asking(Collision):
        def prepare(self, problem):
            asked.append(problem)
            return super().prepare(problem)

    pos, faces = grid(4, 4, 0.1)
    problem = make_problem(build_cloth(pos, faces, Material()), pos)
    potential = default_potential().with_terms(collision=Asking())
    prepared = potential.prepare(problem)
    assert potential.prepare(prepared) is prepared
    assert len(asked) == 1
    potential.with_terms(collision=Asking()).prepare(prepared)  # other terms may ask for more
    potential.prepare(replace(prepared))
    assert len(asked) == 3
    assert potential.prepare(copy.copy(prepared)) is not prepared  # fixed shapes copy problems so
    assert len(asked) == 4
    potential.prepare(prepared)
    potential.terms["collision"].epsilon = 4e-3
    potential.prepare(prepared)
    assert len(asked) == 6


def test_time_steps_of_vertices_are_those_of_their_scene():
    pos, faces = grid(3, 3, 0.1)
    cloth = build_cloth(pos, faces, Material())
    single = make_problem(cloth, pos)
    assert torch.equal(single.vertex_dt, single.step.dt[cloth.vertex_scene].unsqueeze(1))
    dt = single.step.dt.clone().requires_grad_()
    followed = replace(single, step=replace(single.step, dt=dt))
    assert followed.vertex_dt.requires_grad
