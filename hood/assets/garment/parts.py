"""Parts of a garment by name: panels, one of an outfit, sleeves, what is above or below a joint, bands along openings, colours,
listed vertices.

Parts of a garment cut larger or smaller than the rest of it, or gathered by elastic.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy import sparse
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from hood.assets.body.body import JOINTS, Body
from hood.assets.files.library import unknown
from hood.assets.files.text import meant, read_indices
from hood.assets.formats.raw_mesh import read_texture
from hood.assets.garment.garment import Garment
from hood.assets.garment.pins import REGIONS, region_loop
from hood.mesh.flat import followed, laid_out, stretched_sides
from hood.mesh.parts import part_labels

#: Colours of vertices that are names of parts.
COLOURS = ("red", "green", "blue")
#: Cloth farther out than the shoulders, by the sides of the body on which it is.
SLEEVES = {"sleeves": ("left", "right"), "sleeve_left": ("left",), "sleeve_right": ("right",)}
#: A vertex is of a colour that exceeds the two others by this much of the full scale.
_STRENGTH = 0.5
#: Faces whose centre is within this [m] of the rim of an opening are its band.
BAND = 0.035


def part_faces(part: str, garment: Garment, body: Body | None) -> np.ndarray:
    """(F,) bool: the faces of a part of ``garment``. Where it borders on others, a face is of the side of its centre, or of
    most of its corners.

    Args:
        part: the name of a panel, as its file has it or folded (:mod:`hood.assets.files.text`), which counts before all else;
            likewise that of a garment of an outfit; ``above_JOINT`` or ``below_JOINT``, by the height of the centre in T-pose,
            the joint by its own name or that of an opening (:data:`hood.assets.garment.pins.REGIONS`); one of
            :data:`SLEEVES`; an opening, for the band of :data:`BAND` along its rim; one of :data:`COLOURS`, of the vertices in
            the mesh file; ``COLOUR@IMAGE``, where the centre of a face lies on that colour of a PNG or JPEG file over the
            texture coordinates; or the path of a ``.txt`` or ``.json`` list of vertices.
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
    elif part in REGIONS:
        found = _band(part, garment, body)
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
        known = unknown(
            "part", part, [*names, *(garment.panels or {}), "above_JOINT", "below_JOINT", *SLEEVES, *REGIONS, *COLOURS]
        )
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


def _band(part: str, garment: Garment, body: Body | None) -> np.ndarray:
    """Near to the rim of an opening, in its piece of cloth."""
    rim = _rim(part, garment, body)
    share = np.linspace(0.0, 1.0, 8)[:, None, None]
    points = ((1.0 - share) * rim + share * np.roll(rim, -1, axis=0)).reshape(-1, 3)
    label = part_labels(len(garment.rest_pos), garment.faces)[garment.faces[:, 0]]
    distance = cKDTree(points).query(_centres(garment))[0]
    return np.asarray((distance < BAND) & (label == label[distance.argmin()]))


def _rim(part: str, garment: Garment, body: Body | None) -> np.ndarray:
    """(L, 3) m: the rim of an opening in T-pose."""
    if body is None:
        raise ValueError(f"part {part!r}: openings need a body with joints; give a list of vertices")
    return np.asarray(garment.worn_pos[region_loop(garment, body, part, "part ")])


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


#: Faces with a smaller sine between their normal and an axis have no direction across it.
_LEVEL = 0.1
#: Weights of edges are cotangents, but for those of flat angles, which are at least this.
_LEAST = 1e-3
#: Pull of every vertex towards its place, as a share of the mean weight: it holds pieces of cloth where they are, no more.
_HOLD = 1e-8


def tailored(garment: Garment, factors: Mapping[str, float], body: Body | None = None) -> Garment:
    """The garment with a rest shape whose parts are larger or smaller; worn where it was.

    Where two parts meet, no cloth has the lengths of both. The new rest shape is the one whose edges are nearest to what
    their faces ask for, in the least squares of gradients that cotangent weights make independent of the mesh, so the step from
    one factor to the next is spread over some edges on both sides.

    Args:
        factors: of lengths, by part (:func:`hood.assets.garment.parts.part_faces`); of parts that overlap the last counts.
        body: whose joints names of parts mean, in T-pose; None refuses these.

    Raises:
        ValueError: a part that the garment does not have.
    """
    factor = np.ones(len(garment.faces))
    for part, value in factors.items():
        factor[part_faces(part, garment, body)] = value
    rest_pos, riders = _stretched(garment.rest_pos, garment.faces, factor), garment.riders
    if riders is not None:
        riders = replace(riders, pos=riders.positions(rest_pos, garment.rest_pos))
    flat = None if garment.flat is None else followed(garment.flat, garment.faces, garment.rest_pos, rest_pos)
    return replace(garment, rest_pos=rest_pos, skin_pos=garment.worn_pos, riders=riders, flat=flat)


def elasticated(garment: Garment, factors: Mapping[str, float], body: Body | None = None) -> Garment:
    """The garment with parts that elastic draws together: shorter at rest by a factor, in one direction, than they are cut.

    That direction runs along the rim of an opening; in a panel of a pattern along its x; in other parts level.

    Args:
        factors: by part (:func:`part_faces`); of parts that overlap the last counts.
        body: as for :func:`tailored`.

    Raises:
        ValueError: a part that the garment does not have.
    """
    elastic = np.ones(garment.faces.shape) if garment.elastic is None else garment.elastic.copy()
    edges = laid_out(torch.as_tensor(garment.rest_pos), torch.as_tensor(garment.faces), garment.flat).numpy()
    for part, factor in factors.items():
        mask, axis = part_faces(part, garment, body), np.array([0.0, 1.0, 0.0])
        if part in REGIONS and part not in (garment.panels or {}):
            rim = _rim(part, garment, body)
            axis = np.cross(rim - rim.mean(axis=0), np.roll(rim, -1, axis=0) - rim.mean(axis=0)).sum(axis=0)
        way = _across(garment, axis / np.linalg.norm(axis))
        along = np.einsum("fi,fix->fx", way, edges)
        if garment.flat is not None and part in (garment.panels or {}):
            along[:] = [1.0, 0.0]
        elastic[mask] = stretched_sides(edges, along, factor)[mask]
    return replace(garment, elastic=elastic)


def _across(garment: Garment, axis: np.ndarray) -> np.ndarray:
    """(F, 2): the direction in every face, as worn, that is across ``axis`` (3,), as shares of its edges x₁ - x₀ and x₂ - x₀;
    zero on faces that are almost across it as a whole."""
    corners = garment.worn_pos[garment.faces]
    edges = corners[:, 1:] - corners[:, :1]
    normal = np.cross(edges[:, 0], edges[:, 1])
    way = np.cross(axis, normal / np.linalg.norm(normal, axis=1, keepdims=True))
    way[np.linalg.norm(way, axis=1) < _LEVEL] = 0.0
    metric = np.einsum("fix,fjx->fij", edges, edges)
    return np.asarray(np.linalg.solve(metric, np.einsum("fix,fx->fi", edges, way)[..., None])[..., 0])


def lengths_of(before: Garment, after: Garment, part: str, body: Body | None = None) -> float:
    """How many times as long the edges of a part are in ``after``, all together."""
    faces = before.faces[part_faces(part, before, body)]
    return float(_edges(after.rest_pos, faces).sum() / _edges(before.rest_pos, faces).sum())


def _stretched(pos: np.ndarray, faces: np.ndarray, factor: np.ndarray) -> np.ndarray:
    """(V, 3) m: ``pos`` (V, 3) with the edges of every face ``factor`` (F,) times as long, as nearly as a mesh can be."""
    count = len(pos)
    rows, values, target = [], [], np.zeros_like(pos)
    for corner in range(3):
        apex, i, j = (faces[:, (corner + step) % 3] for step in range(3))
        a, b = pos[i] - pos[apex], pos[j] - pos[apex]
        area = np.linalg.norm(np.cross(a, b), axis=1)
        weight = np.maximum((a * b).sum(axis=1) / np.maximum(area, 1e-30), _LEAST)
        asked = (weight * factor)[:, None] * (pos[i] - pos[j])
        np.add.at(target, i, asked)
        np.add.at(target, j, -asked)
        rows.append(np.stack([i, j], axis=1))
        values.append(weight)
    ends, weight = np.concatenate(rows), np.concatenate(values)
    off = sparse.coo_matrix((weight, (ends[:, 0], ends[:, 1])), shape=(count, count))
    degree = np.bincount(ends.ravel(), np.repeat(weight, 2), minlength=count)
    hold = _HOLD * degree[degree > 0].mean()
    matrix = sparse.diags(degree + hold) - off - off.T
    return np.asarray(splu(matrix.tocsc()).solve(target + hold * pos))


def _edges(pos: np.ndarray, faces: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.norm(pos[faces] - pos[np.roll(faces, 1, axis=1)], axis=2))
