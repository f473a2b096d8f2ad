"""Sews the wardrobe: own designs (hood/assets/pattern/designs.py) on the default body, each at three sizes."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hood.assets.body.load import load_body
from hood.assets.files.atomic import write_atomically
from hood.assets.garment.garment import Garment, load_garment
from hood.assets.garment.garment_arrays import as_arrays
from hood.assets.pattern.designs import draft
from hood.assets.pattern.measures import measure_body
from hood.assets.pattern.pattern import Pattern
from hood.assets.pattern.sheet import sheet_of
from hood.cli.main import main as run_hood

#: Vertices of the three sizes, by what their names end with.
SIZES = {"": 1000, "_4k": 4000, "_12k": 12000}
#: Steps [m, share] that what is stored is rounded to: the files are half as large.
_POSITION, _SHAPE, _WEIGHT = 2.0**-16, 2.0**-12, 2.0**-9


class Piece(NamedTuple):
    """A garment of the wardrobe: a design with its options."""

    design: str
    options: Mapping[str, Any] = {}


WARDROBE = {
    "blouse": Piece("blouse"),
    "blazer": Piece("blazer"),
    "bomber": Piece("bomber"),
    "gilet": Piece("gilet"),
    "hoodie": Piece("hoodie"),
    "poncho": Piece("poncho"),
    "apron": Piece("apron"),
    "jeans": Piece("jeans"),
    "leggings": Piece("leggings"),
    "jumpsuit": Piece("jumpsuit"),
    "swing": Piece("swing"),
    "circle": Piece("circle", {"length": 0.45}),
    "pleated": Piece("pleated"),
    "wrap": Piece("wrap"),
    "tiered": Piece("tiered"),
}


def build_wardrobe(folder: Path, names: Iterable[str] = WARDROBE) -> list[Path]:
    """Sew garments of the wardrobe at each size into ``folder``.

    Raises:
        RuntimeError: one that is not sewn well.
    """
    written = []
    vertices, faces, joints = _mean_body()
    for name in names:
        piece = WARDROBE[name]
        pattern = draft(piece.design, measure_body(vertices, faces, joints), piece.options)
        for ending, count in SIZES.items():
            path = folder / f"{name}{ending}.npz"
            _sew(piece, edge_for(pattern, count), path)
            written.append(path)
    return written


def edge_for(pattern: Pattern, count: int) -> float:
    """Length of edges [m] at which the mesh of a pattern has about ``count`` vertices."""
    edge = 0.02
    for _ in range(3):
        edge = round(edge * float(np.sqrt(len(sheet_of(pattern, edge, pattern.name).pos) / count)), 4)
    return edge


def _mean_body() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    body = load_body()
    vertices, joints = body.shaped(np.zeros(10))
    return vertices, body.faces, joints


def _sew(piece: Piece, edge: float, path: Path) -> None:
    options = ",".join(f"{key}:{value}" for key, value in piece.options.items())
    with tempfile.TemporaryDirectory() as folder:
        sewn = Path(folder) / path.name
        words = ["sew", f"design:{piece.design}", f"output={sewn}", f"edge={edge}", "sheet=none"]
        if run_hood([*words, *([f"design={{{options}}}"] if options else [])]):
            raise RuntimeError(f"{path.stem} is not sewn well at edge={edge}")
        write_rounded(path, load_garment(sewn))


def write_rounded(path: Path, garment: Garment) -> None:
    """Write a sewn garment in few bytes: rounded, its flat pattern as its texture coordinates."""
    arrays = as_arrays({field.name: getattr(garment, field.name) for field in fields(garment)})
    if garment.flat is None or not np.array_equal(garment.flat, np.asarray(garment.uv)[garment.uv_faces]):
        raise RuntimeError(f"{path.stem}: its texture coordinates are not its flat pattern")
    arrays["flat"] = np.array(True)
    steps = {"rest_pos": _POSITION, "skin_pos": _POSITION, "shapedirs": _SHAPE, "lbs_weights": _WEIGHT}
    for key, step in steps.items():
        if key in arrays:
            kind = np.float32 if step == _POSITION else np.float16
            arrays[key] = (np.round(arrays[key] / step) * step).astype(kind)
    for key, value in arrays.items():
        if (
            isinstance(value, np.ndarray)
            and value.dtype == np.int64
            and value.min(initial=0) >= 0
            and value.max(initial=0) < 2**16
        ):
            arrays[key] = value.astype(np.uint16)
        elif key in ("uv", "rider_pos"):
            arrays[key] = value.astype(np.float32)
        elif isinstance(value, np.ndarray) and value.dtype == np.float64:
            arrays[key] = value.astype(np.float16)
    with tempfile.TemporaryDirectory() as folder:
        content = Path(folder) / "garment.npz"
        np.savez_compressed(content, **arrays)
        write_atomically(path, content.read_bytes())


if __name__ == "__main__":
    print(build_wardrobe(Path(sys.argv[1]), sys.argv[2:] or WARDROBE))
