"""Files as others write them, made up: body models with pose blend shapes, pickles of chumpy arrays, animated glTF."""

from __future__ import annotations

import json
import pickle
import struct
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import sparse
from scipy.spatial.transform import Rotation

_BODY_PARENTS = [-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19]


def parents_of(num_joints: int) -> list[int]:
    """Skeletons of SMPL (24), SMPL-H (52) and SMPL-X (55)."""
    if num_joints == 24:
        return [*_BODY_PARENTS, 20, 21]
    parents = [*_BODY_PARENTS, *([15, 15, 15] if num_joints == 55 else [])]
    for wrist in (20, 21):
        for _ in range(5):
            base = len(parents)
            parents += [wrist, base, base + 1]
    return parents


def model_arrays(num_joints: int, num_betas: int = 16, num_vertices: int = 150, seed: int = 0) -> dict[str, np.ndarray]:
    """A random body model of that skeleton, sized like a person; the pelvis is away from the origin."""
    rng = np.random.default_rng(seed)
    template = rng.uniform([-0.8, -1.2, -0.15], [0.8, 0.5, 0.15], size=(num_vertices, 3))
    regressor = rng.uniform(size=(num_joints, num_vertices)) ** 8
    weights = rng.uniform(size=(num_vertices, num_joints)) ** 6
    return {
        "v_template": template,
        "shapedirs": rng.normal(scale=0.01, size=(num_vertices, 3, num_betas)),
        "posedirs": rng.normal(scale=2e-3, size=(num_vertices, 3, 9 * (num_joints - 1))),
        "J_regressor": regressor / regressor.sum(axis=1, keepdims=True),
        "weights": weights / weights.sum(axis=1, keepdims=True),
        "kintree_table": np.stack([np.array(parents_of(num_joints)), np.arange(num_joints)]),
        "f": rng.permuted(np.tile(np.arange(num_vertices), (40, 1)), axis=1)[:, :3],
    }


def evaluate(model: dict[str, np.ndarray], betas: np.ndarray, poses: np.ndarray, transl: np.ndarray) -> tuple[np.ndarray, ...]:
    """Joints (T, J, 3) and vertices (T, W, 3) [m] by the formulas of SMPL (Loper et al. 2015, eq. 2 to 12), in float64."""
    rest = model["v_template"] + model["shapedirs"][..., : len(betas)] @ betas
    joints = model["J_regressor"] @ rest
    parents = model["kintree_table"][0]
    all_joints, all_vertices = [], []
    for pose, shift in zip(poses, transl, strict=True):
        local = Rotation.from_rotvec(pose).as_matrix()
        shaped = rest + model["posedirs"] @ (local[1:] - np.eye(3)).reshape(-1)
        world = np.zeros((len(parents), 4, 4))
        for joint, parent in enumerate(parents):
            step = np.eye(4)
            step[:3, :3] = local[joint]
            step[:3, 3] = joints[joint] - (joints[parent] if parent >= 0 else 0)
            world[joint] = world[parent] @ step if parent >= 0 else step
        posed = world[:, :3, 3].copy()
        world[:, :3, 3] -= np.einsum("jab,jb->ja", world[:, :3, :3], joints)
        blended = np.einsum("vj,jab->vab", model["weights"], world)
        all_vertices.append(np.einsum("vab,vb->va", blended[:, :3, :3], shaped) + blended[:, :3, 3] + shift)
        all_joints.append(posed + shift)
    return np.array(all_joints), np.array(all_vertices)


class Ch:
    """Imitates chumpy's array: the state holds it as ``x``."""

    def __init__(self, x: np.ndarray) -> None:
        self.x, self._dirty_vars = x, set()


class Select:
    """Imitates chumpy's selection of entries of another array."""

    def __init__(self, a: Ch, idxs: np.ndarray, shape: tuple) -> None:
        self.a, self.idxs, self.preferred_shape = a, idxs, shape


def write_official_pickle(path: Path, arrays: dict[str, np.ndarray], protocol: int = 2) -> Path:
    """As the official SMPL files: chumpy arrays, a sparse regressor, an unsigned root parent, text beside."""
    shapes = arrays["shapedirs"]
    table = arrays["kintree_table"].astype(np.int64)
    content: dict[str, Any] = {
        **arrays,
        "shapedirs": Select(Ch(np.concatenate([shapes.ravel(), [9.9]])), np.arange(shapes.size), shapes.shape),
        "posedirs": Ch(arrays["posedirs"]),
        "v_template": Ch(arrays["v_template"]),
        "J_regressor": sparse.csc_matrix(arrays["J_regressor"]),
        "kintree_table": np.where(table < 0, 4294967295, table).astype(np.uint32),
        "f": arrays["f"].astype(np.uint32),
        "bs_style": "lbs",
    }
    with pytest.MonkeyPatch.context() as patch:  # the package exists while the file is written
        patch.setitem(sys.modules, "chumpy", types.ModuleType("chumpy"))
        for kind, name in ((Ch, "chumpy.ch"), (Select, "chumpy.reordering")):
            module = types.ModuleType(name)
            setattr(module, kind.__name__, kind)
            patch.setitem(sys.modules, name, module)
            patch.setattr(kind, "__module__", name)
        path.write_bytes(pickle.dumps(content, protocol))
    return path


class GltfWriter:
    """Collects tables and writes a document as ``.glb``, or as ``.gltf`` with its ``.bin`` beside."""

    _TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
    _COMPONENTS = {"float32": 5126, "uint8": 5121, "uint16": 5123, "uint32": 5125, "int16": 5122}

    def __init__(self) -> None:
        self.content = bytearray()
        self.document: dict[str, Any] = {"asset": {"version": "2.0"}, "accessors": [], "bufferViews": []}

    def view(self, array: np.ndarray) -> int:
        self.content += b"\0" * (-len(self.content) % 4)
        place = {"buffer": 0, "byteOffset": len(self.content), "byteLength": array.nbytes}
        self.content += array.tobytes()
        self.document["bufferViews"].append(place)
        return len(self.document["bufferViews"]) - 1

    def table(self, array: np.ndarray, **extra: Any) -> int:
        array = np.ascontiguousarray(array)
        width = 1 if array.ndim == 1 else int(np.prod(array.shape[1:]))
        spec = {
            "bufferView": self.view(array), "componentType": self._COMPONENTS[str(array.dtype)], "count": len(array),
            "type": self._TYPES[width], **extra,
        }  # fmt: skip
        self.document["accessors"].append(spec)
        return len(self.document["accessors"]) - 1

    def write(self, path: Path) -> Path:
        self.document["buffers"] = [{"byteLength": len(self.content)}]
        if path.suffix == ".gltf":
            path.with_suffix(".bin").write_bytes(self.content)
            self.document["buffers"][0]["uri"] = path.with_suffix(".bin").name
            path.write_text(json.dumps(self.document))
            return path
        text = json.dumps(self.document).encode()
        text += b" " * (-len(text) % 4)
        chunk = bytes(self.content) + b"\0" * (-len(self.content) % 4)
        head = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(chunk))
        parts = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(chunk), 0x004E4942) + chunk
        path.write_bytes(head + parts)
        return path


def write_seated(path: Path) -> Path:
    """An AMASS file (SMPL-H, z up, 60 fps): sitting upright with hanging arms, the chest swaying a little."""
    time = np.arange(40) / 60
    poses = np.zeros((len(time), 52, 3))
    poses[:, 0] = Rotation.from_euler("x", 90, degrees=True).as_rotvec()
    poses[:, [1, 2], 0], poses[:, [4, 5], 0] = -np.pi / 2, np.pi / 2
    poses[:, 16, 2], poses[:, 17, 2] = -np.pi / 2, np.pi / 2
    poses[:, 9, 1] = 0.05 * np.sin(2 * np.pi * time)
    trans = np.tile([0.0, 0.0, 0.5], (len(time), 1))
    np.savez(path, poses=poses.reshape(len(time), 156), trans=trans, mocap_framerate=60.0, betas=np.zeros(16), gender="neutral")
    return path
