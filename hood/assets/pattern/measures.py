"""Measures of a body for drafting patterns: its mesh is cut by planes, and a tape goes around each cut."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull

from hood.mesh import topology

#: Joints of a skeleton of the SMPL family that say where to measure.
_PELVIS, _SPINE, _SPINE_2, _SPINE_3, _NECK, _HEAD = 0, 3, 6, 9, 12, 15
_HIP, _KNEE, _ANKLE, _SHOULDER, _ELBOW, _WRIST = 1, 4, 7, 16, 18, 20
_UP, _LEFT = np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])
#: The point of the shoulder is so much farther out than its joint; half of the neck's width is this share of its girth.
_TIP, _NECK_WIDTH = 1.05, 0.2


@dataclass(frozen=True)
class Measures:
    """Measures of a body that stands in T-pose, in metres; heights are above its lowest point.

    Args:
        height: of the whole body; the girths that follow are lengths of a taut tape.
        neck_height: of the side of the neck on the shoulder, which ends at ``shoulder_height``.
        shoulder_width: from one point of the shoulder to the other; ``arm_length`` from there to the wrist.
        front_length: from the side of the neck over the chest to the waist, ``back_length`` over the back.
        shoulder: (x, y, z) of the joint of the left arm; ``stance``: x of the left knee.
        front: the greatest z of the trunk; ``back`` the least.
    """

    height: float
    neck: float
    chest: float
    waist: float
    hips: float
    head: float
    upper_arm: float
    wrist: float
    thigh: float
    knee: float
    calf: float
    ankle: float
    neck_height: float
    shoulder_height: float
    underarm_height: float
    waist_height: float
    hip_height: float
    crotch_height: float
    knee_height: float
    ankle_height: float
    shoulder_width: float
    arm_length: float
    front_length: float
    back_length: float
    shoulder: tuple[float, float, float]
    stance: float
    front: float
    back: float

    @property
    def neck_width(self) -> float:
        """Half the width [m] of a neckline that lies at the neck."""
        return _NECK_WIDTH * self.neck


def cuts(vertices: np.ndarray, faces: np.ndarray, point: np.ndarray, normal: np.ndarray) -> list[np.ndarray]:
    """The closed curves in which a plane cuts a surface, as the points (N, 3) where it cuts edges, in no order.

    Args:
        vertices: (V, 3), ``faces`` (F, 3).
        point: (3,) of the plane, whose ``normal`` is (3,).
    """
    side = (vertices - point) @ normal
    # A vertex in the plane counts as above it.
    side = np.where(np.abs(side) < 1e-9, 1e-9, side)
    mixed = faces[np.ptp((side > 0)[faces].astype(np.int8), axis=1) > 0]
    edges = np.sort(mixed[:, [[0, 1], [1, 2], [2, 0]]], axis=2)
    edges = edges[(side[edges[..., 0]] > 0) != (side[edges[..., 1]] > 0)]  # two of every face
    if not len(edges):
        return []
    codes, number = np.unique(edges[:, 0] * len(vertices) + edges[:, 1], return_inverse=True)
    own = np.stack(np.divmod(codes, len(vertices)), axis=1)
    share = side[own[:, 0]] / (side[own[:, 0]] - side[own[:, 1]])
    points = vertices[own[:, 0]] + share[:, None] * (vertices[own[:, 1]] - vertices[own[:, 0]])
    label = topology.connected_components(len(own), number.reshape(-1, 2))
    return [points[label == one] for one in range(int(label.max()) + 1)]


def girth(curve: np.ndarray, normal: np.ndarray) -> float:
    """Length [m] of a taut tape around points (N, 3) of a plane: the perimeter of their convex hull."""
    if len(curve) < 3:
        return 0.0
    first = np.cross(normal, _LEFT if abs(normal[0]) < 0.9 * np.linalg.norm(normal) else _UP)
    first = first / np.linalg.norm(first)
    second = np.cross(normal, first) / np.linalg.norm(normal)
    return float(ConvexHull(np.stack([curve @ first, curve @ second], axis=1)).area)


def measure_body(vertices: np.ndarray, faces: np.ndarray, joints: np.ndarray) -> Measures:
    """The measures of a body in T-pose.

    Args:
        vertices: (V, 3) m, y up, z forward; ``faces`` (F, 3), a closed surface.
        joints: (J, 3) m, J ≥ 22, in the order of the SMPL family.

    Raises:
        ValueError: a plane at a joint misses the surface, which is no such body then.
    """
    floor = np.array([0.0, vertices[:, 1].min(), 0.0])
    return _Tape(vertices - floor, faces, joints - floor).measures()


class _Tape:
    """A body to be measured; its floor is at y = 0."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, joints: np.ndarray) -> None:
        self.vertices, self.faces, self.joints = vertices, faces, joints

    def curve(self, point: np.ndarray, normal: np.ndarray = _UP) -> np.ndarray:
        """Points (N, 3) of the curve around ``point``: the nearest of those in its plane."""
        found = [one for one in cuts(self.vertices, self.faces, point, normal) if len(one) > 2]
        if not found:
            raise ValueError(f"the body cannot be measured: nothing of it is at {np.round(point, 3).tolist()} m; give another")
        return min(found, key=lambda one: float(np.linalg.norm(one.mean(axis=0) - point)))

    def along(self, first: int, second: int, share: float) -> float:
        """Girth across the bone from one joint to another, at a share of its length."""
        bone = self.joints[second] - self.joints[first]
        return girth(self.curve(self.joints[first] + share * bone, bone), bone)

    def trunk(self, height: float) -> np.ndarray:
        return self.curve(np.array([0.0, height, float(np.interp(height, *self._spine()))]))

    def _spine(self) -> tuple[np.ndarray, np.ndarray]:
        spine = self.joints[[_PELVIS, _SPINE, _SPINE_2, _SPINE_3, _NECK, _HEAD]]
        return spine[:, 1], spine[:, 2]

    def extreme(self, low: float, high: float, sign: float) -> tuple[float, float]:
        """Height and girth of the trunk where it is widest (``sign`` 1) or narrowest (-1) between two heights."""
        heights = np.linspace(low, high, 25)
        girths = np.array([girth(self.trunk(height), _UP) for height in heights])
        best = int((sign * girths).argmax())
        return float(heights[best]), float(girths[best])

    def lowest(self, low: float, high: float, test: str) -> float:
        """The height between two where the legs become one ("crotch") or the arms join ("underarm"), by bisection."""
        elbow, shoulder = self.joints[_ELBOW, 0], self.joints[_SHOULDER, 0]
        for _ in range(9):
            middle = 0.5 * (low + high)
            if test == "crotch":
                curves = cuts(self.vertices, self.faces, np.array([0.0, middle, 0.0]), _UP)
                reached = any(one[:, 0].min() < -0.02 and one[:, 0].max() > 0.02 for one in curves)
            else:
                reached = bool(self.trunk(middle)[:, 0].max() > 0.7 * shoulder + 0.3 * elbow)
            low, high = (low, middle) if reached else (middle, high)
        return 0.5 * (low + high)

    def top(self, x: float) -> np.ndarray:
        """The highest point (3,) of the surface below the head, so far to the left."""
        curves = cuts(self.vertices, self.faces, np.array([x, 0.0, 0.0]), _LEFT)
        # Ears and cheeks are curves above the neck.
        points = np.concatenate([one for one in curves if one[:, 1].min() < self.joints[_NECK, 1]])
        points = points[points[:, 1] < self.joints[_HEAD, 1]]
        return np.asarray(points[points[:, 1].argmax()])

    def over(self, top: np.ndarray, waist: float, forward: float) -> float:
        """Length of a taut tape from ``top`` to the height of the waist, over the chest (1) or the back (-1)."""
        points = np.concatenate(cuts(self.vertices, self.faces, top, _LEFT))
        points = points[(points[:, 1] >= waist) & (points[:, 1] <= top[1])]
        points = points[forward * (points[:, 2] - top[2]) >= 0.0]
        chain: list[np.ndarray] = []
        for here in points[np.argsort(points[:, 1])][:, 1:] * [1.0, forward]:
            while len(chain) > 1 and np.linalg.det([chain[-1] - chain[-2], here - chain[-2]]) >= 0.0:
                chain.pop()
            chain.append(here)
        return float(np.linalg.norm(np.diff(chain, axis=0), axis=1).sum())

    def measures(self) -> Measures:
        joints = self.joints
        waist_height, waist = self.extreme(joints[_SPINE, 1], 0.5 * (joints[_SPINE_2, 1] + joints[_SPINE_3, 1]), -1.0)
        crotch = self.lowest(joints[_KNEE, 1], joints[_PELVIS, 1], "crotch")
        underarm = self.lowest(waist_height, joints[_SHOULDER, 1], "underarm")
        hip_height, hips = self.extreme(crotch + 0.02, waist_height - 0.02, 1.0)
        _, chest = self.extreme(waist_height + 0.02, underarm - 0.05, 1.0)
        _, neck = self.extreme(joints[_NECK, 1], joints[_HEAD, 1], -1.0)
        _, head = self.extreme(joints[_HEAD, 1] + 0.03, self.vertices[:, 1].max() - 0.03, 1.0)
        side, tip = self.top(_NECK_WIDTH * neck), self.top(float(joints[_SHOULDER, 0]))
        thigh = joints[_HIP] + (joints[_KNEE] - joints[_HIP]) * (joints[_HIP, 1] - crotch + 0.02) / (
            joints[_HIP, 1] - joints[_KNEE, 1]
        )
        arm = np.linalg.norm(joints[_SHOULDER] - joints[_ELBOW]) + np.linalg.norm(joints[_ELBOW] - joints[_WRIST])
        inside = (self.vertices[:, 1] > crotch) & (self.vertices[:, 1] < tip[1])
        depth = self.vertices[inside & (np.abs(self.vertices[:, 0]) < joints[_SHOULDER, 0]), 2]
        return Measures(
            height=float(self.vertices[:, 1].max()),
            neck=neck,
            chest=chest,
            waist=waist,
            hips=hips,
            head=head,
            upper_arm=self.along(_SHOULDER, _ELBOW, 0.45),
            wrist=self.along(_ELBOW, _WRIST, 0.98),
            thigh=girth(self.curve(thigh), _UP),
            knee=self.along(_KNEE, _ANKLE, 0.0),
            calf=max(self.along(_KNEE, _ANKLE, share) for share in (0.2, 0.3, 0.4)),
            ankle=self.along(_KNEE, _ANKLE, 0.95),
            neck_height=float(side[1]),
            shoulder_height=float(tip[1]),
            underarm_height=underarm,
            waist_height=waist_height,
            hip_height=hip_height,
            crotch_height=crotch,
            knee_height=float(joints[_KNEE, 1]),
            ankle_height=float(joints[_ANKLE, 1]),
            shoulder_width=2.0 * _TIP * float(joints[_SHOULDER, 0]),
            arm_length=float(arm),
            front_length=self.over(side, waist_height, 1.0),
            back_length=self.over(side, waist_height, -1.0),
            shoulder=(float(joints[_SHOULDER, 0]), float(joints[_SHOULDER, 1]), float(joints[_SHOULDER, 2])),
            stance=float(joints[_KNEE, 0]),
            front=float(depth.max()),
            back=float(depth.min()),
        )
