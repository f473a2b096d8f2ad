"""Garments: embedded templates, prepared files, mesh files, and the reference implementation's pickles.

Garments that somebody made of arrays: checked like those of files before anything is computed with them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from hood.assets.files.library import locate, require_name, unknown_suffix
from hood.assets.formats.mesh_file import MeshFile, mesh_suffixes, object_alone, read_mesh_file, split_object
from hood.assets.garment.garment_arrays import as_arrays, checked_fields, read_fields, write_fields
from hood.assets.garment.reference_garments import read_reference_garment
from hood.assets.material import NO_GRADIENT
from hood.mesh.editing.quality import check_triangles
from hood.mesh.flat import Construction
from hood.mesh.parts import Riders

#: What can be given as a garment, besides embedded names and mesh files.
GARMENT_SUFFIXES = (".npz", ".pkl")


@dataclass(frozen=True)
class Garment:
    """A garment at zero shape coefficients, with what it needs to follow a body's shape and pose.

    The rest shape is in the body's T-pose unless ``skin_pos`` says otherwise: then ``rest_pos`` may be in any pose (a
    garment modelled around an A-pose keeps its lengths and angles) and ``skin_pos`` is where skinning starts from.
    """

    name: str  # for messages and files
    rest_pos: np.ndarray  # (V, 3) m, float64
    faces: np.ndarray  # (F, 3) int64
    pinned: np.ndarray  # (V,) bool
    lbs_weights: np.ndarray | None = None  # (V, J)
    shapedirs: np.ndarray | None = None  # (V, 3, S) m per unit of beta, in T-pose
    bound_to: str | None = None  # body whose weights and shape offsets these are; None: whichever it is put on
    uv: np.ndarray | None = None  # (U, 2)
    uv_faces: np.ndarray | None = None  # (F, 3)
    normal_faces: np.ndarray | None = None  # (F, 3): corners of one number share a normal; None: smooth everywhere
    colours: np.ndarray | None = None  # (V, 3), 0 to 1
    skin_pos: np.ndarray | None = None  # (V, 3) m, in T-pose; None: rest_pos is
    rest_turn: np.ndarray | None = None  # (V, 3, 3) from the T-pose into the pose of rest_pos; None: identity
    coarse_edges: tuple[np.ndarray, ...] | None = None  # each (E, 2), levels of a hierarchy that came with the garment
    region: np.ndarray | None = None  # (V,) int64, index into hood.assets.garment.pins.MARKS; None: not marked
    stiffness: np.ndarray | None = None  # (V,) how many times as stiff as its fabric the cloth is there; None: once
    piece: np.ndarray | None = None  # (V,) int64, garment of an outfit that a vertex belongs to, from 0; None: all one garment
    #: (P, 2) by name: pairs of vertices that a seam, buttons or a zipper hold together.
    fasteners: dict[str, np.ndarray] | None = None
    panels: dict[str, np.ndarray] | None = None  # (F,) bool each: faces that the mesh file gives a name, as its pattern pieces
    flat: np.ndarray | None = None  # (F, 3, 2) m, corners in the flat pattern: the cloth's lengths. NaN, None: as in rest_pos
    elastic: np.ndarray | None = None  # (F, 3) sides at rest, shares of what they are cut at (:mod:`hood.mesh.flat`)
    fold: np.ndarray | None = None  # (F, 3) rad, angles at rest across the sides opposite to the corners; NaN: no fold
    bending: np.ndarray | None = None  # (F, 3) factors on the bending stiffness across these sides, of seams and hems; None: 1
    thickness: np.ndarray | None = None  # (V,) m, of the cloth as its file shows it; 0: not known. The fabric has its own
    riders: Riders | None = None  # buttons and the like, which ride on the cloth
    file_numbers: np.ndarray | None = None  # (V of the file,) present number of each of its vertices, -1: gone; None: as there

    @classmethod
    def from_arrays(cls, positions: Any, faces: Any, pins: Any = (), name: str = "garment") -> Garment:
        """A garment of arrays, as :func:`hood.simulate` takes it.

        Args:
            positions: (V, 3) m, y up, around the body's T-pose; of a body that is a mesh as it is worn in its first frame.
            faces: (F, 3) vertex numbers from 0.
            pins: vertices that are held: numbers, or (V,) true and false.
            name: for messages.

        Raises:
            ValueError: arrays that cannot be simulated; names the argument, the index and the fix.
        """
        where = f"garment {name!r}"
        garment = checked_garment(cls(name, positions, faces, np.zeros(len(_array(where, "positions", positions)), bool)))
        return replace(garment, pinned=_held(where, _array(where, "pins", pins), len(garment.rest_pos)))

    @property
    def bound(self) -> bool:
        """Whether it has the weights and shape offsets that it follows a body with."""
        return self.lbs_weights is not None and self.shapedirs is not None

    @property
    def worn_pos(self) -> np.ndarray:
        """(V, 3) m: where it is worn, on the mean body in T-pose or in the first frame of a body without a skin."""
        return self.rest_pos if self.skin_pos is None else self.skin_pos

    @property
    def construction(self) -> Construction:
        """What :func:`hood.cloth.cloth.build_cloth` is to know of elastic, folds and layers."""
        return Construction(self.elastic, self.fold, self.bending)

    def shaped(self, betas: np.ndarray) -> np.ndarray:
        """Rest shape (V, 3) [m], grown with the body of shape ``betas``."""
        offset = self._offset(betas)
        if self.rest_turn is not None:
            offset = np.einsum("vij,vj->vi", self.rest_turn, offset)
        return self.rest_pos + offset

    def tpose(self, betas: np.ndarray) -> np.ndarray:
        """Garment (V, 3) [m] in T-pose on the body of shape ``betas``: what skinning poses."""
        return self.worn_pos + self._offset(betas)

    def numbers_of(self, vertices: np.ndarray, where: str) -> np.ndarray:
        """Present numbers of vertices (n,) that somebody names by their numbers in the file; those that are gone are left out.

        Raises:
            ValueError: a number that no vertex of the file has; ``where`` says who names it.
        """
        count = len(self.rest_pos) if self.file_numbers is None else len(self.file_numbers)
        outside = (vertices < 0) | (vertices >= count)
        if outside.any():
            raise ValueError(f"{where}: vertex {int(vertices[np.argmax(outside)])} of {count}; they are numbered from 0")
        present = vertices if self.file_numbers is None else self.file_numbers[vertices]
        return np.asarray(present[present >= 0])

    def _offset(self, betas: np.ndarray) -> np.ndarray:
        assert self.shapedirs is not None, "bind the garment first"
        count = min(len(betas), self.shapedirs.shape[2])
        return np.asarray(self.shapedirs[..., :count] @ np.asarray(betas[:count], dtype=np.float64))


def load_garment(name: str | Path, triangulate: bool = False) -> Garment:
    """A garment by its embedded name or from a file.

    Args:
        name: an embedded name, a garment ``.npz``, a mesh file (OBJ, PLY, STL, GLB, OFF) in metres around the body's T-pose,
            or a ``.pkl`` of the reference implementation. A name behind the file's chooses one of several
            (``garments_dict.pkl:dress``, ``scene.obj:tank``; of a mesh file without its texture).
        triangulate: split faces of four and more corners instead of refusing them.

    Returns:
        The :class:`Garment`, with ``rest_pos`` (V, 3) m, ``faces`` (F, 3).

    Raises:
        FileNotFoundError: unknown name or missing file.
        ValueError: unreadable or broken mesh; names the file, the index and the fix.

    Examples:
        >>> import hood
        >>> tank = hood.load_garment("tank")
        >>> tank.rest_pos.shape, tank.faces.shape
        ((1016, 3), (1901, 3))
    """
    path, entry = locate_garment(name)
    suffix = path.suffix.lower()
    if suffix == ".npz":
        garment = Garment(**{"name": path.stem, **read_fields(path)})
    elif suffix == ".pkl":
        garment = Garment(**read_reference_garment(path, entry))
    elif suffix in mesh_suffixes():
        mesh = read_mesh_file(path, triangulate)
        garment = garment_of_mesh(path, mesh if entry is None else object_alone(path, mesh, entry))
    else:
        known = ", ".join((*GARMENT_SUFFIXES, *mesh_suffixes()))
        raise ValueError(f"{path}: {unknown_suffix(path, 'garment')}; give one of {known}")
    check_triangles(garment.rest_pos, garment.faces, str(path))
    check_levels(garment, str(path))
    return garment


def garment_of_mesh(path: Path, mesh: MeshFile) -> Garment:
    """The garment in a mesh file as it is written; it may still need repair."""
    pinned = np.zeros(len(mesh.pos), dtype=bool)
    extra = {key: getattr(mesh, key) for key in ("uv", "uv_faces", "normal_faces", "colours", "panels")}
    return Garment(path.stem, mesh.pos, mesh.faces, pinned, **extra)


def save_garment(path: Path, garment: Garment) -> None:
    """Write a garment ``.npz`` that :func:`load_garment` reads back; an existing file is replaced at once or not at all."""
    write_fields(path, {field.name: getattr(garment, field.name) for field in fields(garment)})


def garments_in(folder: Path) -> list[Path]:
    """Garment files ``.npz`` in a folder and below, sorted.

    Raises:
        ValueError: there are none, or there is a sewing pattern without its garment; says how to sew it.
    """
    found = sorted(path for path in folder.rglob("*.npz") if not path.name.startswith("."))
    sewn = {path.stem for path in found}
    for path in sorted(folder.rglob("*specification.json")):
        name = path.parent.name if path.stem == "specification" else path.stem
        if name not in sewn:
            raise ValueError(f"{path}: not sewn yet; hood sew {path} output={folder / name}.npz sews it")
    if not found:
        raise ValueError(
            f"{folder}: no garments (.npz) in it or below; hood sew design:tshirt output={folder / 'tshirt.npz'} makes one"
        )
    return found


def locate_garment(name: str | Path) -> tuple[Path, str | None]:
    """File of a garment, and which of its entries is meant (``garments_dict.pkl:dress``, ``scene.obj:tank``)."""
    require_name("garments", name)
    head, colon, entry = str(name).rpartition(":")
    if colon and head.lower().endswith(".pkl"):
        return locate("garments", head), entry
    path, entry_of_mesh = split_object(name)
    return (locate("garments", name), None) if entry_of_mesh is None else (locate("garments", str(path)), entry_of_mesh)


def check_levels(garment: Garment, where: str) -> None:
    """Raise ValueError where an edge of a coarse level has a vertex that the garment does not have."""
    for level, edges in enumerate(garment.coarse_edges or ()):
        outside = (edges < 0) | (edges >= len(garment.rest_pos))
        if outside.any():
            row = int(np.argmax(outside.any(axis=1)))
            raise ValueError(f"{where}: coarse edge {row} of level {level} is {edges[row].tolist()}; there is no such vertex")


#: Weights of a vertex that sum to one within this stay as they are.
_ROUNDING = 1e-9


def checked_garment(garment: Garment) -> Garment:
    """The garment with its fields as arrays of the types that they are to have; itself where they are that already.

    Lists and tensors are taken as arrays.

    Raises:
        ValueError: no garment, or one that cannot be simulated; names the garment, the field, the index and the fix.
    """
    if not isinstance(garment, Garment):
        raise ValueError(
            f"garment is of type {type(garment).__name__}; give a hood.Garment, such as hood.load_garment('tank') or of a file"
        )
    where = f"garment {str(garment.name)!r}"
    given = {field.name: getattr(garment, field.name) for field in fields(garment)}
    for key in ("rest_pos", "faces", "pinned"):
        if given[key] is None:
            raise ValueError(f"{where}: {key} is None; give rest_pos (V, 3) m, faces (F, 3) and pinned (V,)")
    arrays = {key: _array(where, key, value) for key, value in as_arrays(given).items() if key != "bound_to"}
    found = checked_fields(where, arrays)
    check_triangles(found["rest_pos"], found["faces"], where)
    changed = {key: value for key, value in found.items() if not _same(given[key], value)}
    garment = replace(garment, **changed) if changed else garment
    check_levels(garment, where)
    return garment


def _array(where: str, key: str, value: Any) -> np.ndarray:
    if getattr(value, "requires_grad", False):
        raise ValueError(f"{where}: {key}: {NO_GRADIENT}")
    value = value.detach().cpu() if hasattr(value, "detach") else value  # a tensor
    try:
        array = np.asarray(value)
    except ValueError:
        rows = ", split polygons into triangles first" if key == "faces" else ""
        raise ValueError(f"{where}: rows of {key} differ in length; give an array{rows}") from None
    if array.ndim == 0:
        raise ValueError(f"{where}: {key} is of type {type(value).__name__}; give an array")
    return array


def _held(where: str, pins: np.ndarray, count: int) -> np.ndarray:
    """(V,) bool: ``pins`` as such, or the vertices that it numbers."""
    if pins.dtype == bool:
        if pins.shape != (count,):
            raise ValueError(f"{where}: pins have shape {pins.shape}; give one of true and false a vertex, ({count},)")
        return pins
    if pins.ndim != 1 or (pins.size and pins.dtype.kind not in "iu"):
        raise ValueError(f"{where}: pins are {pins.dtype} of shape {pins.shape}; give vertex numbers, or true and false of all")
    outside = (pins < 0) | (pins >= count)
    if outside.any():
        row = int(outside.argmax())
        raise ValueError(f"{where}: pins[{row}] is {pins[row]}; give vertex numbers from 0 to {count - 1}")
    held = np.zeros(count, dtype=bool)
    held[pins.astype(np.int64)] = True
    return held


def _same(given: Any, checked: Any) -> bool:
    """Whether a field is what it was checked to be."""
    if isinstance(checked, Mapping):
        return isinstance(given, Mapping) and all(_same(given[key], value) for key, value in checked.items())
    if isinstance(checked, Riders):
        tables = {name: table for name, table in vars(checked).items() if table is not None}
        return isinstance(given, Riders) and all(_same(getattr(given, name), table) for name, table in tables.items())
    if isinstance(checked, tuple):
        return isinstance(given, tuple) and all(map(_same, given, checked))
    if not isinstance(given, np.ndarray) or given.dtype != checked.dtype:
        return False
    return bool(np.allclose(given, checked, rtol=0.0, atol=_ROUNDING, equal_nan=True))
