"""The joints of a recorded motion in its file's world, by the skeleton of the embedded body."""

from __future__ import annotations

import numpy as np

from hood.assets.motion.rotation_vectors import from_vectors

PELVIS, HEAD = 0, 15
FEET, HANDS = (7, 8, 10, 11), (20, 21, 22, 23)
KNEES, ELBOWS = (4, 5), (18, 19)  # left, right
#: The joint above each joint of SMPL; -1 for the pelvis.
PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)
#: Time [s] over which speeds are taken.
_SPAN = 0.08
#: (24, 3) m: the joints of the embedded body in its T-pose, y up, z forward. The pelvis of SMPL's own lies 0.3 m lower against
#: its origin: heights against a floor at 0 are known to that.
_REST = np.array([
    [0, 0.097, 0.014], [0.112, 0.081, 0.005], [-0.112, 0.081, 0.005], [0, 0.177, -0.025], [0.146, -0.31, 0.009],
    [-0.146, -0.31, 0.009], [0, 0.248, -0.011], [0.145, -0.745, -0.017], [-0.145, -0.745, -0.017], [0, 0.329, -0.014],
    [0.155, -0.796, 0.125], [-0.155, -0.796, 0.125], [0, 0.641, 0.015], [0.024, 0.565, 0.03], [-0.023, 0.565, 0.03],
    [0, 0.74, 0.049], [0.177, 0.559, 0.024], [-0.177, 0.559, 0.024], [0.438, 0.543, 0], [-0.438, 0.543, 0],
    [0.672, 0.554, -0.006], [-0.672, 0.554, -0.006], [0.773, 0.549, -0.006], [-0.773, 0.549, -0.006],
])  # fmt: skip


def joints_about_pelvis(poses: np.ndarray) -> np.ndarray:
    """(N, 24, 3) m: places of the joints less that of the pelvis, for poses (N, 24, 3) [rad] in the file's world."""
    local = from_vectors(poses.reshape(-1, 3)).as_matrix().reshape(len(poses), len(PARENTS), 3, 3)
    turn, place = local.copy(), np.zeros((len(poses), len(PARENTS), 3))
    for joint, parent in enumerate(PARENTS):
        if parent < 0:
            continue
        turn[:, joint] = turn[:, parent] @ local[:, joint]
        place[:, joint] = place[:, parent] + turn[:, parent] @ (_REST[joint] - _REST[parent])
    return place


def upright(joints: np.ndarray) -> np.ndarray:
    """(N, 3): the unit vector from the feet to the head, of joints (N, 24, 3)."""
    along = joints[:, HEAD] - joints[:, FEET].mean(axis=1)
    return along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)


def spread(num_frames: int, most: int = 1000) -> np.ndarray:
    """Up to ``most`` frames, evenly over a motion: what most of them show is what most of its frames show."""
    return np.unique(np.linspace(0, num_frames - 1, min(most, num_frames)).round().astype(np.int64))


def some_frames(num_frames: int, fps: float, span: float = _SPAN, most: int = 400) -> tuple[np.ndarray, int]:
    """Up to ``most`` frames spread over a motion, and how many frames later to look again: about ``span`` [s], so that a speed
    is more than noise. None of a single frame."""
    step = min(max(round(span * fps), 1), max(num_frames - 1, 0))
    if step == 0:
        return np.zeros(0, np.int64), 0
    return np.unique(np.linspace(0, num_frames - 1 - step, most).astype(np.int64)), step
