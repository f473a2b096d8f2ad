"""What a motion file holds, whatever its format: a tree of dicts, lists and numpy arrays; nothing in it is run.

The published layouts by their keys: what each holds, its custom of the up axis, and the frame rate of its recordings.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass, field
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


#: Numbers of one rotation: axis-angle vectors, quaternions, 6D, matrices.
PER_TURN = (3, 4, 6, 9)
#: Numbers of joints of a whole skeleton: without hands, SMPL, SMPL-H, SMPL-X.
WHOLE = (22, 24, 52, 55)
_ROOT, _BODY = (1,), (21, 23)
#: The joints that a key of rotations holds: how many, from which on.
_COUNTS: dict[str, tuple[tuple[int, ...], int]] = {
    "rootorient": (_ROOT, 0), "globalorient": (_ROOT, 0), "posesroot": (_ROOT, 0), "worldglobalrots": (_ROOT, 0),
    "posebody": (_BODY, 1), "bodypose": (_BODY, 1), "posesbody": (_BODY, 1),
}  # fmt: skip
#: Keys of a translation in the world, and of one in front of a camera.
WORLD_TRANSL = (
    "trans", "transl", "translation", "smpltrans", "smpltransl", "transworld", "worldtrans", "roottrans", "roottranslation",
)  # fmt: skip
CAMERA_TRANSL = ("predtrans", "predcamt", "camt", "camtrans", "transcam", "cameratranslation", "camera", "cameratransl")
#: A frame rate of recordings from video, where their layout says none.
VIDEO_FPS = 30.0


@dataclass(frozen=True)
class MotionLayout:
    """How a published file is told by its keys; keys are in lower case, without signs.

    ``fps`` is the rate that recordings of the layout are known to have where no file says it; None: a file must say it.
    """

    name: str
    poses: tuple[str, ...]  # keys of the joint rotations, in the order of the joints
    transl: tuple[str, ...] = WORLD_TRANSL  # keys that may hold the translation, the first counts
    marks: tuple[str, ...] = ()  # keys of which one must be there as well
    above: str = ""  # key of the dict that the layout stands in
    fps: float | None = VIDEO_FPS
    up: str = "y"
    camera: bool = False  # as seen from a camera, which need not be level
    family: str | None = None  # None: by the number of joints
    scaling: str = ""  # key of the number by which its translation is larger than metres
    ids: tuple[str, ...] = field(default=())  # keys of the person that each row is of

    def fits(self, keys: Mapping[str, str], above: str) -> bool:
        """Whether a dict with these keys under the key ``above`` is of this layout."""
        marked = not self.marks or any(mark in keys for mark in self.marks)
        placed = not self.above or self.above == above
        return marked and placed and all(key in keys for key in self.poses)


def counts_of(key: str) -> tuple[tuple[int, ...], int]:
    """How many joints a squeezed key of rotations may hold, and from which on."""
    return _COUNTS.get(key, (WHOLE, 0))


def layout_sizes(key: str) -> set[int]:
    """How many numbers a pose under a squeezed key of rotations may have, in whatever representation."""
    return {count * per for count in counts_of(key)[0] for per in PER_TURN}


_TRACKS = ("trackids", "trackedids", "tid", "subjectids")
#: In the order in which they are tried: those told by special keys before those whose keys others have as well.
LAYOUTS = (
    MotionLayout("AIST++", ("smplposes",), ("smpltrans",), ("smplscaling",), fps=60.0, family="smpl", scaling="smplscaling"),
    MotionLayout("3DPW", ("poses",), marks=("poses60hz", "vtemplateclothed", "camposevalid", "camposes"), family="smpl"),
    MotionLayout("EMDB", ("posesroot", "posesbody"), family="smpl"),
    MotionLayout("BEDLAM labels", ("poseworld",), ("transworld",), marks=("imgname",), family="smplx"),
    MotionLayout("BEDLAM labels", ("posecam",), ("transcam",), marks=("imgname",), camera=True, up="-y", family="smplx"),
    MotionLayout("WHAM", ("poseworld",), ("transworld",), family="smpl"),
    MotionLayout("GVHMR", ("globalorient", "bodypose"), above="smplparamsglobal", family="smplx"),
    MotionLayout("GVHMR, in its camera", ("globalorient", "bodypose"), above="smplparamsincam", camera=True, up="-y",
           family="smplx"),
    MotionLayout(
        "SLAHMR", ("rootorient", "posebody"), marks=("trackmask", "floorplane", "worldscale", "latentpose", "camr"),
        camera=True, up="-y", family="smplh",
    ),
    MotionLayout("TRACE", ("worldglobalrots", "smplthetas"), ("worldtrans",), family="smpl", up="-y", camera=True, ids=_TRACKS),
    MotionLayout("ROMP", ("smplthetas",), CAMERA_TRANSL, camera=True, up="-y", family="smpl", ids=_TRACKS),
    MotionLayout("TRAM", ("predrotmat",), CAMERA_TRANSL, camera=True, up="-y", family="smpl"),
    MotionLayout("Motion-X", ("rootorient", "posebody"), above="motionx", family="smplx"),
    MotionLayout("MDM", ("thetas",), ("roottranslation",), fps=20.0, family="smpl"),
    MotionLayout("GRAB", ("fullpose",), above="params", fps=None, up="z"),
    MotionLayout("SMPL-X stage ii", ("fullpose",), marks=("stageiidebugdetails", "markerslatent"), fps=None, up="z"),
    MotionLayout("fullpose", ("fullpose",), fps=None, up="z"),
    MotionLayout("PHC", ("poseaa",), ("trans", "transorig", "roottransoffset"), up="z"),
    MotionLayout("HybrIK", ("predthetas",), ("transl", *CAMERA_TRANSL), camera=True, up="-y", family="smpl"),
    MotionLayout("AMASS", ("poses",), fps=None, up="z"),
    MotionLayout("AMASS", ("rootorient", "posebody"), fps=None, up="z"),
    MotionLayout("body_pose", ("globalorient", "bodypose")),
    MotionLayout("pose and translation", ("pose",)),
    MotionLayout("image estimator", ("globalorient", "bodypose"), CAMERA_TRANSL, CAMERA_TRANSL, camera=True, up="-y"),
    MotionLayout("image estimator", ("pose",), CAMERA_TRANSL, CAMERA_TRANSL, camera=True, up="-y"),
    MotionLayout("SMPL poses", ("smplposes",)),
    MotionLayout("SMPL poses", ("smplpose",)),
    MotionLayout("SMPL poses", ("thetas",)),
)  # fmt: skip


def find_layout(keys: Mapping[str, str], above: str = "") -> MotionLayout | None:
    """The layout of a dict with the squeezed ``keys``; one whose translation is there goes before one where it is not."""
    fitting = [layout for layout in LAYOUTS if layout.fits(keys, above)]
    return next((layout for layout in fitting if any(key in keys for key in layout.transl)), next(iter(fitting), None))
