"""Bodies of the table that have no skeleton: a person as a moving or still mesh, a table, a ball."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from hood.assets.garment.garment import load_garment
from hood.assets.motion.load import load_sequence
from hood.assets.motion.sequence import PoseSequence
from hood.scene.scene import build_scene
from hood.testing import box, sphere
from tests.verdict.table.meshes import body, write_obj
from tests.verdict.table.scene import Maker

_FPS = 30.0


def person(name: str = "walk_proud", first: int = 40, count: int = 20, folder_of: bool = False) -> Maker:
    """The default body on a motion, as an ``.npz`` of vertices, or as a folder of OBJ files."""

    def make(folder: Path) -> Path:
        verts = _verts(_window(name, first, count))
        if not folder_of:
            np.savez(folder / "person.npz", verts=verts.astype(np.float32), faces=body().faces, fps=_FPS)
            return folder / "person.npz"
        (folder / "frames").mkdir(exist_ok=True)
        for frame, pos in enumerate(verts):
            write_obj(folder / "frames" / f"frame_{frame:03d}.obj", (pos, body().faces))
        return folder / "frames"

    return make


def worn_at_first(garment: str, name: str = "walk_proud", first: int = 40) -> Maker:
    """The garment as it is worn in the first frame of :func:`person`."""

    def make(folder: Path) -> Path:
        scene = build_scene(load_garment(garment), body(), _window(name, first, 2))
        state = scene.start(0, relaxed=False, thorough=True)
        pos = state.pos.double().numpy() + state.origin[0].numpy()
        return write_obj(folder / f"{garment}.obj", (pos, scene.garment.faces))

    return make


def mannequin(folder: Path) -> Path:
    """The default body in its T-pose, still."""
    return write_obj(folder / "mannequin.obj", (body().v_template, body().faces))


def table(folder: Path) -> Path:
    """A cube of 60 cm whose top is at y = 0.7."""
    pos, faces = box(10, 0.6)
    return write_obj(folder / "table.obj", (pos + [0.0, 0.4, 0.0], faces))


def ball(speed: float, height: float = 0.5, radius: float = 0.2, count: int = 16) -> Maker:
    """A ball that rises from below a height at ``speed`` [m/s]."""

    def make(folder: Path) -> Path:
        pos, faces = sphere(3, radius)
        rise = height - radius - 0.05 + np.maximum(np.arange(count) - 2, 0) * speed / _FPS
        np.savez(folder / "ball.npz", verts=pos + rise[:, None, None] * [0.0, 1.0, 0.0], faces=faces, fps=_FPS)
        return folder / "ball.npz"

    return make


def spear(speed: float, height: float = 0.5, count: int = 12) -> Maker:
    """A spindle of 1 m, 8 cm thick, that rises through a height at ``speed`` [m/s]."""

    def make(folder: Path) -> Path:
        pos, faces = sphere(3, 1.0)
        rise = height - 0.7 + np.arange(count) * speed / _FPS
        np.savez(
            folder / "spear.npz", verts=pos * [0.04, 0.5, 0.04] + rise[:, None, None] * [0.0, 1.0, 0.0], faces=faces, fps=_FPS
        )
        return folder / "spear.npz"

    return make


def _window(name: str, first: int, count: int) -> PoseSequence:
    return load_sequence(name).window(first, first + count)


def _verts(sequence: PoseSequence) -> np.ndarray:
    still = np.zeros(10)
    local = body().surface(sequence, still, torch.float64).numpy()
    return np.asarray(local + body().translation(sequence, still)[:, None])
