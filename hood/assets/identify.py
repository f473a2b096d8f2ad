"""The kind of a file (garment, body, motion, rollout, …), from its name and its keys."""

from __future__ import annotations

import zipfile
from collections.abc import Collection
from pathlib import Path
from typing import Any

import h5py

from hood.assets.files.guarded import guarded, listed, own_group
from hood.assets.files.library import RENAMED, names, nearest, require_readable
from hood.assets.formats.gltf import read_gltf
from hood.assets.formats.mesh_file import mesh_suffixes, split_object
from hood.assets.formats.usd import USD_SUFFIXES, moves
from hood.assets.formats.vertex_files import CACHE_SUFFIXES
from hood.assets.garment.reference_garments import garment_names
from hood.assets.motion.animated_mesh import body_kind
from hood.assets.motion.layouts.content import PICKLES, TENSORS, plain_content, read_content
from hood.assets.motion.layouts.read import is_of_motion
from hood.assets.motion.recording import motion_suffixes
from hood.assets.pickles.content import load_content

GARMENT, BODY, MOTION, MOVING_MESH = "garment", "body model", "motion", "moving mesh"
CHECKPOINT, ROLLOUT, REFERENCE_ROLLOUT, VERTEX_LIST = "checkpoint", "rollout", "rollout of the reference", "vertex list"
_CHECKPOINTS = (".safetensors", ".ckpt")
_EMBEDDED = {"garments": GARMENT, "motions": MOTION, "body": BODY, "weights": CHECKPOINT}
_KEYS = {
    GARMENT: ({"rest_pos", "faces"}, {"vertices", "faces", "coarse_edges"}),
    BODY: ({"v_template", "weights"},),
    MOTION: ({"poses"}, {"root_orient"}, {"global_orient"}, {"pose", "translation"}),
    REFERENCE_ROLLOUT: ({"pred", "cloth_faces"},),
    MOVING_MESH: ({"verts", "faces"}, {"vertices", "faces"}, {"verts", "f"}),
}


def identify(name: str) -> str:
    """The kind of an embedded name or a file.

    Raises:
        FileNotFoundError: neither an embedded name nor a file.
        ValueError: unreadable, or of a kind that nothing here reads; says what was found in it.
    """
    for folder, kind in _EMBEDDED.items():
        if name in names(folder) or name in RENAMED.get(folder, {}):
            return kind
    head, colon, _ = name.rpartition(":")
    path = Path(head).expanduser() if colon and head.lower().endswith(".pkl") else split_object(name)[0]
    if not path.exists():
        near = nearest(name, [known for folder in _EMBEDDED for known in names(folder)])
        hint = f"; did you mean {near}?" if near else ""
        raise FileNotFoundError(f"{path}: no such file, and no embedded asset of that name{hint}")
    if path.is_dir():
        return MOVING_MESH if body_kind(path) == "mesh" else BODY
    require_readable(path, "file")
    suffix = path.suffix.lower()
    if suffix in (".glb", ".gltf"):
        gltf = read_gltf(path)
        return MOVING_MESH if gltf.items("animations") or gltf.items("skins") else GARMENT
    if suffix in USD_SUFFIXES:
        return MOVING_MESH if moves(path) else GARMENT
    if suffix in CACHE_SUFFIXES:
        return MOVING_MESH
    if suffix in mesh_suffixes():
        return GARMENT
    if suffix in _CHECKPOINTS:
        return CHECKPOINT
    if suffix in TENSORS:
        return MOTION if _is_torch_motion(path) else CHECKPOINT
    if suffix in (".txt", ".json"):
        return VERTEX_LIST
    if suffix in (".h5", ".hdf5"):
        return guarded(path, "HDF5 file", lambda: _h5_kind(path))
    if suffix == ".npz":
        keys = guarded(path, "NumPy archive", lambda: _archive_keys(path))
        return _kind_of_keys(keys) or _kind_of_content(path, read_content(path), keys)
    if suffix in PICKLES:
        content = load_content(path)
        if garment_names(content):
            return GARMENT
        keys = [str(key) for key in content] if isinstance(content, dict) else []
        return _kind_of_keys(keys) or _kind_of_content(path, plain_content(content), keys)
    if suffix in motion_suffixes():
        return MOTION
    kind = f"unknown file type {path.suffix!r}" if path.suffix else "its name has no ending, such as .obj or .npz"
    raise ValueError(f"{path}: {kind}; convert or rename it, docs/files.md lists what is read")


def _kind_of_keys(keys: Collection[str]) -> str | None:
    fitting = (kind for kind, alternatives in _KEYS.items() if any(needed <= set(keys) for needed in alternatives))
    return next(fitting, None)


def _is_torch_motion(path: Path) -> bool:
    """Whether a file of torch holds a motion; what cannot be read is left to the reader of checkpoints."""
    try:
        return is_of_motion(path, read_content(path))
    except ValueError:
        return False


def _kind_of_content(path: Path, content: Any, keys: Collection[str]) -> str:
    """A motion may stand deeper in a file, or under keys of other layouts."""
    if is_of_motion(path, content):
        return MOTION
    raise ValueError(f"{path}: no garment, body, motion or mesh has the keys {listed(sorted(keys))}")


def _archive_keys(path: Path) -> list[str]:
    with zipfile.ZipFile(path) as archive:
        return [name.removesuffix(".npy") for name in archive.namelist()]


def _h5_kind(path: Path) -> str:
    with h5py.File(path, "r") as file:
        cloth = own_group(file, "cloth")
        known = cloth is not None and any(cloth.get(name, getlink=True) is not None for name in ("pos", "steps"))
        return ROLLOUT if known else MOVING_MESH
