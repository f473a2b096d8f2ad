"""Loading a body by name or by path.

Body model files: which file of a folder, and its arrays, checked. Archives and pickles of the SMPL family alike; licensed SMPL,
SMPL-H and SMPL-X models are evaluated by ``smplx`` (non-commercial licence), which is imported here alone.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from hood.assets.body.body import Body, axis_angle_to_matrix
from hood.assets.files.library import SIZE_LIMIT, locate, read_arrays, unknown_suffix
from hood.assets.motion.sequence import PoseSequence
from hood.assets.pickles.records import load_pickle

#: Number of joints in a file → name of the model.
FAMILY = {24: "smpl", 52: "smplh", 55: "smplx"}
#: AMASS records at most this many shape coefficients.
_MAX_BETAS = 16
#: SMPL-X files end with directions of facial expression: 100 behind 300 of shape, or 10 behind 10.
_EXPRESSIONS = {400: 300, 20: 10}


@dataclass(frozen=True)
class SmplFamilyBody(Body):
    """A body whose surface is evaluated by ``smplx``, pose blend shapes included."""

    posedirs: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))  # (P, 3W) m per entry of a rotation matrix
    _tensors: dict[torch.dtype, tuple[Tensor, ...]] = field(default_factory=dict, repr=False, compare=False)

    def surface(self, sequence: PoseSequence, betas: np.ndarray, dtype: torch.dtype = torch.float32) -> Tensor:
        """Posed vertices (T, W, 3) [m] relative to :meth:`translation`."""
        from smplx.lbs import lbs

        rotations = axis_angle_to_matrix(torch.as_tensor(self.joint_poses(sequence))).to(dtype)
        shape = torch.zeros(len(rotations), self.shapedirs.shape[2], dtype=dtype)
        count = min(len(betas), shape.shape[1])
        shape[:, :count] = torch.as_tensor(np.asarray(betas, dtype=np.float64)[:count])
        template, shapedirs, posedirs, regressor, weights = self._tensors_in(dtype)
        parents = torch.as_tensor(self.parents)
        with torch.no_grad():
            return lbs(
                shape, rotations, template[None], shapedirs, posedirs, regressor, parents, weights, pose2rot=False
            )[0]  # fmt: skip

    def some_points(self, sequence: PoseSequence, betas: np.ndarray, stride: int) -> Tensor:
        """Every ``stride``-th vertex of :meth:`surface`, (T, W′, 3) [m] in float64."""
        return self.surface(sequence, betas, torch.float64)[:, ::stride]

    def _tensors_in(self, dtype: torch.dtype) -> tuple[Tensor, ...]:
        # Each precision is rounded from float64 by itself: a module turned to float32 and back has lost its digits.
        if dtype not in self._tensors:
            arrays = (self.v_template, self.shapedirs, self.posedirs, self.joint_regressor, self.weights)
            self._tensors[dtype] = tuple(torch.as_tensor(array).to(dtype) for array in arrays)
        return self._tensors[dtype]


def smpl_family_body(path: Path, arrays: dict[str, np.ndarray]) -> SmplFamilyBody:
    """A licensed model from the arrays of its file (see :func:`hood.assets.body.load.read_model`).

    Raises:
        ValueError: the number of joints belongs to no model of the family.
        ImportError: ``smplx`` is not installed.
    """
    import smplx  # noqa: F401  (asked for here, so that its absence shows when the file is opened)

    num_vertices, num_joints = arrays["weights"].shape
    if num_joints not in FAMILY:
        raise ValueError(f"{path}: {num_joints} joints; SMPL has 24, SMPL-H 52, SMPL-X 55")
    num_shapes = arrays["shapedirs"].shape[2]
    if FAMILY[num_joints] == "smplx":
        num_shapes = _EXPRESSIONS.get(num_shapes, num_shapes)
    return SmplFamilyBody(
        name=path.stem if path.stem != "model" else f"{path.parent.name}_{path.stem}",
        v_template=arrays["v_template"],
        shapedirs=arrays["shapedirs"][..., : min(num_shapes, _MAX_BETAS)],
        joint_regressor=arrays["J_regressor"],
        weights=arrays["weights"],
        parents=tuple(int(parent) for parent in arrays["kintree_table"][0]),
        faces=arrays["f"],
        family=FAMILY[num_joints],
        posedirs=arrays["posedirs"].reshape(3 * num_vertices, -1).T,
    )


MODEL_SUFFIXES = (".npz", ".pkl")
MODEL_KEYS = ("v_template", "shapedirs", "J_regressor", "weights", "kintree_table", "f")
_GENDERS = ("neutral", "male", "female")
#: How file and folder names tell the gender: SMPL_MALE.pkl, basicModel_f_lbs_10_207_0_v1.0.0.pkl, male/model.npz.
_GENDER_MARKS = {
    "female": re.compile(r"(?<![a-z])(female|f)(?![a-z])", re.I),
    "male": re.compile(r"(?<![a-z])(male|m)(?![a-z])", re.I),
    "neutral": re.compile(r"(?<![a-z])(neutral|n)(?![a-z])", re.I),
}


def choose_model(folder: Path, gender: str | None) -> Path:
    """The model file of ``gender`` in a folder (its files, and those one folder below).

    None asks for the neutral model; the folder's only model serves every gender.

    Raises:
        ValueError: no model, none of that gender, or several; names those that were found and the fix.
    """
    found = sorted(path for pattern in ("*", "*/*") for path in folder.glob(pattern) if _is_model(path))
    if not found:
        raise ValueError(f"{folder}: no body model (.npz or .pkl) in this folder; give the path of the file")
    wanted = gender or "neutral"
    if wanted not in _GENDERS:
        raise ValueError(f"gender {gender!r}: give one of {', '.join(_GENDERS)}")
    if len(found) == 1:
        return found[0]
    fitting = [path for path in found if model_gender(path, folder) == wanted]
    if len(fitting) != 1:
        some = ", ".join(str(path.relative_to(folder)) for path in (fitting or found)[:6])
        kind = "no" if not fitting else "more than one"
        raise ValueError(f"{folder}: {kind} {wanted} model among {some}; give the path of the file, or gender=…")
    return fitting[0]


def model_gender(path: Path, folder: Path | None = None) -> str | None:
    """Gender in the file's name, or in the name of its folder below ``folder``; None: it does not tell."""
    stems = [path.stem] if folder is None or path.parent == folder else [path.stem, path.parent.name]
    for stem in stems:
        for gender, mark in _GENDER_MARKS.items():
            if mark.search(stem.replace("_", " ")):
                return gender
    return None


def read_model(path: Path) -> dict[str, np.ndarray]:
    """Arrays of a body model: ``.npz`` (never unpickled) or the official ``.pkl`` (restricted unpickler, no chumpy).

    ``v_template (W, 3)``, ``shapedirs (W, 3, S)``, ``posedirs (W, 3, P)`` or absent, ``J_regressor (J, W)``,
    ``weights (W, J)`` and ``f (G, 3)`` int64, ``kintree_table (2, J)`` int64 with -1 for the root; floats in float64.

    Raises:
        ValueError: unreadable, a missing key, shapes or indices that do not agree, not finite; names file, key and fix.
    """
    fields: Mapping[str, Any]
    if path.suffix == ".pkl":
        fields = load_pickle(path, SIZE_LIMIT)
        if not isinstance(fields, dict):
            raise ValueError(f"{path}: holds a {type(fields).__name__}, not a body model; it must be a dict of arrays")
    elif path.suffix == ".npz":
        fields = read_arrays(path, (), "body model")
    else:
        raise ValueError(f"{path}: {unknown_suffix(path, 'body model')}; give .npz or .pkl")
    missing = [key for key in MODEL_KEYS if key not in fields]
    if missing:
        found = sorted(str(key) for key in fields)[:8]
        raise ValueError(f"{path}: not a body model file: key {missing[0]!r} is missing (found {found})")
    arrays = {key: _numbers(path, key, fields[key]) for key in (*MODEL_KEYS, "posedirs") if key in fields}
    _check_shapes(path, arrays)
    for key in ("f", "kintree_table"):
        arrays[key] = arrays[key].astype(np.int64)
    arrays["kintree_table"][0] = _parents(path, arrays["kintree_table"][0])
    if arrays["f"].size and not 0 <= arrays["f"].min() <= arrays["f"].max() < len(arrays["v_template"]):
        raise ValueError(f"{path}: f refers to vertices outside 0 … {len(arrays['v_template']) - 1}; the file is damaged")
    return arrays


def _is_model(path: Path) -> bool:
    return path.is_file() and path.suffix in MODEL_SUFFIXES and not path.name.startswith(".")


def _numbers(path: Path, key: str, value: Any) -> np.ndarray:
    if sparse.issparse(value):
        # A sparse matrix may claim any size; one row per joint and a column per vertex is the most that is meant.
        if value.shape[0] * value.shape[1] * 8 > SIZE_LIMIT // 4:
            raise ValueError(f"{path}: {key} is a sparse matrix of shape {value.shape}; that is no body model")
        value = value.toarray()
    array = np.asarray(value)
    if array.dtype.kind not in "iuf":
        raise ValueError(f"{path}: {key} holds {array.dtype} values; it must hold numbers")
    if not np.isfinite(array).all():
        raise ValueError(f"{path}: {key} is not finite everywhere; the file is damaged")
    return array.astype(np.float64)


def _check_shapes(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    weights = arrays["weights"]
    if weights.ndim != 2 or 0 in weights.shape:
        raise ValueError(f"{path}: weights has shape {weights.shape}; it must be (vertices, joints)")
    num_vertices, num_joints = weights.shape
    expected: dict[str, tuple[int | None, ...]] = {
        "v_template": (num_vertices, 3),
        "shapedirs": (num_vertices, 3, None),
        "J_regressor": (num_joints, num_vertices),
        "f": (None, 3),
        "kintree_table": (2, num_joints),
        "posedirs": (num_vertices, 3, 9 * (num_joints - 1)),
    }
    for key, shape in expected.items():
        if key not in arrays:
            continue
        own = arrays[key].shape
        if len(own) != len(shape) or any(want not in (None, have) for want, have in zip(shape, own, strict=True)):
            asked = ", ".join("any" if want is None else str(want) for want in shape)
            raise ValueError(
                f"{path}: {key} has shape {own}; weights of {num_vertices} vertices and {num_joints} joints ask for ({asked})"
            )
    if (weights.sum(axis=1) <= 0).any():
        raise ValueError(f"{path}: weights of vertex {int(np.argmin(weights.sum(axis=1)))} do not sum to more than zero")


def _parents(path: Path, table: np.ndarray) -> np.ndarray:
    """Parents with -1 for the root, which comes first; files write it as 2³² - 1 or as the root itself."""
    parents = table.copy()
    parents[0] = -1
    for joint, parent in enumerate(parents[1:], start=1):
        if not 0 <= parent < joint:
            raise ValueError(
                f"{path}: kintree_table gives joint {joint} the parent {parent}; parents come before their children"
            )
    return parents


def load_body(name: str | Path = "default", gender: str | None = None) -> Body:
    """A body model by its embedded name or from a file.

    Files of the SMPL family with pose blend shapes are evaluated through ``smplx``.

    Args:
        name: the embedded ``default``, a body model file (``.npz``, official ``.pkl``), or a folder of them.
        gender: "neutral", "male" or "female": which model of a folder; None means neutral.

    Returns:
        The :class:`Body`, with ``v_template`` (W, 3) m in T-pose, ``faces`` (G, 3).

    Raises:
        FileNotFoundError: unknown name or missing file.
        ValueError: not a body model; names the file, the key and the fix.

    Examples:
        >>> import hood
        >>> body = hood.load_body()
        >>> body.v_template.shape, body.num_joints
        ((6890, 3), 24)
    """
    path = locate("body", name, folders=True)
    if path.is_dir():
        path = choose_model(path, gender)
    return _read_body(path, path.stat().st_mtime_ns, path.stat().st_size)


@lru_cache(maxsize=1)
def _read_body(path: Path, changed: int, size: int) -> Body:
    """The body of a file; many rollouts of one process ask for the same, as it was ``changed`` last [ns]."""
    arrays = read_model(path)
    if "posedirs" in arrays and np.any(arrays["posedirs"]):
        return smpl_family_body(path, arrays)
    weights = arrays["weights"]
    return Body(
        name=path.stem,
        v_template=arrays["v_template"],
        shapedirs=arrays["shapedirs"],
        joint_regressor=arrays["J_regressor"],
        weights=weights / weights.sum(axis=1, keepdims=True),
        parents=tuple(int(parent) for parent in arrays["kintree_table"][0]),
        faces=arrays["f"],
    )
