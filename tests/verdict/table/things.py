"""Bodies of the second table: low-poly and other people, puppets of several parts, furniture, glTF with moving nodes."""

from __future__ import annotations

import base64
import json
from pathlib import Path

import numpy as np

from hood.testing import box, sphere
from tests.verdict.table.bodies import person
from tests.verdict.table.meshes import Mesh, body, joined, moved, tube, write_obj
from tests.verdict.table.scene import Maker

Array = np.ndarray
_FPS = 30.0


def low_poly(cell: float = 0.035) -> Maker:
    """The default body in its T-pose, its vertices drawn together in cells of ``cell`` [m]."""

    def make(folder: Path) -> Path:
        pos, faces = np.asarray(body().v_template, dtype=np.float64), np.asarray(body().faces)
        _, own = np.unique(np.floor(pos / cell).astype(int), axis=0, return_inverse=True)
        own = own.reshape(-1)
        count = np.bincount(own)
        middle = np.stack([np.bincount(own, pos[:, axis]) / count for axis in range(3)], axis=1)
        rows = own[faces]
        kept = (rows[:, 0] != rows[:, 1]) & (rows[:, 1] != rows[:, 2]) & (rows[:, 2] != rows[:, 0])
        _, first = np.unique(np.sort(rows[kept], axis=1), axis=0, return_index=True)
        return write_obj(folder / "low_poly.obj", (middle, rows[kept][np.sort(first)]))

    return make


def other_person(name: str, first: int, count: int, scale: float = 1.0, jump: float = 0.0, at: int = 10) -> Maker:
    """The default body on a motion as vertices, scaled; it jumps by ``jump`` [m] at frame ``at``."""

    def make(folder: Path) -> Path:
        with np.load(person(name, first, count)(folder)) as file:
            verts, faces = file["verts"].astype(np.float64), file["faces"]
        aside = jump * (np.arange(len(verts)) >= at)
        np.savez(folder / "other.npz", verts=scale * verts + aside[:, None, None] * [1.0, 0.0, 0.0], faces=faces, fps=_FPS)
        return folder / "other.npz"

    return make


def puppet(swing: float = 0.05, count: int = 24) -> Maker:
    """Six egg-shaped parts that do not touch in every place: trunk, head, two arms, two legs; it rocks from side to side."""

    def make(folder: Path) -> Path:
        pos, faces = _puppet()
        phase = np.sin(2 * np.pi * np.arange(count) / count)
        lean = swing * phase[:, None] * (pos[:, 1] + 0.8)
        verts = pos + lean[:, :, None] * [1.0, 0.0, 0.0]
        np.savez(folder / "puppet.npz", verts=verts, faces=faces, fps=_FPS)
        return folder / "puppet.npz"

    return make


def _puppet() -> Mesh:
    def egg(middle: tuple[float, float, float], radii: tuple[float, float, float]) -> Mesh:
        pos, faces = sphere(3, 1.0)
        return pos * radii + middle, faces

    return joined(
        egg((0, 0.28, 0.03), (0.17, 0.36, 0.115)),
        egg((0, 0.76, 0.04), (0.09, 0.13, 0.1)),
        egg((0.43, 0.545, 0), (0.30, 0.055, 0.05)),
        egg((-0.43, 0.545, 0), (0.30, 0.055, 0.05)),
        egg((0.11, -0.42, 0), (0.085, 0.42, 0.08)),
        egg((-0.11, -0.42, 0), (0.085, 0.42, 0.08)),
    )


def chair(folder: Path) -> Path:
    """Seat, back and four legs, six boxes in one file."""
    seat, faces = box(8, 0.45)
    boxes = [(seat * [1, 0.12, 1] + [0, 0.44, 0], faces), (seat * [1, 1.1, 0.12] + [0, 0.70, -0.22], faces)]
    boxes += [(seat * [0.1, 0.9, 0.1] + [x, 0.2, z], faces) for x in (-0.19, 0.19) for z in (-0.19, 0.19)]
    return write_obj(folder / "chair.obj", joined(*boxes))


def post(folder: Path) -> Path:
    """A thick round post with a ball on it."""
    pos, faces = sphere(3, 1.0)
    return write_obj(
        folder / "post.obj", joined((pos * [0.09, 0.5, 0.09] + [0, 0.5, 0], faces), moved((0.2 * pos, faces), (0, 1.05, 0)))
    )


def ramp(degrees: float = 40.0) -> Maker:
    """A cube of 60 cm, turned about x: what lies on it slides off."""

    def make(folder: Path) -> Path:
        pos, faces = box(10, 0.6)
        angle = np.radians(degrees)
        turn = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
        return write_obj(folder / "ramp.obj", (pos @ turn.T + [0.0, 0.5, 0.0], faces))

    return make


def turntable(turns: float = 1.0, count: int = 24, radius: float = 0.2) -> Maker:
    """A ball that turns about the upright axis ``turns`` times a second."""

    def make(folder: Path) -> Path:
        pos, faces = sphere(3, radius)
        angle = 2 * np.pi * turns * np.maximum(np.arange(count) - 4, 0) / _FPS
        x = np.cos(angle)[:, None] * pos[:, 0] + np.sin(angle)[:, None] * pos[:, 2]
        z = np.cos(angle)[:, None] * pos[:, 2] - np.sin(angle)[:, None] * pos[:, 0]
        verts = np.stack([x, np.broadcast_to(pos[:, 1] + 0.5, x.shape), z], axis=2)
        np.savez(folder / "turntable.npz", verts=verts, faces=faces, fps=_FPS)
        return folder / "turntable.npz"

    return make


def blade(speed: float, height: float = 0.5, count: int = 14) -> Maker:
    """An upright plate of 3 mm, 40 cm wide, that rises at ``speed`` [m/s]."""

    def make(folder: Path) -> Path:
        pos, faces = box(10, 1.0)
        rise = height - 0.35 + np.maximum(np.arange(count) - 2, 0) * speed / _FPS
        verts = pos * [0.4, 0.6, 0.003] + rise[:, None, None] * [0.0, 1.0, 0.0]
        np.savez(folder / "blade.npz", verts=verts, faces=faces, fps=_FPS)
        return folder / "blade.npz"

    return make


def pendulum(metres: float = 0.25, seconds: float = 0.8) -> Maker:
    """A glTF file of two nodes: a still post, and a ball above it that is moved to and fro by an animation."""

    def make(folder: Path) -> Path:
        ball, bar = sphere(3, 0.18), tube(20, 8, (0.05, 0.05, 0.05, 0.05), 0.3)
        time = np.linspace(0.0, seconds, 25)
        place = np.stack([metres * np.sin(2 * np.pi * time / seconds), 0.5 + 0 * time, 0 * time], axis=1)
        (folder / "pendulum.gltf").write_text(json.dumps(_gltf(ball, (bar[0] + [0.0, 0.15, 0.0], bar[1]), time, place)))
        return folder / "pendulum.gltf"

    return make


def _gltf(first: Mesh, second: Mesh, time: Array, place: Array) -> dict[str, object]:
    """Two nodes of a mesh each; the first is moved along ``place`` (N, 3) at ``time`` (N,)."""
    arrays = [first[0], first[1], second[0], second[1], time, place]
    blob, views, accessors = b"", [], []
    for values in arrays:
        whole = values.dtype.kind == "i"
        rows = np.ascontiguousarray(values.reshape(-1) if whole else values, dtype=np.uint32 if whole else np.float32)
        views.append({"buffer": 0, "byteOffset": len(blob), "byteLength": rows.nbytes})
        entry = {"bufferView": len(views) - 1, "componentType": 5125 if whole else 5126, "count": len(rows)}
        entry |= {"type": "SCALAR" if rows.ndim == 1 else "VEC3"}
        if not whole:
            least, most = np.atleast_1d(rows.min(axis=0)), np.atleast_1d(rows.max(axis=0))
            entry |= {"min": least.tolist(), "max": most.tolist()}
        accessors.append(entry)
        blob += rows.tobytes()
    text = base64.b64encode(blob).decode()
    meshes = [{"primitives": [{"attributes": {"POSITION": row}, "indices": row + 1}]} for row in (0, 2)]
    channel = {"sampler": 0, "target": {"node": 0, "path": "translation"}}
    return {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0, 1]}],
        "nodes": [{"mesh": 0, "name": "ball", "translation": place[0].tolist()}, {"mesh": 1, "name": "post"}],
        "meshes": meshes,
        "animations": [{"samplers": [{"input": 4, "output": 5, "interpolation": "LINEAR"}], "channels": [channel]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(blob), "uri": "data:application/octet-stream;base64," + text}],
    }
