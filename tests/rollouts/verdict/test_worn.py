"""Whether a garment stays where it was worn, on tubes of cloth around posts."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from stored import frames, stored, tube

from hood.rollouts.file.reader import RolloutData
from hood.rollouts.verdict.rule import Reason, judge_rollout
from hood.rollouts.verdict.worn import measure_wear

POST, POST_FACES = tube(0.10, 0.0, 1.6, 24, 60)
SLEEVE, SLEEVE_FACES = tube(0.115, 0.8, 1.2)
COUNT = 21


def rollout(cloth: np.ndarray, faces: np.ndarray = SLEEVE_FACES, body: np.ndarray = POST, **config: object) -> RolloutData:
    return stored(COUNT, cloth=cloth, faces=faces, body=body, body_faces=POST_FACES.astype(np.int32), config=config)


def off(data: RolloutData) -> list[Reason]:
    """Why it is not worn; sliding tubes also cut their posts."""
    return [reason for reason in judge_rollout(data).reasons if reason.kind == "not_worn"]


def falling(pos: np.ndarray, way: float, sideways: float = 0.0) -> np.ndarray:
    """(T, V, 3): frame by frame down by ``way`` metres in all, and aside."""
    share = np.linspace(0.0, 1.0, COUNT)[:, None, None]
    return pos + share * np.array([sideways, -way, 0.0])


def test_a_sleeve_that_stays_is_worn() -> None:
    verdict = judge_rollout(rollout(SLEEVE))
    assert (verdict.sound, verdict.doubts) == (True, ())
    assert off(rollout(falling(SLEEVE, 0.05))) == []


def test_a_sleeve_that_slides_down_has_come_off() -> None:
    (reason,) = off(rollout(falling(SLEEVE, 0.6)))
    assert (reason.kind, reason.part, reason.unit) == ("not_worn", 1, "m")
    assert reason.sentence.startswith("'shirt' has come off: from frame ")
    assert reason.frames[-1][1] == COUNT - 1
    first = reason.frames[0][0]
    assert 0.05 <= 0.6 * first / (COUNT - 1) <= 0.1  # as soon as its top is beyond the limit
    assert reason.value is not None
    assert reason.value == pytest.approx(0.6 - 0.15, abs=0.05)


def test_a_waistband_that_slips_by_a_hand_has_come_off() -> None:
    """Two thirds of the way are within the region of what touches the body."""
    for way in (0.05, -0.13):  # clothes slide up in a handstand
        assert off(rollout(falling(SLEEVE, way))) == []
    (reason,) = off(rollout(falling(SLEEVE, 0.2)))
    assert "its highest opening has slipped along the body, by 0.21 m at worst (beyond 0.15)" in reason.sentence
    (reason,) = off(rollout(falling(SLEEVE, 0.12)))
    assert "its top has slid down the body, by 0.13 m at worst (beyond 0.06)" in reason.sentence
    (reason,) = off(rollout(falling(SLEEVE, -0.2)))  # to the end of its post
    assert "its highest opening has slipped along the body, by 0.19 m at worst (beyond 0.15)" in reason.sentence
    turned = SLEEVE @ Rotation.from_euler("y", 40, degrees=True).as_matrix().T
    assert off(rollout(np.linspace(SLEEVE, turned, COUNT))) == []  # around the post


def test_a_sleeve_that_winds_around_its_post_is_not_worn() -> None:
    """The post is as thick as a trunk. The sleeve's top stays, and what lies below turns the more the lower it is."""
    sleeve, post = SLEEVE * [1.5, 1.0, 1.5], POST * [1.5, 1.0, 1.5]
    share = (SLEEVE[:, 1].max() - SLEEVE[:, 1]) / np.ptp(SLEEVE[:, 1])
    for most, worn in ((100.0, True), (300.0, False)):
        turns = [np.radians(degrees) * share for degrees in np.linspace(0.0, most, COUNT)]
        wound = [Rotation.from_rotvec(np.outer(turn, [0.0, 1.0, 0.0])).apply(sleeve) for turn in turns]
        found = off(rollout(np.array(wound), body=post))
        assert (not found) is worn
        assert worn or "it has shifted along the body, by 0." in found[0].sentence


def test_a_strap_that_slides_down_has_come_off() -> None:
    """Two straps stand up from a sleeve: one stays, and the opening with it, in the mean."""
    above = SLEEVE[:, 1] > 1.1
    left, right = above & (SLEEVE[:, 0] > 0.08), above & (SLEEVE[:, 0] < -0.08)
    faces = SLEEVE_FACES[(~above | left | right)[SLEEVE_FACES].all(axis=1)]
    for ways, worn in (((0.1, 0.0), False), ((0.04, 0.04), True), ((-0.1, -0.1), True)):
        down = sum(way * strap for way, strap in zip(ways, (left, right), strict=True))
        cloth = SLEEVE - np.linspace(0.0, 1.0, COUNT)[:, None, None] * down[:, None] * np.array([0.0, 1.0, 0.0])
        assert (off(rollout(cloth, faces)) == []) is worn


def test_what_sank_while_it_settled_has_come_off() -> None:
    for before, worn in ((0.1, True), (0.14, False)):
        data = stored(COUNT, {"settle_sunk": frames(COUNT, before)}, cloth=SLEEVE, faces=SLEEVE_FACES, body=POST,
                      body_faces=POST_FACES.astype(np.int32))  # fmt: skip
        assert (off(data) == []) is worn


def test_a_sleeve_beside_its_post_holds_it_no_more() -> None:
    (reason,) = off(rollout(falling(SLEEVE, 0.0, 0.4)))
    assert "its highest opening has slipped" in reason.sentence


def test_the_body_moves_and_the_cloth_with_it() -> None:
    away = np.linspace(0.0, 5.0, COUNT)[:, None, None] * np.array([1.0, 0.0, 0.3])
    assert judge_rollout(rollout(SLEEVE + away, body=POST + away)).sound
    assert off(rollout(SLEEVE, body=POST + away))


def test_nobody_asks_where_nothing_has_to_be_worn() -> None:
    assert off(rollout(falling(SLEEVE, 0.6), worn=False)) == []
    assert off(stored(COUNT, cloth=falling(SLEEVE, 0.6), faces=SLEEVE_FACES)) == []


def test_what_an_event_lets_go_may_fall() -> None:
    verdict = judge_rollout(rollout(falling(SLEEVE, 0.6), events=[{"time": 2 / 30, "detach": "pins"}]))
    assert all(reason.kind != "not_worn" for reason in verdict.reasons)
    assert verdict.notes == ("whether the garment stays on is not judged from frame 2 on, where an event lets go of it",)
    assert off(rollout(falling(SLEEVE, 0.6), events=[{"frame": 2, "open": "front"}]))


def test_a_swinging_hem_is_worn() -> None:
    """Half of a skirt swings out by a metre; what touched the body stays."""
    pos, faces = tube(0.115, 0.3, 1.2, 24, 12)
    low = np.clip((0.9 - pos[:, 1]) / 0.6, 0.0, 1.0)
    swing = np.sin(np.linspace(0, 6, COUNT))[:, None, None] * low[None, :, None] * np.array([1.0, 0.2, 0.0])
    assert off(rollout(pos + swing, faces)) == []


def test_each_part_is_judged_and_named() -> None:
    """A front and a back panel: the back one falls."""
    pos, faces = tube(0.115, 0.8, 1.2)
    side = pos[faces].mean(axis=1)[:, 2]
    front, back = faces[side > 0.03], faces[side < -0.03]
    cloth = np.concatenate([np.repeat(pos[None], COUNT, axis=0), falling(pos, 1.0)], axis=1)
    (reason,) = off(rollout(cloth, np.concatenate([front, back + len(pos)])))
    assert reason.part == 2
    count, lowest = len(np.unique(back)), int(np.unique(back).min()) + len(pos)
    assert reason.sentence.startswith(f"part 2 of 2 of 'shirt' ({count} vertices, the lowest is {lowest}) has come off")


def test_a_sheet_above_the_body_may_fall_and_is_told() -> None:
    sheet = np.array([[x, 2.1, z] for x in np.linspace(-0.4, 0.4, 9) for z in np.linspace(-0.4, 0.4, 9)])
    corner = (np.arange(8)[:, None] * 9 + np.arange(8)).ravel()
    faces = np.concatenate([np.stack([corner, corner + 1, corner + 10], 1), np.stack([corner, corner + 10, corner + 9], 1)])
    assert off(rollout(falling(sheet, 2.0), faces)) == []
    (doubt,) = judge_rollout(rollout(falling(sheet, 2.0), faces)).doubts
    assert (doubt["kind"], doubt["unit"]) == ("worn", "m")
    assert doubt["value"] == pytest.approx(0.5, abs=0.02)
    assert judge_rollout(rollout(falling(sheet, 2.0), faces, worn=False)).doubts == ()


def test_a_coarse_body_is_as_good() -> None:
    """Its vertices are 16 cm apart."""
    post, post_faces = tube(0.10, 0.0, 1.6, 24, 10)
    for way, worn in ((0.05, True), (0.6, False)):
        data = stored(COUNT, cloth=falling(SLEEVE, way), faces=SLEEVE_FACES, body=post, body_faces=post_faces.astype(np.int32))
        assert (off(data) == []) is worn


def test_frames_that_are_not_finite_are_left_out() -> None:
    cloth = np.repeat(SLEEVE[None], COUNT, axis=0)
    cloth[7, 0] = np.nan
    reasons = judge_rollout(rollout(cloth)).reasons
    assert [reason.kind for reason in reasons] == ["not_finite"]
    assert measure_wear(cloth[7:], SLEEVE_FACES, np.repeat(POST[None], 14, axis=0), POST_FACES, [0]) is None


def test_files_without_settings_are_judged_as_well() -> None:
    data = rollout(falling(SLEEVE, 0.6))
    for text in ("[]", "no json"):
        data.attributes["config"] = text
        assert off(data)
    data.attributes["config"] = json.dumps({"worn": False})
    assert off(data) == []
