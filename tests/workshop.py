"""Every kind of body, motion and garment file that rollouts take, written from the embedded assets when first asked for."""

from __future__ import annotations

import pickle
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from imitations import GltfWriter, parents_of, write_official_pickle
from scipy.spatial.transform import Rotation

from hood.assets.body.body import JOINTS, Body
from hood.assets.body.load import load_body
from hood.assets.files.library import locate
from hood.assets.garment.garment import load_garment
from hood.assets.motion.load import load_sequence
from hood.assets.motion.recording import read_recording
from hood.assets.motion.sequence import PoseSequence
from hood.assets.motion.sequence_edit import arms_down
from hood.scene.scene import build_scene

FPS, FIRST, COUNT = 30.0, 40, 10
_WALK = "walk_proud"


class Workshop:
    """Files in ``folder``; bodies, motions and garments by the names of the methods and keys below."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._made: dict[str, str] = {}

    def body(self, kind: str) -> str:
        """What ``body=`` is given."""
        return kind if kind in ("default", "none") else self._once(f"body_{kind}")

    def motion(self, style: str) -> str:
        """What ``sequence=`` is given: the same steps of a walk in every style."""
        return style if style == "none" else self._once(f"motion_{style}")

    def garment(self, name: str, pose: str) -> str:
        """A mesh file of the embedded garment ``name`` as it is worn in ``pose``: tpose, apose, or posed, at the first step."""
        path = self.folder / f"{name}_{pose}.obj"
        if not path.exists():
            sequence = {"tpose": arms_down(0.0), "apose": arms_down(45.0), "posed": self._walk}[pose]
            scene = build_scene(load_garment(name), self._default, sequence)
            state = scene.start(0, relaxed=False, thorough=True)
            write_obj(path, state.pos.double().numpy() + state.origin[0].numpy(), scene.garment.faces)
        return str(path)

    def _once(self, what: str) -> str:
        if what not in self._made:
            self._made[what] = str(getattr(self, what)())
        return self._made[what]

    @cached_property
    def _default(self) -> Body:
        return load_body()

    @cached_property
    def _walk(self) -> PoseSequence:
        return load_sequence(_WALK).window(FIRST, FIRST + COUNT)

    @cached_property
    def _verts(self) -> np.ndarray:
        """(T, W, 3) m of the default body on its walk."""
        still = np.zeros(10)
        local = self._default.surface(self._walk, still, torch.float64).numpy()
        return local + self._default.translation(self._walk, still)[:, None]

    # ---- motions -----------------------------------------------------------------------------------------------------

    def motion_amass_smplh(self) -> Path:
        """z up, at the rate it was recorded with; fingers that must not count."""
        poses, rest = self._recorded()
        fingers = np.full((len(poses), 90), 0.3)
        return write_npz(
            self.folder / "smplh_poses.npz", poses=np.c_[poses, fingers], mocap_framerate=rest["fps"], **rest["also"]
        )

    def motion_amass_smplx(self) -> Path:
        poses, rest = self._recorded()
        tables = {"root_orient": poses[:, :3], "pose_body": poses[:, 3:], "pose_hand": np.full((len(poses), 90), 0.3)}
        kind = np.array("smplx")
        path = self.folder / "smplx_stageii.npz"
        return write_npz(path, mocap_frame_rate=rest["fps"], surface_model_type=kind, **tables, **rest["also"])

    def motion_pose_pickle(self) -> Path:
        poses, transl = self._upright()
        fields = {
            "body_pose": poses[:, 3:],
            "global_orient": poses[:, :3],
            "transl": transl,
            "betas": np.zeros((len(poses), 10)),
        }
        return write_pickle(self.folder / "pose.pkl", fields)

    def motion_vto(self) -> Path:
        poses, transl = self._upright()
        return write_pickle(self.folder / "vto.pkl", {"pose": poses, "translation": transl, "shape": np.zeros(10)})

    def _recorded(self) -> tuple[np.ndarray, dict[str, Any]]:
        recording = read_recording(locate("motions", _WALK))
        step = round(recording.fps / FPS)
        part = slice(FIRST * step, (FIRST + COUNT) * step)
        also = {"trans": recording.transl[part], "betas": np.zeros(16), "gender": np.array("neutral")}
        return recording.poses[part, :22].reshape(-1, 66), {"fps": recording.fps, "also": also}

    def _upright(self) -> tuple[np.ndarray, np.ndarray]:
        """y up: the pelvis' offset is part of the translation already."""
        return self._walk.poses.reshape(COUNT, 72), self._default.translation(self._walk, np.zeros(10))

    # ---- bodies with joints ------------------------------------------------------------------------------------------

    def body_smpl_pickle(self) -> Path:
        return write_official_pickle(self.folder / "basicmodel_neutral.pkl", self._model(24))

    def body_smpl_npz(self) -> Path:
        return write_npz(self.folder / "SMPL_NEUTRAL.npz", **self._model(24))

    def body_smplh_npz(self) -> Path:
        return write_npz(self.folder / "SMPLH_NEUTRAL.npz", **self._model(52))

    def body_smplx_npz(self) -> Path:
        return write_npz(self.folder / "SMPLX_NEUTRAL.npz", **self._model(55))

    def _model(self, num_joints: int) -> dict[str, np.ndarray]:
        """The default body with the skeleton of a model of the family, and pose blend shapes of half a millimetre."""
        body = self._default
        weights, regressor = np.zeros((len(body.v_template), num_joints)), np.zeros((num_joints, len(body.v_template)))
        parents = parents_of(num_joints)
        for joint in range(num_joints):
            own = joint
            while own >= (24 if num_joints == 24 else 22):  # fingers, jaw and eyes lie where their limb ends
                own = parents[own]
            regressor[joint] = body.joint_regressor[own]
        weights[:, :22] = body.weights[:, :22]
        hands = (22, 23) if num_joints == 24 else (20, 21)
        for hand, of in zip(hands, (22, 23), strict=True):
            weights[:, hand] += body.weights[:, of]
        waves = 1e-4 * np.sin(6.0 * body.v_template)[..., None] * np.random.default_rng(0).normal(size=9 * (num_joints - 1))
        return {
            "v_template": body.v_template, "shapedirs": body.shapedirs, "posedirs": waves, "J_regressor": regressor,
            "weights": weights, "kintree_table": np.stack([np.array(parents), np.arange(num_joints)]), "f": body.faces,
        }  # fmt: skip

    # ---- meshes that move, or do not ---------------------------------------------------------------------------------

    def body_folder(self) -> Path:
        folder = self.folder / "frames"
        folder.mkdir()
        for frame, pos in enumerate(self._verts):
            write_obj(folder / f"frame_{frame}.obj", pos, self._default.faces)
        return folder

    def body_verts_npz(self) -> Path:
        return write_npz(self.folder / "character.npz", verts=self._verts, faces=self._default.faces, fps=FPS)

    def body_verts_h5(self) -> Path:
        import h5py

        with h5py.File(self.folder / "character.h5", "w") as file:
            file["verts"], file["faces"] = self._verts.astype(np.float32), self._default.faces
            file.attrs["fps"] = FPS
        return self.folder / "character.h5"

    def body_mesh_pickle(self) -> Path:
        fields = {"verts": self._verts.astype(np.float32), "faces": self._default.faces}
        return write_pickle(self.folder / "sequence.pkl", fields)

    def body_still(self) -> Path:
        """The default body in its T-pose."""
        return write_obj(self.folder / "mannequin.obj", self._default.v_template, self._default.faces)

    def body_gltf_morph(self) -> Path:
        """Every frame is a morph target of the first."""
        writer, verts = GltfWriter(), self._verts.astype(np.float32)
        mesh = self._gltf_mesh(writer, verts[0])
        mesh["primitives"][0]["targets"] = [{"POSITION": writer.table(pos - verts[0])} for pos in verts[1:]]
        amounts = np.eye(COUNT, dtype=np.float32)[:, 1:]
        writer.document |= {"meshes": [mesh], "nodes": [{"mesh": 0}]}
        writer.document["animations"] = [_animation(writer, {(0, "weights"): amounts.reshape(-1)})]
        return writer.write(self.folder / "morph.glb")

    def body_gltf_skin(self) -> Path:
        """The default body's skeleton, skinned by the four greatest weights of each vertex."""
        body, writer = self._default, GltfWriter()
        joints = body.shaped(np.zeros(10))[1]
        first = np.argsort(-body.weights, axis=1)[:, :4]
        shares = np.take_along_axis(body.weights, first, axis=1)
        shares /= shares.sum(axis=1, keepdims=True)
        skin = {"JOINTS_0": writer.table(first.astype(np.uint8)), "WEIGHTS_0": writer.table(shares.astype(np.float32))}
        inverse = np.tile(np.eye(4, dtype=np.float32), (len(joints), 1, 1))
        inverse[:, 3, :3] = -joints  # column by column
        names = (*JOINTS, "left_hand", "right_hand")
        nodes: list[dict[str, Any]] = [{"name": names[0], "translation": joints[0].tolist()}]
        for joint, parent in enumerate(body.parents[1:], start=1):
            nodes.append({"name": names[joint], "translation": (joints[joint] - joints[parent]).tolist()})
            nodes[parent].setdefault("children", []).append(joint)
        turns = Rotation.from_rotvec(self._walk.poses.reshape(-1, 3)).as_quat().reshape(COUNT, -1, 4)
        moves = {(joint, "rotation"): turns[:, joint] for joint in range(len(joints))}
        moves[0, "translation"] = joints[0] + body.translation(self._walk, np.zeros(10))
        writer.document |= {
            "meshes": [self._gltf_mesh(writer, body.v_template, **skin)], "nodes": [*nodes, {"mesh": 0, "skin": 0}],
            "skins": [{"joints": list(range(len(joints))), "inverseBindMatrices": writer.table(inverse)}],
            "animations": [_animation(writer, moves)],
        }  # fmt: skip
        return writer.write(self.folder / "skinned.glb")

    def _gltf_mesh(self, writer: GltfWriter, pos: np.ndarray, **extra: int) -> dict[str, Any]:
        attributes = {"POSITION": writer.table(pos.astype(np.float32)), **extra}
        indices = writer.table(self._default.faces.astype(np.uint32).reshape(-1))
        return {"primitives": [{"attributes": attributes, "indices": indices}]}


def _animation(writer: GltfWriter, moves: dict[tuple[int, str], np.ndarray]) -> dict[str, Any]:
    """One animation of nodes' properties, a value a frame."""
    times = writer.table((np.arange(COUNT) / FPS).astype(np.float32))
    samplers = [{"input": times, "output": writer.table(values.astype(np.float32))} for values in moves.values()]
    channels = [{"sampler": row, "target": {"node": node, "path": path}} for row, (node, path) in enumerate(moves)]
    return {"samplers": samplers, "channels": channels}


def write_obj(path: Path, pos: np.ndarray, faces: np.ndarray) -> Path:
    rows = [f"v {x:.7f} {y:.7f} {z:.7f}" for x, y, z in pos.tolist()] + [f"f {a} {b} {c}" for a, b, c in (faces + 1).tolist()]
    path.write_text("\n".join(rows) + "\n")
    return path


def write_npz(path: Path, **arrays: Any) -> Path:
    np.savez(path, **arrays)
    return path


def write_pickle(path: Path, fields: dict[str, Any]) -> Path:
    path.write_bytes(pickle.dumps(fields, 2))
    return path
