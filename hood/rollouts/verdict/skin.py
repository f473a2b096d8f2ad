"""Skin that comes through the cloth where a viewer sees it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial import cKDTree

from hood.limits import (
    CUT_UNSOUND,
    DEPTH_UNSOUND,
    INSIDE_UNSOUND,
    SPOTS_HEIGHT,
    SPOTS_LARGE,
    SPOTS_LARGE_LASTING,
    SPOTS_LASTING,
    SPOTS_UNSOUND,
)
from hood.mesh.editing.repair import boundary_vertices
from hood.mesh.penetration.crossing import Crossings, crossings
from hood.mesh.topology import connected_components, hinges, unique_edges
from hood.rollouts.verdict.frames import Cause, FoundFrames, name_frames, standing_for
from hood.rollouts.verdict.surface import HARDLY, Meshes, in_folds, sampled, spread_over, visible

#: Frames that are looked at from all sides, at most, of those in which the skin cuts the cloth.
_LOOKED_AT = 8
#: How large spots of skin are, and in how many of the frames they then count.
_LASTING = ((SPOTS_UNSOUND, SPOTS_LASTING), (SPOTS_LARGE, SPOTS_LARGE_LASTING))
#: A thing turns by more than the first [rad] at an edge between two of its sides, and by less than the second within them;
#: people do so at toes and fingers, but have no flat sides.
_CORNER, _FLAT = np.deg2rad(60.0), 0.01


def skin_causes(metrics: Mapping[str, np.ndarray], inside: Mapping[str, np.ndarray], meshes: Meshes) -> FoundFrames:
    """Skin through cloth.

    A frame is bad where the skin that a viewer sees cuts more than 1% of the cloth's triangles, or sticks out by more than a
    centimetre. Spots of some millimetres are seen where they stay: they count if more than ``SPOTS_LASTING`` of the
    frames have them, or ``SPOTS_LARGE_LASTING`` larger ones, and not where a corner of a thing comes through between the
    vertices of the cloth. Triangles caught in a fold of the skin do not count.

    Args:
        metrics: of the surface, (S,) each.
        inside: of the rollout, of which ``penetration_share`` says how many vertices are inside the body.
    """
    share, depth = metrics["cut_face_share"], metrics["skin_depth"]
    measured, cut_at_all = np.isfinite(share), np.nan_to_num(share)
    shown, spots, poked = (spread_over(values, measured) for values in _seen(cut_at_all, meshes))
    shown, spots = np.minimum(shown, cut_at_all), np.minimum(spots, cut_at_all)
    depth = np.where(measured, np.fmax(depth, poked), np.nan)
    height = np.nan_to_num(depth)
    cut, deep = shown > CUT_UNSOUND.value, (height > DEPTH_UNSOUND.value) & (shown > 0)
    lasting = np.zeros_like(measured)
    for size, share_of_frames in _LASTING:
        there = measured & (spots > size.value) & (height > SPOTS_HEIGHT.value)
        lasting |= there & (standing_for(there, measured).mean() > share_of_frames.value)
    lasting &= ~deep
    causes = [
        Cause("skin_through_cloth", f"the skin is seen through more than {cut_text()} of the cloth's triangles", cut & measured,
              shown, CUT_UNSOUND.value, CUT_UNSOUND.unit, ".1%", measured=measured),
        Cause("skin_depth", f"skin sticks out of the cloth by more than {1e3 * DEPTH_UNSOUND.value:g} mm", deep & measured,
              depth, DEPTH_UNSOUND.value, "m", ".0f", 1e3, " mm", measured),
        Cause("skin_depth", f"spots of skin stick out by more than {1e3 * SPOTS_HEIGHT.value:g} mm, and stay,", lasting,
              depth, SPOTS_HEIGHT.value, "m", ".0f", 1e3, " mm", measured),
    ]  # fmt: skip
    return FoundFrames(causes, notes=_notes(metrics, share, shown)) + inside_causes(inside)


def cut_text() -> str:
    return f"{CUT_UNSOUND.value:.0%}"


def inside_causes(metrics: Mapping[str, np.ndarray]) -> FoundFrames:
    """Cloth inside the body, as far as a rollout measured it: it cuts nothing there."""
    share = metrics.get("penetration_share")
    if share is None:
        return FoundFrames()
    text, limit = f"more than {INSIDE_UNSOUND.value:.0%} of the cloth's vertices are inside the body", INSIDE_UNSOUND
    bad = np.nan_to_num(share) > limit.value
    return FoundFrames([Cause("inside_body", text, bad, share, limit.value, limit.unit, ".0%", measured=np.isfinite(share))])


def _seen(share: np.ndarray, meshes: Meshes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Shares (S,) of the cloth's triangles through which skin is seen, of those apart from corners, and how far the body goes
    through them [m].

    NaN in frames that were not looked at, 0 in those whose skin cuts hardly anything.
    """
    found = np.where(share <= HARDLY, 0.0, np.nan)[None].repeat(3, axis=0)
    stored = {int(step): frame for frame, step in enumerate(meshes.step)}
    over = [step for step in np.flatnonzero(share > HARDLY).tolist() if step in stored]
    if over:
        places = np.unique(np.linspace(0, len(over) - 1, min(len(over), _LOOKED_AT)).astype(np.int64))
        for step in {max(over, key=lambda step: share[step]), *(over[place] for place in places)}:
            found[:, step] = _seen_at(meshes, stored[step])
    return found[0], found[1], found[2]


def _seen_at(meshes: Meshes, frame: int) -> tuple[float, float, float]:
    pos, body = meshes.cloth[frame].astype(np.float64), meshes.body[frame].astype(np.float64)
    cut = crossings(pos, meshes.faces, body, meshes.body_faces)
    pairs = cut.pairs
    pairs = pairs[~in_folds(pairs[:, 1], body, meshes.body_faces)]
    faces = np.unique(pairs[:, 0])
    found = faces[visible(pos[meshes.faces[faces]].mean(axis=1), [(pos, meshes.faces), (body, meshes.body_faces)])]
    round_faces = pairs[~_at_corners(body, meshes.body_faces)[pairs[:, 1]], 0]
    through = way_through(pos, meshes.faces, body, meshes.body_faces, cut) if len(found) else 0.0
    return len(found) / len(meshes.faces), int(np.isin(found, round_faces).sum()) / len(meshes.faces), through


def _at_corners(pos: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(G,) bool: faces of a body that have a vertex on an edge between two flat sides of it."""
    corners = pos[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True).clip(1e-30)
    hinge = hinges(faces)
    cosine = np.einsum("hx,hx->h", *normal[hinge.faces].swapaxes(0, 1))
    flat = np.zeros(len(faces), dtype=bool)
    flat[hinge.faces[cosine > np.cos(_FLAT)]] = True
    sharp = np.zeros(len(pos), dtype=bool)
    sharp[hinge.vertices[(cosine < np.cos(_CORNER)) & flat[hinge.faces].all(axis=1), :2]] = True
    return np.asarray(sharp[faces].any(axis=1))


def way_through(cloth: np.ndarray, faces: np.ndarray, body: np.ndarray, body_faces: np.ndarray, cut: Crossings) -> float:
    """How far [m] a body (W, 3) goes through the middle of a cloth (V, 3), (F, 3): the greatest distance to the cloth of what
    is cut off from the rest of the body where edges of it pass through the cloth; 0 where nothing is cut off. A limb has not
    gone through where the cloth ends inside of it, as a hem does that lies too close all around.

    Args:
        cut: of the cloth and the body.
    """
    piece, off = _cut_off(len(body), body_faces, cut.second_edges)
    cloth_piece, inside = _cut_off(len(cloth), faces, cut.first_edges)
    inside &= np.isin(cloth_piece, cloth_piece[boundary_vertices(faces)])
    ends, at_end = piece[cut.second_edges[:, :2]], inside[faces].any(axis=1)[cut.second_edges[:, 2]]
    beyond = off & ~np.isin(piece, ends[at_end])
    return float(cKDTree(sampled(cloth, faces)).query(body[beyond])[0].max()) if beyond.any() else 0.0


def _cut_off(count: int, faces: np.ndarray, cut: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of a mesh of ``count`` vertices, without the edges that ``cut`` (K, 3) begins with, the piece (count,) that each vertex
    is of, and whether (count,) that is another than the largest one of what the mesh connects."""
    edges = unique_edges(faces)
    kept = edges[~np.isin(edges @ [count, 1], cut[:, :2] @ [count, 1])]
    whole, piece = (connected_components(count, some) for some in (edges, kept))
    _, first, sizes = np.unique(piece, return_index=True, return_counts=True)
    largest, order = np.zeros(count, dtype=np.int64), np.argsort(sizes, kind="stable")
    largest[whole[first[order]]] = order  # of several the last one stays
    return piece, largest[whole] != piece


def _notes(metrics: Mapping[str, np.ndarray], share: np.ndarray, shown: np.ndarray) -> list[str]:
    """What was cut and does not count."""
    folds = np.nan_to_num(metrics["cut_in_folds"])  # older files have none
    caught = folds > CUT_UNSOUND.value
    notes = []
    if caught.any():
        notes.append(
            f"the skin cuts up to {folds.max():.1%} of the cloth's triangles where it passes through itself, in "
            f"{name_frames(caught)}: cloth cannot be outside both sides of such a fold, and this does not count"
        )
    apart = np.nan_to_num(share) - folds
    hidden = apart > CUT_UNSOUND.value
    if hidden.any() and not (shown[hidden] > CUT_UNSOUND.value).any():
        notes.append(
            f"the skin cuts up to {apart.max():.1%} of the cloth's triangles in {name_frames(hidden)}, "
            "where no viewer sees it: this does not count"
        )
    return notes
