"""Garments bound to a body: from its T-pose, from any other pose, and out of its skin."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from scipy import sparse
from scipy.sparse.linalg import splu

from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.assets.motion.sequence import PoseSequence
from hood.mesh import topology
from hood.mesh.closest_point.search import search_surface
from hood.mesh.flat import followed

#: Distance [m] over which the body's influence on a garment vertex halves: beyond it neighbours decide.
_BINDING_REACH = 0.03
#: Least stretch that undoing a pose assumes: blends of opposite rotations shrink volume to nothing.
_LEAST_STRETCH = 0.3
#: Joints of the trunk and the hips that hang on it, the same in all skeletons of the SMPL family.
_TRUNK, _HIPS = (0, 3, 6, 9), (1, 2)
#: Searches for the way out: leaving one limb may enter another.
_ROUNDS = 8


class Pushed(NamedTuple):
    """Points outside a surface, and what it took."""

    pos: np.ndarray  # (V, 3)
    num_inside: int  # points that had been inside
    depth: float  # m, of the deepest of them


@dataclass(frozen=True)
class PosedBody:
    """One frame of a body of shape ``betas``, in the world, float64."""

    body: Body
    betas: np.ndarray
    surface: np.ndarray  # (W, 3) m
    transforms: np.ndarray  # (J, 3, 4) from the T-pose to the frame, translation included

    @property
    def faces(self) -> np.ndarray:
        return self.body.faces


def posed_body(body: Body, sequence: PoseSequence, frame: int, betas: np.ndarray) -> PosedBody:
    """``body`` of shape ``betas`` at ``frame`` of ``sequence``."""
    window = sequence.window(frame, frame + 1)
    translation = body.translation(window, betas)[0]
    surface = body.surface(window, betas, torch.float64)[0].numpy() + translation
    transforms = body.transforms(window, betas, torch.float64)[0].numpy().copy()
    transforms[:, :, 3] += translation
    return PosedBody(body, np.asarray(betas, dtype=np.float64), surface, transforms)


def bind_garment(garment: Garment, body: Body) -> Garment:
    """The garment with skinning weights and shape offsets of ``body``, diffused beyond the skin.

    Each vertex asks the closest point of the body's T-pose; far vertices trust it less. The result minimises
    Σ c_v |w_v − w_v⁰|² + Σ_edges |w_a − w_b|² with confidence c falling with distance (paper, section 3.5: weights diffused
    beyond the body), so loose cloth gets smooth weights. A garment that has fitting weights is returned
    as it is, unless they are those of another body.
    """
    fits = garment.lbs_weights is not None and garment.lbs_weights.shape[1] == body.num_joints
    if garment.bound and fits and garment.bound_to in (None, body.name):
        return garment
    at = garment.worn_pos
    weights, shapedirs = _spread_skin(at, garment.faces, body, body.v_template)
    return replace(garment, lbs_weights=weights, shapedirs=shapedirs, bound_to=body.name)


def hold_on_trunk(garment: Garment, body: Body) -> Garment:
    """The bound garment with held vertices of the trunk following the trunk alone.

    Skin at the waist follows the thighs by up to a fifth. A waistband that does so folds with the belly: its edges change
    by 20% and it sinks 7 mm into a body that squats. A waistband keeps its girth. Nothing changes for other vertices, nor
    in a T-pose.
    """
    if garment.lbs_weights is None or not garment.pinned.any() or body.parents[1:3] != (0, 0):
        return garment
    weights = garment.lbs_weights.copy()
    hips, trunk = weights[:, _HIPS].sum(axis=1), weights[:, _TRUNK].sum(axis=1)
    chosen = garment.pinned & (hips > 0) & (hips < trunk)
    if not chosen.any():
        return garment
    weights[np.ix_(chosen, _HIPS)] = 0.0
    weights[chosen] /= weights[chosen].sum(axis=1, keepdims=True)
    return replace(garment, lbs_weights=weights)


def bind_posed(garment: Garment, posed: PosedBody, worn_pos: np.ndarray | None = None) -> Garment:
    """A garment modelled around ``posed``, bound to its body: the mesh as it is given is the rest shape.

    Weights come from the posed skin as in :func:`bind_garment`; linear blend skinning is then undone vertex by vertex,
    so that skinning the result back into the same pose gives ``worn_pos``. Where blended rotations all but cancel
    (deep folds of a joint) the inverse is limited, and only nearly so.

    Args:
        worn_pos: (V, 3) [m], where the garment is worn in that pose; None: where it is given. The rest shape stays.
    """
    worn_pos = garment.rest_pos if worn_pos is None else worn_pos
    weights, shapedirs = _spread_skin(worn_pos, garment.faces, posed.body, posed.surface)
    grown, turn = undo_skinning(weights, posed.transforms, worn_pos)
    count = min(len(posed.betas), shapedirs.shape[2])
    offset = shapedirs[..., :count] @ posed.betas[:count]
    straight = np.allclose(turn, np.eye(3), atol=1e-9)
    as_given = straight and np.array_equal(worn_pos, garment.rest_pos)
    mean = garment.rest_pos - np.einsum("vij,vj->vi", turn, offset)
    riders = garment.riders
    return replace(
        garment,
        riders=None if riders is None else replace(riders, pos=riders.positions(mean, garment.rest_pos)),
        rest_pos=mean,
        flat=None if garment.flat is None else followed(garment.flat, garment.faces, garment.rest_pos, mean),
        skin_pos=None if as_given else grown - offset,
        rest_turn=None if straight else turn,
        lbs_weights=weights,
        shapedirs=shapedirs,
        bound_to=posed.body.name,
    )


def undo_skinning(weights: np.ndarray, transforms: np.ndarray, pos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What linear blend skinning by ``weights`` (V, J) and ``transforms`` (J, 3, 4) takes to ``pos`` (V, 3), and its turns.

    Where blended rotations all but cancel the inverse is limited.

    Returns:
        (V, 3) [m], in T-pose, and (V, 3, 3): the rotations from there to ``pos``.
    """
    blended = (weights @ transforms.reshape(len(transforms), 12)).reshape(-1, 3, 4)
    left, stretch, right = np.linalg.svd(blended[:, :, :3])
    inverse = right.transpose(0, 2, 1) / np.maximum(stretch, _LEAST_STRETCH)[:, None, :] @ left.transpose(0, 2, 1)
    return np.einsum("vij,vj->vi", inverse, pos - blended[:, :, 3]), left @ right


def signed_distances(points: np.ndarray, surface: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Distances (V,) [m] of ``points`` to a closed surface, negative inside."""
    return _search(points, surface, faces).dist


def closest_points(points: np.ndarray, surface: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """:func:`signed_distances`, and the places (V, 3) [m] on the surface that ``points`` are nearest to."""
    hit = _search(points, surface, faces)
    return hit.dist, hit.closest(surface)


def push_out(points: np.ndarray, surface: np.ndarray, faces: np.ndarray, clearance: float) -> Pushed:
    """``points`` (V, 3) with those inside the closed surface, or nearer than ``clearance`` [m], moved straight out to it."""
    pos, inside, depth = points.copy(), 0, 0.0
    for round_ in range(_ROUNDS):
        hit = _search(pos, surface, faces)
        if round_ == 0:
            inside, depth = int((hit.dist < 0).sum()), float(max(-hit.dist.min(initial=0.0), 0.0))
        near = hit.dist < clearance - 1e-6
        if not near.any():
            break
        closest = hit.closest(surface)[near]
        away = (pos[near] - closest) * np.sign(hit.dist[near])[:, None]
        length = np.linalg.norm(away, axis=1, keepdims=True)
        normal = _face_normals(surface, hit.corners[near])
        # On the surface itself there is no direction from the closest point: the face's normal is one.
        direction = np.where(length > 1e-9, away / np.maximum(length, 1e-9), normal)
        pos[near] = closest + clearance * direction
    return Pushed(pos, inside, depth)


@dataclass(frozen=True)
class _Nearest:
    corners: np.ndarray
    bary: np.ndarray
    dist: np.ndarray

    def closest(self, vertices: np.ndarray) -> np.ndarray:
        return np.asarray((self.bary[:, :, None] * vertices[self.corners]).sum(axis=1))


def _search(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> _Nearest:
    tensors = [torch.as_tensor(np.ascontiguousarray(x)) for x in (points, vertices, faces)]
    zeros = [torch.zeros(len(x), dtype=torch.int64) for x in tensors]
    hit = search_surface(tensors[0], zeros[0], tensors[1], tensors[2], zeros[1], zeros[2])
    return _Nearest(faces[hit.face.numpy()], hit.bary.numpy(), hit.dist.numpy())


def _face_normals(pos: np.ndarray, corners: np.ndarray) -> np.ndarray:
    cross = np.cross(pos[corners[:, 1]] - pos[corners[:, 0]], pos[corners[:, 2]] - pos[corners[:, 0]])
    return np.asarray(cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-30))


def _spread_skin(points: np.ndarray, faces: np.ndarray, body: Body, surface: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Skinning weights (V, J) and shape offsets (V, 3, S) of ``points`` around ``surface`` (W, 3), a pose of ``body``."""
    nearest = _search(points, surface, body.faces)
    raw = np.concatenate([body.weights, body.shapedirs.reshape(len(body.weights), -1)], axis=1)
    values = sum(nearest.bary[:, k : k + 1] * raw[nearest.corners[:, k]] for k in range(3))
    smooth = _diffuse(np.asarray(values), faces, np.abs(nearest.dist))
    weights = np.clip(smooth[:, : body.num_joints], 0.0, None)
    weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1e-12)
    return weights, smooth[:, body.num_joints :].reshape(len(points), 3, -1)


def _diffuse(values: np.ndarray, faces: np.ndarray, dist: np.ndarray) -> np.ndarray:
    edges = topology.unique_edges(faces)
    num_vertices = len(values)
    rows, cols = np.concatenate([edges[:, 0], edges[:, 1]]), np.concatenate([edges[:, 1], edges[:, 0]])
    adjacency = sparse.csr_matrix((np.ones(len(rows)), (rows, cols)), shape=(num_vertices, num_vertices))
    laplacian = sparse.diags(np.asarray(adjacency.sum(axis=1)).ravel()) - adjacency
    confidence = np.maximum(2.0 ** (-dist / _BINDING_REACH), 1e-3)
    system = sparse.diags(confidence) + laplacian
    return np.asarray(splu(system.tocsc()).solve(confidence[:, None] * values))
