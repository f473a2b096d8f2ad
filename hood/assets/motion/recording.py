"""Motion files as recorded: AMASS archives of every layout, pose pickles of the reference implementation and of VTO."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hood import plugins
from hood.assets.files.library import SIZE_LIMIT, read_arrays
from hood.assets.pickles.unpickle import load_pickle

#: Body joints that drive a garment: pelvis to wrists. Columns 66:72 of SMPL+H poses are fingers, not SMPL's hands.
NUM_BODY_JOINTS = 22
SMPL_JOINTS = 24
NUM_FINGER_JOINTS = 30  # 15 a side, left first
MOTION_SUFFIXES = (".npz", ".pkl")
#: Readers of other formats, see :mod:`hood.plugins`: a path in; the arrays of one of the layouts below out, by key.
PLUGINS = "motions"
#: Frame rate of the layouts that never say it.
_SILENT_FPS = 30.0
#: No rotation [rad] or place [m] is farther from zero, no shape coefficient than a thousandth of it.
_LARGEST = 1e6
#: Joint rotations beyond a full turn [rad] are rare (an unwound root), and in degrees most of them are.
_FULL_TURN, _MOST_BEYOND = 2 * np.pi, 0.2

_RATE_KEYS = ("mocap_framerate", "mocap_frame_rate", "fps", "frame_rate")
_TRANSL_KEYS = ("trans", "transl", "translation")
_SHAPE_KEYS = ("betas", "shape")
#: Keys of the joint rotations → columns allowed in each. AMASS writes the first two, the reference the third, VTO the last.
_LAYOUTS: dict[tuple[str, ...], tuple[tuple[int, ...], ...]] = {
    ("poses",): ((66, 72, 156, 165),),
    ("root_orient", "pose_body"): ((3,), (63,)),
    ("global_orient", "body_pose"): ((3,), (63, 69)),
    ("pose",): ((66, 72, 156, 165),),
}
_Z_UP_KEYS = ("poses", "root_orient")
_FAMILIES = {72: "smpl", 156: "smplh", 165: "smplx"}


@dataclass(frozen=True)
class Recording:
    """A motion in the world, at the frame rate and with the joints of its file."""

    poses: np.ndarray  # (N, 24, 3) axis-angle [rad], float64; joints 22 and 23 only of SMPL files
    fingers: np.ndarray | None  # (N, 30, 3) axis-angle [rad], of SMPL-H and SMPL-X files
    transl: np.ndarray  # (N, 3) m, float64
    fps: float
    betas: np.ndarray  # (S,) of the recorded subject, zeros where the file has none
    gender: str | None  # "neutral", "male", "female"
    family: str | None  # model that recorded it: "smpl", "smplh", "smplx"; None: the file does not tell
    up: str  # "y" or "z": the custom of the layout


def motion_suffixes() -> tuple[str, ...]:
    """Suffixes of the motion files that can be read, those of plugins last."""
    return (*MOTION_SUFFIXES, *(f".{name}" for name in plugins.names(PLUGINS)))


def read_recording(path: Path, file_fps: float | None = None) -> Recording:
    """A motion file: ``.npz`` (never unpickled) or ``.pkl`` (restricted unpickler), told apart by their keys; or a
    format that a plugin reads.

    Accepted: AMASS ``poses (N, 66 | 72 | 156 | 165), trans`` or ``root_orient, pose_body[, pose_hand], trans`` with
    ``mocap_framerate`` or ``mocap_frame_rate``; ``body_pose (N, 63 | 69), global_orient, transl[, betas]``;
    ``pose (N, 72), translation[, shape]``. The last two are taken at 30 fps where they hold no ``fps``.

    Args:
        file_fps: frame rate [1/s] of the file, whatever it says itself.

    Raises:
        ValueError: none of these, wrong shapes, fewer than two frames, not finite; names file, key and fix.
    """
    fields = _fields(path)
    keys = next((keys for keys in _LAYOUTS if all(key in fields for key in keys)), None)
    if keys is None:
        raise ValueError(_unknown(path, fields))
    parts = [_table(path, key, fields[key], widths) for key, widths in zip(keys, _LAYOUTS[keys], strict=True)]
    if len({len(part) for part in parts}) > 1:
        raise ValueError(f"{path}: {' and '.join(keys)} have {[len(part) for part in parts]} frames; they must agree")
    flat = np.concatenate(parts, axis=1)
    transl_key = next((key for key in _TRANSL_KEYS if key in fields), None)
    if transl_key is None:
        raise ValueError(f"{path}: not an AMASS motion: key 'trans' is missing (found {sorted(fields)[:8]})")
    transl = _table(path, transl_key, fields[transl_key], (3,))
    _check_frames(path, " and ".join(keys), flat, transl_key, transl)
    _require_radians(path, " and ".join(keys), flat)
    return Recording(
        poses=_body_poses(flat),
        fingers=_fingers(path, fields, flat),
        transl=transl,
        fps=_frame_rate(path, fields, keys[0] not in _Z_UP_KEYS, file_fps),
        betas=_betas(path, fields),
        gender=_gender(fields.get("gender")),
        family=_family(fields, flat),
        up="z" if keys[0] in _Z_UP_KEYS else "y",
    )


def _fields(path: Path) -> Mapping[str, Any]:
    if path.suffix == ".npz":
        return read_arrays(path, (), "AMASS motion")
    if path.suffix != ".pkl":
        if path.suffix.lower()[1:] in plugins.names(PLUGINS):
            return _read_by_plugin(path)
        raise ValueError(
            f"{path}: unknown motion format {path.suffix!r}; give an AMASS .npz or a .pkl with body_pose, global_orient, transl"
        )
    content = load_pickle(path, SIZE_LIMIT)
    if not isinstance(content, dict):
        raise ValueError(f"{path}: holds a {type(content).__name__}, not a motion; it must be a dict of arrays")
    return {str(key): value for key, value in content.items()}


def _read_by_plugin(path: Path) -> Mapping[str, Any]:
    """What a plugin's reader gives.

    Raises:
        ValueError: the reader refuses the file, or gives no arrays by key; names the file.
    """
    read = plugins.find(PLUGINS, path.suffix.lower()[1:])
    try:
        fields = read(path)
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: the reader of {path.suffix} files: {error}") from error
    if not isinstance(fields, Mapping):
        raise ValueError(
            f"{path}: the reader of {path.suffix} files gives a {type(fields).__name__}; it has to return arrays by key, "
            "poses, trans and mocap_framerate"
        )
    return {str(key): value for key, value in fields.items()}


def _unknown(path: Path, fields: Mapping[str, Any]) -> str:
    if "verts" in fields or "vertices" in fields:
        return f"{path}: holds a mesh, not joint rotations; a moving mesh is a body: pass body={path}"
    if "v_template" in fields:
        return f"{path}: holds a body model, not a motion; pass body={path}"
    return (
        f"{path}: not an AMASS motion: neither 'poses' nor 'root_orient' and 'pose_body' inside "
        f"(found {sorted(fields)[:8]}); or give 'body_pose', 'global_orient' and 'transl'"
    )


def _numbers(path: Path, key: str, value: Any) -> np.ndarray:
    array = np.asarray(value)
    if array.dtype.kind not in "iuf":
        raise ValueError(f"{path}: {key} holds {array.dtype} values; it must hold numbers")
    return array.astype(np.float64)


def _table(path: Path, key: str, value: Any, widths: tuple[int, ...]) -> np.ndarray:
    array = _numbers(path, key, value)
    if array.ndim == 3 and array.shape[2] == 3:
        array = array.reshape(len(array), -1)
    if array.ndim != 2 or array.shape[1] not in widths:
        allowed = " or ".join(f"(N, {width})" for width in widths)
        raise ValueError(f"{path}: {key} has shape {array.shape}; it must be {allowed}")
    return array


def _check_frames(path: Path, pose_key: str, flat: np.ndarray, transl_key: str, transl: np.ndarray) -> None:
    if len(flat) != len(transl):
        raise ValueError(f"{path}: {pose_key} has {len(flat)} frames, {transl_key} has shape {transl.shape}; they must agree")
    if len(flat) < 2:
        raise ValueError(f"{path}: the sequence has {len(flat)} frame(s); a motion needs at least 2")
    for name, values in ((pose_key, flat), (transl_key, transl)):
        _require_sound(path, name, values)


def _require_sound(path: Path, name: str, values: np.ndarray) -> None:
    for word, bad in (("not finite", ~np.isfinite(values)), (f"beyond ±{_LARGEST:g}", np.abs(values) > _LARGEST)):
        frames = bad.any(axis=1)
        if frames.any():
            raise ValueError(f"{path}: {name} is {word} in frame {int(np.argmax(frames))}; remove or repair that frame")


def _require_radians(path: Path, name: str, flat: np.ndarray) -> None:
    angle = np.linalg.norm(flat[:, : 3 * NUM_BODY_JOINTS].reshape(len(flat), -1, 3), axis=2)
    turned = angle[angle > 0]
    if len(turned) and float((turned > _FULL_TURN).mean()) > _MOST_BEYOND:
        raise ValueError(
            f"{path}: {name} holds degrees (half of the joint rotations are beyond {np.median(turned):.3g}, a full turn is "
            f"{_FULL_TURN:.3g}); multiply it by pi / 180"
        )


def _body_poses(flat: np.ndarray) -> np.ndarray:
    poses = np.zeros((len(flat), SMPL_JOINTS, 3))
    width = 72 if flat.shape[1] == 72 else 66
    poses[:, : width // 3] = flat[:, :width].reshape(len(flat), -1, 3)
    return poses


def _fingers(path: Path, fields: Mapping[str, Any], flat: np.ndarray) -> np.ndarray | None:
    if flat.shape[1] in (156, 165):
        return flat[:, -90:].reshape(len(flat), NUM_FINGER_JOINTS, 3)
    if "pose_hand" not in fields:
        return None
    hand = _table(path, "pose_hand", fields["pose_hand"], (90,))
    if len(hand) != len(flat):
        raise ValueError(f"{path}: pose_hand has {len(hand)} frames, the body has {len(flat)}; they must agree")
    _require_sound(path, "pose_hand", hand)
    return hand.reshape(len(hand), NUM_FINGER_JOINTS, 3)


def _frame_rate(path: Path, fields: Mapping[str, Any], silent: bool, file_fps: float | None) -> float:
    if file_fps is not None:
        if not np.isfinite(file_fps) or not 0.1 <= file_fps <= 1e5:
            raise ValueError(f"{path}: file_fps={file_fps}; give the file's frames per second, 0.1 to 100000")
        return float(file_fps)
    for key in _RATE_KEYS:
        if key in fields:
            value = np.asarray(fields[key]).reshape(-1)
            rate = float(value[0]) if len(value) == 1 and value.dtype.kind in "iuf" else np.nan
            if not np.isfinite(rate) or not 0.1 <= rate <= 1e5:
                raise ValueError(
                    f"{path}: {key} is {' '.join(str(fields[key]).split())[:40]}; it must be a positive number of frames per "
                    "second (0.1 to 100000; file_fps=… overrides it)"
                )
            return rate
    if silent:
        return _SILENT_FPS
    raise ValueError(f"{path}: no mocap_framerate: add it (frames per second) to the file, or pass file_fps=…")


def _betas(path: Path, fields: Mapping[str, Any]) -> np.ndarray:
    """(S,): a table of one row per frame must repeat the same row, a body does not change its shape."""
    key = next((key for key in _SHAPE_KEYS if key in fields), None)
    if key is None:
        return np.zeros(10)
    table = _numbers(path, key, fields[key])
    if table.ndim == 0 or table.ndim > 2 or len(table) == 0 or not (np.abs(table) <= _LARGEST / 1e3).all():
        raise ValueError(f"{path}: {key} has shape {table.shape} or absurd values; give (S,) finite shape coefficients")
    if table.ndim == 1:
        return table
    changed = np.abs(table - table[0]).max(axis=1) > 1e-6
    if changed.any():
        raise ValueError(f"{path}: {key} changes in frame {int(np.argmax(changed))}; a body keeps one shape, keep one row")
    return table[0]


def _gender(value: Any) -> str | None:
    if value is None:
        return None
    item = np.asarray(value).reshape(-1)
    if len(item) != 1:
        return None
    text = item[0].decode("latin-1") if isinstance(item[0], bytes) else str(item[0])
    text = text.strip().strip("b'\"").lower()
    return text if text in ("neutral", "male", "female") else None


def _family(fields: Mapping[str, Any], flat: np.ndarray) -> str | None:
    if "surface_model_type" in fields:
        name = np.asarray(fields["surface_model_type"]).reshape(-1)
        text = "" if len(name) != 1 else name[0].decode("latin-1") if isinstance(name[0], bytes) else str(name[0])
        text = text.strip().lower().replace("-", "").replace("+", "").replace("_locked_head", "")
        return text if text in _FAMILIES.values() else None
    if "root_orient" in fields and "poses" not in fields:
        return "smplx" if any(key in fields for key in ("pose_jaw", "pose_eye")) else None
    if "body_pose" in fields:
        return "smpl"
    return _FAMILIES.get(flat.shape[1])
