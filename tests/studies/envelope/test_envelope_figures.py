"""Figures of the stability map: what they are on curves whose answer is known."""

from __future__ import annotations

import numpy as np
import pytest

from hood.studies.envelope.judge import FIGURES, at_same_times, figures

TIME = np.arange(100)


def cloth(num_frames: int = 100) -> np.ndarray:
    """Four vertices that move by 1 mm a frame along x."""
    pos = np.zeros((num_frames, 4, 3))
    pos[:, :, 0] = 1e-3 * np.arange(num_frames)[:, None]
    return pos


def test_figures_of_the_worst_frame_and_of_the_middle() -> None:
    metrics = {
        "strain_p99": np.where(TIME == 7, 0.5, 0.1),
        "cut_face_share": np.where(TIME % 5 == 0, 0.02, np.nan),
        "relative_gradient": np.r_[np.nan, np.linspace(0.0, 1.0, 99)],
        "solver_converged": np.r_[np.nan, np.ones(66), np.zeros(33)],
        "solver_iterations": np.full(100, 12.0),
        "ms_total": np.full(100, 40.0),
    }
    found = figures(metrics, cloth(), at_rest=False)
    assert tuple(found) == FIGURES
    assert (found["strain_p99"], found["strain_p99_median"], found["cut_face_share"]) == (0.5, 0.1, 0.02)
    assert (found["rg_median"], found["rg_p95"]) == (pytest.approx(0.5), pytest.approx(0.95))
    assert found["converged"] == pytest.approx(66 / 99)
    assert (found["iterations"], found["ms_per_frame"], found["frames"]) == (12.0, 40.0, 100)
    unknown = ("strain_max", "penetration_depth_m", "energy_slope", "moved_at_rest_mm", "difference_mm")
    assert [found[name] for name in unknown] == [None] * 5


def test_of_refined_steps_the_gradient_that_refinement_left() -> None:
    metrics = {"relative_gradient": np.full(9, 2.0), "refine_rg": np.full(9, 0.5), "refine_iterations": np.full(9, 5.0)}
    found = figures(metrics, cloth(9), at_rest=False)
    assert (found["rg_median"], found["iterations"]) == (0.5, 5.0)


def test_at_rest_energy_that_grows_and_cloth_that_walks() -> None:
    metrics = {"energy_stretching": 1.0 + 0.01 * TIME, "energy_bending": np.full(100, 1.0)}
    found = figures(metrics, cloth(), at_rest=True)
    mean = (2.0 + 0.01 * TIME)[50:].mean()
    assert found["energy_slope"] == pytest.approx(1.0 / mean)
    assert found["moved_at_rest_mm"] == pytest.approx(49.0)


def test_difference_to_the_solver_at_the_same_times() -> None:
    finer = np.repeat(cloth(25), 4, axis=0)
    np.testing.assert_array_equal(at_same_times(finer, 1 / 120, 1 / 30), cloth(25))
    moved = cloth(25)
    moved[10, :2] += [0.0, 0.04, 0.0]
    assert figures({}, moved, False, at_same_times(finer, 1 / 120, 1 / 30))["difference_mm"] == pytest.approx(20.0)
    assert figures({}, moved[:5], False, cloth(25))["difference_mm"] == 0.0
    assert figures({}, cloth(25)[:, :3], False, cloth(25))["difference_mm"] is None
