"""A garment of a hundred vertices and a walk of a few frames, as files: rollouts of a second."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hood.assets.body.load import load_body
from hood.assets.files.library import locate
from hood.assets.motion.recording import read_recording
from hood.testing import cylinder


def write_belt(path: Path) -> None:
    """A ring of cloth round the default body's waist, tight enough to stay there."""
    waist = load_body().shaped(np.zeros(10))[1][3]
    pos, faces = cylinder(around=20, rows=5, radius=0.14, height=0.16)
    rows = [f"v {x} {y} {z}" for x, y, z in pos - pos.mean(axis=0) + waist] + [f"f {a} {b} {c}" for a, b, c in faces + 1]
    path.write_text("\n".join(rows) + "\n")


def write_walk(path: Path, num_frames: int, twist_at: int | None = None) -> None:
    """Steps of an embedded walk at 30 fps; from frame ``twist_at`` on the trunk looks the other way, the legs do not."""
    recording = read_recording(locate("motions", "walk_proud"))
    every = round(recording.fps / 30.0)
    poses = recording.poses[: num_frames * every : every, :22].reshape(num_frames, 66)
    transl = recording.transl[: num_frames * every : every].copy()
    if twist_at is not None:
        about = Rotation.from_rotvec([0.0, np.pi, 0.0])  # along the spine, in the frame of its joint
        poses[twist_at:, 9:12] = (Rotation.from_rotvec(poses[twist_at:, 9:12]) * about).as_rotvec()
    path.parent.mkdir(parents=True, exist_ok=True)
    hands = np.zeros((num_frames, 90))
    np.savez(path, poses=np.c_[poses, hands], trans=transl, mocap_framerate=30.0, betas=np.zeros(16), gender="neutral")
