"""Sews the default garments for the default body.

The zero level of a pattern's field is cut along smooth curves, remeshed isotropically, kept clear of the
body and bound to it with smoothed weights and shape directions.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from hood.assets.body.body import Body
from hood.assets.body.load import load_body
from hood.assets.garment.binding import PosedBody, posed_body, undo_skinning
from hood.assets.garment.garment_arrays import write_fields
from hood.assets.garment.pins import MARKS, opening_names
from hood.assets.motion.sequence_edit import arms_down
from hood.mesh import topology
from hood.mesh.editing.remeshing import Array, Faces, closest, compact, flip_edges, isotropic, relax
from tools.assets.isosurface import zero_level
from tools.assets.patterns import CLEARANCE, ORIGIN, PATTERNS, SIZES, VOXEL, Fields, Pattern, body_fields
from tools.assets.placket import open_front, pull_apart, sewn_together, slit_pairs
from tools.assets.remesh import collapse_short, cut, diffuse, largest_component, push_out, smooth_loops
from tools.assets.unwrap import panels, unwrap

#: m. What the T-pose brings nearer to the skin than the first, of garments drafted in another pose, is moved to the second:
#: contact holds edges of 35 mm as far off the crest of the shoulders (hood/contact/activation_distance.py), and would stretch
#: nearer cloth.
_TPOSE_NEAR, _TPOSE_CLEARANCE = 0.004, 0.007
#: How many times as stiff as plain cloth bindings and linings are; within the range of fabrics that networks are trained with
#: (hood/assets/material.py). Bindings and linings reach so far [m] from a rim and from the crotch.
_FIRMER, _BINDING, _LINING = 2.0, 0.025, 0.08
_SHAPE_STEP = 2.0**-16  # m per unit of beta


def sew(pattern: Pattern, fields: Fields) -> tuple[Array, Faces]:
    """The garment at voxel resolution: zero level, cut, one component, normals outwards."""
    field = pattern.field(fields)
    verts, faces = zero_level(field, ORIGIN, VOXEL)
    for keep in pattern.cuts:
        verts, faces = cut(verts, faces, keep(verts))
        verts, faces = largest_component(verts, faces)
    # The signed volume of the cone over the surface tells the orientation.
    corner = verts[faces] - verts.mean(0)
    if np.einsum("fa,fa->f", corner[:, 0], np.cross(corner[:, 1], corner[:, 2])).sum() < 0:
        faces = faces[:, ::-1]
    return verts, np.ascontiguousarray(faces)


class Model(NamedTuple):
    """The default body, and it in the pose that a garment is drafted in."""

    rest: PosedBody  # T-pose
    posed: PosedBody


def tailor(pattern: Pattern, model: Model, verts: Array, faces: Faces) -> dict[str, Any]:
    """One garment file's arrays from its remeshed surface."""
    skin, skin_faces = model.posed.surface, model.posed.faces
    verts, faces = collapse_short(relax(verts, faces, 8), faces, 0.5)
    for _ in range(3):
        faces = flip_edges(verts, faces)
        verts = relax(verts, faces, 8)
        verts = push_out(verts, faces, skin, skin_faces, CLEARANCE)
    closed, fastened, slit = faces, {}, np.zeros((0, 2), dtype=np.int64)
    if pattern.front is not None:
        slit = slit_pairs(verts, faces)
        verts = pull_apart(verts, slit)
        closed, fastened = sewn_together(faces, slit), {pattern.front.name: slit[:: pattern.front.every]}
    weights, shapedirs = bind(pattern, verts, faces, model.posed)
    for values in (weights, shapedirs):  # both edges of a slit move as one
        values[slit] = values[slit].mean(axis=1, keepdims=True)
    sewn = compact(verts, closed)
    panel = panels(*sewn, [part(sewn[0]) for part in pattern.parts])
    if pattern.front is not None:
        panel[(panel == 0) & (verts[faces, 0].mean(axis=1) < 0)] = 2 ** (len(pattern.parts) + 1)  # a front of two halves
    uv, uv_faces = unwrap(verts, faces, panel)
    worn = {}
    tpose = verts
    if pattern.arms:
        tpose, turn = undo_skinning(weights, model.posed.transforms, verts)
        tpose = push_out(tpose, faces, model.rest.surface, skin_faces, _TPOSE_CLEARANCE, near=_TPOSE_NEAR)
        tpose = pull_apart(tpose, slit)
        worn = {"skin_pos": tpose.astype(np.float32), "rest_turn": turn.astype(np.float16)}
    return {
        "rest_pos": verts.astype(np.float32),
        "faces": faces.astype(np.uint16),
        "uv": uv,
        "uv_faces": uv_faces.astype(np.uint16),
        "shapedirs": _steps(shapedirs).astype(np.float16),
        "lbs_weights": weights.astype(np.float16),
        "pinned": pinned_vertices(pattern, verts, faces),
        "region": (region := mark_regions(tpose, faces, closed, panel, model.rest.body)),
        "stiffness": firmness(pattern.firm, verts, faces, region),
        "fasteners": fastened,
        **worn,
    }


def firmness(firm: str | None, verts: Array, faces: Faces, region: NDArray[np.uint8]) -> NDArray[np.float16] | None:
    """Stiffness (V,) of a garment whose neckline and armholes are bound (``rims``), or which is lined around its ``crotch``;
    None of one that is all plain cloth."""
    if firm is None:
        return None
    places, width = (_rims(verts, region), _BINDING) if firm == "rims" else (_crotch(verts, faces), _LINING)
    near = cKDTree(places).query(verts)[0] < width
    return np.where(near, _FIRMER, 1.0).astype(np.float16)


def _rims(verts: Array, region: NDArray[np.uint8]) -> Array:
    """Vertices (N, 3) of the neckline and the armholes."""
    return verts[np.isin(region, [MARKS.index(name) for name in ("neckline", "armhole_left", "armhole_right")])]


def _crotch(verts: Array, faces: Faces) -> Array:
    """Where the legs meet (1, 3): the lowest point at which an edge passes through the middle."""
    start, end = verts[topology.unique_edges(faces)].transpose(1, 0, 2)
    across = start[:, 0] * end[:, 0] < 0
    start, end = start[across], end[across]
    points = start + (end - start) * (start[:, :1] / (start[:, :1] - end[:, :1]))
    return points[points[:, 1].argmin()][None]


def mark_regions(tpose: Array, faces: Faces, closed: Faces, panel: NDArray[np.int64], body: Body) -> NDArray[np.uint8]:
    """Region (V,) of every vertex, an index into :data:`hood.assets.garment.pins.MARKS`: on a seam, on an opening's edge,
    or cloth. Openings are those of the ``closed`` faces; other edges, which a front has, are seams."""
    region = np.zeros(len(tpose), dtype=np.uint8)
    hinges = topology.hinges(faces)
    seams = hinges.vertices[panel[hinges.faces[:, 0]] != panel[hinges.faces[:, 1]], :2]
    region[seams] = MARKS.index("seam")
    region[np.concatenate(topology.boundary_loops(faces))] = MARKS.index("seam")
    loops = topology.boundary_loops(closed)
    centres = np.stack([tpose[loop].mean(axis=0) for loop in loops])
    for loop, name in zip(loops, opening_names(centres, body.shaped(np.zeros(0))[1]), strict=True):
        region[loop] = MARKS.index(name)
    return region


def _steps(shapedirs: Array) -> Array:
    """Shape directions in steps far below a hundredth of a millimetre per unit of beta: they compress to half."""
    return np.round(shapedirs / _SHAPE_STEP) * _SHAPE_STEP


def bind(pattern: Pattern, verts: Array, faces: Faces, posed: PosedBody) -> tuple[Array, Array]:
    """Skinning weights (V,24) and shape directions (V,3,10) of the closest skin of ``posed``, smoothed over the cloth."""
    body, skin_faces = posed.body, posed.faces
    hit = closest(verts, posed.surface, skin_faces)
    corners, bary = skin_faces[hit.face.numpy()], hit.bary.numpy()

    def at_skin(values: Array) -> Array:
        flat = values.reshape(len(values), -1).astype(np.float64)
        return np.einsum("vk,vkc->vc", bary, flat[corners])

    weights = at_skin(body.weights)
    if pattern.flared:
        weights = flare_weights(weights, verts)
    if not pattern.legs:
        weights = share_thighs(weights, verts, width=0.16 if pattern.flared else 0.10)
    weights = diffuse(weights, verts, faces, pattern.weight_reach)
    weights[weights < 1e-3] = 0.0
    # Far from the skin the closest point jumps between the legs; close to it, smoothing would lose clearance.
    near, far = (diffuse(at_skin(body.shapedirs), verts, faces, reach) for reach in (0.012, 0.08))
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


def build_garments(folder: Path, body_path: Path, names: tuple[str, ...] = tuple(PATTERNS)) -> dict[str, int]:
    """Write every garment in every size to `folder` and return the vertex counts.

    Each size is remeshed from the next finer one, so that they are one cut.

    Raises:
        FileNotFoundError: `body_path` does not exist; build the body first.
    """
    body = load_body(body_path)
    folder.mkdir(parents=True, exist_ok=True)
    counts = {}
    for angle in sorted({PATTERNS[name].arms for name in names}):
        rest, posed = (posed_body(body, arms_down(degrees), 0, np.zeros(0)) for degrees in (0.0, angle))
        fields = body_fields(posed)
        for name in (name for name in names if PATTERNS[name].arms == angle):
            verts, faces = sew(PATTERNS[name], fields)
            if PATTERNS[name].front is not None:
                arrays = tailor(PATTERNS[name], Model(rest, posed), *open_front(verts, faces, *SIZES[""]))
                write_fields(folder / f"{name}.npz", arrays)
                counts[name] = len(arrays["rest_pos"])
                continue
            for suffix, (num_vertices, tolerance) in sorted(SIZES.items(), key=lambda size: -size[1][0]):
                verts, faces = isotropic(verts, faces, num_vertices, tolerance)
                verts = smooth_loops(verts, faces, 6 * max(1, num_vertices // 1000))
                arrays = tailor(PATTERNS[name], Model(rest, posed), verts, faces)
                write_fields(folder / f"{name}{suffix}.npz", arrays)
                counts[name + suffix] = len(arrays["rest_pos"])
    return counts
