"""The rule that says whether a rollout can be trusted, on arrays made for each of its clauses."""

from __future__ import annotations

import numpy as np
import pytest

from hood.dynamics.recorder import RolloutData
from hood.dynamics.soundness import Verdict, judge, judge_rollout, name_frames, worst_frame


def frames(count: int, value: float = 0.1, **other: float) -> np.ndarray:
    """(count,) of ``value``, but for frames given as ``f7=0.9``."""
    values = np.full(count, value)
    for name, given in other.items():
        values[int(name[1:])] = given
    return values


def steps(count: int, value: float, **other: float) -> np.ndarray:
    """The same for what only steps have: frame 0 has none."""
    return frames(count, value, **{"f0": np.nan, **other})


def by_network(strain: np.ndarray, gradient: float = 3.0) -> Verdict:
    return judge(np.ones(len(strain), bool), strain, {"relative_gradient": steps(len(strain), gradient)})


def by_solver(converged: np.ndarray, **metrics: np.ndarray) -> Verdict:
    count = len(converged)
    return judge(np.ones(count, bool), frames(count), {"solver_converged": converged, **metrics})


def test_a_quiet_rollout_is_sound() -> None:
    assert by_network(frames(150)) == Verdict(True)
    assert by_network(frames(1)) == Verdict(True)


def test_one_frame_that_is_not_finite_is_enough() -> None:
    for bad in (0, 3, 149):
        finite = np.arange(150) != bad
        verdict = judge(finite, np.where(finite, 0.1, np.nan), {})
        assert verdict == Verdict(False, (f"1 of 150 frames are not finite: frame {bad}",))


def test_the_median_hides_nothing() -> None:
    """Eight frames of 32 at several hundred percent: the median is that of the others."""
    strain = np.where(np.arange(32) >= 24, 2.4, 0.09)
    strain[29] = 11.74
    assert np.median(strain) == 0.09
    assert by_network(strain) == Verdict(
        False,
        ("strain p99 is beyond 50% in 8 of 27 frames after the fifth: frames 24–31, worst 1174% in frame 29",),
    )


def test_two_percent_of_the_frames_after_the_fifth_are_suffered() -> None:
    settling = {f"f{frame}": 9.0 for frame in range(5)}
    assert by_network(frames(105, **settling)).sound
    assert by_network(frames(105, f50=0.6, f51=0.6)).sound
    assert not by_network(frames(105, f50=0.6, f51=0.6, f5=0.6)).sound
    assert by_network(frames(105, f50=0.5, f51=0.5, f5=0.5)).sound


def test_bad_frames_of_all_causes_count_together() -> None:
    converged = steps(105, 1.0, f10=0.0, f11=0.0)
    assert by_solver(converged, relative_gradient=steps(105, 1e-3)).sound
    verdict = by_solver(converged, relative_gradient=steps(105, 1e-3, f12=101.0))
    assert verdict.reasons == (
        "the solver missed its target in 2 of 100 frames after the fifth: frames 10–11",
        "the relative gradient is beyond 100 in 1 of 100 frames after the fifth: frame 12, worst 101 in frame 12",
    )


@pytest.mark.parametrize("count", [2, 5])
def test_of_five_frames_and_fewer_all_must_be_bad(count: int) -> None:
    steps_taken = count - 1
    missed = by_solver(steps(count, 0.0)).reasons[0]
    assert missed.startswith(f"the solver missed its target in {steps_taken} of {steps_taken} frames:")
    assert not by_network(frames(count, 0.6)).sound
    assert not by_network(frames(count, 0.6, f0=0.1)).sound
    if count > 2:
        assert by_network(frames(count, 0.6, f1=0.1)).sound


def test_a_single_frame_is_judged_by_itself() -> None:
    assert not by_network(frames(1, 0.6)).sound
    assert judge(np.ones(0, bool), np.ones(0), {}).sound is None


def test_a_network_alone_is_not_held_to_the_gradient() -> None:
    gradient = steps(30, 500.0)
    assert by_network(frames(30), 500.0).sound
    refined = judge(np.ones(30, bool), frames(30), {"refine_rg": gradient})
    assert refined.reasons == (
        "the relative gradient is beyond 100 in 25 of 25 frames after the fifth: frames 5–29, worst 500 in frame 5",
    )
    # Measured and not finite is no better than large.
    measured = {"refine_rg": steps(30, 1.0), "relative_gradient": steps(30, np.nan)}
    assert judge(np.ones(30, bool), frames(30), measured).sound is False


def test_what_was_not_measured_is_not_called_sound() -> None:
    verdict = judge(np.ones(30, bool), frames(30), {"refine_rg": steps(30, np.nan)})
    assert verdict.sound is None
    assert "frames 5–29 was not measured" in verdict.reasons[0]
    assert by_solver(steps(30, 1.0)).sound  # within its target, so within the limit


def test_strain_that_was_not_measured_comes_from_the_positions() -> None:
    rest = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=np.float32)
    growth = np.array([1.0, 1.1, 1.6, 1.6], dtype=np.float32)
    body = np.zeros((4, 0, 3), dtype=np.float32)
    faces = np.array([[0, 1, 2]], dtype=np.int32)
    data = RolloutData(growth[:, None, None] * rest, faces, rest, body, np.zeros((0, 3)), np.arange(4.0), {}, {})
    assert judge_rollout(data).sound  # frame 1 is good
    data.cloth_pos[1] = data.cloth_pos[2]
    assert judge_rollout(data).reasons == ("strain p99 is beyond 50% in 3 of 3 frames: frames 1–3, worst 60% in frame 1",)
    data.cloth_pos[1, 0, 0] = np.inf
    assert judge_rollout(data).reasons[0] == "1 of 4 frames are not finite: frame 1"


def test_frames_in_words() -> None:
    chosen = np.zeros(40, bool)
    for numbers, words in (
        ([3], "frame 3"),
        ([3, 4], "frames 3–4"),
        ([3, 7, 8, 9, 12], "frames 3, 7–9 and 12"),
        ([1, 3, 5, 7, 9, 10], "frames 1, 3, 5 and 3 more"),
    ):
        chosen[:] = False
        chosen[numbers] = True
        assert name_frames(chosen) == words


def test_the_worst_frame() -> None:
    assert worst_frame(np.array([np.nan, 0.2, np.inf, 0.7, 0.1])) == (0.7, 3)
    assert worst_frame(np.array([np.nan])) is None
