"""Files that can be read and are not what they are given as: beside the body, flat, in degrees, in pieces, a body."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from imitations import GltfWriter
from workshop import write_npz, write_obj

from hood.assets.body.body import Body
from hood.assets.files.library import locate
from hood.assets.garment.garment import Garment
from hood.assets.motion.recording import read_recording
from hood.assets.motion.sequence import Z_UP_TO_Y_UP
from hood.mesh import topology
from hood.testing import grid

#: How far the floor lies below the middle of the default body [m]: characters of other programs stand on y = 0.
_FLOOR = 0.9


def far_garment(path: Path, garment: Garment) -> Path:
    """The garment, 3 m beside the body it was made for."""
    return write_obj(path, garment.tpose(np.zeros(10)) + [3.0, 0.0, 0.0], garment.faces)


def soup(path: Path, garment: Garment) -> Path:
    """The garment with three vertices of its own for every triangle."""
    return write_obj(
        path, garment.tpose(np.zeros(10))[garment.faces].reshape(-1, 3), np.arange(garment.faces.size).reshape(-1, 3)
    )


def pattern_pieces(path: Path, garment: Garment) -> Path:
    """The garment's front and back, pressed flat and laid side by side in the plane z = 0."""
    ahead = garment.tpose(np.zeros(10))[garment.faces].mean(axis=1)[:, 2] > garment.tpose(np.zeros(10))[:, 2].mean()
    places, tables = [], []
    for part, shift in ((ahead, -0.6), (~ahead, 0.6)):
        used, faces = np.unique(garment.faces[part], return_inverse=True)
        tables.append(faces.reshape(-1, 3) + sum(map(len, places)))
        places.append(garment.tpose(np.zeros(10))[used] * [1.0, 1.0, 0.0] + [shift, 0.0, 0.0])
    return write_obj(path, np.concatenate(places), np.concatenate(tables))


def body_as_garment(path: Path, body: Body) -> Path:
    """The closed body itself."""
    return write_obj(path, body.v_template, body.faces)


def lying_body(path: Path, body: Body) -> Path:
    """The closed body as a program with z up writes it: with y up it lies on its back."""
    return write_obj(path, body.v_template[:, [0, 2, 1]] * [1.0, -1.0, 1.0], body.faces)


def towel(path: Path) -> Path:
    """A sheet of a square metre, 30 cm above the origin."""
    pos, faces = grid(20, 20)
    flat = pos - pos.mean(axis=0)
    return write_obj(path, flat[:, np.argsort(-np.ptp(flat, axis=0))][:, [0, 2, 1]] + [0.0, 0.3, 0.0], faces)


def torn_body(path: Path, body: Body, num_parts: int = 410) -> Path:
    """The body as an exporter writes its texture islands: ``num_parts`` pieces that share no vertices."""
    centres = body.v_template[body.faces].mean(axis=1)
    seeds = centres[np.random.default_rng(0).choice(len(centres), num_parts, replace=False)]
    part = np.argmin(((centres[:, None] - seeds[None]) ** 2).sum(axis=2), axis=1)
    pairs, corners = np.unique(np.stack([np.repeat(part, 3), body.faces.reshape(-1)], axis=1), axis=0, return_inverse=True)
    return write_obj(path, body.v_template[pairs[:, 1]], corners.reshape(-1, 3))


def character(path: Path, body: Body) -> Path:
    """A skinned character of four joints that stands on y = 0, as game engines have it: no skeleton of the family."""
    pos = (body.v_template - [0.0, body.v_template[:, 1].min(), 0.0]).astype(np.float32)
    joints = np.array([[0, 0.95, 0], [0, 1.4, 0], [0.12, 0.9, 0], [-0.12, 0.9, 0]], dtype=np.float32)
    nearest = np.argmin(((pos[:, None] - joints[None]) ** 2).sum(axis=2), axis=1)
    writer = GltfWriter()
    chosen, shares = np.zeros((len(pos), 4), np.uint8), np.zeros((len(pos), 4), np.float32)
    chosen[:, 0], shares[:, 0] = nearest, 1.0
    attributes = {"POSITION": writer.table(pos), "JOINTS_0": writer.table(chosen), "WEIGHTS_0": writer.table(shares)}
    mesh = {"primitives": [{"attributes": attributes, "indices": writer.table(body.faces.astype(np.uint32).reshape(-1))}]}
    inverse = np.tile(np.eye(4, dtype=np.float32), (4, 1, 1))
    inverse[:, 3, :3] = -joints  # column by column
    nodes = [{"translation": joint.tolist()} for joint in joints]
    writer.document |= {
        "meshes": [mesh], "nodes": [*nodes, {"mesh": 0, "skin": 0}],
        "skins": [{"joints": [0, 1, 2, 3], "inverseBindMatrices": writer.table(inverse)}],
    }  # fmt: skip
    return writer.write(path)


def y_up_poses(path: Path) -> Path:
    """A walk in the keys of AMASS, turned y up: its layout says that z is."""
    recording = read_recording(locate("motions", "walk_proud"))
    from scipy.spatial.transform import Rotation

    poses = recording.poses.copy()
    poses[:, 0] = (Rotation.from_matrix(Z_UP_TO_Y_UP) * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    return _motion(path, poses, recording.transl @ Z_UP_TO_Y_UP.T, recording.fps)


def poses_in_degrees(path: Path) -> Path:
    """A walk with its angles in degrees."""
    recording = read_recording(locate("motions", "walk_proud"))
    return _motion(path, np.degrees(recording.poses), recording.transl, recording.fps)


def _motion(path: Path, poses: np.ndarray, trans: np.ndarray, fps: float) -> Path:
    flat = np.concatenate([poses[:, :22].reshape(len(poses), 66), np.zeros((len(poses), 90))], axis=1)
    return write_npz(path, poses=flat, trans=trans, mocap_framerate=fps, betas=np.zeros(16))


def num_components(pos: np.ndarray, faces: np.ndarray) -> int:
    """Connected parts of a mesh."""
    return len(np.unique(topology.connected_components(len(pos), topology.unique_edges(faces))))
