"""Drag of the air: forces by hand, and what gusts are."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth, concatenate_cloths
from hood.cloth.state import State
from hood.energies.potential import Potential
from hood.energies.problem import StepProblem
from hood.energies.wind import Wind, air
from hood.testing import grid, make_problem

F64 = torch.float64
DT = 1 / 30


def sheet(velocity=(0.0, 0.0, 0.0), tilt: float = 0.0, flipped: int = 0) -> StepProblem:
    """A flat sheet of 0.3 m in the plane y = x tan(tilt), all of it at one velocity."""
    pos, faces = grid(4, 5, 0.3)
    pos = pos * [np.cos(tilt), 1.0, 1.0] + pos[:, :1] * [0.0, np.sin(tilt), 0.0]
    faces = faces.copy()
    faces[:flipped] = faces[:flipped, ::-1]
    return make_problem(build_cloth(pos, faces, Material(), dtype=F64), vel=np.tile(velocity, (len(pos), 1)))


def force(term: Wind, problem: StepProblem) -> np.ndarray:
    """On the whole sheet [N] (3,), where it keeps its velocity."""
    pos = problem.state.pos + DT * problem.state.vel
    return -Potential({"wind": term}).gradient(problem, pos)[0].sum(dim=0).numpy()


def test_a_plate_across_the_stream_feels_its_dynamic_pressure():
    area, term = 0.09, Wind([0.0, 5.0, 0.0], drag=1.17, friction=0.0, density=1.2)
    np.testing.assert_allclose(force(term, sheet()), [0, 0.5 * 1.2 * 1.17 * area * 25.0, 0], rtol=1e-9, atol=1e-12)
    # It is the velocity against the air that counts.
    np.testing.assert_allclose(force(term, sheet((0.0, 2.0, 0.0)))[1], 0.5 * 1.2 * 1.17 * area * 9.0, rtol=1e-9)
    np.testing.assert_allclose(force(term, sheet((0.0, 5.0, 0.0))), 0.0, atol=1e-12)


def test_in_the_plane_there_is_friction_alone():
    term = Wind([3.0, 0.0, 4.0], drag=1.17, friction=0.02)
    expected = 0.5 * 1.2 * 0.02 * 0.09 * 5.0 * np.array([3.0, 0.0, 4.0])
    np.testing.assert_allclose(force(term, sheet()), expected, rtol=1e-9, atol=1e-12)


def test_a_tilted_plate_is_pushed_along_its_normal():
    tilt = 0.7
    normal = np.array([-np.sin(tilt), np.cos(tilt), 0.0])
    found = force(Wind([4.0, 0.0, 0.0], friction=0.0), sheet(tilt=tilt))
    speed = 4.0 * normal[0]
    np.testing.assert_allclose(found, 0.5 * 1.2 * 1.17 * 0.09 * abs(speed) * speed * normal, rtol=1e-9, atol=1e-12)


def test_which_way_faces_are_wound_plays_no_role():
    term = Wind([1.0, 2.0, 3.0])
    np.testing.assert_allclose(force(term, sheet(tilt=0.3, flipped=7)), force(term, sheet(tilt=0.3)), rtol=1e-12)


def test_a_face_without_area_feels_nothing():
    problem = sheet()
    pos = problem.state.pos.clone()
    pos[:] = pos[0]
    flat = replace(problem, state=State(pos, problem.state.vel, problem.state.origin))
    gradient, energies = Potential({"wind": Wind([1.0, 2.0, 3.0])}).gradient(flat, pos + 0.01)
    assert not gradient.any()
    assert float(energies["wind"]) == 0.0


def test_gradient_is_that_of_differences():
    problem, term = sheet((0.5, 1.0, 0.0), tilt=0.4), Wind([3.0, -1.0, 2.0], gusts=0.2)
    rng = np.random.default_rng(0)
    pos = problem.state.pos + 0.03 * torch.as_tensor(rng.normal(size=problem.state.pos.shape))
    heading = torch.as_tensor(rng.normal(size=pos.shape))
    gradient, _ = Potential({"wind": term}).gradient(problem, pos)
    ends = [float(term(problem, pos + sign * 1e-6 * heading, pos)) for sign in (1.0, -1.0)]
    assert float((gradient * heading).sum()) == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-7)


def at(problem: StepProblem, time: float, origin=(0.0, 0.0, 0.0)) -> StepProblem:
    moved = replace(problem.state, origin=torch.tensor([origin], dtype=F64))
    return replace(problem, state=moved, step=replace(problem.step, time=torch.tensor([time], dtype=F64)))


def speeds(term: Wind, problem: StepProblem) -> torch.Tensor:
    return term.air(problem, problem.state.pos[problem.cloth.faces].mean(dim=1))


def test_gusts_have_the_intensity_that_was_asked_for_and_follow_from_the_seed():
    problem, term = sheet(), Wind([0.0, 0.0, -6.0], gusts=0.25, gust_time=0.5, seed=3)
    times = np.arange(0.0, 300.0, 0.25)
    series = np.array([float(speeds(term, at(problem, time))[0, 2]) for time in times])
    assert series.mean() == pytest.approx(-6.0, rel=0.03)
    assert series.std() / 6.0 == pytest.approx(0.25, rel=0.1)
    again, other = Wind([0.0, 0.0, -6.0], gusts=0.25, gust_time=0.5, seed=3), Wind([0.0, 0.0, -6.0], gusts=0.25, seed=4)
    assert torch.equal(speeds(again, at(problem, 1.7)), speeds(term, at(problem, 1.7)))
    assert not torch.equal(speeds(other, at(problem, 1.7)), speeds(term, at(problem, 1.7)))


def test_gusts_are_carried_along_with_the_wind():
    problem, term = sheet(), Wind([3.0, 0.0, 4.0], gusts=0.4, seed=1)
    later = at(problem, 2.5, origin=(3.0 * 1.5, 0.7, 4.0 * 1.5))
    torch.testing.assert_close(speeds(term, later), speeds(term, at(problem, 1.0)))
    assert float((speeds(term, at(problem, 2.5)) - speeds(term, at(problem, 1.0))).abs().max()) > 0.1


def test_scenes_of_a_batch_have_their_own_air():
    term, problems = Wind([2.0, 0.0, 0.0], gusts=0.3), [at(sheet(), 1.0), at(sheet(tilt=0.5), 2.0, (5.0, 0.0, 1.0))]
    cloth = concatenate_cloths([problem.cloth for problem in problems])
    whole = make_problem(cloth, torch.cat([problem.state.pos for problem in problems]))
    whole = replace(
        whole,
        state=replace(whole.state, origin=torch.cat([problem.state.origin for problem in problems])),
        step=replace(whole.step, time=torch.tensor([1.0, 2.0], dtype=F64)),
    )
    pos = whole.state.pos + 0.01
    alone = [term(problem, problem.state.pos + 0.01, pos) for problem in problems]
    torch.testing.assert_close(term(whole, pos, pos), torch.cat(alone), rtol=1e-12, atol=0)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"velocity": [1.0, 2.0]}, r"velocity is \[1.0, 2.0\]; give three numbers"),
        ({"velocity": [0.0, float("nan"), 0.0]}, "velocity is .*; give three numbers"),
        ({"drag": -1.0}, "drag is -1.0; give a finite number >= 0"),
        ({"gusts": -0.1}, "gusts is -0.1"),
        ({"gust_time": 0.0}, "gust_time is 0.0; give seconds > 0"),
    ],
)
def test_bad_values_are_refused(given, message):
    with pytest.raises(ValueError, match=message):
        Wind(**given)


@pytest.mark.parametrize("given", ["abc", [1.0, "x", 0.0]])
def test_a_wind_that_is_no_number_is_refused(given):
    with pytest.raises(ValueError, match="give m/s, a number"):
        air(given)
