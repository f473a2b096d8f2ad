"""Inputs of the third table, as strangers bring them: garment files that were edited, poses by joints, edited captures, things.

A ``change`` takes a mesh, or the rows of a capture, and returns it otherwise. In meshes x is the body's left, y up, z ahead.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hood.testing import box, sphere
from tests.verdict.table.bodies import person
from tests.verdict.table.meshes import Mesh, body, joined, moved, part, worn, write_obj
from tests.verdict.table.motions import recorded, turned, write
from tests.verdict.table.scene import Maker
from tests.verdict.table.takes import Angles

Array = np.ndarray
_FPS, _STEPS = 60.0, 30.0


def edited(name: str, word: str, *changes: Callable[[Mesh], Mesh]) -> Maker:
    """An embedded garment as a file, after ``changes``."""

    def make(folder: Path) -> Path:
        mesh = worn(name)
        for change in changes:
            mesh = change(mesh)
        return write_obj(folder / f"{name}_{word}.obj", mesh)

    return make


def tilted(about: str, degrees: float) -> Callable[[Mesh], Mesh]:
    """Turned about an axis through its middle."""
    turn = Rotation.from_euler(about, degrees, degrees=True)

    def change(mesh: Mesh) -> Mesh:
        middle = 0.5 * (mesh[0].max(axis=0) + mesh[0].min(axis=0))
        return turn.apply(mesh[0] - middle) + middle, mesh[1]

    return change


def shifted(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Callable[[Mesh], Mesh]:
    return lambda mesh: moved(mesh, (x, y, z))


def scaled(factor: float) -> Callable[[Mesh], Mesh]:
    """In other units, about the origin."""
    return lambda mesh: (factor * mesh[0], mesh[1])


def mirrored(mesh: Mesh) -> Mesh:
    """Left and right change places."""
    return mesh[0] * [-1, 1, 1], mesh[1][:, ::-1]


def inside_out(mesh: Mesh) -> Mesh:
    """Every normal is flipped."""
    return mesh[0], mesh[1][:, ::-1]


def noisy(metres: float) -> Callable[[Mesh], Mesh]:
    """Every vertex is off by some millimetres."""
    return lambda mesh: (mesh[0] + metres * np.random.default_rng(7).normal(size=mesh[0].shape), mesh[1])


def doubled(mesh: Mesh) -> Mesh:
    """Every face twice, from both sides, on the same vertices."""
    return mesh[0], np.concatenate([mesh[1], mesh[1][:, ::-1]])


def lined(share: float) -> Callable[[Mesh], Mesh]:
    """With itself once more, drawn towards its upright axis, as a lining."""

    def change(mesh: Mesh) -> Mesh:
        axis = mesh[0].mean(axis=0) * [1, 0, 1]
        return joined(mesh, ((mesh[0] - axis) * [share, 1, share] + axis, mesh[1]))

    return change


def lacking(where: Callable[[Array], Array]) -> Callable[[Mesh], Mesh]:
    """Without the faces whose middles are there."""
    return lambda mesh: part(mesh, ~where(mesh[0][mesh[1]].mean(axis=1)))


def spikes(count: int, metres: float) -> Callable[[Mesh], Mesh]:
    """Some vertices lie away from the axis."""

    def change(mesh: Mesh) -> Mesh:
        pos = mesh[0].copy()
        rows = np.random.default_rng(3).choice(len(pos), count, replace=False)
        away = (pos[rows] - pos.mean(axis=0)) * [1, 0, 1]
        pos[rows] += metres * away / np.linalg.norm(away, axis=1, keepdims=True)
        return pos, mesh[1]

    return change


def held(
    word: str, joints: Angles, seconds: float = 0.6, root: tuple[float, float, float] = (0, 0, 0), up: float = 0.0
) -> Maker:  # fmt: skip
    """From standing, within ``seconds``, joints go to these angles from the T-pose; 0: they are there at once."""

    def make(folder: Path) -> Path:
        poses, trans = (np.repeat(rows[:1], 90, axis=0) for rows in recorded("stand_sway"))
        time = np.clip((np.arange(90) - 6) / (_FPS * seconds), 0, 1) if seconds else np.ones(90)
        share = time * time * (3 - 2 * time)
        for joint, angles in joints.items():
            columns = slice(3 * joint, 3 * joint + 3)
            before = Rotation.from_rotvec(poses[:, columns])
            way = (before.inv() * Rotation.from_euler("xyz", angles, degrees=True)).as_rotvec()
            poses[:, columns] = (before * Rotation.from_rotvec(share[:, None] * way)).as_rotvec()
        poses = turned(poses, Rotation.from_rotvec(np.radians(share[:, None] * np.asarray(root, dtype=np.float64))))
        return write(folder / f"{word}.npz", poses, trans + up * share[:, None] * [0, 0, 1.0])

    return make


def take(name: str, start: int, word: str, change: Callable[[Array, Array], tuple[Array, Array]]) -> Maker:
    """Two seconds of an embedded motion after a change of its poses and places."""

    def make(folder: Path) -> Path:
        poses, trans = (rows[start : start + 120].copy() for rows in recorded(name))
        return write(folder / f"{word}.npz", *change(poses, trans))

    return make


def cut_to(name: str, start: int, at: int, stay: bool = True) -> Callable[[Array, Array], tuple[Array, Array]]:
    """From row ``at`` another motion, at the same place or where it was recorded."""

    def change(poses: Array, trans: Array) -> tuple[Array, Array]:
        other, places = (rows[start : start + len(poses) - at] for rows in recorded(name))
        if stay:
            places = places + (trans[at - 1] - places[0]) * [1, 1, 0]
        return np.concatenate([poses[:at], other]), np.concatenate([trans[:at], places])

    return change


def odd_rows(rows: Sequence[int], joint: int, angles: Sequence[float]) -> Callable[[Array, Array], tuple[Array, Array]]:
    """A joint is turned by so many degrees more in some rows; joint 0 is the root."""

    def change(poses: Array, trans: Array) -> tuple[Array, Array]:
        turn = Rotation.from_rotvec(np.radians(np.asarray(angles, dtype=np.float64)))
        columns = slice(3 * joint, 3 * joint + 3)
        for row in rows:
            before = Rotation.from_rotvec(poses[row, columns])
            poses[row, columns] = (turn * before if joint == 0 else before * turn).as_rotvec()
        return poses, trans

    return change


def spun(degrees: float, seconds: float, at: int = 12) -> Callable[[Array, Array], tuple[Array, Array]]:
    """Turns about the upright axis within ``seconds``, on the spot where it stands at row ``at``."""

    def change(poses: Array, trans: Array) -> tuple[Array, Array]:
        share = np.clip((np.arange(len(poses)) - at) / (_FPS * seconds), 0, 1)
        share = share * share * (3 - 2 * share)
        turn = Rotation.from_euler("z", degrees * share[:, None], degrees=True)
        return turned(poses, turn), turn.apply(trans - trans[at]) + trans[at]

    return change


def hopped(metres: float, seconds: float = 0.5, at: int = 10) -> Callable[[Array, Array], tuple[Array, Array]]:
    """Jumps up and lands hard, without bending its knees."""

    def change(poses: Array, trans: Array) -> tuple[Array, Array]:
        share = np.clip((np.arange(len(poses)) - at) / (_FPS * seconds), 0, 1)
        return poses, trans + 4 * metres * (share - share**2)[:, None] * [0, 0, 1.0]

    return change


def driven(speed: float, at: int = 12) -> Callable[[Array, Array], tuple[Array, Array]]:
    """Moves aside at ``speed`` [m/s] from row ``at``."""
    return lambda poses, trans: (
        poses, trans + speed / _FPS * np.maximum(np.arange(len(trans)) - at, 0)[:, None] * [1.0, 0.0, 0.0]
    )  # fmt: skip


def coarse_person(name: str, first: int, count: int, cell: float) -> Maker:
    """A moving person whose vertices are drawn together in cells of ``cell`` [m] of the T-pose."""

    def make(folder: Path) -> Path:
        with np.load(person(name, first, count)(folder)) as file:
            verts, faces = file["verts"].astype(np.float64), file["faces"]
        template = np.asarray(body().v_template, dtype=np.float64)
        _, own = np.unique(np.floor(template / cell).astype(int), axis=0, return_inverse=True)
        own = own.reshape(-1)
        members = np.bincount(own)
        middles = np.stack([np.stack([np.bincount(own, pos[:, axis]) / members for axis in range(3)], axis=1) for pos in verts])
        rows = own[faces]
        kept = (rows[:, 0] != rows[:, 1]) & (rows[:, 1] != rows[:, 2]) & (rows[:, 2] != rows[:, 0])
        _, once = np.unique(np.sort(rows[kept], axis=1), axis=0, return_index=True)
        np.savez(folder / "coarse.npz", verts=middles, faces=rows[kept][np.sort(once)], fps=_STEPS)
        return folder / "coarse.npz"

    return make


def solid(word: str, *meshes: Mesh) -> Maker:
    """Still things in one file."""
    return lambda folder: write_obj(folder / f"{word}.obj", joined(*meshes))


def ball(radius: float, at: Sequence[float], fine: int = 1) -> Mesh:
    pos, faces = sphere(fine, radius)
    return pos + np.asarray(at), faces


def slab(size: Sequence[float], at: Sequence[float], cells: int = 6) -> Mesh:
    pos, faces = box(cells, 1.0)
    return pos * np.asarray(size) + np.asarray(at), faces


def capsule(radius: float, length: float, at: Sequence[float], fine: int = 2) -> Mesh:
    """Lies along x."""
    pos, faces = sphere(fine, radius)
    return pos + 0.5 * length * np.sign(np.round(pos[:, :1], 9)) * [1.0, 0.0, 0.0] + np.asarray(at), faces
