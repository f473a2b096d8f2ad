"""Every layout that is read, as a file of each: what makes it, and what is to be found in it."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from motion_kinds.parameters import (
    amass,
    camera_space,
    of_kind,
    of_tensors,
    one_frame_a_dict,
    posed,
    quaternions,
    rows_of_objects,
    six,
    split,
    split_matrices,
)
from motion_kinds.published import (
    aist,
    bedlam,
    emdb,
    grab,
    gvhmr,
    hmr,
    hybrik,
    interhuman,
    mdm,
    motion_x,
    moyo,
    phalp,
    phc,
    romp,
    slahmr,
    stageii,
    threedpw,
    trace,
    tram,
    wham,
)
from motion_kinds.walks import COUNT, matrices, world


@dataclass(frozen=True)
class File:
    """A file of a published layout, and what is to be found in it."""

    suffix: str
    make: Callable[[], Any]
    layout: str
    fps: float = 30.0
    assumed: bool = True
    up: str = "y"
    people: int = 1
    family: str | None = "smpl"
    doubts: tuple[str, ...] = ()  # kinds, beside the frame rate
    keys: dict[str, Any] = field(default_factory=dict)  # arguments that the file needs
    betas: bool = True


_CAMERA = {"up": "-y", "doubts": ("orientation",)}
_AMASS = {"layout": "AMASS", "up": "z", "assumed": False}
GENERATORS: dict[str, File] = {
    "AIST++": File(".pkl", aist, "AIST++", fps=60.0, betas=False),
    "AIST++, float32": File(".pkl", lambda: of_kind(np.float32, aist()), "AIST++", fps=60.0, betas=False),
    "AIST++ in npz": File(".npz", aist, "AIST++", fps=60.0, betas=False),
    "3DPW, one person": File(".py2.pkl", threedpw, "3DPW"),
    "3DPW, second of two": File(".pkl", lambda: threedpw(2), "3DPW", people=2, keys={"person": 1}),
    "EMDB": File(".pkl", emdb, "EMDB"),
    "EMDB of tensors": File(".pt", lambda: {"smpl": of_tensors(emdb()["smpl"])}, "EMDB"),
    "WHAM by joblib": File(".jl.pkl", wham, "WHAM", doubts=("shape",), betas=False),
    "WHAM by joblib, compressed": File(".jlz.pkl", wham, "WHAM", doubts=("shape",), betas=False),
    "WHAM, subject 2 of two": File(
        ".pkl", lambda: wham(2), "WHAM", people=2, keys={"person": 2}, doubts=("shape",), betas=False
    ),
    "GVHMR": File(".pt", gvhmr, "GVHMR", family="smplx"),
    "GVHMR in its camera": File(".pt", lambda: gvhmr(False), "GVHMR, in its camera", family="smplx", **_CAMERA),
    "TRAM, tensors in an object array": File(".npy", tram, "TRAM", **_CAMERA),
    "TRAM, arrays": File(".npy", lambda: tram(False), "TRAM", **_CAMERA),
    "4DHumans": File(".pkl", hmr, "image estimator", **_CAMERA),
    "PHALP": File(".jl.pkl", phalp, "image estimator", **_CAMERA),
    "PHALP, two tracks": File(".pkl", lambda: phalp(2), "image estimator", people=2, keys={"person": 6}, **_CAMERA),
    "HybrIK": File(".pk", hybrik, "HybrIK", **_CAMERA),
    "PHC": File(".jl.pkl", phc, "PHC", assumed=False, up="z"),
    "PHC, second of two": File(
        ".pkl", lambda: phc(2), "PHC", assumed=False, up="z", people=2, keys={"person": "0-KIT_3_walk_1_poses"}
    ),
    "ROMP": File(".npz", romp, "ROMP", **_CAMERA),
    "TRACE": File(".npz", trace, "TRACE", **_CAMERA),
    "SLAHMR": File(".npz", slahmr, "SLAHMR", family="smplh", **_CAMERA),
    "SLAHMR, first of two": File(".npz", lambda: slahmr(2), "SLAHMR", family="smplh", people=2, keys={"person": 0}, **_CAMERA),
    "Motion-X": File(".npy", motion_x, "Motion-X", family="smplx"),
    "Motion-X, float32": File(".npy", lambda: motion_x().astype(np.float32), "Motion-X", family="smplx"),
    "SMPL-X stage ii": File(".pkl", stageii, "SMPL-X stage ii", assumed=False, up="z", family="smplx"),
    "GRAB": File(".npz", grab, "GRAB", assumed=False, up="z", family="smplx", betas=False),
    "MOYO": File(".pkl", moyo, "fullpose", assumed=False, up="z", family="smplx"),
    "BEDLAM labels": File(".npz", bedlam, "BEDLAM labels", family="smplx"),
    "BEDLAM animation": File(".npz", lambda: amass(165, mocap_frame_rate=30.0), **_AMASS, family="smplx"),
    "InterHuman, second of two": File(".pkl", interhuman, **_AMASS, people=2, keys={"person": "person2"}, family=None),
    "MDM": File(".npy", mdm, "MDM", fps=20.0, betas=False),
    "AMASS, bytes and 0-d": File(
        ".npz", lambda: amass(gender=b"male", mocap_framerate=np.array(30)), **_AMASS, family="smplh"
    ),
    "AMASS, objects": File(".npz", lambda: amass(gender=np.array("male", dtype=object)), **_AMASS, family="smplh"),
    "AMASS in a 0-d object": File(".npy", lambda: np.array(amass(72), dtype=object), **_AMASS),
    "AMASS, keys in capitals": File(".npz", lambda: {k.upper(): v for k, v in amass(72).items()}, **_AMASS),
    "AMASS of tensors": File(".pt", lambda: of_tensors(amass(72)), **_AMASS),
    "AMASS, list of rows": File(
        ".pkl", lambda: amass(72, poses=list(world("z").flat()), trans=list(world("z").transl)), **_AMASS
    ),
    "AMASS, objects of rows": File(".npz", rows_of_objects, **_AMASS),
    "AMASS, nested": File(".pkl", lambda: OrderedDict(meta={"fps": "30"}, data={"motion": amass(72)}), **_AMASS),
    "AMASS, an axis of one": File(
        ".npz", lambda: amass(72, poses=world("z").flat()[None], trans=world("z").transl[:, None]), **_AMASS
    ),
    "rotation matrices": File(".npz", lambda: posed(matrices(world("z").poses)), **_AMASS),
    "rotation matrices, flat and float32": File(
        ".pkl", lambda: of_kind(np.float32, posed(matrices(world("z").poses).reshape(COUNT, 216))), **_AMASS
    ),
    "rotation matrices, transposed": File(
        ".npz", lambda: posed(matrices(world("z").poses).swapaxes(2, 3)), **_AMASS, doubts=("layout",)
    ),
    "6D, rows": File(".npz", lambda: posed(six("rows")), **_AMASS),
    "6D, columns": File(".npz", lambda: posed(six("columns").reshape(COUNT, 144)), **_AMASS),
    "6D, columns interleaved": File(".npz", lambda: posed(six("woven")), **_AMASS),
    "quaternions, w first": File(".npz", lambda: posed(quaternions(True)), **_AMASS),
    "quaternions, w last": File(".npz", lambda: posed(quaternions(False).reshape(COUNT, 96)), **_AMASS),
    "body_pose of matrices": File(".pkl", split_matrices, "body_pose"),
    "body_pose, frameRate": File(".pkl", lambda: split(frameRate="30"), "body_pose", assumed=False),
    "body_pose, camera space": File(
        ".pkl", lambda: split(global_orient=world("-y").root, transl=world("-y").transl), "body_pose", up="-y"
    ),
    "one frame a dict": File(".pkl", one_frame_a_dict, "pose and translation"),
    "AMASS, camera space": File(".npz", camera_space, "AMASS", assumed=False, up="-y"),
}  # fmt: skip
