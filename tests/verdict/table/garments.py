"""Garment files of the table: bare pieces of cloth, and garments in parts, turned, torn, misplaced or tangled."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.verdict.table.meshes import Mesh, joined, moved, part, ring, sheet, tube, worn, write_obj
from tests.verdict.table.scene import Maker


def _file(name: str, mesh: Mesh) -> Maker:
    return lambda folder: write_obj(folder / f"{name}.obj", mesh)


def plain(name: str, shift: tuple[float, float, float] = (0, 0, 0), scale: float = 1.0) -> Maker:
    """An embedded garment as a file, moved and scaled."""
    return lambda folder: write_obj(folder / f"{name}.obj", (worn(name)[0] * scale + np.asarray(shift), worn(name)[1]))


def panels(name: str, count: int = 4, away: float = 0.009) -> Maker:
    """Cut by upright planes through its axis; every panel lies so far outwards that the gaps are too wide for a seam."""

    def make(folder: Path) -> Path:
        whole = worn(name)
        axis = whole[0].mean(axis=0)
        middle = whole[0][whole[1]].mean(axis=1) - axis
        angle = np.arctan2(middle[:, 2], middle[:, 0]) + np.pi + 0.3
        which = np.floor(angle / (2 * np.pi) * count).astype(int) % count
        pieces = []
        for number in range(count):
            outwards = middle[which == number].mean(axis=0) * [1.0, 0.0, 1.0]
            pieces.append(moved(part(whole, which == number), away * outwards / np.linalg.norm(outwards)))
        return write_obj(folder / f"{name}_panels.obj", joined(*pieces))

    return make


def sleeves_off(name: str = "tshirt", at: float = 0.2, gap: float = 0.015) -> Maker:
    """The sleeves are tubes of their own, ``gap`` [m] outwards."""

    def make(folder: Path) -> Path:
        whole = worn(name)
        x = whole[0][whole[1]].mean(axis=1)[:, 0]
        left, right = moved(part(whole, x > at), (gap, 0, 0)), moved(part(whole, x < -at), (-gap, 0, 0))
        return write_obj(folder / f"{name}_sleeves.obj", joined(part(whole, np.abs(x) <= at), left, right))

    return make


def cut_across(name: str, at: float, gap: float = 0.015) -> Maker:
    """Cut at a height; what is below lies ``gap`` [m] lower and holds on to nothing."""

    def make(folder: Path) -> Path:
        whole = worn(name)
        y = whole[0][whole[1]].mean(axis=1)[:, 1]
        return write_obj(folder / f"{name}_cut.obj", joined(part(whole, y > at), moved(part(whole, y <= at), (0, -gap, 0))))

    return make


def with_buttons(name: str, count: int = 4, off: float = 0.012) -> Maker:
    """Discs of 2 cm in front of the garment that nothing holds."""

    def make(folder: Path) -> Path:
        whole = worn(name)
        pos = whole[0]
        discs = []
        for height in np.linspace(0.35, 0.05, count):
            near = (np.abs(pos[:, 0]) < 0.04) & (np.abs(pos[:, 1] - height) < 0.06)
            disc, faces = ring(10, 2, 0.002, 0.010)
            discs.append((disc[:, [0, 2, 1]] * [1, -1, 1] + [0.0, height, pos[near, 2].max() + off], faces))
        return write_obj(folder / f"{name}_buttons.obj", joined(whole, *discs))

    return make


def slit(name: str, high: float, half_width: float = 0.012, side: str = "front") -> Maker:
    """Open along the middle of the front, the back or both, below the height ``high`` [m]."""

    def make(folder: Path) -> Path:
        whole = worn(name)
        middle = whole[0][whole[1]].mean(axis=1)
        ahead = middle[:, 2] > whole[0][:, 2].mean()
        where = {"front": ahead, "back": ~ahead, "both": np.ones(len(ahead), bool)}[side]
        cut = where & (np.abs(middle[:, 0]) < half_width) & (middle[:, 1] < high)
        return write_obj(folder / f"{name}_slit.obj", part(whole, ~cut))

    return make


def band(name: str, low: float, high: float) -> Maker:
    """What lies between two heights [m]: a belt, a tube top, a hem."""

    def make(folder: Path) -> Path:
        whole = worn(name)
        y = whole[0][whole[1]].mean(axis=1)[:, 1]
        x = np.abs(whole[0][whole[1]].mean(axis=1)[:, 0])
        return write_obj(folder / f"{name}_band.obj", part(whole, (y > low) & (y < high) & (x < 0.25)))

    return make


def upside_down(name: str) -> Maker:
    """Turned by half about the axis from left to right, in its own place."""

    def make(folder: Path) -> Path:
        pos, faces = worn(name)
        middle = 0.5 * (pos.max(axis=0) + pos.min(axis=0))
        return write_obj(folder / f"{name}_turned.obj", ((pos - middle) * [1, -1, -1] + middle, faces))

    return make


def shrunk_inside(name: str, share: float = 0.45) -> Maker:
    """Drawn towards its upright axis: most of it lies in the trunk."""

    def make(folder: Path) -> Path:
        pos, faces = worn(name)
        axis = pos.mean(axis=0) * [1, 0, 1]
        return write_obj(folder / f"{name}_inside.obj", ((pos - axis) * [share, 1, share] + axis, faces))

    return make


def tangled(name: str, low: float, high: float, through: float = 0.35) -> Maker:
    """Its front between two heights is pushed through its back: the layers have changed places."""

    def make(folder: Path) -> Path:
        pos, faces = worn(name)
        ahead = np.clip((pos[:, 2] - pos[:, 2].mean()) / 0.05, 0, 1)
        inside = np.clip((pos[:, 1] - low) / 0.04, 0, 1) * np.clip((high - pos[:, 1]) / 0.04, 0, 1)
        return write_obj(folder / f"{name}_tangled.obj", (pos - (through * ahead * inside)[:, None] * [0, 0, 1.0], faces))

    return make


def twice(name: str, shift: tuple[float, float, float] = (0, 0, 0.01)) -> Maker:
    """The same garment two times in one file, one moved through the other."""
    return lambda folder: write_obj(folder / f"{name}_twice.obj", joined(worn(name), moved(worn(name), shift)))


def both(first: str, second: str) -> Maker:
    """Two garments in one file."""
    return lambda folder: write_obj(folder / f"{first}_{second}.obj", joined(worn(first), worn(second)))


def cape(folder: Path) -> Path:
    """A sheet behind the back, as wide as the shoulders; ``cape.txt`` beside it names its upper row."""
    pos, faces = sheet(18, 30, 0.40, 0.95)
    pos = np.stack([pos[:, 0] * (1 - 0.5 * pos[:, 1]), pos[:, 1] + 0.60, pos[:, 2] - 0.13], axis=1)
    (folder / "cape.txt").write_text("\n".join(map(str, range(18))) + "\n")
    return write_obj(folder / "cape.obj", (pos, faces))


def scarf(folder: Path) -> Path:
    """A strip round the neck from behind, its ends hang down in front."""
    way = np.array(
        [
            [0.09, 0.20, 0.19],
            [0.09, 0.40, 0.19],
            [0.10, 0.56, 0.13],
            [0.105, 0.635, 0.04],
            [0.09, 0.66, -0.04],
            [0.0, 0.665, -0.085],
        ]
    )
    way = np.concatenate([way, way[-2::-1] * [-1, 1, 1]])
    share = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))])
    at = np.linspace(0, share[-1], 60)
    middle = np.stack([np.interp(at, share, way[:, axis]) for axis in range(3)], axis=1)
    ahead = np.clip(np.abs(np.linspace(-1, 1, 60)) * 3 - 0.6, 0, 1)[:, None]
    across = ahead * [1.0, 0.0, 0.0] + (1 - ahead) * [0.0, 1.0, -0.35]
    side = np.where(at < share[-1] / 2, 1.0, -1.0)[:, None]
    across = ahead * across * [1, 1, 1] + (1 - ahead) * across
    offsets = np.linspace(0.0, 0.10, 6)
    pos = np.stack([middle + offset * across * np.where(ahead > 0.5, side, 1.0) for offset in offsets], axis=1).reshape(-1, 3)
    own = np.arange(360).reshape(60, 6)
    a, b, c, d = (own[:-1, :-1], own[:-1, 1:], own[1:, :-1], own[1:, 1:])
    faces = np.concatenate([np.stack([a, b, c], 2).reshape(-1, 3), np.stack([b, d, c], 2).reshape(-1, 3)])
    return write_obj(folder / "scarf.obj", (pos, faces))


def cowl(folder: Path) -> Path:
    """A loop of cloth round the neck."""
    pos, faces = tube(40, 10, (0.11, 0.11, 0.15, 0.13), 0.14)
    return write_obj(folder / "cowl.obj", (pos + [0.0, 0.70, 0.01], faces))


def poncho(folder: Path) -> Path:
    """A level disc with a hole for the neck."""
    pos, faces = ring(44, 16, 0.105, 0.55)
    reach = np.linalg.norm(pos[:, [0, 2]], axis=1, keepdims=True)
    return write_obj(
        folder / "poncho.obj", (pos + [0.0, 0.66, 0.01] - (0.12 * np.clip(reach - 0.1, 0, None)) * [0, 1.0, 0], faces)
    )


def belt(radius_x: float = 0.155, radius_z: float = 0.125, height: float = 0.06, at: float = 0.22) -> Maker:
    """A ring of cloth round the waist, no more."""
    pos, faces = tube(56, 6, (radius_x, radius_z, radius_x, radius_z), height)
    return _file("belt", (pos + [0.0, at, 0.012], faces))


def armband(radius: float = 0.062, along: float = 0.30) -> Maker:
    """A tube round the left upper arm."""
    pos, faces = tube(28, 9, (radius, radius, radius, radius), 0.12)
    level = np.stack([-pos[:, 1] + along, pos[:, 0], -pos[:, 2]], axis=1)
    return _file("armband", (level + [0.0, 0.552, 0.0], faces))


def dropped(height: float = 0.05, side: float = 1.0, edges: int = 28) -> Maker:
    """A level square above the head."""
    pos, faces = sheet(edges, edges, side, side)
    level = np.stack([pos[:, 0], 0.893 + height + 0 * pos[:, 1], -pos[:, 1] - side / 2 + 0.03], axis=1)
    return _file("dropped", (level, faces[:, ::-1]))


def curtain(pinned: str = "row") -> Maker:
    """A sheet of 0.8 × 0.8 m that hangs; ``pins.txt`` names its upper row, or its upper corners."""

    def make(folder: Path) -> Path:
        rows = range(26) if pinned == "row" else (0, 25)
        (folder / "pins.txt").write_text("\n".join(map(str, rows)) + "\n")
        pos, faces = sheet(26, 26, 0.8, 0.8)
        return write_obj(folder / "curtain.obj", (pos, faces))

    return make


def level_sheet(height: float, side: float = 1.0, edges: int = 26) -> Maker:
    """A level square at a height, for bodies that are no persons; ``rim.txt`` names two opposite rows."""

    def make(folder: Path) -> Path:
        pos, faces = sheet(edges, edges, side, side)
        level = np.stack([pos[:, 0], height + 0 * pos[:, 1], -pos[:, 1] - side / 2], axis=1)
        rows = [*range(edges), *range(edges * (edges - 1), edges * edges)]
        (folder / "rim.txt").write_text("\n".join(map(str, rows)) + "\n")
        return write_obj(folder / "level.obj", (level, faces[:, ::-1]))

    return make
