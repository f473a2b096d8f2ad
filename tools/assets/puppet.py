"""A puppet on the SMPL skeleton: readable controls (pelvis, feet, spine, arms) become joint rotations.

The legs are solved by two-bone inverse kinematics, so a planted foot stays where it is whatever the
pelvis does. The pelvis is lowered where a leg would otherwise have to stretch. World: y up, floor at y =
0, the puppet faces +z, its left is +x. Side 0 is left, side 1 right.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, maximum_filter1d
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

NUM_POSED_JOINTS = 22
_HIP, _KNEE, _ANKLE, _TOES = (1, 2), (4, 5), (7, 8), (10, 11)
_SPINE, _NECK, _HEAD = (3, 6, 9), 12, 15
_COLLAR, _SHOULDER, _ELBOW, _WRIST = (13, 14), (16, 17), (18, 19), (20, 21)
_MAX_REACH = 0.99  # of the leg's length: a straight knee would snap
_MIRROR = np.diag([-1.0, 1.0, 1.0])


@dataclass(frozen=True)
class Skeleton:
    """Rest joints (24, 3) [m] of a standing T-pose and the two points each foot rolls on.

    `heel` and `ball` (2, 3) lie on the floor, at the height `floor` in the body's own frame.
    """

    joints: Array
    floor: float
    heel: Array
    ball: Array

    @staticmethod
    def from_body(path: str | Path) -> Skeleton:
        """Reads `v_template`, `J_regressor` and `weights` of a body in SMPL layout."""
        with np.load(path, allow_pickle=False) as body:
            vertices = body["v_template"].astype(np.float64)
            joints = body["J_regressor"].astype(np.float64) @ vertices
            weights = body["weights"]
        floor = float(vertices[:, 1].min())
        heel, ball = np.zeros((2, 3)), np.zeros((2, 3))
        for side in range(2):
            foot = vertices[weights[:, [_ANKLE[side], _TOES[side]]].sum(axis=1) > 0.5]
            sole = foot[foot[:, 1] < floor + 0.03]
            x = joints[_ANKLE[side], 0]
            # The heel is round: it touches the floor a little before its rearmost point.
            heel[side] = x, floor, sole[:, 2].min() + 0.015
            ball[side] = joints[_TOES[side], 0], floor, joints[_TOES[side], 2]
        return Skeleton(joints, floor, heel, ball)

    @property
    def pelvis_height(self) -> float:
        return float(self.joints[0, 1] - self.floor)

    @property
    def leg_length(self) -> float:
        """Hip to knee to ankle [m]."""
        return float(sum(np.linalg.norm(bone) for bone in _leg_bones(self, 0)))

    @property
    def ankle_spacing(self) -> float:
        """Half the distance between the ankles in the rest pose [m]."""
        return float(0.5 * (self.joints[7, 0] - self.joints[8, 0]))


@dataclass
class Controls:
    """Everything a puppeteer moves, per frame; lengths in metres, angles in degrees.

    pelvis      (T, 3) x, z on the floor in columns 0 and 2; column 1 is the height above standing
    pelvis_turn (T, 3) pitch forward, yaw to the left, roll (left side up)
    spine       (T, 3) bend forward, twist to the left, bend to the left, summed over the spine
    head        (T, 3) the same for neck and head
    foot        (T, 2, 3) place of the ankle when the foot is flat; column 1 is the lift
    foot_yaw    (T, 2); foot_pitch (T, 2): positive on the ball (heel up), negative on the heel (toes up)
    arm         (T, 2, 4) lowering from the T-pose, swing forward, twist (negative: outward), elbow
    """

    fps: float
    pelvis: Array
    pelvis_turn: Array
    spine: Array
    head: Array
    foot: Array
    foot_yaw: Array
    foot_pitch: Array
    arm: Array

    @staticmethod
    def standing(num_frames: int, fps: float, skeleton: Skeleton) -> Controls:
        """An easy stand: feet under the hips, toes slightly out, arms half lowered."""
        zeros = np.zeros((num_frames, 3))
        foot = np.zeros((num_frames, 2, 3))
        foot[:, :, 0] = skeleton.ankle_spacing * np.array([1.0, -1.0])
        yaw = np.tile([7.0, -7.0], (num_frames, 1))
        arm = np.tile([52.0, 2.0, 0.0, 14.0], (num_frames, 2, 1))
        return Controls(fps, zeros.copy(), zeros.copy(), zeros.copy(), zeros.copy(), foot, yaw, np.zeros_like(yaw), arm)

    @property
    def time(self) -> Array:
        """(T,) seconds."""
        return np.arange(len(self.pelvis)) / self.fps


def solve(controls: Controls, skeleton: Skeleton) -> tuple[Array, Array]:
    """Joint rotations (T, 22, 3, 3), local as in SMPL, and pelvis positions (T, 3) [m], y up.

    The pelvis height asked for is an upper bound: see the module docstring.
    """
    count = len(controls.pelvis)
    local = np.broadcast_to(np.eye(3), (count, NUM_POSED_JOINTS, 3, 3)).copy()
    root = _turn("YXZ", controls.pelvis_turn[:, [1, 0, 2]])
    local[:, 0] = root
    for joint, share in zip(_SPINE, (0.32, 0.36, 0.32), strict=True):
        local[:, joint] = _turn("YXZ", share * controls.spine[:, [1, 0, 2]] * [1, 1, -1])
    local[:, _NECK] = local[:, _HEAD] = _turn("YXZ", 0.5 * controls.head[:, [1, 0, 2]] * [1, 1, -1])

    feet = [_foot(controls, skeleton, side) for side in range(2)]
    ankles = np.stack([ankle for _, ankle in feet], axis=1)
    pelvis = controls.pelvis + [0.0, skeleton.pelvis_height, 0.0]
    pelvis[:, 1] = _reachable(pelvis, root, ankles, skeleton, controls.fps)
    for side in range(2):
        foot = feet[side][0]
        hinge_yaw = 0.5 * (controls.pelvis_turn[:, 1] + controls.foot_yaw[:, side])
        thigh, shin = _leg(pelvis, root, ankles[:, side], hinge_yaw, skeleton, side)
        local[:, _HIP[side]] = _inverse(root) @ thigh
        local[:, _KNEE[side]] = _inverse(thigh) @ shin
        local[:, _ANKLE[side]] = _inverse(shin) @ foot
        on_floor = np.clip(1.0 - controls.foot[:, side, 1] / 0.06, 0.25, 1.0)
        local[:, _TOES[side]] = _turn("X", -np.clip(controls.foot_pitch[:, side], 0.0, 50.0) * on_floor)
        _pose_arm(local, controls.arm[:, side], side)
    return local, pelvis


def _foot(controls: Controls, skeleton: Skeleton, side: int) -> tuple[Array, Array]:
    """World rotation of the foot and ankle position: the foot rolls about its ball or about its heel."""
    pitch = controls.foot_pitch[:, side]
    flat = _turn("Y", controls.foot_yaw[:, side])
    rotation = flat @ _turn("X", pitch)
    rest = skeleton.joints[_ANKLE[side]]
    # The pivot moves from heel to ball within a few degrees: a sudden change would jerk a swinging foot.
    part = np.clip(0.5 + pitch / 8.0, 0.0, 1.0)
    on_ball = (part**2 * (3.0 - 2.0 * part))[:, None]
    pivot = on_ball * skeleton.ball[side] + (1.0 - on_ball) * skeleton.heel[side]
    ground = np.array([rest[0], skeleton.floor, rest[2]])
    target = controls.foot[:, side] + _apply(flat, pivot - ground)
    return rotation, target + _apply(rotation, rest - pivot)


def _reachable(pelvis: Array, root: Array, ankles: Array, skeleton: Skeleton, fps: float) -> Array:
    """Pelvis heights (T,), smooth and low enough for both legs."""
    excess = np.zeros(len(pelvis))
    for side in range(2):
        thigh, shin = _leg_bones(skeleton, side)
        hip = pelvis + _apply(root, skeleton.joints[_HIP[side]] - skeleton.joints[0])
        gap = ankles[:, side] - hip
        reach = _MAX_REACH * (np.linalg.norm(thigh) + np.linalg.norm(shin))
        rise = np.sqrt(np.maximum(reach**2 - gap[:, 0] ** 2 - gap[:, 2] ** 2, 0.01))
        excess = np.maximum(excess, -gap[:, 1] - rise)
    # Widened by the window of the blur, the blurred lowering is nowhere less than the sharp one.
    radius = max(1, round(0.06 * fps))
    widened = maximum_filter1d(excess, 2 * radius + 1, mode="nearest")
    return pelvis[:, 1] - gaussian_filter1d(widened, radius / 2.5, mode="nearest", truncate=2.5)


def _leg(pelvis: Array, root: Array, ankle: Array, hinge_yaw: Array, skeleton: Skeleton, side: int) -> tuple[Array, Array]:
    """World rotations (T, 3, 3) of thigh and shin that bring the ankle to its target, knee forward."""
    rest_thigh, rest_shin = _leg_bones(skeleton, side)
    upper, lower = np.linalg.norm(rest_thigh), np.linalg.norm(rest_shin)
    hip = pelvis + _apply(root, skeleton.joints[_HIP[side]] - skeleton.joints[0])
    gap = ankle - hip
    distance = np.clip(np.linalg.norm(gap, axis=1), 0.3 * (upper + lower), 0.9995 * (upper + lower))
    toward = _unit(gap)
    sideways = _turn("Y", hinge_yaw)[:, :, 0]
    # The hinge must be square to the leg, wherever the leg points.
    hinge = _unit(sideways - (sideways * toward).sum(axis=1, keepdims=True) * toward)
    cosine = ((upper**2 + distance**2 - lower**2) / (2 * upper * distance))[:, None]
    bend = np.sqrt(np.maximum(1.0 - cosine**2, 0.0))
    thigh = cosine * toward + bend * np.cross(toward, hinge)
    shin = _unit(distance[:, None] * toward - upper * thigh)
    return (
        _frame(thigh, hinge) @ _inverse(_frame(rest_thigh[None], np.eye(3)[:1])),
        _frame(shin, hinge) @ _inverse(_frame(rest_shin[None], np.eye(3)[:1])),
    )


def _pose_arm(local: Array, arm: Array, side: int) -> None:
    """Collar, shoulder, elbow and wrist from the four arm angles, mirrored for the right arm."""
    lower, swing, twist, elbow = arm.T
    shoulder = _turn("X", -swing) @ _turn("Z", -lower) @ _turn("X", twist)
    elevation = np.degrees(np.arcsin(np.clip(shoulder[:, 1, 0], -1.0, 1.0)))
    # Above the horizontal the shoulder blade takes part of the lift.
    collar = _turn("Z", 12.0 * np.log1p(np.exp((elevation - 5.0) / 30.0)) - 2.0)
    parts = {
        _COLLAR[side]: collar,
        _SHOULDER[side]: _inverse(collar) @ shoulder,
        _ELBOW[side]: _turn("Y", -elbow),
        _WRIST[side]: _turn("Z", np.full(len(arm), -4.0)),
    }
    for joint, rotation in parts.items():
        local[:, joint] = rotation if side == 0 else _MIRROR @ rotation @ _MIRROR


def _leg_bones(skeleton: Skeleton, side: int) -> tuple[Array, Array]:
    hip, knee, ankle = (skeleton.joints[chain[side]] for chain in (_HIP, _KNEE, _ANKLE))
    return knee - hip, ankle - knee


def _frame(direction: Array, hinge: Array) -> Array:
    """Rotations (T, 3, 3) with columns hinge (made square to the bone), bone × hinge, bone."""
    bone = _unit(direction)
    hinge = _unit(hinge - (hinge * bone).sum(axis=1, keepdims=True) * bone)
    return np.stack([hinge, np.cross(bone, hinge), bone], axis=-1)


def _turn(axes: str, degrees: Array) -> Array:
    """Intrinsic Euler rotations (T, 3, 3)."""
    return Rotation.from_euler(axes, degrees.reshape(len(degrees), len(axes)), degrees=True).as_matrix()


def _apply(rotation: Array, vectors: Array) -> Array:
    return np.einsum("tij,...tj->ti", rotation, np.broadcast_to(vectors, (len(rotation), 3)))


def _inverse(rotation: Array) -> Array:
    return np.swapaxes(rotation, -1, -2)


def _unit(vectors: Array) -> Array:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)
