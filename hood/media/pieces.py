"""The garments in a rollout, one by one, with their texture coordinates.

Colours that tell the garments of an outfit apart, how fabrics look, and how thick they are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hood.assets.material import Material, values_of
from hood.media.renderer.render import FUZZ, GARMENT_COLOR, SHEEN
from hood.mesh import topology
from hood.rollouts.file.reader import RolloutData

#: Of a fabric that nothing is known of [m]: that of the default fabric.
_THICKNESS = values_of(Material().thickness)[0].item()


@dataclass(frozen=True)
class FabricLook:
    """How a fabric is drawn.

    Args:
        colour: sRGB, 0 to 1.
        sheen: share of the key light that its broad highlight reflects, and ``glint`` its narrow one.
        fuzz: share of the light that its fibres scatter where it is seen at a grazing angle.
        thickness: m, of pictures and exports; the simulation does not read it.
    """

    colour: tuple[float, float, float] = GARMENT_COLOR
    sheen: float = SHEEN
    glint: float = 0.0
    fuzz: float = FUZZ
    thickness: float = _THICKNESS

    @property
    def roughness(self) -> float:
        """Of a physically based material, from 0 to 1."""
        return min(max(0.972 - 1.2 * self.sheen - 0.9 * self.glint, 0.2), 1.0)


#: By the name of an option of ``material=``; the paper's default fabric and others look alike. Their thickness is typical of a
#: fabric of this kind and weight under the 1 kPa of ISO 5084; those that measured the fabrics do not all report it.
LOOKS = {
    "chiffon": FabricLook((0.90, 0.74, 0.74), 0.14, 0.0, 0.16, 1.5e-4),
    "coated_nylon": FabricLook((0.85, 0.40, 0.14), 0.16, 0.30, 0.06, 1.3e-4),
    "cotton_canvas": FabricLook((0.72, 0.64, 0.48), 0.01, 0.0, 0.08, 6.0e-4),
    "cotton_jersey": FabricLook((0.55, 0.58, 0.60), 0.01, 0.0, 0.14, 5.5e-4),
    "cotton_poplin": FabricLook((0.82, 0.86, 0.91), 0.03, 0.0, 0.06, 2.2e-4),
    "denim": FabricLook((0.17, 0.24, 0.40), 0.01, 0.0, 0.07, 9.0e-4),
    "denim_12oz": FabricLook((0.14, 0.19, 0.33), 0.01, 0.0, 0.07, 8.0e-4),
    "double_knit": FabricLook((0.44, 0.15, 0.22), 0.02, 0.0, 0.14, 1.0e-3),
    "jersey": FabricLook((0.42, 0.52, 0.48), 0.01, 0.0, 0.14, 5.5e-4),
    "linen": FabricLook((0.77, 0.71, 0.57), 0.02, 0.0, 0.08, 3.5e-4),
    "nappa_leather": FabricLook((0.20, 0.11, 0.08), 0.10, 0.22, 0.04, 8.0e-4),
    "silk": FabricLook((0.66, 0.12, 0.20), 0.34, 0.10, 0.08, 1.2e-4),
    "silk_crepe": FabricLook((0.10, 0.36, 0.34), 0.16, 0.0, 0.10, 2.0e-4),
    "silk_habotai": FabricLook((0.84, 0.73, 0.52), 0.36, 0.12, 0.08, 8.0e-5),
    "wool_felt": FabricLook((0.43, 0.42, 0.42), 0.0, 0.0, 0.26, 2.0e-3),
    "wool_suiting": FabricLook((0.19, 0.20, 0.24), 0.03, 0.0, 0.14, 6.0e-4),
}
#: Of a garment of an outfit that has the fabric of an earlier one, this share of its colour is its own.
_TOLD_APART = 0.5
_ALIKE = 0.15  # distance of two colours that look alike

#: In their order; far from the body's colour and from each other, in lightness as well.
_OTHERS = ((0.80, 0.45, 0.22), (0.30, 0.52, 0.34), (0.62, 0.28, 0.42), (0.86, 0.74, 0.38), (0.28, 0.26, 0.42))


def outfit_ranks(name: str, faces: np.ndarray, num_vertices: int, piece: np.ndarray | None = None) -> np.ndarray:
    """(V,) the number of the garment of an outfit, whose ``name`` joins theirs by ``+``, that a vertex belongs to.

    Args:
        faces: (F, 3).
        piece: (V,) garment that a vertex belongs to. None, as in older recordings: every connected component counts as one.
    """
    if piece is not None and piece.shape == (num_vertices,):
        return np.unique(piece, return_inverse=True)[1].reshape(-1)
    if "+" not in name:
        return np.zeros(num_vertices, dtype=np.int64)
    part = topology.connected_components(num_vertices, topology.unique_edges(faces))
    # By their first vertices: garments lie one after another. Vertices of no face are not drawn.
    order = {int(label): rank for rank, label in enumerate(dict.fromkeys(part[np.unique(faces)].tolist()))}
    return np.array([order.get(int(label), 0) for label in part])


def part_colour(rank: int) -> tuple[float, float, float]:
    """Colour, sRGB from 0 to 1, of garment number ``rank`` of an outfit."""
    colours = (GARMENT_COLOR, *_OTHERS)
    red, green, blue = (float(channel) for channel in colours[rank % len(colours)])
    return red, green, blue


def looks_of(data: RolloutData, fabrics: bool = True) -> tuple[list[FabricLook], np.ndarray]:
    """Looks of the cloth of a rollout, and which of them a vertex (V,) has: by its fabric and its garment. Garments of the same
    fabric, or of one that looks like it, differ in colour.

    Args:
        fabrics: whether a fabric has a look of its own; else every garment has the colour of :func:`part_colour`.
    """
    count = data.cloth_pos.shape[1]
    rank = outfit_ranks(str(data.attributes.get("garment", "")), data.cloth_faces, count, data.still.get("piece"))
    names, fabric = str(data.attributes.get("fabric_names", "")).split("+"), data.still.get("fabric")
    if fabric is None or fabric.shape != (count,) or not 0 <= fabric.min(initial=0) <= fabric.max(initial=0) < len(names):
        fabric = np.zeros(count, dtype=np.int64)
    pairs, number = np.unique(np.stack([rank, fabric], axis=1), axis=0, return_inverse=True)
    looks, taken = [], list[tuple[int, np.ndarray]]()
    for garment, own in pairs.tolist():
        look, mine = LOOKS.get(names[own]) if fabrics else None, np.array(part_colour(garment))
        if look is None:
            known = LOOKS.get(names[own], FabricLook())
            looks.append(FabricLook(part_colour(garment), thickness=known.thickness))
            continue
        colour = np.array(look.colour)
        near = any(other != garment and np.linalg.norm(colour - theirs) < _ALIKE for other, theirs in taken)
        taken.append((garment, colour))
        red, green, blue = ((1.0 - _TOLD_APART) * colour + _TOLD_APART * mine if near else colour).tolist()
        looks.append(replace(look, colour=(red, green, blue)))
    return looks, number.reshape(-1)


def layer_distances(data: RolloutData, thickness: float | None = None) -> np.ndarray:
    """Distances (V, 2) [m] of the outer and the inner side of the cloth of a rollout from its mesh: half of the thickness of
    its fabrics, or of the one given. The mesh of what rides on cloth, as a pocket, is its outer side; solid buttons have 0."""
    looks, number = looks_of(data)
    thick = np.array([look.thickness if thickness is None else thickness for look in looks])[number]
    found = np.stack([0.5 * thick, 0.5 * thick], axis=1)
    riders, num_faces = data.riding
    if riders:
        first = len(found) - riders
        edges, count = topology.counted_edges(data.cloth_faces[len(data.cloth_faces) - num_faces :] - first)
        part = topology.connected_components(riders, edges)
        is_open = np.isin(part, part[edges[count == 1]])
        found[first:] = np.stack([np.zeros(riders), is_open * thick[first:]], axis=1)
    return found


@dataclass(frozen=True)
class GarmentPiece:
    """One garment."""

    name: str  # letters, digits and underscores
    vertices: np.ndarray  # (P,) their numbers in the rollout
    faces: np.ndarray  # (N,) their numbers in the rollout
    uv: np.ndarray | None  # (U, 2); None where the rollout holds none
    uv_faces: np.ndarray | None  # (N, 3) into uv

    @property
    def is_mapped(self) -> bool:
        """Whether its texture coordinates cover an area; in an outfit, garments without any lie in one point."""
        if self.uv is None or self.uv_faces is None or not len(self.uv_faces):
            return False
        corners = self.uv[self.uv_faces].reshape(-1, 2)
        return bool((corners != corners[0]).any())


def pieces_of(data: RolloutData) -> list[GarmentPiece]:
    """The garments of a rollout, in their order; one where the file does not say which vertex belongs to which."""
    return pieces_by(str(data.attributes.get("garment", "cloth")), data.cloth_pos.shape[1], data.cloth_faces, data.still)


def pieces_by(title: str, count: int, faces: np.ndarray, still: Mapping[str, np.ndarray]) -> list[GarmentPiece]:
    """The same by the names of the garments, joined by ``+``, the number of vertices, the faces (F, 3) and what a rollout holds
    beside them (:data:`hood.rollouts.file.recorder.STILL`)."""
    piece, uv, uv_faces = (still.get(name) for name in ("piece", "uv", "uv_faces"))
    if (
        uv is None
        or uv_faces is None
        or uv.ndim != 2
        or uv.shape[1] != 2
        or uv_faces.shape != faces.shape
        or _outside(uv_faces, len(uv))
    ):
        uv = uv_faces = None
    if piece is None or piece.shape != (count,) or piece.min(initial=0) == piece.max(initial=0):
        return [GarmentPiece(plain_name(title), np.arange(count), np.arange(len(faces)), uv, uv_faces)]
    words, labels, found = title.split("+"), sorted(set(piece.tolist())), list[GarmentPiece]()
    for rank, label in enumerate(labels):
        mine = np.flatnonzero((piece[faces] == label).all(axis=1))
        name = plain_name(words[rank]) if len(words) == len(labels) else f"cloth_{rank}"
        name = name if name not in [other.name for other in found] else f"{name}_{rank}"
        found.append(GarmentPiece(name, np.flatnonzero(piece == label), mine, uv, None if uv_faces is None else uv_faces[mine]))
    return found


def hideable_parts(data: RolloutData, pieces: Sequence[GarmentPiece]) -> tuple[list[str], np.ndarray]:
    """Names of the parts of the cloth, and the part (F,) of every face: garments, and within them their fabrics and what rides
    on them, as buttons and pockets."""
    count, (_, riding), faces = len(data.cloth_faces), data.riding, data.cloth_faces
    garment, fabric = np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.int64)
    for rank, piece in enumerate(pieces):
        garment[piece.faces] = rank
    words, own = str(data.attributes.get("fabric_names", "")).split("+"), data.still.get("fabric")
    if own is not None and own.shape == data.cloth_pos.shape[1:2] and 0 <= own.min() <= own.max() < len(words):
        fabric = own[faces].min(axis=1)
    kinds = np.stack([garment, fabric, np.arange(count) >= count - riding], axis=1)
    rows, part = np.unique(kinds, axis=0, return_inverse=True)
    several = {rank for rank in rows[:, 0].tolist() if len(set(rows[rows[:, 0] == rank, 1].tolist())) > 1}
    names = [
        pieces[rank].name + (f", {words[kind]}" if rank in several else "") + (", pockets and buttons" if rides else "")
        for rank, kind, rides in rows.tolist()
    ]
    return names, part.reshape(-1)


def between_hems(faces: np.ndarray) -> np.ndarray:
    """Numbers (N,) of faces beside an edge from hem to hem through the cloth: distances from the hem are 0 all along it, where
    they are not along the way."""
    corners = np.asarray(faces, dtype=np.int64)
    edges, count = topology.counted_edges(corners)
    at_hem = np.zeros(int(corners.max(initial=-1)) + 1, dtype=bool)
    at_hem[edges[count == 1]] = True
    bridges = edges[(count > 1) & at_hem[edges].all(axis=1)]
    key = len(at_hem)
    sides = np.sort(np.stack([corners, np.roll(corners, -1, axis=1)], axis=-1), axis=-1) @ np.array([key, 1])
    return np.flatnonzero(np.isin(sides, bridges @ np.array([key, 1])).any(axis=1))


def split_seams(faces: np.ndarray, uv_faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points to draw: a vertex on a seam of the texture is several.

    Args:
        faces, uv_faces: vertex and texture coordinate of every corner, (F, 3).

    Returns:
        Vertex (N,) and texture coordinate (N,) of every point, and the faces (F, 3) over points.
    """
    pairs = np.stack([faces.reshape(-1), uv_faces.reshape(-1)], axis=1)
    points, number = np.unique(pairs, axis=0, return_inverse=True)
    return points[:, 0], points[:, 1], number.reshape(-1, 3)


def plain_name(name: str) -> str:
    """A name that every format takes: letters, digits and underscores, no digit first."""
    stem = Path(name).stem if "/" in name or "\\" in name else name
    plain = "".join(letter if letter.isascii() and letter.isalnum() else "_" for letter in stem)
    plain = f"cloth_{plain}" if not plain or plain[0].isdigit() else plain
    return "cloth" if plain == "body" else plain


def _outside(faces: np.ndarray, count: int) -> bool:
    return bool(faces.size and not 0 <= faces.min() <= faces.max() < count)
