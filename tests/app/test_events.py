"""``events=``: what opens, closes, is held and let go during a rollout."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hood.app.scene.events import Asked, checked_events, describe_fasteners, describe_held
from hood.app.settings.compose import ConfigError
from hood.app.settings.rollout_settings import RolloutSettings
from hood.assets.garment.garment import Garment, save_garment
from hood.cli.main import main
from hood.rollouts.file.reader import RolloutData, read_rollout
from hood.scene.holding import FASTEST, SPEED
from hood.testing import grid

ROLLOUT = ["rollout", "garment=flag.npz", "body=none", "sequence=none", "stepper=newton", "cloth_contact=off", "video=none",
           "sheet=false", "metrics=strain", "settle=0", "guard=off", "output=run"]  # fmt: skip
UNTRAINED = ["checkpoint=untrained", "model=small", "model.latent_dim=4", "model.schedule='1x(mesh)'"]
ROW = np.array([[9, 12], [10, 13], [11, 14]])


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two sheets, the upper one held by its upper edge, the lower one fastened to it 4 mm below."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HOOD_TRACEBACK", raising=False)
    flat, faces = grid(4, 3, 0.1)
    upper = np.stack([flat[:, 2], 2.0 - flat[:, 0], 0.0 * flat[:, 0]], axis=1)
    lower = upper - [0.0, np.ptp(upper[:, 1]) + 0.004, 0.0]
    pinned = np.arange(24) < 3
    rows = {"seam": ROW}
    flag = Garment("flag", np.concatenate([upper, lower]), np.concatenate([faces, faces + 12]), pinned, fasteners=rows)
    save_garment(Path("flag.npz"), flag)


def rollout(*words: str) -> tuple[RolloutData, dict[str, Any]]:
    assert main([*ROLLOUT, *words]) == 0
    return read_rollout(Path("run/rollout.h5")), json.loads(Path("run/summary.json").read_text())


def off(data: RolloutData) -> np.ndarray:
    """(T, P) m by which pairs are farther apart than at rest."""
    return np.linalg.norm(data.cloth_pos[:, ROW[:, 0]] - data.cloth_pos[:, ROW[:, 1]], axis=2) - 0.004


def test_a_row_opens_and_closes_without_a_jump(capsys: pytest.CaptureFixture[str]) -> None:
    usual, _ = rollout("num_frames=40")
    words = "events=[{time: 0.5, close: seam, speed: 0.6}, {frame: 10, open: [seam]}]"
    data, summary = rollout("num_frames=40", words)
    assert np.array_equal(data.cloth_pos[:11], usual.cloth_pos[:11])  # the step from frame 10 is the first without it
    gap, free = off(data), 9.81 / 30**2
    assert np.abs(gap[:11]).max() < 1e-3
    # Let go, it falls: from rest by 1, 3, 6… times g dt².
    np.testing.assert_allclose(gap[11:15].mean(axis=1), free * np.array([1, 3, 6, 10]), rtol=0.1)
    # Closed in frame 15, it comes back by 0.6 m/s, 20 mm a frame.
    shut = gap[16:].max(axis=1)
    assert (np.diff(gap[15:22], axis=0) > -0.0205).all()
    assert (np.diff(gap[17:20].mean(axis=1)) < -0.01).all()
    row = summary["fasteners"]["seam"]
    first = 16 + int(np.argmax(shut <= 1e-3))
    assert row["pairs"] == 3
    assert row["closed_at_first"]
    assert [(event["action"], event["frame"]) for event in row["events"]] == [("open", 10), ("close", 15)]
    assert row["events"][1]["within_frame"] == first
    assert row["off_while_closed_max_m"] < 1e-3
    line = f"seam (3 pairs): opened at 0.33 s (frame 10); closing from 0.50 s (frame 15) on, within 1 mm at {first / 30:.2f} s"
    assert line in capsys.readouterr().out
    assert data.still["fastened"].tolist() == ROW.tolist()


def test_a_row_is_closed_by_a_frame(capsys: pytest.CaptureFixture[str]) -> None:
    opened = "{frame: 4, open: seam}"
    slow, _ = rollout("num_frames=32", f"events=[{opened}, {{frame: 12, close: seam}}]")
    assert off(slow)[28].max() > 0.05  # at the usual speed it is late
    data, summary = rollout("num_frames=32", f"events=[{opened}, {{time: 0.4, close: seam, by: 0.95}}]")
    assert np.abs(off(data)[28:]).max() < 1e-3
    assert off(data)[24].min() > 1e-3
    (_, event) = summary["fasteners"]["seam"]["events"]
    assert (event["frame"], event["by_frame"], event["in_time"]) == (12, 28, 3)
    assert event["apart_max_m"] == pytest.approx(off(data)[12].max(), abs=1e-6)
    told = capsys.readouterr().out
    assert "seam: closes from 0.40 s (frame 12) on, by 0.93 s (frame 28), at " in told
    assert "closing from 0.40 s (frame 12) on, 3 of 3 pairs within 1 mm by frame 28, within 1 mm at" in told


def test_a_row_that_cannot_be_closed_in_time_is_warned_about() -> None:
    data, summary = rollout("num_frames=16", "events=[{frame: 0, open: seam}, {frame: 11, close: seam, by: 12}]")
    (warning,) = [line for line in summary["warnings"] if line.startswith("seam: closes by")]
    assert "m/s more than the 1.5 m/s" in warning
    assert summary["fasteners"]["seam"]["events"][1]["in_time"] == 0
    assert -np.diff(off(data)[11:14].max(axis=1)).max() < FASTEST / 30 + 1e-3
    _, summary = rollout("num_frames=6", "events=[{frame: 0, open: seam}, {frame: 3, close: seam, by: 9}]")
    (warning,) = [line for line in summary["warnings"] if line.startswith("events[1]")]
    assert "by 0.30 s (frame 9) is after the last frame, 0.17 s (frame 5)" in warning
    assert summary["fasteners"]["seam"]["events"][1]["in_time"] is None


def test_what_is_closed_first_is_open_before() -> None:
    data, summary = rollout("num_frames=6", "events=[{frame: 3, close: seam}]")
    assert off(data)[3].min() > 0.01
    row = summary["fasteners"]["seam"]
    assert not row["closed_at_first"]
    assert row["events"][0]["within_frame"] is None
    assert row["events"][0]["left_open"] == 3
    assert describe_fasteners(summary) == [
        "seam (3 pairs): closing from 0.10 s (frame 3) on, 3 of 3 pairs still apart in the end"
    ]


def test_networks_have_closed_pairs_as_edges_and_refined_steps_keep_them() -> None:
    network = ["stepper=network", *UNTRAINED, "refine=5", "num_frames=8"]
    data, _ = rollout(*network, "events=[{frame: 4, open: seam}]")
    usual, _ = rollout(*network)
    assert np.array_equal(data.cloth_pos[:5], usual.cloth_pos[:5])
    assert np.abs(off(data)[:5]).max() < 1e-3
    assert off(data)[-1].min() > 5e-3


def test_many_motions_and_resuming_know_the_events() -> None:
    still = {"poses": np.zeros((8, 156)), "trans": np.zeros((8, 3)), "betas": np.zeros(16)}
    Path("motions").mkdir()
    for name in ("a", "b"):
        np.savez(Path("motions") / f"{name}.npz", **still, mocap_framerate=30.0, gender="neutral")
    words = ["rollout", "garment=shirt", "sequence=motions", "up=y", "stepper=newton", "cloth_contact=off", "num_frames=3",
             "metrics=none", "video=none", "sheet=false", "settle=0", "guard=off", "resume=true",
             "output=many"]  # fmt: skip
    events, times = "events=[{frame: 1, open: front_buttons}]", []
    for given in ([events], [events], []):
        assert main([*words, *given]) == 0
        times.append({path: path.stat().st_mtime_ns for path in Path("many").rglob("rollout.h5")})
        rows = json.loads(Path("many/summary.json").read_text())["motions"]
        assert {len(row["fasteners"]["front_buttons"]["events"]) for row in rows.values()} == {len(given)}
    assert len(times[0]) == 2
    assert times[1] == times[0]
    assert not set(times[2].values()) & set(times[0].values())


def test_vertices_are_let_go_and_held_again(capsys: pytest.CaptureFixture[str]) -> None:
    words = "events=[{frame: 4, detach: pins}, {frame: 8, attach: [0, 1, 2], speed: 0.6}]"
    data, summary = rollout("num_frames=30", words)
    height = data.cloth_pos[:, :3, 1]
    assert (height[:5] == height[0]).all()
    np.testing.assert_allclose(height[4] - height[5], 9.81 / 30**2, rtol=0.1)
    assert (np.diff(height[8:12], axis=0) < 0.0201).all()
    assert (np.diff(height[8:12], axis=0) > 0.0199).all()
    np.testing.assert_allclose(height[-1], height[0], atol=1e-9)
    let_go, held = summary["held"]
    assert (let_go["action"], let_go["frame"], let_go["vertices"]) == ("detach", 4, 3)
    assert (held["action"], held["frame"]) == ("attach", 8)
    assert held["within_frame"] == int(np.argmax(np.abs(height - height[0]).max(axis=1)[9:] <= 1e-3)) + 9
    (line,) = describe_held(summary)
    assert line in capsys.readouterr().out
    assert line.startswith("let go of 3 vertices from 0.13 s (frame 4) on; holds 3 vertices from 0.27 s (frame 8) on, in their")


def test_a_late_event_is_warned_about() -> None:
    _, summary = rollout("num_frames=4", "events=[{time: 0.05, open: seam}, {time: 0.1, close: seam}]")
    (warning,) = [line for line in summary["warnings"] if line.startswith("events[1]")]
    assert "no step begins at 0.10 s (frame 3) or later, the last one begins at 0.07 s" in warning


def test_events_of_a_config() -> None:
    words = ["events=[{time: 2, open: a}, {frame: 7, close: [a, b]}, {time: 0.5, attach: [3, hem]}]"]
    assert checked_events(RolloutSettings.from_words(words)) == (
        Asked(0, 2, False, "open", ("a",)), Asked(1, 7, True, "close", ("a", "b")), Asked(2, 0.5, False, "attach", (3, "hem"))
    )  # fmt: skip
    assert checked_events(RolloutSettings.from_words([])) == ()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["events=[3]"], r"events\[0\] is 3; give a time and what happens"),
        (["events=[{time: 1, open: a}, {time: 1, opens: a}]"], r"events\[1\]: unknown key 'opens': did you mean 'open'"),
        (["events=[{open: a}]"], r"events\[0\] has 0 of time and frame; give one"),
        (["events=[{time: 1, frame: 3, open: a}]"], "has 2 of time and frame"),
        (["events=[{time: 1}]"], "has 0 of open, close, detach, attach"),
        (["events=[{time: -1, open: a}]"], "time is -1; give seconds >= 0"),
        (["events=[{frame: 1.5, open: a}]"], "frame is 1.5; give a whole number"),
        (["events=[{frame: 1, open: []}]"], r"open is \[\]; give a name or a list of names"),
        (["events=[{frame: 1, open: [3]}]"], r"open is \[3\]; give a name or a list of names"),
        (["events=[{time: 1, close: a, speed: 0}]"], r"events\[0\]: speed is 0; give a speed > 0 in m/s, such as speed: 0.25"),
        (["events=[{time: 1, open: a, speed: 1}]"], r"events\[0\]: speed belongs to close and attach; open acts at once"),
        (["events=[{frame: 1, attach: hem}]", "step=fixed"], r"events\[0\]: step=fixed has fixed shapes"),
        (["events=[{frame: 1, close: a, by: 9}]", "step=fixed"], r"step=fixed has fixed shapes, in which no speed changes"),
        (["events=[{frame: 1, open: a, by: 9}]"], r"events\[0\]: by belongs to close and attach; open acts at once"),
        (["events=[{frame: 1, close: a, by: 9, speed: 1}]"], r"events\[0\] has speed and by; give one"),
        (["events=[{frame: 9, close: a, by: 9}]"], r"by is 9; give a frame after frame: 9, as frame is given"),
        (["events=[{frame: 1, close: a, by: 9.5}]"], r"by is 9.5; give a frame after"),
        (["events=[{time: 1, close: a, by: soon}]"], r"by is soon; give seconds after time: 1"),
    ],
)
def test_what_is_no_event_names_its_place_and_the_fix(words: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        checked_events(RolloutSettings.from_words(words))


@pytest.mark.parametrize(
    ("events", "message"),
    [
        ("[{time: 0, open: seam}, {time: 0, open: seams}]", "events[1]: unknown fastener 'seams': did you mean 'seam'?"),
        (
            "[{time: 0.1, open: seam}, {frame: 3, close: seam}]",
            "events[1]: closes seam in frame 3, where events[0] does",
        ),
        ("[{time: 1.0, open: seam}, {time: 1.01, close: seam, by: 1.05}]", "events[1]: by is 1.05, no step after it begins"),
        (
            "[{frame: 1, close: seam, by: 6}, {frame: 3, open: seam}]",
            "events[0]: closes seam by frame 6, and events[1] opens it in frame 3, before; give by an earlier time",
        ),
        ("[{time: 0, detach: [20]}]", "events[0]: detach: none of these vertices are held then; pins=… holds vertices"),
        ("[{time: 0, attach: pins}]", "events[0]: attach: all of these vertices are held already"),
        ("[{time: 0, attach: [24]}]", "events[0]: attach: vertex 24 of 24; they are numbered from 0"),
        (
            "[{time: 0, attach: [5, 6]}, {time: 0, detach: [6]}]",
            "events[1]: detach: another event in frame 0 does",
        ),
        ("[{time: 0, attach: hems}]", "events[0]: attach: unknown region 'hems': did you mean 'hem'?"),
    ],
)
def test_what_the_garment_does_not_have_is_refused(events: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*ROLLOUT, "num_frames=8", f"events={events}"]) == 2
    assert message in capsys.readouterr().err


def test_garments_without_fasteners_say_what_to_do(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["rollout", "garment=tank", "stepper=newton", "num_frames=3", "output=run", "events=[{time: 0, open: zip}]"]
    assert main(words) == 2
    message = (
        "events[0]: garment 'tank' has nothing that opens or closes; wear shirt or jacket, or name pairs of your garment's"
    )
    assert message in capsys.readouterr().err


def test_an_event_has_a_speed_of_its_own() -> None:
    words = ["events=[{time: 1, close: a, speed: 3}, {time: 2, close: a}]"]
    assert [one.speed for one in checked_events(RolloutSettings.from_words(words))] == [3.0, SPEED]
