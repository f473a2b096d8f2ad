"""Pinned vertices of a garment: by number, by opening, by painted colour, or from a file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hood.assets.body.body import JOINTS, Body
from hood.assets.files.library import unknown
from hood.assets.files.text import read_indices
from hood.assets.garment.garment import Garment
from hood.mesh import topology

#: Openings by name and the joint that they surround. Any joint's own name works as well.
REGIONS = {
    "waistband": "spine1",
    "hem": "pelvis",
    "neckline": "neck",
    "cuff_left": "left_wrist",
    "cuff_right": "right_wrist",
    "armhole_left": "left_shoulder",
    "armhole_right": "right_shoulder",
    "hem_left": "left_ankle",
    "hem_right": "right_ankle",
}
#: What a vertex of a garment can be marked as: plain cloth, where panels meet, or the opening whose edge it lies on.
MARKS = ("cloth", "seam", *REGIONS)
PAINTED = "painted"
#: A vertex is painted where red exceeds the other colours by this much of the full scale.
_REDNESS = 0.5
_LIST_SUFFIXES = (".txt", ".json")
#: An opening farther from its joint than this [m] is none of that region.
_REGION_REACH = 0.45
#: Heights of openings that an error names.
_MOST_HEIGHTS = 6
#: The two that one joint does not tell apart.
_AT_THE_HIPS = ("waistband", "hem")

Pins = str | int | Sequence[str | int]


def pin_mask(pins: Pins, garment: Garment, body: Body | None) -> np.ndarray:
    """(V,) bool: the vertices that ``pins`` names, and no others.

    Args:
        pins: vertex numbers, regions (:data:`REGIONS` or joint names: the opening of the garment nearest that joint),
            ``painted`` (vertices coloured red in the mesh file), ``none``, paths of ``.txt`` or ``.json`` lists of
            numbers, or several of these.
        body: whose joints the regions refer to, in T-pose; None refuses regions.

    Raises:
        ValueError: a vertex, region or colour that the garment does not have; names what it has.
    """
    numbers, words = pin_numbers(pins)
    mask = np.zeros(len(garment.rest_pos), dtype=bool)
    mask[garment.numbers_of(numbers, "pins")] = True
    for word in words:
        if word != "none":
            mask[_named(word, garment, body)] = True
    return mask


def pin_numbers(pins: Pins) -> tuple[np.ndarray, list[str]]:
    """``pins`` as the vertex numbers among them, lists on disk included, and the other words."""
    numbers, words = [np.zeros(0, dtype=np.int64)], []
    for pin in [pins] if isinstance(pins, (str, int)) else list(pins):
        if not isinstance(pin, str) or pin.isdigit():
            numbers.append(np.array([int(pin)]))
        elif Path(pin).suffix.lower() in _LIST_SUFFIXES:
            numbers.append(read_indices(Path(pin).expanduser()))
        else:
            words.append(pin)
    return np.concatenate(numbers), words


def _named(word: str, garment: Garment, body: Body | None) -> np.ndarray:
    if word == PAINTED:
        return _painted(garment)
    if word not in REGIONS and word not in JOINTS:
        known = unknown("region", word, [*REGIONS, PAINTED, "none"])
        raise ValueError(f"pins: {known}; or a joint, vertex numbers, a .txt or .json list")
    if body is None:
        raise ValueError(f"pins={word}: regions need a body with joints; give vertex numbers")
    return region_loop(garment, body, word)


def region_loop(garment: Garment, body: Body, region: str, key: str = "pins=") -> np.ndarray:
    """Vertices of the opening (boundary loop) of ``garment`` nearest to the joint of ``region`` in T-pose.

    Near means the loop's centre: an opening surrounds its joint. A waistband is above the hips, a hem below. Messages begin
    with ``key``.

    Raises:
        ValueError: the garment has no opening there, or the body no such joint.
    """
    joint = JOINTS.index(REGIONS.get(region, region))
    joints = body.shaped(np.zeros(0))[1]
    if joint >= len(joints):
        raise ValueError(f"{key}{region}: the body has {len(joints)} joints and no {JOINTS[joint]}; give vertex numbers")
    pos = garment.worn_pos
    loops = topology.boundary_loops(garment.faces)
    if not loops:
        raise ValueError(f"{key}{region}: garment {garment.name!r} is closed, it has no openings; give vertex numbers")
    centres = np.stack([pos[loop].mean(axis=0) for loop in loops])
    dist = np.linalg.norm(centres - joints[joint], axis=1)
    if region in _AT_THE_HIPS:
        dist[[name != region for name in opening_names(centres, joints)]] = np.inf
    nearest = int(np.argmin(dist))
    if not np.isfinite(dist[nearest]):
        heights = ", ".join(f"{height:.2f}" for height in centres[:_MOST_HEIGHTS, 1])
        raise ValueError(
            f"{key}{region}: no opening of {garment.name!r} is a {region}: they are at the heights {heights} m, the hips "
            f"of the body at {joints[JOINTS.index('left_hip'), 1]:.2f} m; put the garment in place, or give vertex numbers"
        )
    if dist[nearest] > _REGION_REACH:
        raise ValueError(
            f"{key}{region}: the nearest of the {len(loops)} openings of {garment.name!r} is {dist[nearest]:.2f} m from "
            f"the {JOINTS[joint].replace('_', ' ')}; give vertex numbers"
        )
    return loops[nearest]


def opening_names(centres: np.ndarray, joints: np.ndarray) -> list[str]:
    """For the centre (L, 3) of each opening the region whose joint, of (J, 3) in T-pose, is nearest.

    One opening at most is the waistband, the nearest of those above the hips; the others near the waist are hems.
    """
    names = [name for name, joint in REGIONS.items() if JOINTS.index(joint) < len(joints)]
    if not names or len(centres) == 0:
        return []
    places = np.stack([joints[JOINTS.index(REGIONS[name])] for name in names])
    dist = np.linalg.norm(centres[:, None] - places, axis=2)
    for column, name in enumerate(names):
        dist[~_on_side(name, centres, joints), column] = np.inf
    found = [names[column] for column in dist.argmin(axis=1)]
    waists = [row for row, name in enumerate(found) if name == "waistband"]
    band = min(waists, key=lambda row: float(dist[row].min()), default=None)
    return ["hem" if row in waists and row != band else name for row, name in enumerate(found)]


def _on_side(region: str, centres: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """(L,) bool: whether an opening is on the side of the hips where ``region`` is; all are for most regions."""
    above = centres[:, 1] > joints[JOINTS.index("left_hip"), 1]
    return {"waistband": above, "hem": ~above}.get(region, np.ones(len(centres), dtype=bool))


def _painted(garment: Garment) -> np.ndarray:
    if garment.colours is None:
        raise ValueError(
            f"pins=painted: {garment.name!r} has no vertex colours; paint the held vertices red and export colours"
        )
    red = garment.colours[:, 0] - garment.colours[:, 1:].max(axis=1) > _REDNESS
    if not red.any():
        raise ValueError(f"pins=painted: no vertex of {garment.name!r} is red (red above green and blue by half the scale)")
    return np.flatnonzero(red)
