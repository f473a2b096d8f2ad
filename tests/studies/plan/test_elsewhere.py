"""Other meshes and time steps: common points are the same places, and what is measured there is a distance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from hood.assets.body.body import Body
from hood.assets.garment.garment import load_garment
from hood.assets.motion.load import load_sequence
from hood.energies.potential import default_potential
from hood.scene.scene import Scene, build_scene
from hood.steppers.newton import NewtonStepper
from hood.studies.plan.ablation import Variant
from hood.studies.plan.discretisation import Elsewhere, Reference, common_points, measure_elsewhere


def at(body: Body, garment: str, fps: float = 30.0) -> Scene:
    return build_scene(load_garment(garment), body, load_sequence("plie", fps=fps))


@pytest.fixture(scope="module")
def tank(body: Body) -> Scene:
    return at(body, "tank")


@pytest.fixture(scope="module")
def tank_4k(body: Body) -> Scene:
    return at(body, "tank_4k")


def moved_by(scene: Scene) -> Variant:
    potential = default_potential()
    return Variant(NewtonStepper(potential), potential, scene)


def test_common_points_are_the_coarse_vertices_on_the_fine_mesh(tank: Scene, tank_4k: Scene) -> None:
    on_fine, on_coarse = common_points(tank_4k, tank)
    fine, coarse = (scene.cloth.rest_pos.double() for scene in (tank_4k, tank))
    assert torch.equal(on_coarse.of(coarse), coarse)
    assert torch.allclose(on_fine.weights.sum(dim=1), torch.ones(tank.cloth.num_vertices, dtype=torch.float64))
    miss = (on_fine.of(fine) - coarse).norm(dim=1)
    assert float(miss.max()) < 0.01  # a chord's chord error, far below the edges of 35 mm
    # They move with the mesh: under an affine map both stay together.
    turn = torch.tensor([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    assert torch.allclose((on_fine.of(fine @ turn) - coarse @ turn).norm(dim=1), miss, atol=1e-9)


def test_the_coarser_mesh_gives_the_points_whichever_is_asked_for(tank: Scene, tank_4k: Scene) -> None:
    first, second = common_points(tank_4k, tank), common_points(tank, tank_4k)
    assert torch.equal(first[0].corners, second[1].corners)
    assert torch.equal(first[1].corners, second[0].corners)


def test_the_full_model_is_no_distance_from_itself(tank: Scene) -> None:
    full = moved_by(tank)
    reference = Reference(full, "paper", {})
    found = measure_elsewhere(reference, Elsewhere(moved_by(tank)), [0, 4], 2)
    assert found.mm == found.half_mm == [0.0, 0.0]
    assert len(found.ms) == len(reference.ms) == 4
    assert found.frame_ms(0.5) == pytest.approx(0.5 * float(np.median(found.ms)))


def test_half_the_time_step_ends_at_the_same_moment(body: Body, tank: Scene) -> None:
    """The body is where it was, and the cloth within the error of the step, which is no round number of zero."""
    finer = at(body, "tank", fps=60.0)
    other = Elsewhere(moved_by(finer), pace=2.0)
    assert np.allclose(finer.motion.translation[8], tank.motion.translation[4], atol=1e-3)
    found = measure_elsewhere(Reference(moved_by(tank), "paper", {}), other, [4], 3)
    assert len(found.ms) == 6
    assert 0.01 < found.half_mm[0] < found.mm[0] < 30.0
    back = Elsewhere(moved_by(tank), pace=0.5)
    again = measure_elsewhere(Reference(moved_by(finer), "paper", {}), back, [9], 5)
    assert again.mm[0] == pytest.approx(found.mm[0], rel=0.2)


def test_windows_are_whole_steps_of_both(tank: Scene) -> None:
    other = Elsewhere(moved_by(tank), pace=0.5)
    assert other.span(7, 5) == (6, 6)
    assert other.span(8, 4) == (8, 4)
    assert replace(other, pace=2.0).span(7, 5) == (7, 5)


def test_a_coarser_mesh_is_millimetres_off_and_cheaper(tank: Scene, tank_4k: Scene) -> None:
    reference = Reference(moved_by(tank_4k), "paper", {})
    found = measure_elsewhere(reference, Elsewhere(moved_by(tank), common_points(tank_4k, tank)), [0], 2)
    assert 0.1 < found.half_mm[0] < found.mm[0] < 100.0
    assert np.median(found.ms) < np.median(reference.ms)
