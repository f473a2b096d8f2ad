"""``output_fps``: the stored frames of a rollout, what is said of them, and what stays that of the simulated ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jogging import WORDS, jog

import hood
from hood.assets.garment.garment import Garment, save_garment
from hood.assets.motion.animated_mesh import load_mesh_sequence
from hood.cli.inspect.findings import inspect_rollout
from hood.cli.main import main
from hood.media.exports.sequences import clip_of
from hood.media.film import seconds_per_frame
from hood.rollouts.file.reader import RolloutData, read_rollout
from hood.scene.body_motion.load import MotionOptions, load_motion
from hood.studies.envelope.extreme_files import write_motion
from hood.testing import grid

ROLLOUT = ["rollout", *WORDS, "garment=tank"]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def rollout(*words: str, output: str = "run") -> tuple[RolloutData, dict[str, Any]]:
    return jog("garment=tank", *words, output=output)


def measured(summary: dict[str, Any]) -> dict[str, Any]:
    """What is measured of the cloth: no times, and nothing on what is stored."""
    other = ("num_frames", "dt", "output", "ms_per_frame", "cloth_contact", "warnings", "settled")
    return {key: value for key, value in summary.items() if key not in other}


def same(one: dict[str, np.ndarray], other: dict[str, np.ndarray], rows: slice = slice(None)) -> None:
    assert set(one) == set(other)
    for name in one:
        if not name.startswith("ms_"):
            np.testing.assert_array_equal(one[name], other[name][rows], err_msg=name)


def test_whole_ratios_store_simulated_frames_bit_by_bit(capsys: pytest.CaptureFixture[str]) -> None:
    words = ("fps=120", "num_frames=23", "metrics={fields:[rg],surface_every:2}")
    every, usual = rollout(*words, output="every")
    assert every.steps is None
    assert "output" not in usual
    assert "steps" not in str(list(every.attributes))
    data, summary = rollout(*words, "output_fps=24")
    assert len(data.cloth_pos) == 5
    np.testing.assert_array_equal(data.cloth_pos, every.cloth_pos[::5])
    np.testing.assert_array_equal(data.body_pos, every.body_pos[::5])
    np.testing.assert_array_equal(data.fields["rg"], every.fields["rg"][::5])
    same(data.metrics, every.metrics, slice(None, None, 5))
    same(data.step_metrics, every.metrics)
    np.testing.assert_allclose(data.time, np.arange(5) / 24)
    assert measured(summary) == measured(usual)
    assert summary["num_frames"] == 5
    assert summary["output"] == {"fps": 24.0, "simulated_fps": 120.0, "simulated_frames": 23, "interpolated_frames": 0}
    assert "stored at 24 frames a second (each of them simulated) of 23 simulated at 120" in capsys.readouterr().out
    facts = inspect_rollout("run/rollout.h5").facts
    assert facts["frames"] == 5
    assert facts["simulated frames"] == "23 at 120 fps"


@pytest.mark.parametrize("fps", [24, 50])
def test_other_ratios_interpolate_and_measure_what_was_simulated(fps: int) -> None:
    words = ("fps=30", "num_frames=13", "metrics=all", "guard=off")
    every, usual = rollout(*words, output="every")
    data, summary = rollout(*words, f"output_fps={fps}")
    count, common = {24: 10, 50: 21}[fps], {24: (4, 5), 50: (5, 3)}[fps]
    assert len(data.cloth_pos) == count
    np.testing.assert_array_equal(data.cloth_pos[:: common[0]], every.cloth_pos[:: common[1]])
    np.testing.assert_array_equal(data.body_pos[:: common[0]], every.body_pos[:: common[1]])
    same(data.step_metrics, every.metrics)
    assert measured(summary) == measured(usual)
    assert summary["output"]["interpolated_frames"] == count - len(data.cloth_pos[:: common[0]])
    # The body is where the motion has it; the cloth, which is worn, is nowhere far from a straight way between two frames.
    motion = load_motion("default", "jog", MotionOptions(fps=fps, start=1.0))
    for index in range(count):
        origin = motion.translation[index]
        np.testing.assert_allclose(data.body_pos[index], motion.surface(index, origin).numpy() + origin, atol=1e-6)
        at = index * 30 / fps
        left, share = min(int(at), 11), at - min(int(at), 11)
        straight = (1 - share) * every.cloth_pos[left] + share * every.cloth_pos[left + 1]
        moved = np.linalg.norm(every.cloth_pos[left + 1] - every.cloth_pos[left], axis=1).max()
        assert np.linalg.norm(data.cloth_pos[index] - straight, axis=1).max() <= 0.5 * moved


def test_a_body_of_joined_motions_is_interpolated_as_the_cloth_is() -> None:
    words = (
        "sequence=stand_sway",
        "start=0.0",
        "num_frames=9",
        "blend_in=0.17",
        "metrics=none",
        "guard=off",
        "fail_on=nothing",
    )
    every, _ = rollout(*words, output="every")
    data, _ = rollout(*words, "output_fps=60")
    np.testing.assert_array_equal(data.body_pos[::2], every.body_pos)
    middle = (every.body_pos[3] + every.body_pos[4]) / 2 - (
        every.body_pos[5] - every.body_pos[4] - every.body_pos[3] + every.body_pos[2]
    ) / 16  # the cubic of differences of second order; those of fourth are near it
    np.testing.assert_allclose(data.body_pos[7], middle, atol=2e-3)


def test_files_for_others_have_the_rate_of_their_frames() -> None:
    data, _ = rollout("fps=120", "num_frames=12", "output_fps=40", "metrics=strain", "formats=[pc2]")
    assert clip_of(data).fps == pytest.approx(40.0)
    assert 1.0 / seconds_per_frame(data) == pytest.approx(40.0)
    body = load_mesh_sequence("run/rollout.h5", 40.0)
    assert body.fps == pytest.approx(40.0)
    assert body.num_frames == 4
    with (Path("run") / next(path.relative_to("run") for path in Path("run").rglob("*.pc2"))).open("rb") as file:
        header = file.read(32)
    assert int.from_bytes(header[28:32], "little") == 4


def test_a_jump_of_the_body_is_stored_as_it_was_simulated() -> None:
    write_motion(Path("jump.npz"), "teleport:0.7", 1.0)
    words = ("sequence=jump.npz", "start=0.3", "num_frames=12", "metrics=strain", "guard=off")
    every, _ = rollout(*words, output="every")
    data, _ = rollout(*words, "output_fps=90")
    moved = np.linalg.norm(np.diff(every.body_pos.mean(axis=1), axis=0), axis=1)
    jump = int(moved.argmax())
    assert moved[jump] > 0.5
    first = 3 * jump
    np.testing.assert_array_equal(data.cloth_pos[first + 1], every.cloth_pos[jump])
    np.testing.assert_array_equal(data.body_pos[first + 1], every.body_pos[jump])
    np.testing.assert_array_equal(data.cloth_pos[first + 2], every.cloth_pos[jump + 1])
    np.testing.assert_array_equal(data.body_pos[first + 2], every.body_pos[jump + 1])


def test_events_are_reported_of_simulated_frames() -> None:
    flat, faces = grid(4, 3, 0.1)
    upper = np.stack([flat[:, 2], 2.0 - flat[:, 0], 0.0 * flat[:, 0]], axis=1)
    lower = upper - [0.0, np.ptp(upper[:, 1]) + 0.004, 0.0]
    rows = {"seam": np.array([[9, 12], [10, 13], [11, 14]])}
    pos, both = np.concatenate([upper, lower]), np.concatenate([faces, faces + 12])
    save_garment(Path("flag.npz"), Garment("flag", pos, both, np.arange(24) < 3, fasteners=rows))
    events = (
        "events=[{frame: 8, open: seam}, {frame: 13, close: seam, speed: 0.6}, {frame: 20, detach: pins}, "
        "{frame: 24, attach: [0, 1, 2], speed: 0.6}]"
    )
    words = ("garment=flag.npz", "body=none", "sequence=none", "start=null", "metrics=strain", "settle=0", "guard=off",
             "num_frames=45", events)  # fmt: skip
    _, usual = rollout(*words, output="every")
    _, summary = rollout(*words, "output_fps=12")
    assert summary["fasteners"]["seam"]["events"][1]["within_frame"] is not None
    assert summary["held"][1]["within_frame"] is not None
    assert summary["fasteners"] == usual["fasteners"]
    assert summary["held"] == usual["held"]


def test_without_strain_nothing_is_judged_of_frames_that_are_not_stored() -> None:
    _, summary = rollout("num_frames=7", "output_fps=10", "metrics=none", "guard=off")
    assert summary["sound"] is None
    assert "metrics=strain measures it" in summary["unsound_reasons"][0]


def test_the_same_rate_is_no_other_rate() -> None:
    data, summary = rollout("num_frames=3", "output_fps=30", "metrics=strain", "guard=off")
    assert data.steps is None
    assert "output" not in summary


def test_a_rollout_at_another_rate_is_not_taken_for_finished() -> None:
    """Nothing goes on in the middle of a rollout: with other rates it begins again, so no file holds two."""
    still = {"poses": np.zeros((8, 156)), "trans": np.zeros((8, 3)), "betas": np.zeros(16)}
    Path("motions").mkdir()
    for name in ("a", "b"):
        np.savez(Path("motions") / f"{name}.npz", **still, mocap_framerate=30.0, gender="neutral")
    words = [*ROLLOUT, "sequence=motions", "start=null", "up=y", "num_frames=4", "metrics=strain", "guard=off", "resume=true",
             "output=many"]  # fmt: skip
    times = []
    for rates in ([], ["output_fps=15"], ["output_fps=15"], ["output_fps=10"], ["output_fps=20", "fps=40"]):
        assert main([*words, *rates]) == 0
        files = sorted(Path("many").rglob("rollout.h5"))
        times.append([path.stat().st_mtime_ns for path in files])
        steps = {float(np.diff(read_rollout(path).time)[0]) for path in files}
        assert len(steps) == 1
    assert times[2] == times[1]
    for before, after in zip([times[0], times[2], times[3]], [times[1], times[3], times[4]], strict=True):
        assert all(new > old for old, new in zip(before, after, strict=True))


@pytest.mark.parametrize(
    "words, said",
    [
        (("output_fps=0",), "output_fps=0: give stored frames per second, 1 to 300, 10 times fps at most; null stores every"),
        (("output_fps=-24",), "output_fps=-24: give stored frames per second"),
        (("output_fps=nan",), "output_fps=nan: give stored frames per second"),
        (("output_fps=film",), "output_fps=film: give stored frames per second"),
        (("output_fps=true",), "output_fps=true: give stored frames per second"),
        (("output_fps=301",), "output_fps=301: give stored frames per second, 1 to 300"),
        (("output_fps=1001", "fps=500"), "output_fps=1001: give stored frames per second, 1 to 1000"),
    ],
)
def test_rates_that_no_frames_have(words: tuple[str, ...], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*ROLLOUT, *words]) == 2
    assert said in capsys.readouterr().err


def test_python_gives_the_same_frames() -> None:
    keys: dict[str, Any] = {"start": 1.0, "stepper": "newton", "cloth_contact": "off", "settle": "paper", "metrics": "strain"}
    simulation = hood.simulate("tank", "jog", num_frames=7, output_fps=50, guard="off", **keys)
    frames = list(simulation)
    assert len(simulation) == len(frames) == 11
    assert [frame.index for frame in frames if frame.simulated] == [0, 5, 10]
    data, _ = rollout("num_frames=7", "output_fps=50", "metrics=strain", "guard=off")
    np.testing.assert_array_equal(np.stack([frame.world_pos.numpy() for frame in frames]), data.cloth_pos)
