"""The table of labelled rollouts is complete, its counts are right, and its scenes run."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hood.app.settings.compose import load_config, named_today
from hood.assets.files.said import KINDS
from hood.testing import grid, sphere
from tests.verdict.table import counts
from tests.verdict.table.pictures import sheet
from tests.verdict.table.scene import STEPPERS, Scene, run, run_unread
from tests.verdict.table.scenes import FAST, LABELS, REFUSED, SCENES, SECOND, SECOND_LABELS, THIRD, THIRD_LABELS


@pytest.mark.parametrize(
    ("scenes", "labels"),
    [(SCENES, LABELS), (SECOND, SECOND_LABELS), (THIRD, THIRD_LABELS)],
    ids=["first", "second", "third"],
)
def test_every_scene_has_a_label_and_every_label_a_scene(scenes: dict[str, Scene], labels: dict[str, dict[str, Any]]) -> None:
    assert set(labels) == set(scenes)
    for name, label in labels.items():
        assert label["label"] in ("right", "broken"), name
        assert label["margin"] in ("clear", "near"), name
        assert set(label["doubts"]) <= set(KINDS), name
        assert label["why"], name
        broken = label["label"] == "broken"
        assert (label["since"] is not None) == broken == bool(label["part"]), name
        assert label["cause"] in (("cloth", "input") if broken else (None,)), name
        if broken:
            assert 0 <= label["since"] < scenes[name].frames, name


def test_the_table_is_as_wide_as_it_says() -> None:
    assert len(SCENES) >= 110
    assert len({scene.kind for scene in SCENES.values()}) >= 38
    assert {scene.stepper for scene in SCENES.values()} == set(STEPPERS)
    share = Counter(label["label"] for label in LABELS.values())
    assert min(share.values()) > 0.3 * len(LABELS)


def test_the_second_table_is_another_one() -> None:
    assert len(SECOND) >= 180
    assert len({scene.kind for scene in SECOND.values()}) >= 38
    assert {scene.stepper for scene in SECOND.values()} == set(STEPPERS)
    assert not {scene.kind for scene in SECOND.values()} & {scene.kind for scene in SCENES.values()}
    share = Counter(label["label"] for label in SECOND_LABELS.values())
    assert min(share.values()) > 0.3 * len(SECOND_LABELS)


def test_the_third_table_is_another_one() -> None:
    assert len(THIRD) >= 60
    assert len({scene.kind for scene in THIRD.values()}) >= 30
    before = {scene.kind for scene in (*SCENES.values(), *SECOND.values())}
    assert not {scene.kind for scene in THIRD.values()} & before
    share = Counter(label["label"] for label in THIRD_LABELS.values())
    assert min(share.values()) > 0.35 * len(THIRD_LABELS)
    assert sum(label["margin"] == "near" for label in THIRD_LABELS.values()) <= 0.25 * len(THIRD_LABELS)


def test_the_fast_scenes_are_of_many_kinds_and_half_of_them_broken() -> None:
    assert len(FAST) == len(set(FAST)) == 20
    assert len({SCENES[name].kind for name in FAST}) >= 18
    assert Counter(LABELS[name]["label"] for name in FAST) == {"right": 10, "broken": 10}


@pytest.mark.parametrize(
    "scenes",
    [SCENES, *(pytest.param(scenes, marks=pytest.mark.slow) for scenes in (SECOND, THIRD)), REFUSED],
    ids=["first", "second", "third", "refused"],
)
def test_every_scene_is_asked_for_in_keys_of_today(scenes: dict[str, Scene]) -> None:
    asked = {(*STEPPERS[scene.stepper], f"num_frames={scene.frames}", *scene.keys) for scene in scenes.values()}
    for told in asked:
        words = tuple(word.replace("{folder}", "folder") for word in told)
        assert named_today(words) == words
        load_config("rollout", words)


def test_one_text_is_no_list_of_keys() -> None:
    with pytest.raises(TypeError, match="curtain.*tuple of overrides"):
        Scene("curtain", "held sheets", "newton", "tshirt", keys="start=1")  # type: ignore[arg-type]


def test_points_in_a_ball_are_found() -> None:
    pos, faces = sphere(3, 1.0)
    points = np.random.default_rng(0).uniform(-1.5, 1.5, (400, 3))
    clear = np.abs(np.linalg.norm(points, axis=1) - 1.0) > 0.02
    inside = counts.inside(points, pos, faces)
    assert np.array_equal(inside[clear], (np.linalg.norm(points, axis=1) < 1.0)[clear])


def test_crossing_pairs_of_two_squares_are_those_along_the_line_of_both() -> None:
    flat, faces = grid(9, 9, 1.0)
    across, along = 0.517, flat[:, 2][faces]
    upright = (flat - flat.mean(axis=0))[:, [0, 2, 1]] + [flat[:, 0].mean() + 0.013, 0.05, across]
    pairs = counts.crossings(flat, faces, upright, faces)
    assert set(pairs[:, 0]) == set(np.flatnonzero((along.min(axis=1) < across) & (along.max(axis=1) > across)))
    both = np.concatenate([flat, upright]), np.concatenate([faces, faces + len(flat)])
    assert len(counts.crossings(*both)) == len(pairs)
    assert len(counts.crossings(flat, faces)) == 0


def test_parts_and_stretch_of_two_sheets() -> None:
    pos, faces = grid(4, 4, 1.0)
    both = np.concatenate([faces, faces + len(pos)])
    assert counts.parts(2 * len(pos), both).tolist() == [0] * len(pos) + [1] * len(pos)
    np.testing.assert_allclose(counts.stretch(1.3 * pos, pos, faces), 1.3)


def test_a_scene_runs_and_its_sheet_shows_the_cloth(tmp_path: Path) -> None:
    curtain = SCENES["curtain_row"]
    short = Scene("short", curtain.kind, curtain.stepper, curtain.garment, "none", 3, curtain.keys, curtain.body)
    summary, code = run(short, tmp_path)
    assert code == 0
    assert summary["num_frames"] == 3
    picture = sheet(tmp_path / "rollout.h5")
    blue = (picture[..., 2].astype(int) - picture[..., 0] > 60).mean()
    assert 0.1 < blue < 0.9


def test_a_refused_scene_says_why(tmp_path: Path) -> None:
    scene = REFUSED["tank_npz_no_rate"]
    assert "mocap_framerate" in run_unread(scene, tmp_path)
    assert run(scene, tmp_path) == ({}, 2)
