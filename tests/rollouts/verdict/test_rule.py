"""The rule that says whether a rollout can be trusted, on arrays made for each of its clauses."""

from __future__ import annotations

import json

import numpy as np
import pytest
from stored import frames, steps, stored

from hood.rollouts.checks.step_repair import NOT_TRIED, REFINED
from hood.rollouts.verdict.rule import Verdict, judge_rollout


def by_network(strain: np.ndarray, gradient: float = 3.0) -> Verdict:
    return judge_rollout(stored(len(strain), {"strain_p99": strain, "relative_gradient": steps(len(strain), gradient)}))


def by_solver(converged: np.ndarray, **metrics: np.ndarray) -> Verdict:
    count = len(converged)
    return judge_rollout(stored(count, {"strain_p99": frames(count), "solver_converged": converged, **metrics}))


def refined(**metrics: np.ndarray) -> Verdict:
    return judge_rollout(stored(30, {"strain_p99": frames(30), **metrics}))


def test_a_quiet_rollout_is_sound() -> None:
    assert by_network(frames(150)) == Verdict(True)
    assert by_network(frames(1)) == Verdict(True)


def test_one_frame_that_is_not_finite_is_enough() -> None:
    for bad in (0, 3, 149):
        data = stored(150, {"strain_p99": frames(150, **{f"f{bad}": np.nan})})
        data.cloth_pos[bad, 1, 2] = np.nan
        (reason,) = judge_rollout(data).reasons
        assert (reason.kind, reason.frames) == ("not_finite", ((bad, bad),))
        assert reason.sentence == f"1 of 150 frames are not finite: frame {bad}"


def test_the_median_hides_nothing() -> None:
    """Eight frames of 32 at several hundred percent: the median is that of the others."""
    strain = np.where(np.arange(32) >= 24, 2.4, 0.09)
    strain[29] = 11.74
    assert np.median(strain) == 0.09
    (reason,) = by_network(strain).reasons
    assert (
        reason.sentence == "strain p99 is beyond 50% in 8 of 27 frames after the fifth: frames 24–31, worst 1174% in frame 29"
    )
    assert reason.as_dict() == {
        "kind": "strain", "sentence": reason.sentence, "frames": [[24, 31]], "value": 11.74, "frame": 29, "limit": 0.5,
        "unit": "share of the length", "part": None,
    }  # fmt: skip
    json.dumps(reason.as_dict())


def test_two_percent_of_the_frames_after_the_fifth_are_suffered() -> None:
    settling = {f"f{frame}": 0.9 for frame in range(5)}
    assert by_network(frames(105, **settling)).sound
    assert by_network(frames(105, f50=0.6, f51=0.6)).sound
    assert not by_network(frames(105, f50=0.6, f51=0.6, f5=0.6)).sound
    assert by_network(frames(105, f50=0.5, f51=0.5, f5=0.5)).sound


def test_a_single_bad_frame_is_not_seen_unless_it_is_torn() -> None:
    assert by_network(frames(20, f12=0.9)).sound
    assert not by_network(frames(20, f12=0.9, f13=0.6)).sound
    assert not by_network(frames(20, f12=1.1)).sound
    (reason,) = by_network(frames(20, f3=1.1)).reasons  # while it settles
    assert reason.sentence == "strain p99 is beyond 50% in 1 of 16 frames: frame 3, worst 110% in frame 3"
    assert by_network(frames(105, f3=1.1)).sound


def test_bad_frames_of_all_causes_count_together() -> None:
    converged = steps(105, 1.0, f10=0.0, f11=0.0)
    assert by_solver(converged, relative_gradient=steps(105, 1e-3)).sound
    verdict = by_solver(converged, relative_gradient=steps(105, 1e-3, f12=101.0))
    assert verdict.sentences == (
        "the solver missed its target in 2 of 100 frames after the fifth: frames 10–11",
        "the relative gradient is beyond 100 in 1 of 100 frames after the fifth: frame 12, worst 101 in frame 12",
    )


@pytest.mark.parametrize("count", [2, 5])
def test_of_five_frames_and_fewer_all_must_be_bad(count: int) -> None:
    steps_taken = count - 1
    missed = by_solver(steps(count, 0.0)).sentences[0]
    assert missed.startswith(f"the solver missed its target in {steps_taken} of {steps_taken} frames:")
    assert not by_network(frames(count, 0.6)).sound
    assert not by_network(frames(count, 0.6, f0=0.1)).sound
    if count > 2:
        assert by_network(frames(count, 0.6, f1=0.1)).sound


def test_a_single_frame_is_judged_by_itself() -> None:
    assert not by_network(frames(1, 0.6)).sound
    assert judge_rollout(stored(0)).sound is None


def test_the_distance_decides_where_it_was_measured() -> None:
    """Every fifth step was measured, and stands for those up to the next; a network is held to it as a solver is."""
    measured = np.where(np.arange(30) % 5 == 0, 0.001, np.nan)
    loose = {"relative_gradient": steps(30, 500.0), "solver_converged": steps(30, 0.0)}
    assert refined(distance_p99=measured, **loose).sound
    measured[15] = 0.05
    assert refined(distance_p99=measured).sound  # one step beyond 30 mm, and not twice as far
    measured[15] = 0.07
    (reason,) = refined(distance_p99=measured, refine_rg=steps(30, 1e-3)).reasons
    assert (reason.kind, reason.frames, reason.value, reason.frame) == ("distance", ((15, 15),), 0.07, 15)
    assert "worst 70 mm in frame 15" in reason.sentence
    assert refined(distance_p99=np.where(np.isfinite(measured), 0.04, np.nan)).sound is False


def test_a_far_step_is_one_frame_where_the_next_was_measured() -> None:
    measured = np.where(np.arange(30) % 10 == 0, 0.001, np.nan)
    measured[10] = 0.11
    assert refined(distance_p99=measured).sound is False
    measured[11] = 0.015
    assert refined(distance_p99=measured).sound
    measured[11] = 0.04  # still beyond, up to the next that was measured: more than a quarter of the frames
    assert refined(distance_p99=measured).sound is False


def test_the_limit_of_the_distance_goes_with_the_time_step() -> None:
    for fps, sound in ((30.0, True), (120.0, False)):
        data = stored(30, {"strain_p99": frames(30), "distance_p99": steps(30, 0.02)})
        data.time[:] = np.arange(30) / fps
        assert judge_rollout(data).sound is sound


def test_one_measured_frame_of_many_is_suffered_for_as_long_as_it_stands_for() -> None:
    """Six steps of 305 are 2%."""
    measured = np.where(np.arange(305) % 5 == 0, 0.001, np.nan)
    measured[100] = 0.07
    data = {"strain_p99": frames(305), "distance_p99": measured}
    assert judge_rollout(stored(305, data)).sound
    measured[200] = 0.07
    assert judge_rollout(stored(305, data)).sound is False


def test_a_network_alone_is_not_held_to_the_gradient() -> None:
    gradient = steps(30, 500.0)
    assert by_network(frames(30), 500.0).sound
    assert refined(refine_rg=gradient).sentences == (
        "the relative gradient is beyond 100 in 25 of 25 frames after the fifth: frames 5–29, worst 500 in frame 5",
    )
    # Measured and not finite is no better than large.
    assert refined(refine_rg=steps(30, 1.0), relative_gradient=steps(30, np.nan)).sound is False


def test_what_was_not_measured_is_not_called_sound() -> None:
    verdict = refined(refine_rg=steps(30, np.nan))
    assert verdict.sound is None
    assert "frames 5–29 ended from their minimum was not measured" in verdict.sentences[0]
    assert by_solver(steps(30, 1.0)).sound  # within its target, so within the limit
    assert refined(refine_rg=steps(30, np.nan), distance_p99=frames(30, 1e-4)).sound


def test_strain_that_was_not_measured_comes_from_the_positions() -> None:
    rest = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    growth = np.array([1.0, 1.1, 1.6, 1.6])
    data = stored(4, cloth=growth[:, None, None] * rest)
    assert judge_rollout(data).sound  # frame 1 is good
    data.cloth_pos[1] = data.cloth_pos[2]
    assert judge_rollout(data).sentences == ("strain p99 is beyond 50% in 3 of 3 frames: frames 1–3, worst 60% in frame 1",)
    data.cloth_pos[1, 0, 0] = np.inf
    assert judge_rollout(data).sentences[0] == "1 of 4 frames are not finite: frame 1"


def test_doubts_of_the_file_are_told_and_change_nothing() -> None:
    doubt = {"kind": "frame_rate", "sentence": "no rate", "frames": [], "value": 30.0, "unit": "fps"}
    data = stored(30, {"strain_p99": frames(30)})
    data.attributes["doubts"] = json.dumps([doubt])
    verdict = judge_rollout(data)
    assert verdict.sound
    assert verdict.doubts == (doubt,)


def alarm(frame: int, cause: str, repair: str) -> dict[str, object]:
    return {"frame": frame, "cause": cause, "value": 0.3, "limit": 0.25, "repair": repair}


def test_what_the_guard_saw_and_did_not_mend_is_doubtful() -> None:
    rows = [alarm(frame, "strain", NOT_TRIED) for frame in (10, 11)]
    (doubt,) = judge_rollout(stored(30, {"strain_p99": frames(30)}, alarms=rows)).doubts
    assert (doubt["kind"], doubt["frames"], doubt["value"]) == ("guard", [10, 11], 0.3)
    assert "strain p99 beyond 25%, 30% at worst, in frames 10–11, and did not mend it" in doubt["sentence"]
    assert doubt["sentence"].endswith("guard=repair, refine=5 or stepper=newton")
    solved = stored(30, {"strain_p99": frames(30)}, alarms=rows)
    solved.attributes["stepper"] = "newton"
    assert "stepper=newton" not in judge_rollout(solved).doubts[0]["sentence"]
    mended = [alarm(frame, "strain", REFINED) for frame in (10, 11)]
    assert judge_rollout(stored(30, {"strain_p99": frames(30)}, alarms=mended)).doubts == ()
    assert judge_rollout(stored(300, {"strain_p99": frames(300)}, alarms=rows)).doubts == ()
