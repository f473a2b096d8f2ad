"""The objects of a file: which there are, what each seems to be, and which of them are the garment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hood.assets.files.guarded import listed
from hood.assets.files.text import meant
from hood.assets.fitting.alterations import drop_faces
from hood.assets.fitting.placement import LENGTH_UNITS
from hood.assets.fitting.suspicions import body_of
from hood.assets.formats.mesh_file import parts_by_name
from hood.assets.garment.binding import signed_distances
from hood.assets.garment.garment import Garment
from hood.assets.garment.record import Fitting
from hood.mesh.editing.shells import find_shell
from hood.mesh.parts import MeshPart, find_parts, part_labels, rim_length

#: An object has at most so much [share] of its faces elsewhere than in the parts that it is made of.
_WHOLE = 0.99
#: A body is at least so large [share] beside all that the file holds.
_LARGE = 0.5
#: Cloth is at most so thick [m], things on it are at most so large [m], and openings that something can be put on by are at
#: least so long [m].
THICKEST, SMALL, OPENING = 0.012, 0.06, 0.12


@dataclass(frozen=True)
class Item:
    """An object of a file, or a connected part."""

    name: str
    faces: np.ndarray  # (F,) bool
    num_vertices: int
    size: tuple[float, float, float]  # m
    seems: str


def items_of(garment: Garment, scale: float, surface: np.ndarray) -> list[Item]:
    """The objects of a file by the names that it gives them, or else its connected parts.

    Args:
        scale: metres per unit of the file.
        surface: (W, 3) m, the body that garments are measured against.
    """
    named = dict(garment.panels or {}) or parts_by_name(len(garment.rest_pos), garment.faces)
    items = []
    for name, mask in named.items():
        used = np.unique(garment.faces[mask])
        size = np.round(scale * np.ptp(garment.rest_pos[used], axis=0), 3).tolist()
        items.append(Item(name, mask, len(used), tuple(size), seems(scale * garment.rest_pos, garment.faces[mask], surface)))
    return items


def seems(pos: np.ndarray, faces: np.ndarray, surface: np.ndarray) -> str:
    """What the mesh ``pos`` (V, 3) [m], ``faces`` (F, 3) looks like, in a few words."""
    used, corners = np.unique(faces, return_inverse=True)
    pos, faces = pos[used], corners.reshape(-1, 3)
    if body_of(pos, faces, surface, float(np.ptp(surface, axis=0).max())) is not None:
        return "a body"
    parts = find_parts(pos, faces)
    kinds = [_seems_part(pos, faces, part) for part in parts]
    largest = kinds[int(np.argmax([part.area for part in parts]))]
    return largest if len(parts) == 1 else f"{len(parts)} parts, the largest {largest}"


def _seems_part(pos: np.ndarray, faces: np.ndarray, part: MeshPart) -> str:
    if part.closed and part.extent <= SMALL:
        return "a small thing such as a button"
    if part.closed:
        shell = find_shell(pos, faces[part.faces], THICKEST)
        return f"cloth {1e3 * shell.thickness:.1f} mm thick, closed" if shell is not None else "a closed solid"
    openings = num_openings(pos, part)
    return f"cloth with {openings} openings" if openings > 1 else "a sheet"


def num_openings(pos: np.ndarray, part: MeshPart) -> int:
    """Rims of a part that are long enough to put something on by."""
    return sum(rim_length(pos, rim) >= OPENING for rim in part.rims)


def choose_objects(fitting: Fitting, names: tuple[str, ...]) -> None:
    """Keep the faces of the objects, groups, materials or parts ``names``.

    Raises:
        ValueError: there is none of that name; says which there are.
    """
    if not names:
        return
    garment = fitting.garment
    known = {**parts_by_name(len(garment.rest_pos), garment.faces), **(garment.panels or {})}
    kept = np.zeros(len(garment.faces), dtype=bool)
    for name in names:
        found = meant(name, known)
        if found is None:
            there = listed([*(garment.panels or {}), *parts_by_name(len(garment.rest_pos), garment.faces)])
            raise ValueError(
                f"{garment.name}: objects={name}: no object, group, material or part of that name; there are {there}"
            )
        kept |= known[found]
    count = int((~kept).sum())
    drop_faces(fitting, kept)
    fitting.note("objects", count, f"objects={','.join(names)}: {count} faces of other objects are left out")


def leave_body_out(fitting: Fitting, surface: np.ndarray) -> None:
    """Leave out a body that the file holds beside the garment, in any unit, and what lies inside of that, such as eyes."""
    garment = fitting.garment
    pos, height = garment.rest_pos, float(np.ptp(surface, axis=0).max())
    bodies = [
        (name, mask) for name, mask in _candidates(garment).items() if _is_body(pos, garment.faces[mask], surface, height)
    ]
    if not bodies:
        return
    name, body = min(bodies, key=lambda one: int(one[1].sum()))
    left = ~body
    label = part_labels(len(pos), garment.faces)[garment.faces[:, 0]]
    for part in np.unique(label[left]):
        rows = left & (label == part)
        points = pos[np.unique(garment.faces[rows])]
        if (signed_distances(points, pos, garment.faces[body]) < 0).mean() > 0.5:
            left &= ~rows
    if not left.any():
        return  # nothing but the body: that is told as such
    count = len(np.unique(garment.faces[~left]))
    drop_faces(fitting, left)
    fitting.guess(
        "body", count, f"the file holds a body beside the garment, {name!r} ({count} vertices); it is left out",
        f"body=FILE:{name} has it as the body, objects=[…] chooses the garment", name=name,
    )  # fmt: skip


def _candidates(garment: Garment) -> dict[str, np.ndarray]:
    """Objects that are whole parts, and the parts themselves."""
    label = part_labels(len(garment.rest_pos), garment.faces)[garment.faces[:, 0]]
    found = {}
    for name, mask in (garment.panels or {}).items():
        rows = np.isin(label, np.unique(label[mask]))
        if mask.sum() >= _WHOLE * rows.sum() and not rows.all():
            found[name] = rows
    parts = parts_by_name(len(garment.rest_pos), garment.faces)
    return found or (parts if len(parts) > 1 else {})


def _is_body(pos: np.ndarray, faces: np.ndarray, surface: np.ndarray, height: float) -> bool:
    """Whether a mesh is a body in some unit, eyes and teeth of its own aside."""
    size = float(np.ptp(pos[faces].reshape(-1, 3), axis=0).max())
    unit = min(LENGTH_UNITS, key=lambda unit: abs(np.log(max(unit * size, 1e-12) / height)))  # a body is as large as a body
    if not 0.5 * height < unit * size < 2.0 * height or size < _LARGE * float(np.ptp(pos, axis=0).max()):
        return False
    largest = max(find_parts(pos, faces), key=lambda part: part.area)
    used, corners = np.unique(faces[largest.faces], return_inverse=True)
    return body_of(unit * pos[used], corners.reshape(-1, 3), surface, height) is not None
