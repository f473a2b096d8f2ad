"""Contents of motion files as published data sets and estimators write them: their keys, shapes and kinds of numbers."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np
import torch

from motion_kinds.walks import COUNT, Walk, matrices, walk, world


def aist() -> dict[str, Any]:
    own = world()
    return {"smpl_poses": own.flat(), "smpl_trans": own.transl * 93.7, "smpl_scaling": np.array([93.7]), "smpl_loss": 0.01}


def threedpw(people: int = 1) -> dict[str, Any]:
    own = world()
    return {
        "sequence": "downtown_walking_00", "betas": [own.betas] * people, "poses": [own.flat()] * people,
        "trans": [own.transl] * people, "poses_60Hz": [np.repeat(own.flat(), 2, axis=0)] * people,
        "trans_60Hz": [np.repeat(own.transl, 2, axis=0)] * people, "genders": ["m"] * people,
        "cam_poses": np.tile(np.eye(4), (COUNT, 1, 1)), "cam_intrinsics": np.eye(3), "img_frame_ids": np.arange(COUNT),
        "campose_valid": [np.ones(COUNT, bool)] * people, "jointPositions": [own.flat()] * people,
        "v_template_clothed": [np.zeros((10, 3))] * people, "texture_maps": [],
    }  # fmt: skip


def emdb() -> dict[str, Any]:
    own = world()
    smpl = {"poses_root": own.root, "poses_body": own.flat()[:, 3:], "trans": own.transl, "betas": own.betas}
    camera = {"intrinsics": np.eye(3), "extrinsics": np.tile(np.eye(4), (COUNT, 1, 1)), "width": 1440, "height": 1920}
    return {
        "gender": "female", "name": "P0_09_outdoor_walk", "emdb1": True, "n_frames": COUNT, "camera": camera, "smpl": smpl,
        "good_frames_mask": np.ones(COUNT, bool), "kp2d": np.zeros((COUNT, 24, 2)),
        "bboxes": {"bboxes": np.zeros((COUNT, 4)), "invalid_idxs": np.zeros(0, int)},
    }  # fmt: skip


def varying() -> np.ndarray:
    return walk().betas + np.random.default_rng(1).normal(scale=0.05, size=(COUNT, 10)).astype(np.float32)


def wham(people: int = 1) -> Any:
    own, seen = world(), world("-y")
    person = {
        "pose": seen.flat(), "trans": seen.transl + [0, 0, 4.0], "pose_world": own.flat(), "trans_world": own.transl,
        "betas": varying(), "verts": np.zeros((COUNT, 20, 3), np.float32), "frame_ids": np.arange(COUNT) + 3,
    }  # fmt: skip
    results: defaultdict[int, dict[str, Any]] = defaultdict(dict)
    results.update({2 * index: person for index in range(people)})
    return results


def gvhmr(world_too: bool = True) -> dict[str, Any]:
    def params(own: Walk) -> dict[str, torch.Tensor]:
        tables = {
            "body_pose": own.body,
            "betas": np.tile(own.betas, (COUNT, 1)),
            "global_orient": own.root,
            "transl": own.transl,
        }
        return {key: torch.from_numpy(value.copy()) for key, value in tables.items()}

    incam = params(world("-y"))
    content = {
        "smpl_params_incam": incam,
        "K_fullimg": torch.eye(3).repeat(COUNT, 1, 1),
        "net_outputs": {"pred_smpl_params_incam": incam},
    }
    return ({"smpl_params_global": params(world())} if world_too else {}) | content


def tram(tensors: bool = True) -> Any:
    own = world("-y")
    tables = {
        "pred_cam": np.zeros((COUNT, 3)), "pred_pose": np.zeros((COUNT, 144)), "pred_shape": np.tile(own.betas, (COUNT, 1)),
        "pred_rotmat": matrices(own.poses), "pred_trans": own.transl[:, None], "frame": np.arange(COUNT),
    }  # fmt: skip
    results = {key: torch.from_numpy(value) if tensors else value for key, value in tables.items()}
    return np.array(results, dtype=object)


def hmr() -> dict[str, Any]:
    own = world("-y")
    turns = matrices(own.poses)
    return {
        "global_orient": turns[:, :1], "body_pose": turns[:, 1:], "betas": np.tile(own.betas, (COUNT, 1)),
        "pred_cam_t": own.transl + [0, 0, 30.0], "focal_length": 5000.0,
    }  # fmt: skip


def phalp(people: int = 1) -> dict[str, Any]:
    own = world("-y")
    turns = matrices(own.poses)
    frames = {}
    for row in range(COUNT):
        smpl = {"global_orient": turns[row, :1], "body_pose": turns[row, 1:], "betas": own.betas}
        frames[f"outputs/_DEMO/walk/img/{row + 1:06d}.jpg"] = {
            "tid": [5 + index for index in range(people)], "smpl": [smpl] * people, "camera": [own.transl[row]] * people,
            "bbox": [np.zeros(4)] * people, "time": row, "shot": 0, "frame_path": "img.jpg",
        }  # fmt: skip
    return frames


def romp() -> dict[str, Any]:
    own = world("-y")
    frames = {
        f"{row:08d}.jpg": {
            "smpl_thetas": own.flat()[row : row + 1], "smpl_betas": own.betas[None], "cam_trans": own.transl[row : row + 1],
            "cam": np.zeros((1, 3)), "joints": np.zeros((1, 71, 3)), "center_confs": np.ones(1),
        }
        for row in range(COUNT)
    }  # fmt: skip
    return {"results": np.array(frames, dtype=object)}


def trace() -> dict[str, Any]:
    own, seen = world("-y"), world("-y")
    rows = {
        "smpl_thetas": seen.flat(), "smpl_betas": np.tile(own.betas, (COUNT, 1)), "cam_trans": seen.transl,
        "world_trans": own.transl, "world_global_rots": own.root, "track_ids": np.full(COUNT, 4),
        "reorganize_idx": np.arange(COUNT),
    }  # fmt: skip
    return {"outputs": np.array(rows, dtype=object), "imgpaths": np.array(["a.jpg"] * COUNT)}


def slahmr(people: int = 1) -> dict[str, Any]:
    own = world("-y")

    def each(table: np.ndarray) -> np.ndarray:
        return np.stack([table] * people)

    return {
        "trans": each(own.transl), "root_orient": each(own.root), "pose_body": each(own.body), "betas": each(own.betas),
        "latent_pose": np.zeros((people, COUNT, 32)), "cam_R": np.tile(np.eye(3), (people, COUNT, 1, 1)),
        "cam_t": np.zeros((people, COUNT, 3)), "intrins": np.ones(4), "floor_plane": np.zeros((people, 3)),
        "track_mask": np.ones((people, COUNT)), "world_scale": np.ones((people, 1)),
    }  # fmt: skip


def motion_x() -> np.ndarray:
    own = world()
    table = np.zeros((COUNT, 322))
    for first, part in ((0, own.root), (3, own.body), (66, own.fingers.reshape(COUNT, 90)), (309, own.transl)):
        table[:, first : first + part.shape[1]] = part
    table[:, 312:] = own.betas
    return table


def stageii() -> dict[str, Any]:
    own = world("z")
    return {
        "fullpose": own.flat(165), "trans": own.transl, "betas": np.r_[own.betas, np.zeros(390)], "gender": "male",
        "surface_model_type": "smplx", "markers_latent": np.zeros((40, 3)), "latent_labels": ["ARIEL"],
        "stageii_debug_details": {"cfg": {"mocap": {"unit": "mm"}}, "mocap_frame_rate": 30.0},
    }  # fmt: skip


def grab() -> dict[str, Any]:
    own = world("z")
    body = {
        "transl": own.transl, "global_orient": own.root, "body_pose": own.body, "jaw_pose": np.zeros((COUNT, 3)),
        "left_hand_pose": np.zeros((COUNT, 24)), "right_hand_pose": np.zeros((COUNT, 24)), "fullpose": own.flat(165),
        "expression": np.zeros((COUNT, 10)),
    }  # fmt: skip
    hand = {
        "global_orient": own.root,
        "hand_pose": np.zeros((COUNT, 24)),
        "transl": own.transl,
        "fullpose": np.zeros((COUNT, 45)),
    }
    thing = {"params": {"transl": own.transl, "global_orient": own.root}, "object_mesh": "tools/cup.ply"}
    parts = {"body": {"params": body, "vtemp": "s1.ply"}, "lhand": {"params": hand}, "rhand": {"params": hand}, "object": thing}
    plain = {"gender": "female", "sbj_id": "s1", "n_comps": 24, "framerate": 30.0, "motion_intent": "lift"}
    return plain | {key: np.array(value, dtype=object) for key, value in parts.items()}


def moyo() -> dict[str, Any]:
    own = world("z")
    return {
        "fullpose": own.flat(165).astype(np.float64), "trans": own.transl, "betas": np.tile(own.betas, (COUNT, 1)),
        "gender": "neutral", "v_template": np.zeros((10, 3)), "mocap_fps": 30,
    }  # fmt: skip


def bedlam() -> dict[str, Any]:
    own = world()
    order = np.random.default_rng(3).permutation(COUNT)
    pictures = np.array([f"seq_000000/seq_000000_{row:04d}.png" for row in range(COUNT)])
    rows = {
        "imgname": pictures, "pose_world": own.flat(165), "trans_world": own.transl, "pose_cam": world("-y").flat(165),
        "trans_cam": world("-y").transl, "shape": np.tile(np.r_[own.betas, 0.0], (COUNT, 1)),
        "sub": np.array(["rp_aaron"] * COUNT),
        "gender": np.array(["neutral"] * COUNT), "cam_int": np.tile(np.eye(3), (COUNT, 1, 1)),
    }  # fmt: skip
    return {key: value[order] for key, value in rows.items()}


def interhuman(people: int = 2) -> dict[str, Any]:
    own = world("z")
    person = {
        "trans": own.transl, "root_orient": own.root, "pose_body": own.body, "betas": own.betas, "gender": "male",
    }  # fmt: skip
    person = {key: value.astype(np.float32) if key != "gender" else value for key, value in person.items()}
    return {"mocap_framerate": 30.0, "frames": COUNT} | {f"person{index + 1}": person for index in range(people)}


def mdm() -> Any:
    own = world()
    rows = matrices(own.poses)[..., :2, :].reshape(COUNT, 24, 6)
    content = {
        "thetas": rows.transpose(1, 2, 0), "root_translation": own.transl.T, "faces": np.zeros((4, 3), int), "text": "walks",
        "length": COUNT, "motion": np.zeros((25, 6, COUNT)),
    }  # fmt: skip
    return np.array(content, dtype=object)


def hybrik() -> dict[str, Any]:
    own = world("-y")
    return {
        "pred_thetas": matrices(own.poses).reshape(COUNT, 216), "transl": own.transl,
        "pred_betas": np.tile(own.betas, (COUNT, 1)),
        "pred_phi": np.zeros((COUNT, 23, 2)), "pred_uvd": np.zeros((COUNT, 29, 3)), "bbox": np.zeros((COUNT, 4)),
    }  # fmt: skip


def phc(count: int = 1) -> dict[str, Any]:
    own = world("z")
    motion = {
        "pose_aa": own.flat(), "trans_orig": own.transl, "root_trans_offset": own.transl, "beta": own.betas,
        "gender": "neutral", "pose_quat_global": np.zeros((COUNT, 24, 4)), "fps": 30,
    }  # fmt: skip
    return {f"0-KIT_3_walk_{index}_poses": motion for index in range(count)}
