"""Pinned vertices of a garment: by number, by opening, by painted colour, or from a file; exactly or by springs, and what they
follow."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from hood.assets.body.body import JOINTS, Body
from hood.assets.files.library import unknown
from hood.assets.files.text import read_indices, read_objects
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

Pin = str | int | Mapping[str, Any]
Pins = Pin | Sequence[Pin]
#: Keys of a table of pins.
_KEYS = ("vertices", "weights", "follows")
_FORM = "{vertices: waistband, weights: 0.5, follows: spine1}"
#: Vertices of a weight from here on are held exactly.
EXACT = 0.9999
#: Of weights that are painted, red above the other colours by less than this share of the full scale is none.
_FAINT = 0.01


@dataclass(frozen=True)
class PinGroup:
    """Vertices that are held alike.

    ``follows`` says what they go with: None, the garment as it is skinned; ``skin``, the body's surface next to each; the name
    of a bone or of a part of the body, or numbers of body vertices: the surface there.
    """

    vertices: np.ndarray  # (P,) int64
    weights: np.ndarray  # (P,) above 0, up to 1: held exactly
    follows: str | tuple[int, ...] | None = None  # what they go with
    where: str = "pins"  # how messages begin

    @property
    def exact(self) -> np.ndarray:
        """(P,) bool: held exactly, not by a spring."""
        return np.asarray(self.weights >= EXACT)

    @property
    def whom(self) -> str:
        """What they follow, in words."""
        if isinstance(self.follows, tuple):
            return f"{len(self.follows)} vertices of the body"
        return "the skinned garment" if self.follows is None else self.follows


def pin_mask(pins: Pins, garment: Garment, body: Body | None) -> np.ndarray:
    """(V,) bool: the vertices that ``pins`` holds exactly, and no others; see :func:`pin_groups`."""
    mask = np.zeros(len(garment.rest_pos), dtype=bool)
    for group in pin_groups(pins, garment, body):
        mask[group.vertices] = group.exact
    return mask


def pin_groups(pins: Pins, garment: Garment, body: Body | None) -> list[PinGroup]:
    """The vertices that ``pins`` names, by how they are held; of a vertex in several groups the last counts.

    Args:
        pins: vertex numbers, regions (:data:`REGIONS` or joint names: the opening of the garment nearest that joint),
            ``painted`` (vertices coloured red in the mesh file), ``none``, paths of ``.txt`` or ``.json`` lists of
            numbers, or several of these. Tables, or paths of ``.json`` files with one or a list of them, say more:
            ``vertices`` are any of these; ``weights`` a number from 0 to 1 for all, one for each number of ``vertices``, or
            ``painted``, how red the vertices are (1: held exactly, less: by a spring, 0: free); ``follows`` is that of
            :class:`PinGroup`.
        body: whose joints the regions refer to, in T-pose; None refuses regions.

    Raises:
        ValueError: a vertex, region or colour that the garment does not have, or a table that is none; names what there is.
    """
    plain: list[str | int] = []
    groups: list[PinGroup] = []
    for where, pin in _expanded(pins):
        if isinstance(pin, Mapping):
            groups.append(_group(where, pin, garment, body))
        else:
            plain.append(pin)
    vertices = np.unique(_vertices("pins", plain, garment, body))
    return ([PinGroup(vertices, np.ones(len(vertices)))] if len(vertices) else []) + groups


def _expanded(pins: Pins) -> list[tuple[str, Pin]]:
    """Every entry of ``pins`` and how messages about it begin; tables of files as such."""
    found: list[tuple[str, Pin]] = []
    for pin in [pins] if isinstance(pins, (str, int, Mapping)) else list(pins):
        path = Path(pin) if isinstance(pin, str) else Path()
        tables = read_objects(path.expanduser()) if path.suffix.lower() == ".json" else None
        if tables is None:
            found.append(("pins", pin))
        else:
            found += [(str(path) if len(tables) == 1 else f"{path}: entry {row}", one) for row, one in enumerate(tables)]
    return found


def pin_numbers(pins: Pins) -> tuple[np.ndarray, list[str]]:
    """``pins`` as the vertex numbers among them, lists on disk included, and the other words.

    Raises:
        ValueError: tables of pins, which are no numbers.
    """
    numbers, words = [np.zeros(0, dtype=np.int64)], []
    for where, pin in _expanded(pins):
        if isinstance(pin, Mapping):
            raise ValueError(f"{where}: tables of weights and of what pins follow are for pins= of hood rollout; give vertices")
        if not isinstance(pin, str) or pin.isdigit():
            numbers.append(np.array([int(pin)]))
        elif Path(pin).suffix.lower() in _LIST_SUFFIXES:
            numbers.append(read_indices(Path(pin).expanduser()))
        else:
            words.append(pin)
    return np.concatenate(numbers), words


def _vertices(where: str, pins: Pins, garment: Garment, body: Body | None) -> np.ndarray:
    """(n,) present vertices that numbers and words name."""
    numbers, words = pin_numbers(pins)
    named = [_named(word, garment, body) for word in words if word != "none"]
    return np.concatenate([garment.numbers_of(numbers, where), *named])


def _group(where: str, table: Mapping[str, Any], garment: Garment, body: Body | None) -> PinGroup:
    for key in table:
        if key not in _KEYS:
            raise ValueError(f"{where}: {unknown('key', str(key), _KEYS)}")
    pins, weights = table.get("vertices"), table.get("weights")
    if not _are_pins(pins):
        raise ValueError(f"{where}: vertices is {_short(pins)}; give numbers, a region, painted or a list, such as {_FORM}")
    follows = _followed(where, table.get("follows"))
    if weights == PAINTED:
        redness = _redness(where, garment)
        chosen = np.flatnonzero(redness > _FAINT) if pins == PAINTED else _vertices(where, pins, garment, body)
        found = redness[chosen]
    elif isinstance(weights, list):
        chosen, found = _weighted(where, pins, weights, garment)
    else:
        chosen = _vertices(where, pins, garment, body)
        found = np.full(len(chosen), 1.0 if weights is None else _weight(where, weights))
    if not len(chosen):
        raise ValueError(f"{where}: vertices={_short(pins)} are none of {garment.name!r}; name some, or leave the table out")
    return PinGroup(chosen[found > 0], found[found > 0].astype(np.float64), follows, where)


def _weighted(where: str, pins: Any, weights: list[Any], garment: Garment) -> tuple[np.ndarray, np.ndarray]:
    """Present vertices and the weight of each, of numbers with as many weights."""
    numbers, words = pin_numbers(pins)
    if words:
        raise ValueError(f"{where}: a list of weights needs vertex numbers, not {words[0]!r}; give one weight for all of them")
    if len(weights) != len(numbers):
        raise ValueError(f"{where}: {len(weights)} weights of {len(numbers)} vertices; give one for each, or one for all")
    garment.numbers_of(numbers, where)
    present = numbers if garment.file_numbers is None else garment.file_numbers[numbers]
    found = np.array([_weight(f"{where}: weights[{row}]", value) for row, value in enumerate(weights)])
    return present[present >= 0], found[present >= 0]


def _weight(where: str, value: Any) -> float:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not number or not math.isfinite(value) or not 0.0 <= value <= 1.0:
        raise ValueError(f"{where}: the weight {_short(value)} is none; give 0 (free) to 1 (held exactly)")
    return float(value)


def _followed(where: str, value: Any) -> str | tuple[int, ...] | None:
    if value is None or (isinstance(value, str) and value):
        return value
    if isinstance(value, list) and value and all(isinstance(v, int) and not isinstance(v, bool) for v in value):
        return tuple(value)
    raise ValueError(f"{where}: follows is {_short(value)}; give skin, a bone, a part of the body or a list of body vertices")


def _are_pins(value: Any) -> TypeGuard[Pins]:
    """Whether a value can name vertices: a word, a number, or a list of them."""
    one = value if isinstance(value, list) else [value]
    return all(isinstance(pin, (str, int)) and not isinstance(pin, bool) for pin in one)


def _short(value: Any) -> str:
    text = str(value)
    return text if len(text) <= 40 else f"{text[:40]}…"


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


def _redness(where: str, garment: Garment) -> np.ndarray:
    """(V,) by how much of the full scale red exceeds the other colours."""
    if garment.colours is None:
        raise ValueError(f"{where}: {garment.name!r} has no vertex colours; paint the held vertices red and export colours")
    return np.asarray(garment.colours[:, 0] - garment.colours[:, 1:].max(axis=1))


def _painted(garment: Garment) -> np.ndarray:
    red = _redness("pins=painted", garment) > _REDNESS
    if not red.any():
        raise ValueError(f"pins=painted: no vertex of {garment.name!r} is red (red above green and blue by half the scale)")
    return np.flatnonzero(red)
