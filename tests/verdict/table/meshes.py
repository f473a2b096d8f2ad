"""Small meshes and the ways to write them: sheets, tubes, discs, OBJ files of one or more parts."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hood.assets.body.body import Body
from hood.assets.body.load import load_body
from hood.assets.garment.garment import load_garment

Array = np.ndarray
#: Vertices (V, 3) [m] and faces (F, 3).
Mesh = tuple[Array, Array]


def body() -> Body:
    return load_body()


def worn(name: str) -> Mesh:
    """An embedded garment as it is worn in the T-pose of the mean body."""
    garment = load_garment(name)
    return garment.tpose(np.zeros(10)), garment.faces


def sheet(across: int, down: int, width: float, height: float) -> Mesh:
    """In the plane z = 0, centred along x, from y = 0 downwards."""
    x, y = np.meshgrid(np.linspace(-width / 2, width / 2, across), -np.linspace(0.0, height, down))
    first = (np.arange(down - 1)[:, None] * across + np.arange(across - 1)).ravel()
    faces = np.concatenate(
        [np.stack([first, first + across, first + 1], 1), np.stack([first + 1, first + across, first + across + 1], 1)]
    )
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1), faces


def tube(around: int, rows: int, radii: Sequence[float], height: float) -> Mesh:
    """About the y axis; ``radii`` along x and z at the top, along x and z below."""
    angle = 2.0 * np.pi * np.arange(around) / around
    share = np.linspace(0.0, 1.0, rows)[:, None]
    wide, deep = (1 - share) * radii[0] + share * radii[2], (1 - share) * radii[1] + share * radii[3]
    pos = np.stack([wide * np.cos(angle), -height * share + 0 * angle, -deep * np.sin(angle)], axis=2).reshape(-1, 3)
    own = np.arange(rows * around).reshape(rows, around)
    a, b = own[:-1], np.roll(own, -1, axis=1)[:-1]
    c, d = own[1:], np.roll(own, -1, axis=1)[1:]
    faces = np.concatenate([np.stack([a, c, b], 2).reshape(-1, 3), np.stack([b, c, d], 2).reshape(-1, 3)])
    return pos, faces


def ring(around: int, rows: int, inner: float, outer: float) -> Mesh:
    """Level, with a round hole."""
    pos, faces = tube(around, rows, (inner, inner, outer, outer), 0.0)
    return pos, faces


def part(mesh: Mesh, chosen: Array) -> Mesh:
    """The faces ``chosen`` (F,) with their own vertices."""
    pos, faces = mesh
    used, local = np.unique(faces[chosen], return_inverse=True)
    return pos[used], local.reshape(-1, 3)


def joined(*meshes: Mesh) -> Mesh:
    """Several meshes as one of as many parts."""
    firsts = np.cumsum([0, *(len(pos) for pos, _ in meshes)])
    faces = [faces + first for (_, faces), first in zip(meshes, firsts, strict=False)]
    return np.concatenate([pos for pos, _ in meshes]), np.concatenate(faces)


def moved(mesh: Mesh, shift: Sequence[float]) -> Mesh:
    return mesh[0] + np.asarray(shift, dtype=np.float64), mesh[1]


def write_obj(path: Path, mesh: Mesh) -> Path:
    pos, faces = mesh
    rows = [f"v {x:.7f} {y:.7f} {z:.7f}" for x, y, z in pos.tolist()] + [f"f {a} {b} {c}" for a, b, c in (faces + 1).tolist()]
    path.write_text("\n".join(rows) + "\n")
    return path
