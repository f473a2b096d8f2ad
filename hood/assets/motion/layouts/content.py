"""What a motion file holds, whatever its format: a tree of dicts, lists and numpy arrays; nothing in it is run."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch

from hood import plugins
from hood.assets.files.guarded import check_size, guarded
from hood.assets.files.library import SIZE_LIMIT, npy_header, read_arrays
from hood.assets.pickles.content import load_content, load_torch, unpickle

ARCHIVES, ARRAYS, PICKLES, TENSORS = (".npz",), (".npy",), (".pkl", ".pickle", ".pk", ".p", ".joblib"), (".pt", ".pth")
MOTION_SUFFIXES = (*ARCHIVES, *PICKLES, *ARRAYS, *TENSORS)
#: Readers of other formats, see :mod:`hood.plugins`: a path in; the arrays of one of the layouts out, by key.
_PLUGINS = "motions"
#: Containers within each other beyond this number hold no motion that anyone writes.
_DEEPEST = 8


class Unread:
    """Stands for a member of an archive that names a class; ``reason`` is the sentence."""

    def __init__(self, reason: str) -> None:
        self.reason = reason


def motion_suffixes() -> tuple[str, ...]:
    """Suffixes of the motion files that can be read, those of plugins last."""
    return (*MOTION_SUFFIXES, *(f".{name}" for name in plugins.names(_PLUGINS)))


def read_content(path: Path) -> Any:
    """The content of a motion file as dicts with text for keys, lists, numpy arrays, numbers and text.

    Raises:
        FileNotFoundError: no such file.
        ValueError: another format, unreadable, or naming a class; names the file.
    """
    suffix = path.suffix.lower()
    if suffix in ARCHIVES:
        return plain_content(read_arrays(path, (), "AMASS motion", objects=_object))
    if suffix in ARRAYS:
        return plain_content(_read_array(path))
    if suffix in PICKLES:
        return plain_content(load_content(path, SIZE_LIMIT))
    if suffix in TENSORS:
        return plain_content(load_torch(path, SIZE_LIMIT))
    if suffix[1:] in plugins.names(_PLUGINS):
        return plain_content(_read_by_plugin(path))
    raise ValueError(
        f"{path}: unknown motion format {path.suffix!r}; give an AMASS .npz or a .pkl with body_pose, global_orient, transl"
    )


def plain_content(item: Any, depth: int = 0) -> Any:
    """``item`` with tensors as arrays, arrays of objects as lists (one object as itself), and keys as text."""
    if depth > _DEEPEST:
        return None
    if isinstance(item, torch.Tensor):
        item = item.detach().cpu()
        return (item.float() if item.dtype is torch.bfloat16 else item).numpy()
    if isinstance(item, np.ndarray) and item.dtype == object:
        return plain_content(item.item() if item.ndim == 0 else item.tolist(), depth)
    if isinstance(item, Mapping):
        return {_text(key): plain_content(value, depth + 1) for key, value in item.items()}
    if isinstance(item, (list, tuple)):
        table = _table(item)
        return table if table is not None else [plain_content(entry, depth + 1) for entry in item]
    return item


def length(value: Any) -> int:
    """How many entries a list or the first axis of an array has; -1 for what has no entries."""
    return len(value) if isinstance(value, list) or (isinstance(value, np.ndarray) and value.ndim) else -1


def _table(item: Any) -> np.ndarray | None:
    """Lists of numbers, or of such lists of one length, as an array; None for others."""
    first = item
    while isinstance(first, (list, tuple)) and first:
        first = first[0]
    if not isinstance(first, (int, float)):
        return None
    try:
        found = np.asarray(item)
    except ValueError:  # rows of several lengths
        return None
    return found if found.dtype.kind in "iuf" else None


def _text(key: Any) -> str:
    return key.decode("latin-1") if isinstance(key, bytes) else str(key)


def _object(file: IO[bytes]) -> Any:
    """The object of an archive's member by the restricted unpickler; :class:`Unread` where it is more than plain content."""
    try:
        return unpickle(io.BytesIO(file.read()))
    except Exception as error:  # broken bytes raise anything, and other members may still hold the motion
        return Unread(str(error).splitlines()[0] if str(error) else type(error).__name__)


def _read_array(path: Path) -> Any:
    check_size(path, SIZE_LIMIT)

    def read() -> Any:
        with open(path, "rb") as file:
            if npy_header(file)[1].hasobject:
                return unpickle(file)
        # Mapped, not read: a header that announces more than the file holds is refused before memory is asked for.
        return np.array(np.load(path, mmap_mode="r", allow_pickle=False))

    return guarded(path, "NumPy array", read)


def _read_by_plugin(path: Path) -> Mapping[str, Any]:
    """What a plugin's reader gives.

    Raises:
        ValueError: the reader refuses the file, or gives no arrays by key; names the file.
    """
    read = plugins.find(_PLUGINS, path.suffix.lower()[1:])
    try:
        fields = read(path)
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: the reader of {path.suffix} files: {error}") from error
    if not isinstance(fields, Mapping):
        raise ValueError(
            f"{path}: the reader of {path.suffix} files gives a {type(fields).__name__}; it has to return arrays by key, "
            "poses, trans and mocap_framerate"
        )
    return fields
