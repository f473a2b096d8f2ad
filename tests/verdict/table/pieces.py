"""Garment files of the second table: hats, tubes, stoles, cut and asymmetric clothes, and parts that came off.

A ``where`` takes the middles (F, 3) of faces of the garment in the T-pose, x to the body's left, y up, z to the front, and
says of which face it holds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from tests.verdict.table.meshes import Mesh, joined, moved, part, ring, sheet, tube, worn, write_obj
from tests.verdict.table.scene import Maker

Array = np.ndarray
Where = Callable[[Array], Array]


def without(name: str, word: str, where: Where) -> Maker:
    """A garment with a piece cut away: one shoulder, an open side, a hole."""

    def make(folder: Path) -> Path:
        whole = worn(name)
        return write_obj(folder / f"{name}_{word}.obj", part(whole, ~where(_middles(whole))))

    return make


def apart(name: str, word: str, pieces: Sequence[tuple[Where, Sequence[float]]]) -> Maker:
    """Every piece of a garment lies ``shift`` [m] away from it and holds on to nothing."""

    def make(folder: Path) -> Path:
        whole = worn(name)
        rest = np.ones(len(whole[1]), dtype=bool)
        meshes = []
        for where, shift in pieces:
            chosen = where(_middles(whole)) & rest
            meshes.append(moved(part(whole, chosen), shift))
            rest &= ~chosen
        return write_obj(folder / f"{name}_{word}.obj", joined(*([part(whole, rest)] if rest.any() else []), *meshes))

    return make


def turned(name: str, degrees: float, scale: float = 1.0) -> Maker:
    """A garment turned about its upright axis, and scaled about it."""

    def make(folder: Path) -> Path:
        pos, faces = worn(name)
        angle, axis = np.radians(degrees), pos.mean(axis=0) * [1, 0, 1]
        turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        return write_obj(folder / f"{name}_turned.obj", (scale * (pos - axis) @ turn.T + axis, faces))

    return make


def patched(name: str, where: Where, off: float) -> Maker:
    """A pocket: a piece of the garment once more, ``off`` [m] in front of it."""

    def make(folder: Path) -> Path:
        whole = worn(name)
        pocket = moved(part(whole, where(_middles(whole))), (0.0, 0.0, off))
        return write_obj(folder / f"{name}_pocket.obj", joined(whole, pocket))

    return make


def spiked(name: str, metres: float = 0.6) -> Maker:
    """One vertex of the front lies far ahead, as a slip of the hand leaves it."""

    def make(folder: Path) -> Path:
        pos, faces = worn(name)
        pos = pos.copy()
        pos[np.argmax(pos[:, 2])] += [0.0, 0.0, metres]
        return write_obj(folder / f"{name}_spike.obj", (pos, faces))

    return make


def hat(radius: float = 0.108, height: float = 0.17, top: float = 0.915) -> Maker:
    """A round cap on the head, open below."""
    around = 36
    pos, faces = tube(around, 14, (radius, radius * 1.12, radius, radius * 1.12), height)
    share = np.maximum(-pos[:, 1] / height, 0.05)
    wide = np.sqrt(2 * share - share**2)
    pos = pos * np.stack([wide, np.ones_like(wide), wide], axis=1)
    middle = len(pos)
    rim = np.arange(around)
    crown = np.stack([np.full(around, middle), rim, np.roll(rim, -1)], axis=1)
    closed = np.concatenate([pos, [[0.0, 0.004, 0.0]]]), np.concatenate([faces, crown])
    return _file("hat", moved(closed, (0.0, top, 0.055)))


def leg_tube(radius: float, top: float, height: float = 0.22, wider: float = 1.0) -> Maker:
    """Round the left leg, from ``top`` [m] downwards."""
    pos, faces = tube(30, 14, (radius, radius, radius * wider, radius * wider), height)
    return _file("leg_tube", (pos + [0.150, top, -0.012], faces))


def wristband(radius: float = 0.05, along: float = 0.52, height: float = 0.10) -> Maker:
    """Round the right forearm."""
    pos, faces = tube(26, 8, (radius, radius, radius, radius), height)
    level = np.stack([pos[:, 1] - along, pos[:, 0], pos[:, 2]], axis=1)
    return _file("wristband", (level + [0.0, 0.545, 0.0], faces))


def headband(radius: float = 0.09, at: float = 0.84) -> Maker:
    pos, faces = tube(44, 5, (radius, radius * 1.2, radius, radius * 1.2), 0.05)
    return _file("headband", (pos + [0.0, at, 0.056], faces))


def towel(width: float = 0.20, length: float = 0.9, x: float = 0.14, high: float = 0.645) -> Maker:
    """A level strip above the left shoulder, half of it in front, half behind."""
    pos, faces = sheet(12, 46, width, length)
    level = np.stack([pos[:, 0] + x, high + 0 * pos[:, 1], pos[:, 1] + length / 2 + 0.005], axis=1)
    return _file("towel", (level, faces))


def tabard(hole: float = 0.11, reach: float = 0.55, half_width: float = 0.2) -> Maker:
    """A poncho cut to a strip before and behind; with a wide hole it finds no shoulder."""

    def make(folder: Path) -> Path:
        pos, faces = ring(52, 18, hole, reach)
        kept = np.abs(pos[faces].mean(axis=1)[:, 0]) < max(half_width, hole + 0.04)
        return write_obj(folder / "tabard.obj", part((pos + [0.0, 0.66, 0.02], faces), kept))

    return make


def slanted(inner: float = 0.10, outer: float = 0.5) -> Maker:
    """A poncho whose hole is not in its middle: long over the left arm, short over the right one."""
    pos, faces = ring(46, 16, inner, outer)
    reach = (np.linalg.norm(pos[:, [0, 2]], axis=1) - inner) / (outer - inner)
    return _file("slanted", (pos + [0.0, 0.665, 0.01] + (0.16 * reach)[:, None] * [1.0, 0.0, 0.0], faces))


def stole(folder: Path) -> Path:
    """A level sheet over both shoulders and behind the neck; ``pins.txt`` names its two front corners."""
    pos, faces = sheet(44, 16, 1.1, 0.38)
    level = np.stack([pos[:, 0], 0.64 + 0 * pos[:, 1], pos[:, 1] + 0.02], axis=1)
    (folder / "pins.txt").write_text("0\n43\n")
    return write_obj(folder / "stole.obj", (level, faces[:, ::-1]))


def flag(side: float = 0.6, pinned: Sequence[int] = (0, 24 * 25)) -> Maker:
    """An upright sheet held by vertices of one side; ``pins.txt`` names them."""

    def make(folder: Path) -> Path:
        pos, faces = sheet(25, 25, side, side * 0.7)
        (folder / "pins.txt").write_text("\n".join(map(str, pinned)) + "\n")
        return write_obj(folder / "flag.obj", (pos + [0.0, 1.6, 0.0], faces))

    return make


def cover(height: float, wide: float, deep: float, at: Sequence[float] = (0.0, 0.0), edges: int = 30) -> Maker:
    """A level sheet of ``wide`` × ``deep`` [m] above a piece of furniture, its middle ``at`` x, z."""
    pos, faces = sheet(edges, edges, wide, deep)
    level = np.stack([pos[:, 0] + at[0], height + 0 * pos[:, 1], -pos[:, 1] - deep / 2 + at[1]], axis=1)
    return _file("cover", (level, faces[:, ::-1]))


def _file(name: str, mesh: Mesh) -> Maker:
    return lambda folder: write_obj(folder / f"{name}.obj", mesh)


def _middles(mesh: Mesh) -> Array:
    return np.asarray(mesh[0][mesh[1]].mean(axis=1))
