"""A single pose is a motion that stands still, in every layout; parts, loops and lead-ins of it and of short motions."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from motion_kinds.parameters import amass, split
from motion_kinds.published import motion_x
from motion_kinds.walks import matrices, world
from motion_kinds.writers import write

from hood.assets.motion.load import load_sequence
from hood.assets.motion.motion_files import MotionFiles
from hood.assets.motion.sequence import PoseSequence, resample, turn_world
from hood.assets.motion.sequence_edit import blend_in, loop
from hood.scene.body_motion.load import MotionOptions, load_motion

SINGLE = {
    "amass": (".npz", amass(72, poses=world("z").flat()[:1], trans=world("z").transl[:1])),
    "amass, no axis of frames": (".npz", amass(72, poses=world("z").flat()[0], trans=world("z").transl[0])),
    "amass, by joint": (".npz", amass(72, poses=world("z").poses[0], trans=world("z").transl[0])),
    "amass, matrices": (".npz", amass(72, poses=matrices(world("z").poses[0]), trans=world("z").transl[0])),
    "body_pose": (".pkl", split(body_pose=world().flat()[0, 3:], global_orient=world().root[0], transl=world().transl[:1])),
    "body_pose, matrices": (
        ".pkl",
        split(
            body_pose=matrices(world().poses[:1, 1:]),
            global_orient=matrices(world().root[:1])[:, None],
            transl=world().transl[0],
        ),
    ),
    "motion-x": (".npy", motion_x()[:1]),
}


@pytest.mark.parametrize("name", SINGLE)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_single_pose_stands_still(name: str, tmp_path: Path) -> None:
    suffix, content = SINGLE[name]
    path = write(tmp_path / f"m{suffix}", content)
    held = load_sequence(path, 30.0, num_frames=20)
    assert (held.num_frames, held.fps) == (20, 30.0)
    np.testing.assert_allclose(held.transl, np.tile(world().transl[0], (20, 1)), atol=1e-9)
    np.testing.assert_allclose(held.poses, np.tile(held.poses[:1], (20, 1, 1)), atol=0)
    np.testing.assert_allclose(held.poses[0, 1:22], world().poses[0, 1:22], atol=1e-9)
    assert load_sequence(path, 10.0).num_frames == 51
    assert load_sequence(path, 10.0, start="0f", stop=2.0, loop=2, blend_in=0.5).num_frames == 5 + 101


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_single_pose_is_held_as_long_as_is_asked_for(tmp_path: Path) -> None:
    path = write(tmp_path / "m.npz", SINGLE["amass"][1])
    assert load_motion("default", path, MotionOptions(num_frames=12)).num_frames == 12
    assert MotionFiles([str(path)], load_sequence, 30.0).lengths == [151]


@pytest.mark.filterwarnings("error")
def test_parts_loops_and_leads_of_any_length() -> None:
    edges = itertools.product((None, "2f"), ("4f", "5f"), (2, 3), (0.0, 0.033))
    for start, stop, plays, lead in edges:
        sequence = load_sequence("walk_proud", 30.0, start=start, stop=stop, loop=plays, blend_in=lead)
        assert np.isfinite(sequence.poses).all()


def test_arrays_that_cannot_be_written_to(walk: PoseSequence) -> None:
    """Views of mapped files and broadcast poses."""
    part = walk.window(0, 5)
    locked = replace(part, poses=part.poses.copy(), transl=part.transl.copy(), fingers=np.zeros((5, 30, 3)))
    for table in (locked.poses, locked.transl, locked.fingers):
        table.setflags(write=False)
    for edited in (loop(locked, 2), blend_in(locked, 0.034), resample(locked, 47.0), turn_world(locked, np.eye(3))):
        assert np.isfinite(edited.poses).all()
    stretched = replace(walk, poses=np.broadcast_to(walk.poses[:1], walk.poses.shape))
    assert loop(resample(stretched, 24.0), 2).num_frames > walk.num_frames
