"""The content of a mesh file before polygons are split and doubled vertices joined; what all readers return.

Images that lie over texture coordinates: PNG or JPEG files, handed on as they are, and their pixels.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from hood.assets.files.said import install
from hood.assets.files.text import folded_names

#: A garment has not so many panels: the names mean something else, such as single faces.
MOST_PANELS = 256


class Unreadable(ValueError):
    """A mesh file that must be repaired; the message names the line, face or field. The caller adds the file's name."""


@dataclass
class RawMesh:
    """Vertices, and polygons as a flat table of corners.

    Per-corner tables hold an index into ``uv`` or ``normals``; -1 where the file gives none. Per-vertex texture
    coordinates and normals are given by setting the corner tables to ``corners``.
    """

    pos: np.ndarray  # (V, 3) float64
    corners: np.ndarray  # (N,) int64, vertex of each corner
    counts: np.ndarray  # (P,) int64, corners of each polygon
    colours: np.ndarray | None = None  # (V, 3), 0 to 1
    uv: np.ndarray | None = None  # (U, 2)
    uv_corners: np.ndarray | None = None  # (N,)
    normals: np.ndarray | None = None  # (M, 3)
    normal_corners: np.ndarray | None = None  # (N,)
    panels: dict[str, np.ndarray] | None = None  # (P,) bool each: the polygons of a name
    stitches: np.ndarray | None = None  # (S, 2) vertices that lines join: sewing threads of some programs
    notes: list[str] = field(default_factory=list)


def unit_colours(values: np.ndarray) -> np.ndarray:
    """Colours (V, 3) from 0 to 1: integers, and reals beyond 1, count up to 255 (65535 for 16 bits)."""
    real = np.asarray(values, dtype=np.float64)
    if np.issubdtype(values.dtype, np.integer):
        return real / np.iinfo(values.dtype).max if values.dtype.itemsize <= 2 else real / 255.0
    return real / 255.0 if real.size and np.nanmax(real) > 1.0 else real


def named_polygons(
    combinations: Sequence[tuple[str, ...]], of_polygons: np.ndarray
) -> tuple[dict[str, np.ndarray] | None, list[str]]:
    """(P,) bool of every name that some polygons have and others do not, folded (:func:`folded_names`), None without any; and
    what was not kept.

    Args:
        combinations: of names that polygons have.
        of_polygons: (P,) the place among them of each polygon's.
    """
    used = np.unique(of_polygons).tolist()
    shared = set(combinations[used[0]]).intersection(*(combinations[at] for at in used)) if used else set()
    names = list(dict.fromkeys(name for at in used for name in combinations[at] if name not in shared))
    if len(names) > MOST_PANELS:
        return None, [f"{len(names)} names of objects, groups and materials are more than {MOST_PANELS}; none is kept"]
    known = {name: np.array([name in combination for combination in combinations]) for name in names}
    short = folded_names(known)
    return {short[name]: mask[of_polygons] for name, mask in known.items()} or None, []


def join_meshes(parts: list[RawMesh]) -> RawMesh:
    """Several primitives as one mesh; what only some of them have is not kept, and noted."""
    if len(parts) == 1:
        return parts[0]
    offsets = np.cumsum([0, *(len(part.pos) for part in parts)])
    corners = np.concatenate([part.corners + offset for part, offset in zip(parts, offsets, strict=False)])
    joined = RawMesh(np.concatenate([part.pos for part in parts]), corners, np.concatenate([part.counts for part in parts]))
    for name, what in (("uv", "texture coordinates"), ("normals", "normals"), ("colours", "colours")):
        tables = [getattr(part, name) for part in parts]
        if all(table is not None for table in tables):
            setattr(joined, name, np.concatenate(tables))
        elif any(table is not None for table in tables):
            joined.notes.append(f"only some parts have {what}; they are not kept")
    joined.uv_corners = corners if joined.uv is not None else None
    joined.normal_corners = corners if joined.normals is not None else None
    return joined


#: Larger files [bytes] are refused: pages and glTF hold them whole.
_LARGEST = 4_000_000
#: How a file begins, its kind and the ending of its name.
_KINDS = ((b"\x89PNG\r\n\x1a\n", "image/png", ".png"), (b"\xff\xd8\xff", "image/jpeg", ".jpg"))


@dataclass(frozen=True)
class Texture:
    """An image file that is laid over texture coordinates: (0, 0) is its lower left corner, (1, 1) its upper right one, and it
    repeats beyond."""

    content: bytes
    kind: str  # image/png or image/jpeg
    suffix: str  # .png or .jpg

    @property
    def address(self) -> str:
        """The image as an address of its own, for pages that load nothing."""
        return f"data:{self.kind};base64,{base64.b64encode(self.content).decode()}"

    def pixels(self, most: int | None = None) -> np.ndarray:
        """(H, W, 3) uint8, the top row first; with ``most`` made smaller until no side has more pixels.

        Raises:
            ImportError: Pillow is missing.
            ValueError: the image is damaged.
        """
        try:
            from PIL import Image
        except ImportError as error:
            raise ImportError(f"pixels of images need Pillow: {install('pictures')}") from error
        try:
            with Image.open(io.BytesIO(self.content)) as opened:
                image = opened.convert("RGB")
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
            raise ValueError(f"the {self.kind} image cannot be decoded ({error}); save it again") from error
        if most is not None:
            image.thumbnail((most, most))
        return np.asarray(image)


def read_texture(path: Path) -> Texture:
    """The image in a file; its first bytes say which kind it is, whatever its name.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is neither PNG nor JPEG, or larger than :data:`_LARGEST`.
    """
    if not path.is_file():
        raise FileNotFoundError(f"image {path}: no such file; give a PNG or JPEG image")
    size = path.stat().st_size
    if size > _LARGEST:
        raise ValueError(
            f"image {path}: {size / 1e6:.1f} MB, more than {_LARGEST / 1e6:g}; save it smaller, or as JPEG, which takes less"
        )
    content = path.read_bytes()
    for begin, kind, suffix in _KINDS:
        if content.startswith(begin):
            return Texture(content, kind, suffix)
    raise ValueError(f"image {path}: neither PNG nor JPEG by its first bytes; save it as one of them")
