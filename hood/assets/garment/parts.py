"""Parts of a garment by name: panels, one of an outfit, sleeves, what is above or below a joint, colours, listed vertices."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hood.assets.body.body import JOINTS, Body
from hood.assets.files.folded import meant
from hood.assets.files.index_list import read_indices
from hood.assets.files.library import unknown
from hood.assets.formats.image import read_texture
from hood.assets.garment.garment import Garment
from hood.assets.garment.pins import REGIONS

#: Colours of vertices that are names of parts.
COLOURS = ("red", "green", "blue")
#: Cloth farther out than the shoulders, by the sides of the body on which it is.
SLEEVES = {"sleeves": ("left", "right"), "sleeve_left": ("left",), "sleeve_right": ("right",)}
#: A vertex is of a colour that exceeds the two others by this much of the full scale.
_STRENGTH = 0.5


def part_faces(part: str, garment: Garment, body: Body | None) -> np.ndarray:
    """(F,) bool: the faces of a part of ``garment``. Where it borders on others, a face is of the side of its centre, or of
    most of its corners.

    Args:
        part: the name of a panel, as its file has it or folded (:mod:`hood.assets.files.folded`), which counts before all else;
            likewise that of a garment of an outfit; ``above_JOINT`` or ``below_JOINT``, by the height of the centre in T-pose,
            the joint by its own name or that of an opening (:data:`hood.assets.garment.pins.REGIONS`); one of
            :data:`SLEEVES`; one of :data:`COLOURS`, of the vertices in the mesh file; ``COLOUR@IMAGE``, where the centre of a
            face lies on that colour of a PNG or JPEG file over the texture coordinates; or the path of a ``.txt`` or ``.json``
            list of vertices.
        body: whose joints are meant, in T-pose; None refuses them.

    Raises:
        ValueError: the garment has no such part, or no face in it; names what there is.
    """
    side, _, joint = part.partition("_")
    panel = meant(part, garment.panels or {})
    if garment.panels is not None and panel is not None:
        found = np.asarray(garment.panels[panel])
    elif part in SLEEVES:
        found = _sleeves(part, garment, body)
    elif side in ("above", "below") and joint:
        found = _beside(part, side, joint, garment, body)
    elif "@" in part:
        found = _imaged(part, garment)
    elif Path(part).suffix.lower() in (".txt", ".json"):
        found = _listed(Path(part).expanduser(), garment)
    elif part in COLOURS:
        found = _coloured(part, garment)
    else:
        found = _piece(part, garment)
    if not found.any():
        raise ValueError(f"part {part!r}: no face of garment {garment.name!r} is in it; leave it out, or choose another")
    return found


def _piece(part: str, garment: Garment) -> np.ndarray:
    names = garment.name.split("+")
    piece = meant(part, names)
    if piece is None:
        known = unknown("part", part, [*names, *(garment.panels or {}), "above_JOINT", "below_JOINT", *SLEEVES, *COLOURS])
        raise ValueError(f"garment {garment.name!r}: {known}; COLOUR@IMAGE, or a .txt or .json list of vertices")
    if garment.piece is None or len(names) == 1:
        return np.ones(len(garment.faces), dtype=bool)
    return np.asarray(garment.piece[garment.faces[:, 0]] == names.index(piece))


def _beside(part: str, side: str, joint: str, garment: Garment, body: Body | None) -> np.ndarray:
    name = REGIONS.get(joint, joint)
    if name not in JOINTS:
        raise ValueError(f"part {part!r}: {unknown('joint', joint, [*REGIONS, *JOINTS])}")
    above = _centres(garment)[:, 1] > _joint(part, name, body)[1]
    return np.asarray(above if side == "above" else ~above)


def _sleeves(part: str, garment: Garment, body: Body | None) -> np.ndarray:
    """Farther out than a shoulder, and above the chest: a wide skirt is no sleeve."""
    centres = _centres(garment)
    high = centres[:, 1] > _joint(part, "spine2", body)[1]
    found = np.zeros(len(centres), dtype=bool)
    for side in SLEEVES[part]:
        out = _joint(part, f"{side}_shoulder", body)[0]
        found |= high & (centres[:, 0] * np.sign(out) > abs(out))
    return found


def _centres(garment: Garment) -> np.ndarray:
    """(F, 3) m, in T-pose."""
    pos = garment.worn_pos
    return np.asarray(pos[garment.faces].mean(axis=1))


def _joint(part: str, name: str, body: Body | None) -> np.ndarray:
    """(3,) m, of the mean body in T-pose."""
    if body is None:
        raise ValueError(f"part {part!r}: places of joints need a body with joints; give a list of vertices")
    joints = body.shaped(np.zeros(0))[1]
    if JOINTS.index(name) >= len(joints):
        raise ValueError(f"part {part!r}: the body has {len(joints)} joints and no {name}; give another part")
    return np.asarray(joints[JOINTS.index(name)])


def _listed(path: Path, garment: Garment) -> np.ndarray:
    inside = np.zeros(len(garment.rest_pos), dtype=bool)
    inside[garment.numbers_of(read_indices(path), str(path))] = True
    return _of_most_corners(inside, garment)


def _imaged(part: str, garment: Garment) -> np.ndarray:
    """Faces whose centre, in texture coordinates, lies on a pixel of the colour; the image repeats. Garments of an
    outfit that have no coordinates lie in one point, and are not meant."""
    colour, _, file = part.partition("@")
    if colour not in COLOURS:
        raise ValueError(f"part {part!r}: {unknown('colour', colour, COLOURS)}; give COLOUR@IMAGE, such as red@map.png")
    if garment.uv is None or garment.uv_faces is None:
        raise ValueError(
            f"part {part!r}: garment {garment.name!r} has no texture coordinates, over which the image could lie; "
            "save it with them, or choose another part"
        )
    try:
        pixels = read_texture(Path(file).expanduser()).pixels()
    except (ValueError, FileNotFoundError) as error:
        raise ValueError(f"part {part!r}: {error}") from error
    height, width = pixels.shape[:2]
    corners = garment.uv[garment.uv_faces]
    centre, spread = corners.mean(axis=1), (corners != corners[:, :1]).any(axis=(1, 2))
    column = np.floor(centre[:, 0] * width).astype(np.int64) % width
    row = np.floor((1.0 - centre[:, 1]) * height).astype(np.int64) % height
    return spread & _is_colour(colour, pixels[row, column] / 255.0)


def _coloured(colour: str, garment: Garment) -> np.ndarray:
    return _of_most_corners(coloured_vertices(colour, garment), garment)


def coloured_vertices(colour: str, garment: Garment) -> np.ndarray:
    """(V,) bool: the vertices of one of :data:`COLOURS`.

    Raises:
        ValueError: the garment has no colours.
    """
    if garment.colours is None:
        raise ValueError(f"part {colour!r}: {garment.name!r} has no vertex colours; paint the part and export colours")
    return _is_colour(colour, garment.colours)


def _is_colour(colour: str, values: np.ndarray) -> np.ndarray:
    """(N,) bool of colours (N, 3), 0 to 1."""
    own = COLOURS.index(colour)
    return np.asarray(values[:, own] - np.delete(values, own, axis=1).max(axis=1) > _STRENGTH)


def _of_most_corners(inside: np.ndarray, garment: Garment) -> np.ndarray:
    return np.asarray(inside[garment.faces].sum(axis=1) >= 2)
