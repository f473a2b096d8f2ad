"""Bodies without a skeleton of the family: a moving mesh, a still one, or none at all.

Rigid motions of point sets.

Points that follow a surface without skinning weights: carried along by the vertices next to them.
"""

from __future__ import annotations

import itertools
import warnings
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from hood.assets.body.body import Body, linear_blend_skinning
from hood.assets.garment.binding import bind_garment
from hood.assets.garment.garment import Garment
from hood.assets.motion.mesh_sequence import MeshSequence
from hood.cloth.state import Obstacle
from hood.mesh.closest_point import tree
from hood.mesh.closest_point.search import search_surface
from hood.mesh.parts import find_parts


def best_turn(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """The rotation (3, 3) that takes points (N, 3) about their middle nearest to others, by least squares (Kabsch)."""
    left, _, right = np.linalg.svd(end.T @ start)
    mirrored = np.linalg.det(left @ right) < 0.0
    return np.asarray(left @ np.diag([1.0, 1.0, -1.0 if mirrored else 1.0]) @ right)


def turned(start: np.ndarray, end: np.ndarray) -> float:
    """Degrees by which points (N, 3) turn about their middle, as far as they turn as one."""
    turn = best_turn(start - start.mean(axis=0), end - end.mean(axis=0))
    return float(np.degrees(np.arccos(np.clip(0.5 * (np.trace(turn) - 1.0), -1.0, 1.0))))


def moved(start: np.ndarray, end: np.ndarray) -> tuple[float, float]:
    """Degrees as of :func:`turned`, and the longest way [m] of one of the points (N, 3) [m], N > 0."""
    return tree.moved(start, end) or (turned(start, end), float(np.sqrt(np.square(end - start).sum(axis=1).max())))


#: Body vertices whose motion a garment vertex without skin follows; enough to turn as a limb does, not as a facet does.
_NEIGHBOURS = 24
#: Distance [m] below which neighbours count the same.
_SOFTENING = 0.02


@dataclass(frozen=True)
class Anchors:
    """What each garment vertex follows: neighbours (V, K) on the body, their shares, and where all were at first."""

    neighbours: np.ndarray
    shares: np.ndarray  # (V, K), rows sum to one
    arms: np.ndarray  # (V, K, 3) m, neighbours about their centre
    offset: np.ndarray  # (V, 3) m, garment vertex from that centre

    def carried(self, points: np.ndarray) -> np.ndarray:
        """(V, 3) m: moved as the best rigid motion of each vertex's neighbours (Kabsch) to ``points`` (W, 3)."""
        now = points[self.neighbours]
        centre = (self.shares[:, :, None] * now).sum(axis=1)
        spread = np.einsum("vk,vka,vkb->vab", self.shares, now - centre[:, None], self.arms)
        left, _, right = np.linalg.svd(spread)
        # A mirror image is no motion: the weakest direction is turned back.
        left[:, :, 2] *= np.sign(np.linalg.det(left @ right))[:, None]
        return centre + np.einsum("vab,vb->va", left @ right, self.offset)


def anchors(pos: np.ndarray, points: np.ndarray) -> Anchors:
    """What carries ``pos`` (V, 3) [m] along with the vertices ``points`` (W, 3) of a surface."""
    count = min(_NEIGHBOURS, len(points))
    dist, neighbours = cKDTree(points).query(pos, k=list(range(1, count + 1)))
    shares = 1.0 / (dist**2 + _SOFTENING**2)
    shares /= shares.sum(axis=1, keepdims=True)
    near = points[neighbours]
    centre = (shares[:, :, None] * near).sum(axis=1)
    return Anchors(neighbours, shares, near - centre[:, None], pos - centre)


#: A garment is worn in the first frame if at most this share of its vertices is deeper inside than ``_DEEP`` [m], and half
#: of them are closer than ``_NEAR`` [m].
_INSIDE, _DEEP, _NEAR = 0.2, 0.02, 0.3
#: Vertices that say how a mesh turns.
_SAMPLED = 500


@dataclass(frozen=True)
class MeshMotion:
    """A mesh performing its own motion. One frame is held for as long as it is asked for.

    A garment is given where it is in the first frame (``skin_pos``, or ``rest_pos`` where there is none), in the world. Its
    pins and its first velocity follow the body vertices next to it, rigidly: where those turn and shift as one, so does
    the garment. A garment with weights for the mesh's joints is posed by those instead, and so is one given around the
    rest pose of a mesh that has a skin (glTF).
    """

    sequence: MeshSequence
    num_frames: int
    translation: np.ndarray  # (T, 3) m float64, world: middle of the mesh's bounding box
    dtype: torch.dtype
    device: torch.device
    _faces: Tensor  # (G, 3); one tensor, the search keeps its incidence table with it
    _anchors: dict[int, tuple[Garment, Anchors]] = field(default_factory=dict, repr=False, compare=False)

    @property
    def name(self) -> str:
        return self.sequence.name

    @property
    def fps(self) -> float:
        return self.sequence.fps

    @property
    def faces(self) -> np.ndarray:
        return self.sequence.faces

    @property
    def num_vertices(self) -> int:
        return self.sequence.verts.shape[1]

    def turns(self) -> np.ndarray:
        """(T − 1, 3) rad: those that fit some of its vertices best."""
        verts = self.sequence.verts[:, :: -(-self.num_vertices // _SAMPLED)].astype(np.float64)
        centred = verts - verts.mean(axis=1, keepdims=True)
        found = [best_turn(*pair) for pair in itertools.pairwise(centred)]
        turns = np.zeros((self.num_frames - 1, 3))
        turns[: len(found)] = Rotation.from_matrix(np.reshape(found, (-1, 3, 3))).as_rotvec()
        return turns

    def points(self, frame: int) -> np.ndarray:
        """(W, 3) m, float64, world."""
        return self.sequence.verts[min(frame, self.sequence.num_frames - 1)].astype(np.float64)

    def surface(self, frame: int, origin: np.ndarray) -> Tensor:
        """(W, 3) m, relative to ``origin``: subtracted in float64, so that nothing is lost far from the world's."""
        return torch.as_tensor(self.points(frame) - origin).to(self.device, self.dtype)

    def some_points(self, frames: np.ndarray, stride: int) -> np.ndarray:
        """(N, W′, 3) m, float64, in the world: every ``stride``-th vertex in ``frames`` (N,)."""
        return np.stack([self.points(int(frame))[::stride] for frame in frames])

    def obstacle(self, frame: int, origin: np.ndarray, static: bool = False) -> Obstacle:
        """The body around the step ``frame`` → ``frame + 1``; ``static`` freezes it at ``frame`` (relaxing step)."""
        now = self.surface(frame, origin)
        return Obstacle(
            pos=now,
            next_pos=now if static else self.surface(frame + 1, origin),
            prev_pos=now if static or frame == 0 else self.surface(frame - 1, origin),
            faces=self._faces,
            vertex_scene=self._faces.new_zeros(len(now)),
            face_scene=self._faces.new_zeros(len(self._faces)),
            omitted=torch.zeros(len(now), dtype=torch.bool, device=self.device),
        )

    def dressed(self, garment: Garment) -> Garment:
        """The garment as it is, worn in the first frame or with weights of its own; or, given in the rest pose of a mesh that
        has a skin, bound to that.

        Raises:
            ValueError: it is inside the body in the first frame, was made for another body and is far from this one, or has
                weights for other joints.
        """
        if self._bones(garment) is not None:
            return garment
        pos, faces = garment.worn_pos, self.faces
        first = _misfit(pos, self.points(0), faces)
        if self.sequence.rest is not None and self.sequence.weights is not None:
            rest = _misfit(pos, self.sequence.rest, faces)
            if rest.fits and sum(rest) <= sum(first):
                return bind_garment(garment, _rest_body(self.sequence))
        # A sheet may well fall on a body from afar; what was made for another body, or is open at both ends, is misplaced.
        if first.inside <= _INSIDE and garment.bound_to is None and (first.fits or not wearable(garment)):
            if not first.fits:
                warnings.warn(
                    f"garment {garment.name!r}: half of it is over {first.middle:.2g} m away from {self.name!r} at first",
                    stacklevel=3,
                )
            return garment
        if not first.fits:
            raise ValueError(
                f"garment {garment.name!r}: not worn by {self.name!r} in its first frame ({100 * first.inside:.0f}% of the "
                f"vertices are deeper than {100 * _DEEP:.0f} cm inside, half of them farther than {first.middle:.2g} m away); "
                + _REMEDY[self.sequence.rest is not None]
            )
        return garment

    def rest_pos(self, garment: Garment) -> np.ndarray:
        """(V, 3) m: the garment's own."""
        return garment.rest_pos

    def skinned(self, garment: Garment, frame: int, origin: np.ndarray) -> Tensor:
        """(V, 3) m: the garment carried along from the first frame, or posed by its weights, relative to ``origin``."""
        bones = self._bones(garment)
        if bones is not None:
            pose = torch.as_tensor(bones[min(frame, len(bones) - 1)][None])
            rest, weights = (torch.as_tensor(table, dtype=pose.dtype) for table in (garment.worn_pos, garment.lbs_weights))
            pos = linear_blend_skinning(rest, weights, pose)[0].numpy()
        else:
            pos = self._anchored(garment).carried(self.points(frame))
        return torch.as_tensor(pos - origin).to(self.device, self.dtype)

    def _bones(self, garment: Garment) -> np.ndarray | None:
        """(T, J, 3, 4) where the garment has weights for the mesh's joints; weights of another body do not count."""
        bones = self.sequence.transforms
        if bones is None or garment.lbs_weights is None or garment.bound_to not in (None, self.name):
            return None
        if garment.lbs_weights.shape[1] != bones.shape[1]:
            raise ValueError(
                f"garment {garment.name!r}: weights for {garment.lbs_weights.shape[1]} joints, {self.name!r} has "
                f"{bones.shape[1]}; leave lbs_weights out, or give one column per joint in the file's order"
            )
        return bones

    def _anchored(self, garment: Garment) -> Anchors:
        known = self._anchors.get(id(garment))
        if known is None or known[0] is not garment:
            known = (garment, anchors(garment.worn_pos, self.points(0)))
            self._anchors[id(garment)] = known
        return known[1]


@dataclass(frozen=True)
class NoBody:
    """Nothing moves: a garment hangs from its pins, or falls."""

    num_frames: int
    fps: float
    dtype: torch.dtype = torch.float32
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))
    name: str = "none"

    @property
    def translation(self) -> np.ndarray:
        """(T, 3): the world's origin; a scene's local frame finds the cloth by itself."""
        return np.zeros((self.num_frames, 3))

    def turns(self) -> np.ndarray:
        """(T − 1, 3) rad: none."""
        return np.zeros((self.num_frames - 1, 3))

    @property
    def faces(self) -> np.ndarray:
        return np.zeros((0, 3), dtype=np.int64)

    @property
    def num_vertices(self) -> int:
        return 0

    def surface(self, frame: int, origin: np.ndarray) -> Tensor:
        """(0, 3)."""
        return torch.zeros(0, 3, dtype=self.dtype, device=self.device)

    def some_points(self, frames: np.ndarray, stride: int) -> np.ndarray:
        """(N, 0, 3)."""
        return np.zeros((len(frames), 0, 3))

    def obstacle(self, frame: int, origin: np.ndarray, static: bool = False) -> None:
        """None."""

    def dressed(self, garment: Garment) -> Garment:
        """The garment as it is."""
        return garment

    def rest_pos(self, garment: Garment) -> np.ndarray:
        """(V, 3) m: the garment's own."""
        return garment.rest_pos

    def skinned(self, garment: Garment, frame: int, origin: np.ndarray) -> Tensor:
        """(V, 3) m: the garment where it was given; pins stay there."""
        return torch.as_tensor(garment.worn_pos - origin).to(self.device, self.dtype)


def mesh_motion(
    sequence: MeshSequence,
    num_frames: int | None = None,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str = "cpu",
) -> MeshMotion:
    """The motion of ``sequence``; ``num_frames`` is how long a mesh that stands still is held (one frame where None)."""
    count = sequence.num_frames if sequence.num_frames > 1 or num_frames is None else num_frames
    boxes = np.stack([(points.min(axis=0).astype(np.float64) + points.max(axis=0)) / 2 for points in sequence.verts])
    if sequence.num_frames == 1:
        boxes = np.repeat(boxes, count, axis=0)
    faces = torch.as_tensor(sequence.faces, device=device)
    return MeshMotion(sequence, count, boxes, dtype, torch.device(device), faces)


class _Misfit(NamedTuple):
    """How badly a garment sits on a surface."""

    inside: float  # share of the vertices deeper than ``_DEEP`` inside
    middle: float  # m, median distance

    @property
    def fits(self) -> bool:
        return self.inside <= _INSIDE and self.middle <= _NEAR


def _misfit(pos: np.ndarray, points: np.ndarray, faces: np.ndarray) -> _Misfit:
    tensors = [torch.as_tensor(np.ascontiguousarray(table)) for table in (pos, points, faces)]
    zeros = [torch.zeros(len(table), dtype=torch.int64) for table in tensors]
    dist = search_surface(tensors[0], zeros[0], tensors[1], tensors[2], zeros[1], zeros[2]).dist.numpy()
    return _Misfit(float((dist < -_DEEP).mean()), float(np.median(np.abs(dist))))


def wearable(garment: Garment) -> bool:
    """Whether a part of it can be put on: a sheet cannot (:attr:`hood.mesh.parts.Part.can_be_put_on`)."""
    return any(part.can_be_put_on for part in find_parts(garment.rest_pos, garment.faces))


def _rest_body(sequence: MeshSequence) -> Body:
    """A mesh's rest pose and weights as a body to bind to; it has no shapes, and its joints are in the sequence."""
    assert sequence.rest is not None
    assert sequence.weights is not None
    num_vertices, num_joints = sequence.weights.shape
    return Body(
        name=sequence.name,
        v_template=sequence.rest,
        shapedirs=np.zeros((num_vertices, 3, 0)),
        joint_regressor=np.zeros((num_joints, num_vertices)),
        weights=sequence.weights,
        parents=(-1,) * num_joints,
        faces=sequence.faces,
    )


#: What to do about a garment that is not worn, by whether the mesh has a skin.
_REMEDY = {
    False: "a mesh has no skin: give the garment as it is worn there, or with weights for the mesh's joints",
    True: "give the garment as it is worn there, or around the mesh's rest pose",
}
