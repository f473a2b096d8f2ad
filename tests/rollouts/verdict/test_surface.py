"""The cut surface of frames: shares, crossings by garment, and where rollouts measure it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hood.assets.garment.garment import Garment
from hood.assets.garment.outfit import join_garments
from hood.energies.potential import default_potential
from hood.rollouts.loop import simulate
from hood.rollouts.verdict.surface import SURFACE_METRICS, SurfaceMeter
from hood.scene.scene import Scene
from hood.solver.newton import NewtonSettings
from hood.steppers.newton import NewtonStepper
from hood.testing import cylinder, sphere

TUBE, TUBE_FACES = cylinder(24, 12, 0.1, 0.4)
BALL, BALL_FACES = sphere(3, 0.08)


def tube(name: str, shift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Garment:
    return Garment(name, TUBE + shift, TUBE_FACES, np.zeros(len(TUBE), dtype=bool))


def test_a_ball_that_fits_cuts_nothing_and_one_that_does_not_cuts_a_band() -> None:
    meter = SurfaceMeter(tube("tube"), BALL_FACES)
    middle = TUBE.mean(axis=0)
    assert meter(TUBE, BALL + middle) == dict.fromkeys(SURFACE_METRICS, 0.0)
    cut = meter(TUBE, 1.5 * BALL + middle)  # 12 cm in a tube of 10 cm
    assert 0.1 < cut["cut_face_share"] < 0.9
    assert 0.05 < cut["cut_edge_share"] < 0.9
    assert cut["skin_depth"] == pytest.approx(0.02, abs=2e-3)
    assert cut["self_crossings"] == cut["garment_crossings"] == 0.0


def test_cloth_caught_where_the_body_passes_through_itself_is_told_apart() -> None:
    middle, big = TUBE.mean(axis=0), 1.5 * BALL
    alone = SurfaceMeter(tube("tube"), BALL_FACES)(TUBE, big + middle)
    assert alone["cut_in_folds"] == 0.0 < alone["cut_face_share"]
    faces = np.concatenate([BALL_FACES, BALL_FACES + len(BALL)])
    meter = SurfaceMeter(tube("tube"), faces)
    up = np.array([0.0, 0.05, 0.0])
    crossed = meter(TUBE, np.concatenate([big + middle - up, big + middle + up]))
    assert 0.0 < crossed["cut_in_folds"] < crossed["cut_face_share"]
    apart = meter(TUBE, np.concatenate([big + middle, big + middle + 10 * up]))
    assert apart["cut_in_folds"] == 0.0
    assert apart["cut_face_share"] == alone["cut_face_share"]


def test_crossings_are_told_apart_by_garment() -> None:
    first, second = tube("a"), tube("b", (0.05, 0.003, 0.01))
    outfit = join_garments([first, second])
    no_body = np.empty((0, 3)), np.empty((0, 3), dtype=np.int64)
    found = SurfaceMeter(outfit, no_body[1])(outfit.rest_pos, no_body[0])
    assert found["garment_crossings"] > 10
    assert found["self_crossings"] == found["cut_face_share"] == found["skin_depth"] == 0.0
    as_one = SurfaceMeter(replace(outfit, piece=None), no_body[1])(outfit.rest_pos, no_body[0])
    assert (as_one["self_crossings"], as_one["garment_crossings"]) == (found["garment_crossings"], 0.0)
    three = join_garments([outfit, tube("c", (1.0, 0.0, 0.0))])
    assert np.unique(three.piece).tolist() == [0, 1, 2]


def test_nothing_is_said_about_frames_that_are_not_finite() -> None:
    meter = SurfaceMeter(tube("tube"), BALL_FACES)
    broken = TUBE.copy()
    broken[3, 1] = np.inf
    assert all(np.isnan(value) for value in meter(broken, BALL).values())
    assert all(np.isnan(value) for value in meter(TUBE, np.full_like(BALL, np.nan)).values())


def test_nothing_is_said_about_tatters() -> None:
    """A blown-up garment, which would take minutes; stretched to twice its size it is measured."""
    meter = SurfaceMeter(tube("tube"), BALL_FACES)
    assert meter(2 * TUBE, BALL + 2 * TUBE.mean(axis=0))["cut_face_share"] == 0.0
    assert all(np.isnan(value) for value in meter(4 * TUBE, BALL).values())


def test_rollouts_measure_at_a_stride_first_and_last(band_scene: Scene) -> None:
    stepper = NewtonStepper(default_potential(), NewtonSettings(max_iterations=1))
    frames = list(simulate(stepper, band_scene, default_potential(), 6, relaxing_steps=0, surface_stride=2))
    assert [set(SURFACE_METRICS) <= set(frame.metrics) for frame in frames] == [True, False, True, False, True, True]
    meter = SurfaceMeter(band_scene.garment, band_scene.motion.faces)
    again = meter(frames[4].world_pos.numpy(), frames[4].body_pos.numpy())
    assert again == pytest.approx({key: frames[4].metrics[key] for key in SURFACE_METRICS}, abs=1e-6)
    plain = list(simulate(stepper, band_scene, default_potential(), 6, relaxing_steps=0, metrics="none"))
    assert all(bool((a.world_pos == b.world_pos).all()) for a, b in zip(frames, plain, strict=True))
    with pytest.raises(ValueError, match="surface_stride=0: must be at least 1"):
        next(simulate(stepper, band_scene, default_potential(), 6, surface_stride=0))
