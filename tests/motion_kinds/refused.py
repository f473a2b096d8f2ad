"""Files that are answered in one sentence: what is in them, and words of the sentence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from hood.assets.motion.skeleton import joints_about_pelvis
from motion_kinds.parameters import amass, posed, split
from motion_kinds.published import phalp, romp, slahmr, threedpw, wham
from motion_kinds.walks import COUNT, matrices, walk, world


@dataclass(frozen=True)
class Refusal:
    """A file, and a pattern of the sentence that answers it."""

    suffix: str
    make: Callable[[], Any]
    words: str
    keys: dict[str, Any] = field(default_factory=dict)


def places() -> np.ndarray:
    """(N, 24, 3) m: the joints of the walk."""
    return joints_about_pelvis(world().poses) + world().transl[:, None]


def vibe() -> dict[str, Any]:
    tables = {"pose": world("-y").flat(), "betas": np.tile(walk().betas, (COUNT, 1)), "pred_cam": np.ones((COUNT, 3))}
    return {"1": tables | {"orig_cam": np.ones((COUNT, 4)), "frame_ids": np.arange(COUNT)}}


def tumbling() -> np.ndarray:
    """(N, 24, 4): quaternions of any rotations at all, which no order makes a pose."""
    return Rotation.random(COUNT * 24, rng=np.random.default_rng(2)).as_quat().reshape(COUNT, 24, 4)


def stiff_six() -> np.ndarray:
    """(N, 24, 6): a body whose knees and elbows stay straight; only its root turns."""
    turns = np.tile(np.eye(3), (COUNT, 24, 1, 1))
    turns[:, 0] = Rotation.from_rotvec(walk().root).as_matrix()
    return turns[..., :2, :].reshape(COUNT, 24, 6)


def hardly_bent_six() -> np.ndarray:
    """(N, 24, 6): knees that bend backwards by a degree, as those of some who stand still do."""
    turns = np.zeros((COUNT, 24, 3))
    turns[:, [4, 5], 0] = -np.radians(1.0)
    return matrices(turns)[..., :2, :].reshape(COUNT, 24, 6)


def two_in_a_frame() -> dict[str, Any]:
    frames = romp()["results"].item()
    for entry in frames.values():
        for key in ("smpl_thetas", "smpl_betas", "cam_trans"):
            entry[key] = np.concatenate([entry[key], entry[key]])
    return {"results": np.array(frames, dtype=object)}


def bedlam_two() -> dict[str, Any]:
    own = world()
    pictures = np.array([f"seq_{row % 2:06d}/{row:04d}.png" for row in range(COUNT)])
    return {"imgname": pictures, "pose_world": own.flat(165), "trans_world": own.transl, "sub": np.array(["rp_a"] * COUNT)}


def weights() -> dict[str, Any]:
    return {"model": torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.Linear(4, 5)).state_dict(), "epoch": 3}


def easymocap() -> dict[str, Any]:
    own = world()
    poses = np.c_[np.zeros((COUNT, 3)), own.flat()[:, 3:]]
    return {"poses": poses, "Rh": own.root, "Th": own.transl, "shapes": own.betas[None]}


def batch_of_two() -> dict[str, Any]:
    own = world("z")
    return amass(72, poses=np.stack([own.flat()] * 2), trans=np.stack([own.transl] * 2))


def without_rate() -> dict[str, Any]:
    return {key: value for key, value in amass().items() if "rate" not in key}


def shapes_of_many() -> dict[str, Any]:
    return split(betas=np.random.default_rng(0).normal(size=(COUNT, 10)))


def turns_of(matrix: np.ndarray) -> dict[str, Any]:
    return posed(np.tile(matrix, (COUNT, 24, 1, 1)))


REFUSALS: dict[str, Refusal] = {
    "HumanML3D": Refusal(".npy", lambda: np.zeros((COUNT, 263)), "HumanML3D features .* are not read.*AMASS file"),
    "KIT-ML": Refusal(".npy", lambda: np.zeros((COUNT, 251)), "KIT-ML features"),
    "joints, 22": Refusal(".npy", lambda: places()[:, :22], "joint positions .*fit SMPL to them"),
    "joints, 24": Refusal(".npy", lambda: places().astype(np.float32), "joint positions"),
    "joints by key": Refusal(".npz", lambda: {"joints3d": places(), "fps": 30}, "joint positions are not read"),
    "joints in a .pt": Refusal(".pt", lambda: {"joints": torch.from_numpy(places())}, "joint positions are not read"),
    "MDM results": Refusal(
        ".npy", lambda: np.array({"motion": np.zeros((3, 22, 3, 40)), "text": ["a"] * 3, "lengths": [40]}, dtype=object),
        r"results of MDM are joint positions.*render_mesh",
    ),
    "poses without keys": Refusal(".npy", lambda: world().flat(), r"without keys says neither where.*np\.savez"),
    "poses without keys, by joint": Refusal(".npy", lambda: world().poses, "without keys"),
    "matrices without keys": Refusal(".npy", lambda: np.tile(np.eye(3), (COUNT, 24, 1, 1)), "without keys"),
    "VIBE": Refusal(".pkl", vibe, r"'trans' is missing.*VIBE.*add trans \(N, 3\)"),
    "poses alone": Refusal(".npz", lambda: {"poses": world().flat(), "fps": 30}, "'trans' is missing.*zeros to stay in place"),
    "EasyMocap": Refusal(".npz", easymocap, "EasyMocap and ZJU-MoCap.*global_orient=Rh"),
    "two people, WHAM": Refusal(".jl.pkl", lambda: wham(2), r"holds 2 people \(0, 2\); choose one with person=0"),
    "two people, 3DPW": Refusal(".pkl", lambda: threedpw(2), r"holds 2 people \(0, 1\)"),
    "three people, SLAHMR": Refusal(".npz", lambda: slahmr(3), r"holds 3 people \(0, 1, 2\)"),
    "two tracks, PHALP": Refusal(".pkl", lambda: phalp(2), r"holds 2 people \(5, 6\)"),
    "two people of a batch": Refusal(".npz", batch_of_two, "holds 2 people"),
    "two shots, BEDLAM": Refusal(".npz", bedlam_two, r"holds 2 people \(seq_000000/rp_a, seq_000001/rp_a\)"),
    "nobody of that name": Refusal(".pkl", lambda: wham(2), r"nobody in it is person=1; it holds 0, 2", {"person": 1}),
    "two people without numbers, ROMP": Refusal(".npz", two_in_a_frame, "2 people in its frame 0 and no track numbers"),
    "quaternions in any order": Refusal(".npz", lambda: posed(tumbling()), r"neither w first nor w last.*from_quat"),
    "quaternions of another length": Refusal(".npz", lambda: posed(2.0 * tumbling()), "does not hold any"),
    "6D of a stiff body": Refusal(".npz", lambda: posed(stiff_six()), r"rows or columns.*from_matrix"),
    "6D of a body with straight knees": Refusal(".npz", lambda: posed(hardly_bent_six()), "rows or columns"),
    "no matrices": Refusal(".npz", lambda: turns_of(np.ones((3, 3))), "shape of rotation matrices and does not hold any"),
    "mirrored matrices": Refusal(".npz", lambda: turns_of(-np.eye(3)), "shape of rotation matrices and does not"),
    "shapes of several people": Refusal(".pkl", shapes_of_many, r"betas changes in frame 1.*mean\(axis=0\)"),
    "no rate, AMASS": Refusal(".npz", without_rate, "no mocap_framerate.*file_fps"),
    "a rate of two": Refusal(".npz", lambda: amass(mocap_framerate=np.array([30.0, 60.0])), "mocap_framerate is"),
    "a rate in words": Refusal(".npz", lambda: amass(mocap_framerate="fast"), "mocap_framerate is fast"),
    "degrees": Refusal(".npz", lambda: amass(72, poses=np.degrees(world("z").flat())), r"holds degrees.*pi / 180"),
    "a network": Refusal(".pt", weights, "holds the weights of a network, not a motion; pass checkpoint="),
    "a class in an object array": Refusal(
        ".npy", lambda: np.array({"poses": Fraction(1, 2)}, dtype=object), r"names fractions\.Fraction, which is not read"
    ),
    "a class in an archive": Refusal(
        ".npz", lambda: {"poses": np.array(Fraction(1, 2), dtype=object), "fps": 30}, r"poses names fractions\.Fraction"
    ),
    "rows of several lengths": Refusal(
        ".pkl", lambda: amass(72, poses=[np.zeros(72)] * 5 + [np.zeros(66)]), "rows of different shapes|holds object",
    ),
    "frames that disagree": Refusal(".pkl", lambda: split(transl=world().transl[:-1]), "they must agree"),
    "a scaling of 0": Refusal(
        ".pkl", lambda: {"smpl_poses": world().flat(), "smpl_trans": world().transl, "smpl_scaling": np.zeros(1)}, "above 0",
    ),
}  # fmt: skip
