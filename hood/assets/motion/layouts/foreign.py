"""Sentences for what looks like a motion, or is mistaken for one, and is not read: what it is, and what to write instead."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hood.assets.files.guarded import listed
from hood.assets.files.text import squeezed
from hood.assets.motion.layouts.content import Unread
from hood.assets.motion.layouts.people import Person
from hood.assets.motion.skeleton import PARENTS

#: Bones keep their length: it varies by less than this share where triples are places of joints.
_RIGID = 0.03
_WRITE = "np.savez('m.npz', poses=…, trans=…, mocap_framerate=…)"
_NO_BODY = (
    "joint positions are not read, and rotations do not follow from them alone; fit SMPL to them (SMPLify, or the fitting of "
    "the program that made them) and give its poses (N, 72) and trans (N, 3)"
)
#: Widths of tables of features, by the data sets they are from.
_FEATURES = {263: "HumanML3D", 251: "KIT-ML"}
_WEIGHTS = ("statedict", "modelstatedict", "optimizer", "pytorchlightningversion", "epoch")


def unknown_motion(path: Path, content: Any) -> str:
    """The sentence for content in which no layout is found."""
    if isinstance(content, np.ndarray):
        return f"{path}: {_bare(content)}"
    if not isinstance(content, Mapping):
        return f"{path}: holds a {type(content).__name__}, not a motion; it must be a dict of arrays"
    keys = {squeezed(key): key for key in content}
    if are_weights(content):
        return f"{path}: holds the weights of a network, not a motion; pass checkpoint={path}"
    if "vtemplate" in keys:
        return f"{path}: holds a body model, not a motion; pass body={path}"
    if "verts" in keys or "vertices" in keys:
        return f"{path}: holds a mesh, not joint rotations; a moving mesh is a body: pass body={path}"
    if {"rh", "th"} <= set(keys):
        return _about_origin(path)
    if {"motion", "lengths"} <= set(keys):
        return (
            f"{path}: the results of MDM are joint positions, which are not read; its visualize.render_mesh writes a file "
            "…_smpl_params.npy for each, which is"
        )
    if any(_is_positions(squeezed(key), value) for key, value in _tables(content)):
        return f"{path}: {_NO_BODY}"
    unread = next((f"{key} {value.reason}" for key, value in content.items() if isinstance(value, Unread)), None)
    found = listed(sorted(content))
    if unread is not None:
        return f"{path}: no motion among {found}, and {unread}"
    return (
        f"{path}: not an AMASS motion: neither 'poses' nor 'root_orient' and 'pose_body' inside "
        f"(found {found}); or give 'body_pose', 'global_orient' and 'transl'"
    )


def is_like_motion(content: Any) -> bool:
    """Whether content in which no layout is found is given for a motion: arrays without keys, joint positions."""
    if isinstance(content, list):
        return len(content) > 0 and is_like_motion(content[0])
    if not isinstance(content, Mapping):
        return isinstance(content, np.ndarray)
    keys = {squeezed(key) for key in content}
    return {"rh", "th"} <= keys or any(_is_positions(squeezed(key), value) for key, value in _tables(content))


def unplaced(path: Path, person: Person) -> str:
    """The sentence for poses without a translation."""
    if {"rh", "th"} <= set(person.keys):
        return _about_origin(path)
    head = f"{path}: not an AMASS motion: key 'trans' is missing"
    if {"predcam", "origcam", "cam"} & set(person.keys):
        return (
            f"{head}; the poses of an image estimator (VIBE, SPIN, PyMAF) come with a camera that has no metres: add trans "
            "(N, 3) [m], zeros to stay in place, and save both in one file"
        )
    return f"{head} (found {listed(sorted(person.keys.values()))}); add trans (N, 3) in metres, zeros to stay in place"


def _about_origin(path: Path) -> str:
    return (
        f"{path}: the layout of EasyMocap and ZJU-MoCap (Rh, Th), which turns about the origin, not the pelvis, is not read; "
        "write global_orient=Rh, body_pose=poses[:, 3:] and transl=Th + (R(Rh) - 1) @ J0, J0 the pelvis at rest"
    )


def _bare(array: np.ndarray) -> str:
    """What an array without keys is, and how to write it."""
    shape, width = array.shape, array.shape[-1] if array.ndim else 0
    if array.ndim == 2 and width in _FEATURES:
        return (
            f"{_FEATURES[width]} features {shape} are not read: they hold joint positions and velocities, no rotations that a "
            "body can perform; give the AMASS file that they were made from, or fit SMPL to the recovered joints"
        )
    if array.ndim >= 3 and width == 3 and _are_places(array):
        return f"an array of joint positions {shape}: {_NO_BODY}"
    if array.dtype.kind in "iuf" and array.ndim >= 2 and (width in (66, 72, 156, 165) or array.ndim >= 3):
        return (
            f"an array {shape} without keys says neither where the body is nor how fast it moves; if it holds joint rotations, "
            f"write them with a translation: {_WRITE}"
        )
    return f"an array {shape} of {array.dtype} is no motion; write its joint rotations and translation by key: {_WRITE}"


def _are_places(array: np.ndarray) -> bool:
    """Whether triples (N, J, 3) are places: bones between neighbours then have one length in all frames."""
    joints = array.reshape(-1, *array.shape[-2:]).astype(np.float64)
    count = min(joints.shape[1], len(PARENTS))
    if joints.shape[1] < 15 or not np.isfinite(joints).all():
        return joints.shape[1] >= 15
    bones = np.stack([joints[:, j] - joints[:, PARENTS[j]] for j in range(1, count)], axis=1)
    length = np.linalg.norm(bones, axis=2)
    return bool(np.median(length.std(axis=0) / np.maximum(length.mean(axis=0), 1e-9)) < _RIGID and length.mean() > 0)


def _is_positions(key: str, value: Any) -> bool:
    names = ("joints", "joints3d", "jointpositions", "keypoints3d", "kp3d", "j3d", "positions", "motion", "motions")
    return key in names and isinstance(value, np.ndarray) and value.ndim >= 3


def are_weights(content: Any) -> bool:
    """Whether content is what training writes: a dict of tables whose names are paths of modules."""
    if not isinstance(content, Mapping):
        return False
    if any(squeezed(key) in _WEIGHTS for key in content):
        return True
    names = [key for key, value in _tables(content) if "." in key]
    return len(names) > 3 and any(name.endswith(("weight", "bias")) for name in names)


def _tables(content: Mapping[str, Any], depth: int = 0) -> Iterator[tuple[str, np.ndarray]]:
    for key, value in content.items():
        if isinstance(value, np.ndarray):
            yield key, value
        elif isinstance(value, Mapping) and depth < 2:
            yield from _tables(value, depth + 1)
