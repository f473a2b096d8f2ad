"""Published layouts: every one is the same walk, and says what it is; what is not read is answered in one sentence."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
from motion_kinds.parameters import posed, quaternions, six, split
from motion_kinds.published import motion_x, wham
from motion_kinds.refused import REFUSALS
from motion_kinds.siblings import SIBLINGS, opened
from motion_kinds.variants import GENERATORS
from motion_kinds.walks import walk, world
from motion_kinds.writers import write
from scipy.spatial.transform import Rotation

from hood.assets.files.said import Doubt
from hood.assets.identify import MOTION, identify
from hood.assets.motion.load import bearing_notice, load_sequence
from hood.assets.motion.recording import read_recording


@pytest.mark.parametrize("name", GENERATORS)
def test_every_layout_is_the_same_walk(name: str, tmp_path: Path) -> None:
    file = GENERATORS[name]
    path = write(tmp_path / f"m{file.suffix}", file.make())
    found = read_recording(path, **file.keys)
    assert (found.layout, found.fps, found.fps_assumed, found.family) == (file.layout, file.fps, file.assumed, file.family)
    assert (len(found.people), found.unit) == (file.people, "m")
    assert bearing_notice(path, found)[0] == file.up
    if file.betas:
        np.testing.assert_allclose(found.betas[:10], walk().betas, atol=1e-6)
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        sequence = load_sequence(path, file.fps, **file.keys)
    kinds = {said.message.kind for said in heard if isinstance(said.message, Doubt)}
    assert kinds == {*file.doubts, *(("frame_rate",) if file.assumed else ())}
    before_camera = [0.0, 0.0, -30.0] if name == "4DHumans" else [0.0, 0.0, 0.0]
    np.testing.assert_allclose(sequence.transl, walk().transl + before_camera, atol=1e-6)
    own, wanted = (Rotation.from_rotvec(poses[:, :22].reshape(-1, 3)) for poses in (sequence.poses, walk().poses))
    assert (own.inv() * wanted).magnitude().max() < 1e-6


#: One of every way in which layouts arrange their tables.
OTHERWISE = (
    "AIST++", "3DPW, second of two", "EMDB", "GVHMR", "PHALP, two tracks", "ROMP", "Motion-X", "GRAB", "quaternions, w first",
)  # fmt: skip


@pytest.mark.parametrize("way", SIBLINGS)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_the_same_content_is_read_however_it_is_written(way: str, tmp_path: Path) -> None:
    suffix, change = SIBLINGS[way]
    for name in OTHERWISE:
        file = GENERATORS[name]
        path = write(tmp_path / f"m{suffix}", change(opened(file.make())))
        assert identify(str(path)) == MOTION, name
        sequence = load_sequence(path, file.fps, **file.keys)
        assert np.abs(sequence.transl - walk().transl).max() < 2e-6, name
        own, wanted = (Rotation.from_rotvec(poses[:, :22].reshape(-1, 3)) for poses in (sequence.poses, walk().poses))
        assert (own.inv() * wanted).magnitude().max() < 2e-6, name


@pytest.mark.parametrize("count", [2, 3])
def test_people_seen_for_a_few_frames_are_no_frames(count: int, tmp_path: Path) -> None:
    """Three rows of 72 numbers are as many as 24 matrices."""
    people = {name: {key: table[:count] for key, table in person.items()} for name, person in wham(2).items()}
    found = read_recording(write(tmp_path / "m.pkl", people), person=2)
    assert (found.people, found.poses.shape) == (("0", "2"), (count, 24, 3))
    by_joint = {str(name): posed(world("z").poses[:count], trans=world("z").transl[:count]) for name in range(2)}
    assert read_recording(write(tmp_path / "n.pkl", by_joint), person=1).poses.shape == (count, 24, 3)


def test_rows_of_frames_may_hold_any_representation(tmp_path: Path) -> None:
    for turns in (quaternions(True), six("rows").reshape(-1, 144)):
        rows = [{"poses": row, "trans": place} for row, place in zip(turns, world("z").transl, strict=True)]
        found = read_recording(write(tmp_path / "m.pkl", {"fps": 30, "frames": rows}))
        assert np.abs(found.poses[:, 1:22] - walk().poses[:, 1:22]).max() < 1e-6


def test_frames_in_which_nobody_was_seen_are_filled_and_doubted(tmp_path: Path) -> None:
    seen = np.r_[0:20, 25:60]
    people = wham()
    people[0] = {key: value[seen] for key, value in people[0].items()}
    found = read_recording(write(tmp_path / "m.pkl", people))
    np.testing.assert_allclose(found.transl[seen], walk().transl[seen], atol=1e-12)
    assert np.abs(found.transl[20:25] - walk().transl[20:25]).max() < 0.03
    doubt = next(note for note in found.notes if isinstance(note, Doubt) and note.kind == "jump")
    assert (doubt.frames, doubt.value) == ((20, 21, 22, 23, 24), 5.0)


def test_fingers_stand_beside_the_body(tmp_path: Path) -> None:
    own = world()
    hands = {f"{side}_hand_pose": own.fingers[:, rows] for side, rows in (("left", slice(15)), ("right", slice(15, 30)))}
    found = read_recording(write(tmp_path / "m.pkl", split(**hands, fps=30)))
    np.testing.assert_array_equal(found.fingers, own.fingers)
    np.testing.assert_array_equal(read_recording(write(tmp_path / "m.npy", motion_x())).fingers, own.fingers)
    amass_x = {"root_orient": own.root, "pose_body": own.body, "pose_hand": own.fingers.reshape(-1, 90), "trans": own.transl}
    one = {key: value[0] for key, value in amass_x.items()}
    np.testing.assert_array_equal(read_recording(write(tmp_path / "n.npz", one)).fingers, own.fingers[:1])
    for hand, words in ((0.0, r"shape \(\); it must be \(N, 90\)"), (own.fingers[:-1], "59 frames, the body has 60")):
        with pytest.raises(ValueError, match=rf"o\.npz: pose_hand has {words}"):
            read_recording(write(tmp_path / "o.npz", amass_x | {"pose_hand": hand, "fps": 30}))
    coefficients = {f"{side}_hand_pose": np.zeros((60, 12)) for side in ("left", "right")}
    assert read_recording(write(tmp_path / "m.pkl", split(**coefficients, fps=30))).fingers is None


@pytest.mark.parametrize("name", REFUSALS)
def test_what_is_not_read_is_answered_in_one_sentence(name: str, tmp_path: Path) -> None:
    refusal = REFUSALS[name]
    path = write(tmp_path / f"m{refusal.suffix}", refusal.make())
    with pytest.raises(ValueError, match=refusal.words) as error:
        read_recording(path, **refusal.keys)
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)
    assert len(str(error.value).removeprefix(str(path))) < 300
