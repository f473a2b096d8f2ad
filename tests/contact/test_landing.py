"""Contact of fast vertices with the skin that they would fly into."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from corners import corner, obstacle
from torch import Tensor

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.cloth.state import Obstacle, State, StepInput, concatenate_obstacles
from hood.contact.contact import find_contact, find_second_contact
from hood.contact.further import find_landing, find_second_side
from hood.energies.potential import default_potential
from hood.energies.problem import StepProblem, free_flight
from hood.mesh.closest_point.search import build_incidence
from hood.solver.newton import NewtonSettings, minimize
from hood.steppers.static_shapes.problem import with_fixed_contact
from hood.testing import grid, sphere

F64 = torch.float64


def landings(body: Obstacle, points: list[list[float]], ways: list[list[float]]) -> tuple[list[bool], Tensor, Tensor]:
    """Which of the points land, and the planes they land on, at t."""
    pos, way = torch.tensor(points, dtype=F64), torch.tensor(ways, dtype=F64)
    scene = torch.zeros(len(pos)).long()
    found = find_landing(pos, scene, body, find_contact(pos, scene, body), way)
    if found is None:
        return [False] * len(pos), torch.zeros(0, 3), torch.zeros(0, 3)
    return found[1].tolist(), found[0].point, found[0].normal


def test_along_a_floor_into_a_wall() -> None:
    lands, point, normal = landings(obstacle(*corner()), [[-0.06, 0.03, 0.0], [-0.06, 0.03, 0.1]], [[0.1, 0, 0], [0.03, 0, 0]])
    assert lands == [True, False]  # the second stops short
    assert float(point[0, 0]) == pytest.approx(0.0, abs=1e-9)
    torch.testing.assert_close(normal[0], torch.tensor([-1.0, 0, 0], dtype=F64), rtol=0, atol=0.35)


def test_slow_vertices_and_those_that_go_away_do_not_land() -> None:
    body = obstacle(*corner())
    assert landings(body, [[-0.016, 0.03, 0.0]], [[0.018, 0, 0]])[0] == [False]
    assert landings(body, [[-0.06, 0.03, 0.0]], [[-0.1, 0, 0]])[0] == [False]
    assert landings(body, [[-0.06, 0.15, 0.0]], [[0.0, -0.1, 0]])[0] == [False]


def test_straight_down_the_plane_that_is_known_is_enough() -> None:
    assert landings(obstacle(*corner()), [[-0.2, 0.05, 0.0]], [[0, -0.2, 0]])[0] == [False]


def test_along_a_bulge_nothing_is_hidden() -> None:
    pos, faces = sphere(4, 0.1)
    body = obstacle(pos, faces)
    places = [[0.0, 0.105, 0.0], [0.0, 0.16, 0.0], [0.105, 0.0, 0.0]]
    assert landings(body, places, [[0.12, -0.04, 0], [0.1, -0.2, 0], [0, 0.1, 0.1]])[0] == [False] * 3


def test_from_beyond_the_reach_of_the_search() -> None:
    pos, faces = sphere(4, 0.1)
    lands, point, normal = landings(obstacle(pos, faces), [[0.02, 0.25, 0.0]], [[0.0, -0.3, 0.0]])
    assert lands == [True]
    assert float(point[0, 1]) == pytest.approx(0.098, abs=3e-3)
    assert float(normal[0, 1]) > 0.95


def test_cloth_that_moves_with_the_body_does_not_land() -> None:
    pos, faces = corner()
    moved = obstacle(pos, faces, pos + [0.1, 0.0, 0.0])
    assert landings(moved, [[-0.06, 0.03, 0.0]], [[0.1, 0, 0]])[0] == [False]
    lands, _, _ = landings(obstacle(pos, faces, pos - [0.1, 0.0, 0.0]), [[-0.06, 0.03, 0.0]], [[0.0, 0, 0]])
    assert lands == [True]  # the wall comes


def thrown(speed: float, dtype: torch.dtype = F64) -> StepProblem:
    """A sheet of 100 mm that hangs 30 mm above the floor, 30 mm off the wall, and flies into it."""
    pos, faces = grid(6, 6, 0.1)
    pos = pos + [-0.13, 0.03, -0.05]
    cloth = build_cloth(pos, faces, Material(), dtype=dtype)
    body, faces = corner()
    skin = obstacle(body, faces)
    skin = replace(skin, **{name: getattr(skin, name).to(dtype) for name in ("pos", "next_pos", "prev_pos")})
    place = torch.as_tensor(pos, dtype=dtype)
    velocity = torch.tensor([speed, 0.0, 0.0], dtype=dtype).expand(len(pos), 3)
    step = StepInput(torch.tensor([1 / 30], dtype=dtype), obstacle=skin)
    return StepProblem(
        cloth, State(place, velocity.clone(), torch.zeros(3, dtype=F64)), step, gravity=torch.tensor([0, -9.81, 0], dtype=dtype)
    )


@pytest.mark.parametrize("speed", [2.0, 6.0])
def test_a_step_ends_on_the_free_side(speed: float) -> None:
    """Positions against the wall itself: nothing of the search is used."""
    potential, problem = default_potential(), thrown(speed)
    known = potential.prepare(problem)
    assert known.second_contact is not None
    assert known.second_contact.contact is not None
    pos, report = minimize(potential, known, None, NewtonSettings())
    assert report.converged
    assert float(pos[:, 0].max()) < 1e-3
    assert float(pos[:, 1].min()) > -1e-3
    without = replace(
        known, second_contact=find_second_contact(known.state.pos, known.cloth.vertex_scene, known.step.obstacle, known.contact)
    )  # type: ignore[arg-type]
    through, _ = minimize(potential, without, None, NewtonSettings())
    assert float(through[:, 0].max()) > 0.02


def test_calm_cloth_has_the_folds_alone() -> None:
    problem = thrown(0.1)
    known = problem.with_fold()
    assert known.contact is not None
    assert known.step.obstacle is not None
    plain = find_second_contact(problem.state.pos, problem.cloth.vertex_scene, known.step.obstacle, known.contact)
    assert (known.second_contact is None or known.second_contact.contact is None) == (plain.contact is None)


def test_a_batch_finds_what_each_scene_does() -> None:
    ball, room = obstacle(*sphere(4, 0.1)), obstacle(*corner())
    points = torch.tensor([[0.02, 0.25, 0.0], [0.0, 0.3, 0.0], [-0.06, 0.03, 0.0], [-0.2, 0.3, 0.0]], dtype=F64)
    ways = torch.tensor([[0, -0.3, 0], [0, 0.1, 0], [0.1, 0.03, 0.02], [0.1, 0, 0]], dtype=F64)
    scene, both = torch.arange(4) // 2, concatenate_obstacles([ball, room])
    together = find_second_side(points, scene, both, find_contact(points, scene, both), ways).contact
    assert together is not None
    assert together.valid.tolist() == [True, False, True, False]
    for index, body in enumerate((ball, room)):
        own, zero = slice(2 * index, 2 * index + 2), torch.zeros(2).long()
        alone = find_second_side(points[own], zero, body, find_contact(points[own], zero, body), ways[own]).contact
        assert alone is not None
        for name in ("valid", "dist", "next_point", "next_normal"):
            rows = alone.valid
            torch.testing.assert_close(getattr(together, name)[own][rows], getattr(alone, name)[rows], rtol=0, atol=1e-12)


def test_single_precision_and_steps_of_fixed_shapes_find_the_same_on_a_cpu() -> None:
    double, single = thrown(4.0).with_fold(), thrown(4.0, torch.float32).with_fold()
    incidence = build_incidence(double.step.obstacle.faces, len(double.step.obstacle.pos))  # type: ignore[union-attr]
    fixed, _ = with_fixed_contact(thrown(4.0), incidence, 0, folds=True)
    for other in (single, fixed):
        assert other.second_contact is not None
        assert other.second_contact.contact is not None
        assert double.second_contact is not None
        assert double.second_contact.contact is not None
        assert torch.equal(other.second_contact.contact.valid, double.second_contact.contact.valid)
        torch.testing.assert_close(
            other.second_contact.contact.next_point.double(), double.second_contact.contact.next_point, rtol=0, atol=1e-5
        )


@pytest.mark.parametrize("speed", [float("nan"), float("inf"), 1e30])
def test_speeds_that_are_no_numbers_land_nowhere(speed: float) -> None:
    lands, _, _ = landings(obstacle(*corner()), [[-0.06, 0.03, 0.0], [-0.06, 0.03, 0.1]], [[0.1, 0, 0], [speed, speed, 0]])
    assert lands[0]
    assert not lands[1] or speed == 1e30


def test_free_flight_is_that_of_a_step_without_forces() -> None:
    problem = thrown(3.0)
    expected = torch.tensor([0.1, 0.0, 0.0], dtype=F64)
    torch.testing.assert_close(free_flight(problem), expected.expand(36, 3))


def test_cloth_without_vertices() -> None:
    body = obstacle(*sphere(2, 0.1))
    none, scene = torch.zeros(0, 3, dtype=F64), torch.zeros(0).long()
    assert find_second_side(none, scene, body, find_contact(none, scene, body), none).contact is None
