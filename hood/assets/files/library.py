"""Names and files of the embedded assets, and checked reading of ``.npz`` files.

File formats that are not read, each with the way to convert it.
"""

from __future__ import annotations

import difflib
import json
import math
import os
import re
import warnings
import zipfile
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from hood import plugins
from hood.assets.files.guarded import first_line, unreadable

_SCENES = {
    ".fbx": "FBX", ".dae": "COLLADA", ".blend": "Blender",
    ".max": "3ds Max", ".mb": "Maya", ".ma": "Maya", ".abc": "Alembic", ".bvh": "BVH", ".c3d": "C3D", ".trc": "TRC",
}  # fmt: skip
#: How each kind of asset gets out of a scene file.
_WAY_OUT = {
    "garments": "export the garment as OBJ or GLB (Blender imports and exports both)",
    "motions": (
        "export the animated character as GLB and pass it as body={stem}.glb, or retarget the motion to SMPL (AMASS .npz)"
    ),
    "body": "export the character with its animation as GLB (Blender imports and exports it) and pass body={stem}.glb",
    "file": "export a garment as OBJ, a character with its animation as GLB (Blender imports and exports both)",
}
#: A name of a finer garment: that of the coarse one, and about how many vertices it has.
_SIZED = re.compile(r"(.+)(_\d+k)")
#: Plugins' readers of the kind, see :mod:`hood.plugins`.
_READERS = {"garments": ("meshes",), "motions": ("motions",), "body": (), "file": ("meshes", "motions")}
_ALEMBIC = "Python has no official package for them; export USD, which the same programs write, and give {stem}.usd"
#: Files of markers, which are no skeleton yet.
_MARKERS = (".c3d", ".trc")
_FITTED = "fit SMPL to its markers (MoSh++, SOMA) and give the .npz that comes out"
_BVH_BODY = (
    "retarget it to SMPL (AMASS .npz), or animate a character with it in Blender and export that as GLB: body={stem}.glb"
)


def require_readable(path: Path, kind: str) -> None:
    """Refuse a file of another program's format; ``kind`` is what it is wanted as: garments, motions, body, or any file.

    Raises:
        ValueError: names the file and what to export instead.
    """
    suffix = path.suffix.lower()
    if suffix not in _SCENES or kind not in _WAY_OUT or any(suffix[1:] in plugins.names(group) for group in _READERS[kind]):
        return
    way = _FITTED if suffix in _MARKERS else _BVH_BODY if suffix == ".bvh" and kind != "garments" else _WAY_OUT[kind]
    way = _ALEMBIC if suffix == ".abc" else way
    raise ValueError(f"{path}: {_SCENES[suffix]} files are not read; {way.format(stem=path.stem)}")


DATA_FOLDER = Path(__file__).resolve().parents[2] / "data"
#: Content beyond this size [bytes] is not read into memory.
SIZE_LIMIT = 3 << 29
_LABEL = {"body": "body", "garments": "garment", "motions": "sequence", "weights": "checkpoint"}
_SUFFIX = {"body": ".npz", "garments": ".npz", "motions": ".npz", "weights": ".safetensors"}
#: Former names, by kind: they still find what they found.
RENAMED = {"weights": {name: f"small-{name}" for name in ("ours", "fine15", "fine48")}}


def names(kind: str) -> list[str]:
    """Names of what comes with the package.

    Args:
        kind: ``"body"``, ``"garments"``, ``"motions"`` or ``"weights"``.

    Raises:
        ValueError: another kind.

    Examples:
        >>> import hood
        >>> hood.names("garments")[:3]
        ['apron', 'apron_12k', 'apron_4k']
    """
    if kind not in _SUFFIX:
        raise ValueError(unknown("kind", kind, _SUFFIX))
    return sorted(path.stem for path in (DATA_FOLDER / kind).glob("*" + _SUFFIX[kind]))


def locate(kind: str, name: str | Path, folders: bool = False) -> Path:
    """File of an embedded asset, or the user's own file; with ``folders`` also the user's own folder.

    A former name finds the same file under its name of today; a warning says so.

    Raises:
        FileNotFoundError: neither an embedded name nor an existing file; the message lists the nearest names.
        ValueError: a file of another program's format; names the way out.
    """
    require_name(kind, name)
    embedded = DATA_FOLDER / kind / f"{name}{_SUFFIX[kind]}"
    if embedded.is_file():
        return embedded
    today = RENAMED.get(kind, {}).get(str(name))
    if today is not None:
        warnings.warn(f"{_LABEL[kind]} {name} is called {today} now: a small model, not the paper's", stacklevel=2)
        return locate(kind, today)
    path = Path(name).expanduser()
    if path.is_file() or (folders and path.is_dir()):
        require_readable(path, kind)
        return path
    if path.is_dir():
        raise FileNotFoundError(f"{path}: a folder; give the path of a {_LABEL[kind]} file in it")
    if path.suffix or len(path.parts) > 1:
        raise FileNotFoundError(f"{path}: no such file (embedded {kind}: {_listed(names(kind))})")
    raise FileNotFoundError(unknown(_LABEL[kind], str(name), names(kind)) + "; or give the path of a file")


def require_name(kind: str, name: object) -> None:
    """Raise ValueError where something else than a name or a file is given, such as what was read from one already."""
    if not isinstance(name, (str, os.PathLike)):
        raise ValueError(f"a {_LABEL[kind]} is given by its name or file, not as {type(name).__name__}")


def unknown_suffix(path: Path, what: str) -> str:
    """The beginning of a sentence for a file whose name says another kind, or none."""
    return f"unknown {what} format {path.suffix!r}" if path.suffix else "its name has no ending that says the format"


def unknown(what: str, given: str, known: Iterable[str], meant: str | None = None) -> str:
    """The sentence for a misspelt name: the nearest known one first, or the one that is ``meant``."""
    known = list(known)
    near = meant or nearest(given, known)
    hint = f"did you mean {near!r}? " if near else ""
    return f"unknown {what} {given!r}: {hint}known are {_listed(known)}"


def _listed(known: Sequence[str]) -> str:
    """Names in a sentence; of those that are there at several sizes (``dress_4k``) the sizes once, behind all."""
    sized = {name: match for name in known if (match := _SIZED.fullmatch(name)) and match[1] in known}
    sizes = ", ".join(sorted({match[2] for match in sized.values()}, key=len))
    return (", ".join(name for name in known if name not in sized) or "none") + (f", most also with {sizes}" if sized else "")


def nearest(given: str, known: Iterable[str]) -> str | None:
    """The known name that a misspelt one is likeliest to mean; None where none is near."""
    return next(iter(difflib.get_close_matches(given, list(known), n=1, cutoff=0.6)), None)


def motion_split() -> dict[str, list[str]]:
    """Embedded motions by split: ``{"train": [...], "validation": [...]}``."""
    with open(DATA_FOLDER / "motions" / "split.json", encoding="utf-8") as file:
        split: dict[str, list[str]] = json.load(file)
    return split


def read_arrays(
    path: Path,
    required: Iterable[str],
    what: str,
    size_limit: int = SIZE_LIMIT,
    objects: Callable[[IO[bytes]], Any] | None = None,
) -> dict:
    """Arrays of an ``.npz`` file, never unpickled; members that would need it (strings of old files) are passed over.

    Args:
        objects: reads such a member instead, from behind its header.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not an npz file, larger than ``size_limit`` [bytes] once unpacked, or a required key is missing; names
            file, key and fix.
    """
    required = list(required)
    try:
        with zipfile.ZipFile(path) as archive:
            arrays = _members(archive, set(required), size_limit, objects)
    except FileNotFoundError:
        raise
    except Exception as error:
        raise ValueError(unreadable(path, f"{what} .npz file", first_line(error))) from error
    missing = [key for key in required if key not in arrays]
    if missing:
        raise ValueError(f"{path}: not a {what} file: key {missing[0]!r} is missing (found {sorted(arrays)[:8]})")
    return arrays


def _members(
    archive: zipfile.ZipFile, required: set[str], size_limit: int, objects: Callable[[IO[bytes]], Any] | None
) -> dict[str, Any]:
    entries = [info for info in archive.infolist() if info.filename.endswith(".npy")]
    total = sum(info.file_size for info in entries)
    if total > size_limit:
        raise ValueError(f"unpacks to {total} bytes, the limit is {size_limit}")
    arrays: dict[str, Any] = {}
    for info in entries:
        key = info.filename.removesuffix(".npy")
        with archive.open(info) as file:
            shape, dtype = npy_header(file)
            if dtype.hasobject and objects is not None:
                arrays[key] = objects(file)
        if dtype.hasobject:
            if key in required and objects is None:
                raise ValueError(f"key {key!r} holds Python objects, which are not read; save it as a plain array")
            continue
        # Memory is taken before the content is read: a header may promise what the file does not hold.
        if math.prod(shape) * dtype.itemsize > info.file_size:
            raise ValueError(f"key {key!r} claims shape {shape} and holds {info.file_size} bytes; the file is damaged")
        with archive.open(info) as file:
            arrays[key] = np.lib.format.read_array(file, allow_pickle=False)
    return arrays


def npy_header(file: IO[bytes]) -> tuple[tuple[int, ...], np.dtype]:
    """Shape and kind of the array behind a ``.npy`` header; ``file`` is left behind the header.

    Raises:
        ValueError: no such header, or a negative shape.
    """
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(file)
    if any(size < 0 for size in shape):
        raise ValueError(f"shape {shape} is negative; the file is damaged")
    return shape, dtype
