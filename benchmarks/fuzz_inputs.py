"""Small sound files of every format that is read, each with its reader, and ways to damage them."""

from __future__ import annotations

import base64
import io
import json
import pickle
import struct
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
from omegaconf import DictConfig

from hood.app.settings.compose import load_config
from hood.app.settings.record import require_same_config
from hood.assets.body.load import read_model
from hood.assets.files.text import read_indices
from hood.assets.formats.mesh_file import read_mesh_file
from hood.assets.garment.garment import load_garment
from hood.assets.motion.animated_mesh import load_mesh_sequence
from hood.assets.motion.recording import read_recording
from hood.assets.motion.sequence_edit import read_pose
from hood.assets.pickles.content import load_torch
from hood.rollouts.file.reader import read_rollout
from hood.rollouts.file.recorder import ALARM_COLUMNS
from hood.steppers.checkpoint import load_simulator, save_simulator
from hood.steppers.network import build_simulator
from hood.testing import cylinder

Content = bytes | dict[str, Any]


@dataclass(frozen=True, eq=False)
class Sample:
    """A sound file: its ending, its bytes or the fields that are written into it, and what reads it."""

    reader: str
    suffix: str
    content: Content
    read: Callable[[Path], Any]
    names_file: bool = True  # an error names the file; words of a command line are in none


def samples(folder: Path) -> list[Sample]:
    """A small sound file of every format, and its reader."""
    pos, faces = cylinder(6, 3)
    quads = np.array(
        [[r * 6 + k, r * 6 + (k + 1) % 6, r * 6 + 6 + (k + 1) % 6, r * 6 + 6 + k] for r in range(2) for k in range(6)]
    )
    mesh = lambda path: read_mesh_file(path, split_polygons=True)  # noqa: E731
    rng = np.random.default_rng(0)
    weights = rng.uniform(size=(18, 24))
    garment = {"rest_pos": pos, "faces": faces, "pinned": np.zeros(18, bool), "lbs_weights": weights}
    garment |= {"shapedirs": np.zeros((18, 3, 10)), "uv": pos[:, :2], "uv_faces": faces, "coarse_edges_0": faces[:, :2]}
    entry = {"rest_pos": pos, "faces": faces, "node_type": np.zeros((18, 1), int), "coarse_edges": {3: {0: faces[:, :2]}}}
    entry["lbs"] = {"v": pos, "shapedirs": np.zeros((18, 3, 10)), "lbs_weights": weights}
    amass = {"poses": rng.normal(size=(4, 156)), "trans": np.zeros((4, 3)), "mocap_framerate": np.array(60.0)}
    amass |= {"betas": np.zeros(16), "gender": np.array("neutral")}
    smplx = {"root_orient": np.zeros((4, 3)), "pose_body": np.zeros((4, 63)), "trans": np.zeros((4, 3))}
    smplx |= {"mocap_frame_rate": np.array(30.0), "betas": np.zeros(16)}
    pose = {
        "body_pose": np.zeros((4, 69)),
        "global_orient": np.zeros((4, 3)),
        "transl": np.zeros((4, 3)),
        "betas": np.zeros(10),
    }
    vto = {"pose": np.zeros((4, 72)), "translation": np.zeros((4, 3)), "shape": np.zeros(10)}
    model = {"v_template": pos, "shapedirs": np.zeros((18, 3, 10)), "posedirs": np.zeros((18, 3, 207)), "f": faces}
    model |= {
        "J_regressor": np.full((24, 18), 1 / 18),
        "weights": weights,
        "kintree_table": np.stack([np.arange(24) - 1, np.arange(24)]),
    }
    moving = {"verts": np.stack([pos, pos + 0.1]), "faces": faces, "fps": np.array(30.0)}
    torch_file = io.BytesIO()
    torch.save({"training_module": {"a": torch.zeros(3, 4)}}, torch_file)
    torch.manual_seed(0)  # the same bytes are damaged every time
    save_simulator(folder / "m.safetensors", build_simulator(schedule="1x(mesh)", latent_dim=2))
    return [
        Sample("mesh", "obj", _obj(pos, quads), mesh),
        Sample("mesh", "ply", _ascii_ply(pos, quads), mesh),
        Sample("mesh", "ply", _binary_ply(pos, quads, uniform=True), mesh),
        Sample("mesh", "ply", _binary_ply(pos, quads, uniform=False), mesh),
        Sample("mesh", "off", _off(pos, quads), mesh),
        Sample("mesh", "stl", _stl(pos, faces), mesh),
        Sample("mesh", "stl", _ascii_stl(pos, faces), mesh),
        Sample("mesh", "glb", glb(pos, faces), mesh),
        Sample("moving mesh", "glb", glb(pos, faces), load_mesh_sequence),
        Sample("moving mesh", "gltf", gltf(pos, faces), load_mesh_sequence),
        Sample("garment", "npz", garment, load_garment),
        Sample("garment", "pkl", {"dress": entry}, load_garment),
        Sample("garment", "pkl", {"vertices": pos, "faces": faces, "coarse_edges": entry["coarse_edges"]}, load_garment),
        Sample("vertex list", "txt", b"1 2 3\n4, 5 # six\n", read_indices),
        Sample("vertex list", "json", b"[1, 2, 3, 44]", read_indices),
        Sample("pose", "json", json.dumps([0.1] * 72).encode(), read_pose),
        Sample("pose", "npy", _npy(np.zeros(72)), read_pose),
        Sample("motion", "npz", amass, read_recording),
        Sample("motion", "npz", smplx, read_recording),
        Sample("motion", "pkl", pose, read_recording),
        Sample("motion", "pkl", vto, read_recording),
        Sample("body", "npz", model, read_model),
        Sample("body", "pkl", model, read_model),
        Sample("moving mesh", "npz", moving, load_mesh_sequence),
        Sample("moving mesh", "pkl", moving, load_mesh_sequence),
        Sample("moving mesh", "h5", _h5(moving), load_mesh_sequence),
        Sample("rollout", "h5", rollout(pos, faces), read_rollout),
        Sample("weights", "pth", torch_file.getvalue(), load_torch),
        Sample("weights", "safetensors", (folder / "m.safetensors").read_bytes(), load_simulator),
        Sample("words", "txt", _WORDS, read_words, names_file=False),
        Sample("run record", "yaml", _RECORD, read_record),
        Sample("moving mesh", "pc2", _pc2(np.stack([pos, pos + 0.1])), lambda path: read_cache(path, _obj(pos, quads))),
    ]


#: Words of a command, one a line.
_WORDS = b"""garment=tank
num_frames=3
material.density=0.3
losses=default
refine=5
metrics={fields:[rg]}
betas=[1.5,0,-1]
cloth_contact={friction:0.5}
solver.max_iterations=7"""
#: What a run leaves about its settings, in a few lines.
_RECORD = b"""seed: 0
output: outputs/train
losses: {_target_: hood.energies.potential.default_potential, x: [1, 2.5, null, text]}
trainer:
  lr: 1.0e-3
  nested: {a: {b: [1, 2, {c: 3}]}}
"""


def read_words(path: Path) -> Any:
    """The settings of ``hood rollout`` with these words."""
    return load_config("rollout", path.read_bytes().decode("latin-1").split("\n"))


def read_cache(path: Path, mesh: bytes) -> Any:
    """A point cache with its mesh beside it."""
    beside = path.with_suffix(".obj")
    beside.write_bytes(mesh)
    try:
        return load_mesh_sequence(path)
    finally:
        beside.unlink()


def _pc2(verts: np.ndarray) -> bytes:
    head = struct.pack("<12siiffi", b"POINTCACHE2\0", 1, verts.shape[1], 0.0, 1.0, len(verts))
    return head + verts.astype("<f4").tobytes()


def read_record(path: Path) -> None:
    """A run's record, compared with settings; ones that differ are an error of their own."""
    record = path.with_name("config.yaml")
    path.replace(record)
    try:
        require_same_config(_settings(), path.parent, ())
    finally:
        record.replace(path)


@cache
def _settings() -> DictConfig:
    return load_config("train")


def _obj(pos: np.ndarray, quads: np.ndarray) -> bytes:
    lines = [f"v {x} {y} {z} 1 0 0" for x, y, z in pos] + [f"vt {x} {y}" for x, y, _ in pos] + ["vn 0 0 1"]
    return "\n".join([*lines, *("f " + " ".join(f"{c}/{c}/1" for c in face) for face in quads + 1)]).encode()


def _ply_head(form: str, count: int, size: str) -> str:
    properties = (
        "".join(f"property float {axis}\n" for axis in "xyz")
        + "property uchar red\nproperty uchar green\nproperty uchar blue\n"
    )
    faces = f"element face {count}\nproperty list {size} int vertex_indices\nend_header\n"
    return f"ply\nformat {form} 1.0\nelement vertex 18\n{properties}{faces}"


def _ascii_ply(pos: np.ndarray, quads: np.ndarray) -> bytes:
    rows = [f"{x} {y} {z} 255 0 0" for x, y, z in pos] + ["4 " + " ".join(map(str, face)) for face in quads]
    return (_ply_head("ascii", len(quads), "uchar") + "\n".join(rows)).encode()


def _binary_ply(pos: np.ndarray, quads: np.ndarray, uniform: bool) -> bytes:
    body = b"".join(row.astype("<f4").tobytes() + b"\xff\0\0" for row in pos)
    rows = [quads[k] if uniform or k % 2 else quads[k, :3] for k in range(len(quads))]
    body += b"".join(np.uint32(len(row)).tobytes() + row.astype("<i4").tobytes() for row in rows)
    return _ply_head("binary_little_endian", len(quads), "uint").encode() + body


def _off(pos: np.ndarray, quads: np.ndarray) -> bytes:
    rows = [
        "OFF",
        f"18 {len(quads)} 0",
        *(f"{x} {y} {z}" for x, y, z in pos),
        *("4 " + " ".join(map(str, face)) for face in quads),
    ]
    return "\n".join(rows).encode()


def _stl(pos: np.ndarray, faces: np.ndarray) -> bytes:
    body = b"".join(b"\0" * 12 + pos[face].astype("<f4").tobytes() + b"\0\0" for face in faces)
    return b"\0" * 80 + np.uint32(len(faces)).tobytes() + body


def _ascii_stl(pos: np.ndarray, faces: np.ndarray) -> bytes:
    lines = ["solid s"]
    for face in faces:
        lines += ["facet normal 0 0 1", "outer loop", *(f"vertex {x} {y} {z}" for x, y, z in pos[face]), "endloop", "endfacet"]
    return "\n".join([*lines, "endsolid s"]).encode()


def document(pos: np.ndarray, faces: np.ndarray) -> tuple[dict[str, Any], bytes]:
    """A glTF document of two nodes, and its buffer."""
    parts = [pos.astype("<f4").tobytes(), faces.astype("<u4").tobytes(), pos[:, :2].astype("<f4").tobytes()]
    starts = np.cumsum([0, *map(len, parts)]).tolist()
    content = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "translation": [0, 1, 0], "children": [1]}, {"mesh": 0, "scale": [2, 2, 2]}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 2}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": len(pos), "type": "VEC3"},
            {"bufferView": 1, "componentType": 5125, "count": faces.size, "type": "SCALAR"},
            {"bufferView": 2, "componentType": 5126, "count": len(pos), "type": "VEC2"},
        ],
        "bufferViews": [{"buffer": 0, "byteOffset": a, "byteLength": b - a} for a, b in zip(starts, starts[1:], strict=False)],
        "buffers": [{"byteLength": starts[-1]}],
    }  # fmt: skip
    return content, b"".join(parts)


def gltf(pos: np.ndarray, faces: np.ndarray, uri: str | None = None) -> bytes:
    """The document as text, its buffer in it or at ``uri``."""
    content, binary = document(pos, faces)
    content["buffers"][0]["uri"] = uri or "data:application/octet-stream;base64," + base64.b64encode(binary).decode()
    return json.dumps(content).encode()


def glb(pos: np.ndarray, faces: np.ndarray) -> bytes:
    """The document and its buffer in one binary file."""
    content, binary = document(pos, faces)
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    chunks = np.uint32(len(text)).tobytes() + b"JSON" + text + np.uint32(len(binary)).tobytes() + b"BIN\0" + binary
    return b"glTF" + np.array([2, 12 + len(chunks)], "<u4").tobytes() + chunks


def _npy(array: np.ndarray) -> bytes:
    content = io.BytesIO()
    np.save(content, array)
    return content.getvalue()


def _h5(arrays: dict[str, Any]) -> bytes:
    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        for key, value in arrays.items():
            file[key] = value
    return content.getvalue()


def rollout(pos: np.ndarray, faces: np.ndarray) -> bytes:
    """A rollout file of two frames, with an alarm of a guard."""
    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        file["cloth/pos"] = file["body/pos"] = np.stack([pos, pos])
        file["cloth/faces"] = file["body/faces"] = faces
        file["cloth/rest_pos"], file["time"], file["metrics/strain_p50"] = pos, np.arange(2.0), np.zeros(2)
        for name, kind in ALARM_COLUMNS.items():
            file[f"guard/{name}"] = np.array([b"strain" if kind.kind == "S" else 1], dtype=kind)
        own = {"num_frames": 2, "num_planned": 2, "num_alarms": 1, "guard": "report"}
        file.attrs.update({**own, "complete": True, "dt": 1 / 30})
    return content.getvalue()


def encode(suffix: str, content: Content, rng: np.random.Generator | None = None) -> bytes:
    """The bytes of a file; with ``rng``, of one whose fields were changed."""
    if isinstance(content, bytes):
        return content
    fields = dict(content) if rng is None else change_fields(content, rng)
    if suffix == "pkl":
        return pickle.dumps(fields)
    file = io.BytesIO()
    np.savez(file, **{key: np.asarray(value) for key, value in fields.items()})
    return file.getvalue()


def change_fields(fields: dict[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    """Some fields missing, of other shapes, types and values; nested ones too."""
    changed = dict(fields)
    key = list(changed)[rng.integers(len(changed))]
    if isinstance(changed[key], dict) and rng.random() < 0.8:
        changed[key] = change_fields(changed[key], rng)
        return changed
    value = np.asarray(changed[key]) if not isinstance(changed[key], dict) else np.zeros(3)
    big = np.iinfo(np.int64).max
    options: list[Callable[[], Any]] = [
        lambda: changed.pop(key),
        lambda: value.reshape(-1),
        lambda: value[None],
        lambda: value[:0] if value.ndim else value,
        lambda: np.repeat(value.reshape(-1), 3),
        lambda: np.full(value.shape, np.nan),
        lambda: np.full(value.shape, 1e300),
        lambda: np.full(value.shape, big),
        lambda: -np.ones(value.shape, int),
        lambda: value.astype(str) if value.dtype != object else value,
        lambda: value.astype(complex) if value.dtype.kind in "biuf" else value,
        lambda: np.array(["text", "more"]),
        lambda: "text",
        lambda: 7,
        lambda: np.zeros(0),
        lambda: np.zeros((2, 0, 3)),
    ]
    new = options[rng.integers(len(options))]()
    if key in changed:
        changed[key] = new
    return changed


def damage(content: bytes, rng: np.random.Generator) -> bytes:
    """Bits flipped, the end cut off, numbers made huge, parts repeated, removed or overwritten."""
    data = bytearray(content)
    kind, size = rng.integers(7), len(content)
    place = int(rng.integers(size))
    if kind == 0:
        for bit in rng.integers(8 * size, size=rng.integers(1, 30)):
            data[bit // 8] ^= 1 << (bit % 8)
    elif kind == 1:
        del data[place:]
    elif kind == 2:
        huge = [b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\xff" * 8, b"\xff" * 7 + b"\x7f", b"\0" * 8]
        value = huge[rng.integers(len(huge))]
        data[place : place + len(value)] = value
    elif kind == 3:
        digits = [index for index, byte in enumerate(data) if 48 <= byte <= 57]
        at = digits[rng.integers(len(digits))] if digits else place
        data[at : at + 1] = [b"99999999999", b"-1", b"1e400", b"nan", b"4294967296"][rng.integers(5)]
    elif kind == 4:
        data[place:place] = data[place : place + int(rng.integers(1, 400))] * int(rng.integers(1, 50))
    elif kind == 5:
        del data[place : place + int(rng.integers(1, 200))]
    else:
        data[place : place + 32] = rng.bytes(32)
    return bytes(data)
