"""The up axis by the poses: what stands is found, what lies on a floor is asked about, the own motions are left alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hood.assets.files.library import locate, names
from hood.assets.motion.recording import Recording, read_recording
from hood.assets.motion.sequence import Z_UP_TO_Y_UP
from hood.assets.motion.up_axis import find_bearing


@pytest.fixture(scope="module")
def walk() -> Recording:
    return read_recording(locate("motions", "walk_proud"))


def turned(recording: Recording, matrix: np.ndarray) -> Recording:
    poses = recording.poses.copy()
    poses[:, 0] = (Rotation.from_matrix(matrix) * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    return replace(recording, poses=poses, transl=recording.transl @ matrix.T)


def test_the_own_motions_are_left_alone() -> None:
    for name in names("motions"):
        recording = read_recording(locate("motions", name))
        assert find_bearing(recording) == (recording.up, True), name


def test_a_body_that_stands_along_the_other_axis(walk: Recording) -> None:
    assert find_bearing(turned(walk, Z_UP_TO_Y_UP)) == ("y", True)
    assert find_bearing(replace(walk, up="y")) == ("z", True)


def test_lying_on_the_floor_is_asked_about(walk: Recording) -> None:
    """Asleep on a z-up floor with the head towards +y: that is what a body looks like that stands in a y-up world."""
    lying = turned(walk, Z_UP_TO_Y_UP)
    lying.transl[:] = [0.3, 5.0, 0.15]
    assert find_bearing(lying) == ("y", False)


def test_a_roll_does_not_count(walk: Recording) -> None:
    """Cartwheels and crawling: up along y for half of the frames."""
    half = len(walk.poses) // 2
    mixed = turned(walk, Z_UP_TO_Y_UP).poses
    mixed[half:] = walk.poses[half:]
    assert find_bearing(replace(walk, poses=mixed)) == ("z", True)
