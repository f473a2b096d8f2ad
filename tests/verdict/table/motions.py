"""Motions of the table, written as AMASS files (z up, metres) from the embedded ones, right and wrong."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hood.assets.files.library import locate
from hood.studies.envelope.extreme_files import MOTIONS
from tests.verdict.table.scene import Maker

Array = np.ndarray

#: Frames per second of the embedded motions.
_FPS = 60.0
#: From z up to y up.
_TO_Y = Rotation.from_euler("x", -90, degrees=True)


def posed(kind: str, amount: float, seconds: float = 1.4, calm: float = 0.1, rate: float = 1.0) -> Maker:
    """From standing into a pose or movement of :data:`hood.studies.envelope.extreme_files.MOTIONS`, ``rate`` times as fast."""

    def make(folder: Path) -> Path:
        count = round(seconds * _FPS) + 1
        poses, trans = (np.repeat(rows[:1], count, axis=0) for rows in recorded("stand_sway"))
        time = np.maximum(np.arange(count) / _FPS - calm, 0.0) * rate
        return write(folder / f"{kind}.npz", *MOTIONS[kind](poses, trans, time, amount))

    return make


def flip(seconds: float = 0.8, about: str = "x", height: float = 0.6) -> Maker:
    """A turn over the head within ``seconds``: a somersault about x, a cartwheel about y."""

    def make(folder: Path) -> Path:
        calm, count = 6, round(seconds * _FPS)
        poses, trans = (np.repeat(rows[:1], calm + count, axis=0) for rows in recorded("stand_sway"))
        share = np.concatenate([np.zeros(calm), np.linspace(0.0, 1.0, count)])
        eased = share * share * (3.0 - 2.0 * share)
        poses = turned(poses, Rotation.from_euler(about, 360.0 * eased[:, None], degrees=True))
        return write(folder / f"flip_{about}.npz", poses, trans + 4 * height * (share - share**2)[:, None] * [0, 0, 1.0])

    return make


def lying(name: str = "stand_sway", degrees: float = -90.0, start: int = 0) -> Maker:
    """A body on its back (-90) or its belly (90) from the first frame on."""

    def make(folder: Path) -> Path:
        poses, trans = (rows[start:] for rows in recorded(name))
        turn = Rotation.from_euler("x", degrees, degrees=True)
        return write(folder / "lying.npz", turned(poses, turn), turn.apply(trans) + [0.0, 0.0, 0.2])

    return make


def head_down(name: str = "walk_proud", start: int = 60) -> Maker:
    """As image estimators write it: in the space of a camera whose y axis points down and whose z axis points ahead."""

    def make(folder: Path) -> Path:
        poses, trans = (rows[start:] for rows in recorded(name))
        turn = Rotation.from_euler("x", 180, degrees=True) * _TO_Y
        return write(folder / "camera.npz", turned(poses, turn), turn.apply(trans) + [0.0, 0.0, 4.0])

    return make


def y_up(name: str = "walk_proud", start: int = 60) -> Maker:
    """Turned y up, in a layout that mostly has z up."""

    def make(folder: Path) -> Path:
        poses, trans = (rows[start:] for rows in recorded(name))
        return write(folder / "y_up.npz", turned(poses, _TO_Y), _TO_Y.apply(trans))

    return make


def moved(
    name: str = "walk_proud",
    start: int = 60,
    shift: tuple[float, float, float] = (0, 0, 0),
    scale: float = 1.0,
    speed: float = 0.0,
    jump: float = 0.0,
    at: int = 20,
) -> Maker:
    """An embedded motion moved by ``shift`` [m] and ``speed`` [m/s], that jumps by ``jump`` [m] at row ``at``, then scaled."""

    def make(folder: Path) -> Path:
        poses, trans = (rows[start:] for rows in recorded(name))
        row = np.arange(len(trans))
        along = speed * row / _FPS + jump * (row >= at)
        return write(folder / "moved.npz", poses, scale * (trans + shift + along[:, None] * [1.0, 0.0, 0.0]))

    return make


def shaken(metres: float, degrees: float, name: str = "walk_proud", start: int = 60) -> Maker:
    """With noise on every joint and on the place, as of a poor capture."""

    def make(folder: Path) -> Path:
        rng = np.random.default_rng(0)
        poses, trans = (rows[start : start + 120] for rows in recorded(name))
        poses = poses + np.radians(degrees) * rng.normal(size=poses.shape) * (np.arange(poses.shape[1]) < 66)
        return write(folder / "shaken.npz", poses, trans + metres * rng.normal(size=trans.shape))

    return make


def turned_rows(first: int, last: int, name: str = "walk_proud", start: int = 60) -> Maker:
    """Looks the other way in the rows ``first`` to ``last``, as where a tracker loses the front."""

    def make(folder: Path) -> Path:
        poses, trans = (rows[start : start + 120] for rows in recorded(name))
        half = np.where((np.arange(len(poses)) >= first) & (np.arange(len(poses)) < last), 180.0, 0.0)
        return write(folder / "turned.npz", turned(poses, Rotation.from_euler("z", half[:, None], degrees=True)), trans)

    return make


def without_rate(name: str = "walk_proud", start: int = 60) -> Maker:
    """No word about frames per second."""

    def make(folder: Path) -> Path:
        return write(folder / "no_rate.npz", *(rows[start:] for rows in recorded(name)), mocap_framerate=None)

    return make


def pose_pickle(name: str = "walk_proud", start: int = 60, every: int = 1) -> Maker:
    """A pickle of joint rotations, y up, that says nothing of frames per second; it has one of ``every`` recorded rows."""

    def make(folder: Path) -> Path:
        poses, trans = (rows[start::every] for rows in recorded(name))
        upright = turned(poses, _TO_Y)
        fields = {"global_orient": upright[:, :3], "body_pose": np.pad(upright[:, 3:66], ((0, 0), (0, 6)))}
        fields |= {"transl": _TO_Y.apply(trans), "betas": np.zeros((len(poses), 10))}
        (folder / "poses.pkl").write_bytes(pickle.dumps(fields, 2))
        return folder / "poses.pkl"

    return make


def recorded(name: str) -> tuple[Array, Array]:
    with np.load(locate("motions", name), allow_pickle=False) as file:
        return file["poses"].astype(np.float64), file["trans"].astype(np.float64)


def turned(poses: Array, turn: Rotation) -> Array:
    root = turn * Rotation.from_rotvec(poses[:, :3])
    return np.column_stack([root.as_rotvec(), poses[:, 3:]])


def write(path: Path, poses: Array, trans: Array, **extra: Any) -> Path:
    arrays = {"poses": poses, "trans": trans, "mocap_framerate": _FPS, "betas": np.zeros(16), "gender": "neutral"} | extra
    np.savez(path, **{key: value for key, value in arrays.items() if value is not None})
    return path
