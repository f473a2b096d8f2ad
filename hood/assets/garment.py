"""Garments: mesh files and embedded templates, bound to a body so that they follow its shape and its first pose."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import sparse
from scipy.sparse.linalg import splu

from hood.assets.body import Body
from hood.assets.library import DATA_FOLDER, locate, read_arrays
from hood.assets.mesh_file import MESH_SUFFIXES, read_mesh
from hood.mesh import topology
from hood.mesh.proximity import search_surface
from hood.mesh.quality import check_triangles

#: Distance [m] over which the body's influence on a garment vertex halves: beyond it neighbours decide.
_BINDING_REACH = 0.03


@dataclass(frozen=True)
class Garment:
    """A garment in the body's T-pose at zero shape coefficients, with what it needs to follow the body."""

    name: str
    rest_pos: np.ndarray  # (V, 3) m, float64
    faces: np.ndarray  # (F, 3) int64
    pinned: np.ndarray  # (V,) bool
    lbs_weights: np.ndarray | None = None  # (V, J)
    shapedirs: np.ndarray | None = None  # (V, 3, S) m per unit of beta
    bound_to: str | None = None  # body whose weights and shape offsets these are; None: whichever it is put on
    uv: np.ndarray | None = None  # (U, 2)
    uv_faces: np.ndarray | None = None  # (F, 3)

    @property
    def bound(self) -> bool:
        return self.lbs_weights is not None and self.shapedirs is not None

    def shaped(self, betas: np.ndarray) -> np.ndarray:
        """Garment (V, 3) [m] in T-pose, grown with the body of shape ``betas``."""
        assert self.shapedirs is not None, "bind the garment first"
        count = min(len(betas), self.shapedirs.shape[2])
        return self.rest_pos + self.shapedirs[..., :count] @ np.asarray(betas[:count], dtype=np.float64)


def load_garment(name: str | Path, triangulate: bool = False) -> Garment:
    """An embedded garment by name, a garment ``.npz`` or a mesh file (OBJ, PLY, STL, GLB, OFF) in the body's T-pose.

    Args:
        triangulate: split faces of four and more corners instead of refusing them.

    Raises:
        FileNotFoundError: unknown name or missing file.
        ValueError: unreadable or broken mesh; names the file, the index and the fix.
    """
    path = locate("garments", name)
    if path.suffix == ".npz":
        garment = _read_npz(path)
    elif path.suffix.lower() in MESH_SUFFIXES:
        rest_pos, faces = read_mesh(path, triangulate)
        garment = Garment(path.stem, rest_pos, faces, np.zeros(len(rest_pos), dtype=bool))
    else:
        raise ValueError(f"{path}: unknown garment format {path.suffix!r}; give .npz or one of {', '.join(MESH_SUFFIXES)}")
    check_triangles(garment.rest_pos, garment.faces, str(path))
    return garment


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
    nearest = _closest_rows(garment.rest_pos, body)
    raw = np.concatenate([body.weights, body.shapedirs.reshape(len(body.weights), -1)], axis=1)
    values = sum(nearest.bary[:, k : k + 1] * raw[nearest.corners[:, k]] for k in range(3))
    smooth = _diffuse(values, garment.faces, np.abs(nearest.dist))
    weights = np.clip(smooth[:, : body.num_joints], 0.0, None)
    weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1e-12)
    shapedirs = smooth[:, body.num_joints :].reshape(len(values), 3, -1)
    return replace(garment, lbs_weights=weights, shapedirs=shapedirs, bound_to=body.name)


@dataclass(frozen=True)
class _Nearest:
    corners: np.ndarray
    bary: np.ndarray
    dist: np.ndarray


def _closest_rows(points: np.ndarray, body: Body) -> _Nearest:
    vertices, faces = torch.as_tensor(body.v_template), torch.as_tensor(body.faces)
    zeros = [torch.zeros(len(x), dtype=torch.int64) for x in (points, vertices, faces)]
    hit = search_surface(torch.as_tensor(points), zeros[0], vertices, faces, zeros[1], zeros[2])
    return _Nearest(body.faces[hit.face.numpy()], hit.bary.numpy(), hit.dist.numpy())


def _diffuse(values: np.ndarray, faces: np.ndarray, dist: np.ndarray) -> np.ndarray:
    edges = topology.unique_edges(faces)
    num_vertices = len(values)
    rows, cols = np.concatenate([edges[:, 0], edges[:, 1]]), np.concatenate([edges[:, 1], edges[:, 0]])
    adjacency = sparse.csr_matrix((np.ones(len(rows)), (rows, cols)), shape=(num_vertices, num_vertices))
    laplacian = sparse.diags(np.asarray(adjacency.sum(axis=1)).ravel()) - adjacency
    confidence = np.maximum(2.0 ** (-dist / _BINDING_REACH), 1e-3)
    system = sparse.diags(confidence) + laplacian
    return splu(system.tocsc()).solve(confidence[:, None] * values)


def _read_npz(path: Path) -> Garment:
    arrays = read_arrays(path, ("rest_pos", "faces"), "garment")
    num_vertices = len(arrays["rest_pos"])
    optional: dict[str, Any] = {key: arrays[key] for key in ("uv", "uv_faces") if key in arrays}
    if path.is_relative_to(DATA_FOLDER):
        optional["bound_to"] = "default"
    for key in ("lbs_weights", "shapedirs"):
        if key in arrays:
            optional[key] = np.asarray(arrays[key], dtype=np.float64)
    if "lbs_weights" in optional:
        total = optional["lbs_weights"].sum(axis=1, keepdims=True)
        optional["lbs_weights"] = optional["lbs_weights"] / np.where(total > 0, total, np.nan)
    pinned = np.asarray(arrays.get("pinned", np.zeros(num_vertices))).astype(bool)
    for key, value in (("pinned", pinned), *((k, optional[k]) for k in ("lbs_weights", "shapedirs") if k in optional)):
        if len(value) != num_vertices:
            raise ValueError(f"{path}: {key} has {len(value)} rows for {num_vertices} vertices; write one row per vertex")
        finite = np.isfinite(value).reshape(num_vertices, -1).all(axis=1)
        if not finite.all():
            raise ValueError(f"{path}: {key} of vertex {int(np.argmin(finite))} is not finite or sums to zero; repair it")
    faces = np.asarray(arrays["faces"])
    if not np.issubdtype(faces.dtype, np.integer):
        raise ValueError(f"{path}: faces are {faces.dtype}; they must be integer vertex indices")
    return Garment(path.stem, np.asarray(arrays["rest_pos"], dtype=np.float64), faces.astype(np.int64), pinned, **optional)
