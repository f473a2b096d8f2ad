"""Sews the default garments for the default body. Build time only: `scikit-image`, `pymeshlab`, `xatlas`.

The zero level of a pattern's field is cut along smooth curves, remeshed isotropically, kept clear of the
body and bound to it with smoothed weights and shape directions.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hood.assets.patterns import (
    CLEARANCE,
    EXTRA_SIZES,
    ORIGIN,
    PATTERNS,
    SIZES,
    VOXEL,
    Fields,
    Pattern,
    body_fields,
)
from hood.assets.remesh import (
    Array,
    Faces,
    closest,
    collapse_short,
    cut,
    diffuse,
    flip_edges,
    isotropic,
    largest_component,
    push_out,
    relax,
    require,
    smooth_loops,
)
from hood.mesh import topology


def sew(pattern: Pattern, fields: Fields) -> tuple[Array, Faces]:
    """The garment at voxel resolution: zero level, cut, one component, normals outwards."""
    field = pattern.field(fields)
    verts, faces, _, _ = require("skimage.measure").marching_cubes(field, 0.0, spacing=(VOXEL,) * 3)
    verts, faces = verts.astype(np.float64) + ORIGIN, faces.astype(np.int64)
    for keep in pattern.cuts:
        verts, faces = cut(verts, faces, keep(verts))
        verts, faces = largest_component(verts, faces)
    # The signed volume of the cone over the surface tells the orientation.
    corner = verts[faces] - verts.mean(0)
    if np.einsum("fa,fa->f", corner[:, 0], np.cross(corner[:, 1], corner[:, 2])).sum() < 0:
        faces = faces[:, ::-1]
    return verts, np.ascontiguousarray(faces)


def tailor(pattern: Pattern, fields: Fields, body: dict[str, Array], num_vertices: int) -> dict[str, Any]:
    """One garment file's arrays at about `num_vertices`; `body` holds the arrays of the default body."""
    skin, skin_faces = body["v_template"].astype(np.float64), body["f"].astype(np.int64)
    verts, faces = isotropic(*sew(pattern, fields), num_vertices)
    verts = smooth_loops(verts, faces, 6 * max(1, num_vertices // 1000))
    verts, faces = collapse_short(relax(verts, faces, 8), faces, 0.5)
    for _ in range(3):
        faces = flip_edges(verts, faces)
        verts = relax(verts, faces, 8)
        verts = push_out(verts, faces, skin, skin_faces, CLEARANCE)
    weights, shapedirs = bind(pattern, verts, faces, body)
    uv, uv_faces = unwrap(verts, faces)
    return {
        "rest_pos": verts.astype(np.float32),
        "faces": faces.astype(np.int32),
        "uv": uv,
        "uv_faces": uv_faces,
        "shapedirs": shapedirs.astype(np.float16),
        "lbs_weights": weights.astype(np.float16),
        "pinned": pinned_vertices(pattern, verts, faces),
    }


def bind(pattern: Pattern, verts: Array, faces: Faces, body: dict[str, Array]) -> tuple[Array, Array]:
    """Skinning weights (V,24) and shape directions (V,3,10) of the closest skin, smoothed over the cloth."""
    skin_faces = body["f"].astype(np.int64)
    hit = closest(verts, body["v_template"].astype(np.float64), skin_faces)
    corners, bary = skin_faces[hit.face.numpy()], hit.bary.numpy()

    def at_skin(values: Array) -> Array:
        flat = values.reshape(len(values), -1).astype(np.float64)
        return np.einsum("vk,vkc->vc", bary, flat[corners])

    weights = at_skin(body["weights"])
    if pattern.flared:
        weights = flare_weights(weights, verts)
    if not pattern.legs:
        weights = share_thighs(weights, verts, width=0.16 if pattern.flared else 0.10)
    weights = diffuse(weights, verts, faces, pattern.weight_reach)
    weights[weights < 1e-3] = 0.0
    # Far from the skin the closest point jumps between the legs; close to it, smoothing would lose clearance.
    near, far = (diffuse(at_skin(body["shapedirs"]), verts, faces, reach) for reach in (0.012, 0.08))
    share = np.clip((hit.dist.numpy() - 0.02) / 0.06, 0, 1)
    share = diffuse(share[:, None], verts, faces, 0.04)
    shapedirs = (1 - share) * near + share * far
    return weights / weights.sum(1, keepdims=True), shapedirs.reshape(len(verts), 3, -1)


def flare_weights(weights: Array, verts: Array) -> Array:
    """Weights for skirts: below the waist the cloth follows the pelvis and a smooth blend of both thighs.

    Taking the closest leg instead would tear the cloth between the legs at the first step.
    """
    depth = np.clip((0.22 - verts[:, 1]) / 0.34, 0, 1)
    share = 0.72 * depth * depth * (3 - 2 * depth)
    skirt = np.zeros_like(weights)
    skirt[:, 0] = 1 - share
    skirt[:, 1] = share
    blend = np.clip((0.22 - verts[:, 1]) / 0.10, 0, 1)[:, None]
    return blend * skirt + (1 - blend) * weights


def share_thighs(weights: Array, verts: Array, width: float) -> Array:
    """Both thighs' weight divided smoothly over `width` [m] around the middle: one tube must not tear."""
    shared = weights.copy()
    thighs = weights[:, 1] + weights[:, 2]
    left = 0.5 + 0.5 * np.tanh(verts[:, 0] / width)
    shared[:, 1], shared[:, 2] = thighs * left, thighs * (1 - left)
    return shared


def pinned_vertices(pattern: Pattern, verts: Array, faces: Faces) -> NDArray[np.bool_]:
    """Waistband vertices (V,) bool: the upper boundary loop and what lies above `pattern.waist`."""
    pinned = np.zeros(len(verts), dtype=bool)
    if pattern.waist is None:
        return pinned
    loops = topology.boundary_loops(faces)
    pinned[max(loops, key=lambda loop: verts[loop, 1].mean())] = True
    return pinned | (verts[:, 1] > pattern.waist)


def unwrap(verts: Array, faces: Faces) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Texture coordinates (U,2) in 0..1 without overlaps, and their triangles (F,3)."""
    _, uv_faces, uv = require("xatlas").parametrize(verts.astype(np.float32), faces.astype(np.uint32))
    return uv.astype(np.float32), uv_faces.astype(np.int32)


def build_garments(folder: Path, body_path: Path, names: tuple[str, ...] = tuple(PATTERNS)) -> dict[str, int]:
    """Write every garment in every size to `folder` and return the vertex counts.

    Raises:
        ImportError: a build-time package is missing.
        FileNotFoundError: `body_path` does not exist; build the body first.
    """
    with np.load(body_path, allow_pickle=False) as archive:
        body = {key: archive[key] for key in archive.files}
    fields = body_fields(body["v_template"].astype(np.float64), body["f"].astype(np.int64))
    folder.mkdir(parents=True, exist_ok=True)
    counts = {}
    for name in names:
        for suffix, num_vertices in (SIZES | EXTRA_SIZES.get(name, {})).items():
            arrays = tailor(PATTERNS[name], fields, body, num_vertices)
            np.savez_compressed(folder / f"{name}{suffix}.npz", **arrays)
            counts[name + suffix] = len(arrays["rest_pos"])
    return counts
