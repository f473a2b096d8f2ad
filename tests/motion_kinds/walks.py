"""One walk, in the worlds and representations in which files hold it."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from hood.assets.files.library import locate
from hood.assets.motion.recording import read_recording
from hood.assets.motion.skeleton import UP_AXES

COUNT = 60


@dataclass(frozen=True)
class Walk:
    """The steps that all files hold: poses (N, 24, 3) rad with still hands, fingers (N, 30, 3), a translation (N, 3) m."""

    poses: np.ndarray
    fingers: np.ndarray
    transl: np.ndarray
    betas: np.ndarray = field(default_factory=lambda: np.linspace(-1.0, 1.0, 10))

    @property
    def root(self) -> np.ndarray:
        return self.poses[:, 0]

    @property
    def body(self) -> np.ndarray:
        """(N, 63)."""
        return self.poses[:, 1:22].reshape(len(self.poses), 63)

    def flat(self, columns: int = 72) -> np.ndarray:
        """(N, columns) in the order of SMPL, SMPL-H or SMPL-X."""
        count = len(self.poses)
        hands = self.fingers.reshape(count, 90)
        tails = {66: [], 72: [np.zeros((count, 6))], 156: [hands], 165: [np.zeros((count, 9)), hands]}
        return np.concatenate([self.poses[:, :22].reshape(count, 66), *tails[columns]], axis=1)

    def turned(self, matrix: np.ndarray) -> Walk:
        """The walk in a world that is turned by ``matrix``."""
        poses = self.poses.copy()
        poses[:, 0] = (Rotation.from_matrix(matrix) * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
        return Walk(poses, self.fingers, self.transl @ matrix.T, self.betas)


@cache
def walk() -> Walk:
    """Two steps and a half of the embedded walk at 30 frames a second, around the origin."""
    recording = read_recording(locate("motions", "walk_proud"))
    rows = slice(60, 60 + 2 * COUNT, 2)
    poses = recording.poses[rows].copy()
    poses[:, 22:] = 0.0
    fingers = np.random.default_rng(0).normal(scale=0.2, size=(COUNT, 30, 3))
    transl = recording.transl[rows] * [1.0, 1.0, 1.0]
    transl = transl - [transl[:, 0].mean(), transl[:, 1].mean(), 0.0]
    return Walk(poses, fingers, transl).turned(UP_AXES["z"])


def world(up: str = "y") -> Walk:
    """The walk as a file with ``up`` up has it."""
    return walk().turned(UP_AXES[up].T)


def matrices(vectors: np.ndarray) -> np.ndarray:
    """(..., 3, 3) of axis-angle vectors (..., 3)."""
    return Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*vectors.shape[:-1], 3, 3)
