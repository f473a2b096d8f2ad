"""A garment of a hundred vertices and a walk of a few frames, as files: rollouts of a second."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hood.assets.body import load_body
from hood.assets.library import locate
from hood.assets.motion_file import read_recording
from hood.testing import cylinder


def write_belt(path: Path) -> None:
    """A ring of cloth round the default body's waist, tight enough to stay there."""
    waist = load_body().shaped(np.zeros(10))[1][3]
    pos, faces = cylinder(around=20, rows=5, radius=0.14, height=0.16)
    rows = [f"v {x} {y} {z}" for x, y, z in pos - pos.mean(axis=0) + waist] + [f"f {a} {b} {c}" for a, b, c in faces + 1]
    path.write_text("\n".join(rows) + "\n")


def write_walk(path: Path, num_frames: int, turn_at: int | None = None) -> None:
    """Steps of an embedded walk at 30 fps; from frame ``turn_at`` on the body looks the other way."""
    recording = read_recording(locate("motions", "walk_proud"))
    every = round(recording.fps / 30.0)
    poses = recording.poses[: num_frames * every : every, :22].reshape(num_frames, 66)
    transl = recording.transl[: num_frames * every : every].copy()
    if turn_at is not None:
        about = Rotation.from_rotvec([0.0, 0.0, np.pi])  # the file has z up
        poses[turn_at:, :3] = (about * Rotation.from_rotvec(poses[turn_at:, :3])).as_rotvec()
    path.parent.mkdir(parents=True, exist_ok=True)
    hands = np.zeros((num_frames, 90))
    np.savez(path, poses=np.c_[poses, hands], trans=transl, mocap_framerate=30.0, betas=np.zeros(16), gender="neutral")
