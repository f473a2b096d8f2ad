"""A garment that has been sewn around a body, and the verdict on it: what crosses, what is stretched, where it is worn."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.spatial import cKDTree

from hood.assets.body.body import JOINTS
from hood.assets.fitting.suspicions import find_openings
from hood.assets.garment.binding import signed_distances
from hood.assets.pattern.measures import cuts, girth
from hood.mesh import topology
from hood.mesh.flat import edge_extents
from hood.mesh.parts import rim_length
from hood.mesh.penetration.crossing import crossings, self_crossings
from hood.mesh.topology import boundary_loops

if TYPE_CHECKING:
    from hood.assets.garment.binding import PosedBody
    from hood.assets.pattern.sheet import PatternSheet
    from hood.cloth.cloth import Cloth

#: A garment that is sewn well: strain p99, and what its top has sunk or risen by [m], are no more.
STRAIN, SUNK = 0.25, 0.15
#: What nothing but its upper edge holds up has sunk by no more [m].
_SLID = 0.1
#: A coarse mesh is stretched by less than this where a fine one can come to rest.
_COARSE_STRAIN = 0.6
#: In the last step the vertices move by no more than this [m/s] in the mean.
REST_SPEED = 2e-3
#: A garment whose top is below the second of these shares of the height of the body that it was drawn for is held up by its
#: upper edge: at the waist, or above the first at the chest.
_WAIST, _CHEST = 0.72, 0.79
#: A held waist is no farther from the skin [m], in the mean; a hem is no deeper under the floor [m].
_LOOSE, _UNDER = 0.04, 5e-3
#: A forearm with its hand is so many times as long as to the wrist.
_HAND = 1.7
#: Panels with at least this share of what is most are named where something is wrong, the first of them.
_MANY, _NAMED = 0.3, 3
#: The floor reaches so far [m] from the middle, in squares of the second.
_FLOOR, _SQUARE = 1.2, 0.1
#: Of the limbs, and where heads are.
_ARMS, _UP = frozenset({"left arm", "right arm"}), np.array([0.0, 1.0, 0.0])
#: An opening of less than this length [body heights] is a slit; one that is drawn less plane than this share of its size has no
#: part of the body of its own: the front of an open jacket.
_LEAST_LENGTH, _PLANE = 0.07, 0.35


@dataclass(frozen=True)
class SewnFigures:
    """What a sewn garment is judged by.

    Args:
        body_crossings: triangles of cloth and skin that pass through each other, in pairs.
        self_crossings: of cloth and cloth.
        strain_p99: of the lengths of its edges in the pattern: of what is beyond all of them where there are several, of
            both sides of a gathered seam, of elastic at rest and as it is cut.
        empty_openings: with no part of the body in them, of ``openings``.
        sunk: m, of its highest point since it began.
        speed: m/s, the mean in the last step.
        loose: m, from what is held to the skin, in the mean.
        under: m, of its lowest point below the floor.
        swapped: openings that hold other limbs than they were made for, as "left arm, not right arm".
        places: where that is, by the names above, in words.
        girths: m, of the upper edge at rest and of the body where it began; None: it hangs from shoulders.
    """

    body_crossings: int
    self_crossings: int
    strain_p99: float
    openings: int
    empty_openings: int
    sunk: float
    speed: float
    loose: float = 0.0
    under: float = 0.0
    swapped: tuple[str, ...] = ()
    places: Mapping[str, str] = field(default_factory=dict)
    girths: tuple[float, float] | None = None

    @property
    def faults(self) -> list[str]:
        """What is wrong with it, in words; none where it is sewn well."""
        crossed = f"{self.body_crossings} pairs of triangles pass through the body"
        folded = f"{self.self_crossings} pairs of its own triangles pass through each other"
        slid, (rim, body) = self.girths is not None and self.sunk > _SLID, self.girths or (0.0, 0.0)
        cause = "it is too wide" if rim > body else "it does not hold up, waist=held holds it"
        edge = f"its upper edge is {1e2 * rim:.0f} cm around at rest, the body there {1e2 * body:.0f} cm; {cause}"
        limits = (
            (self.body_crossings > 0, crossed, "body_crossings"),
            (self.self_crossings > 0, folded, "self_crossings"),
            (
                not self.strain_p99 <= STRAIN,
                f"it is stretched by {self.strain_p99:.0%} (p99; {STRAIN:.0%} is allowed)",
                "strain_p99",
            ),
            (slid, f"it slid down by {1e2 * self.sunk:.0f} cm: {edge}", "sunk"),
            (not slid and self.sunk > SUNK, f"its top has sunk by {1e2 * self.sunk:.0f} cm", "sunk"),
            (self.sunk < -SUNK, f"its top has risen by {-1e2 * self.sunk:.0f} cm", "sunk"),
        )
        # What has slid down is in the wrong place: the rest follows from that.
        others = (
            (
                self.empty_openings > 0,
                f"{self.empty_openings} of {self.openings} openings hold no part of the body",
                "openings",
            ),
            (bool(self.swapped), f"an opening holds {'; another '.join(self.swapped)}", "swapped"),
            (self.loose > _LOOSE, f"its waist stands off the body by {1e2 * self.loose:.0f} cm, it is too wide", "sunk"),
            (self.under > _UNDER, f"it reaches {1e2 * self.under:.0f} cm below the floor", "under"),
            (not self.speed <= REST_SPEED, f"it still moves by {1e3 * self.speed:.1f} mm a second", "speed"),
        )
        told = limits if slid else (*limits, *others)
        return [text + self.places.get(name, "") for bad, text, name in told if bad]

    @property
    def in_place(self) -> bool:
        """Whether it is where it is worn; what else is wrong with a coarse mesh may be right with a fine one."""
        worn = not self.empty_openings and not self.swapped and abs(self.sunk) <= SUNK
        return worn and self.strain_p99 <= _COARSE_STRAIN

    @property
    def rank(self) -> tuple[int, float]:
        """Less is better: faults, then how many triangles cross and how far it is stretched."""
        return len(self.faults), self.body_crossings + self.self_crossings + 100.0 * max(self.strain_p99 - STRAIN, 0.0)


@dataclass(frozen=True)
class Sewn:
    """A garment where it hangs.

    Args:
        pos: (V, 3) m.
        held: (V,) bool, vertices that were held.
        lift: m up, and ``depth`` m forward, that it was moved by before it began.
        steps: taken.
        seconds: of computing.
    """

    pos: np.ndarray
    held: np.ndarray
    lift: float
    depth: float
    figures: SewnFigures
    steps: int
    seconds: float


def judged(
    cloth: Cloth,
    sheet: PatternSheet,
    posed: PosedBody,
    pos: np.ndarray,
    begun: np.ndarray,
    held: np.ndarray,
    speed: float,
    before: PosedBody | None = None,
) -> SewnFigures:
    """:class:`SewnFigures` of the cloth of a sheet at ``pos`` (V, 3) [m] that began at ``begun`` (V, 3) [m] on the body
    ``before``, or on the same; ``held`` (V,) bool. An open front counts as closed."""
    if not np.isfinite(pos).all():
        return SewnFigures(0, 0, math.inf, 0, 0, math.inf, math.inf)
    assert cloth.flat is not None
    faces, cut, before = sheet.faces, sheet.flat, before or posed
    start, end = cloth.edges.numpy().T
    length = np.linalg.norm(pos[end] - pos[start], axis=1)
    known = torch.cat([cloth.flat, torch.as_tensor(cut[:, 1:] - cut[:, :1])])
    least, most = (side.numpy() for side in edge_extents(known, torch.cat([cloth.faces] * 2), cloth.edges))
    strain = np.maximum(length / most - 1.0, 1.0 - length / least).clip(min=0.0)
    closed = faces if sheet.closed is None else sheet.closed
    openings = find_openings(pos, closed, posed.surface, posed.faces)
    through, folded = crossings(pos, faces, posed.surface, posed.faces).pairs, self_crossings(pos, faces)
    beyond = cloth.edges.numpy()[strain > STRAIN]
    where = {
        "body_crossings": faces[through[:, 0]],
        "self_crossings": faces[folded],
        "strain_p99": beyond,
        "sunk": pos[:, 1].argmax(),
        "openings": np.concatenate([np.zeros(0, dtype=np.int64), *openings.empty]),
        "under": pos[:, 1].argmin(),
    }
    places = {name: _place(sheet, pos, np.reshape(rows, -1)) for name, rows in where.items() if np.size(rows)}
    if len(through):
        places["body_crossings"] = f" near the {_joint(posed, through[:, 1])}{places['body_crossings']}"
    return SewnFigures(
        len(through),
        len(folded),
        float(np.quantile(strain, 0.99)),
        openings.num,
        openings.num_empty,
        float(begun[:, 1].max() - pos[:, 1].max()),
        speed,
        float(signed_distances(pos[held], posed.surface, posed.faces).mean()) if held.any() else 0.0,
        float(posed.surface[:, 1].min() - pos[:, 1].min()),
        _swapped(closed, before, begun, posed, pos),
        places,
        _girths(sheet, least, cloth, before, begun),
    )


def strapless(sheet: PatternSheet) -> bool:
    """Whether a garment is held up by its upper edge, at the chest."""
    return bool(_WAIST * sheet.height < sheet.pos[:, 1].max() <= _CHEST * sheet.height)


def _place(sheet: PatternSheet, pos: np.ndarray, rows: np.ndarray) -> str:
    """Where vertices (N,) of a sheet at ``pos`` (V, 3) are, in words: panels, of which the first have the most of them, and the
    stitch that is nearest to them in the mean."""
    count = np.bincount(rows, minlength=len(pos))
    found = {name: int(count[np.unique(sheet.faces[own])].sum()) for name, own in sheet.panels.items()}
    most = max(found.values())
    names = sorted((name for name, own in found.items() if own >= _MANY * most), key=lambda name: -found[name])
    told = ", ".join(map(repr, names[:_NAMED])) + (" and others" if len(names) > _NAMED else "")
    chosen, welds = np.unique(rows), sheet.welds
    far = {
        text: float((cKDTree(pos[welds[points]]).query(pos[chosen])[0] * count[chosen]).sum())
        for text, points in sheet.seams.items()
    }
    return f", in panel {told}" + (f" near {min(far, key=far.__getitem__)}" if far else "")


def _joint(posed: PosedBody, faces: np.ndarray) -> str:
    """The joint that most of the faces (N,) of a body are nearest to, by name."""
    nearest = cKDTree(joints_of(posed)[: len(JOINTS)]).query(posed.surface[posed.faces[faces]].mean(axis=1))[1]
    return JOINTS[int(np.bincount(nearest).argmax())].replace("_", " ")


def _girths(
    sheet: PatternSheet, least: np.ndarray, cloth: Cloth, posed: PosedBody, begun: np.ndarray
) -> tuple[float, float] | None:
    """The length [m] of the upper edge at rest, where it is all that holds a garment up, and the body's girth where it began.

    Args:
        least: (E,) m, of the edges of the cloth.
    """
    loops = boundary_loops(sheet.faces if sheet.closed is None else sheet.closed)
    if not loops or any(limbs_in(begun[loop], posed) & _ARMS for loop in loops):
        return None
    rim = max(loops, key=lambda loop: float(begun[loop, 1].mean()))
    middle, edges = begun[rim].mean(axis=0), np.stack([rim, np.roll(rim, -1)], axis=1)
    around = [one for one in cuts(posed.surface, posed.faces, middle, _UP) if len(one) > 2]
    if not around:
        return None
    body = min(around, key=lambda one: float(np.linalg.norm(one.mean(axis=0) - middle)))
    row = topology.edge_index(cloth.edges.numpy(), edges)
    return float(least[row].sum()), girth(body, _UP)


def waist_of(sheet: PatternSheet) -> np.ndarray:
    """(V,) bool: the upper rim of a garment for the lower body: edges that the pattern calls ``lower_interface``, else the
    highest opening where all of the pattern is below the shoulders. None of other garments."""
    held = np.zeros(len(sheet.pos), dtype=bool)
    if sheet.pos[:, 1].max() > _CHEST * sheet.height:
        return held
    rims = boundary_loops(sheet.faces)
    rim = np.zeros_like(held)
    for loop in rims:
        rim[loop] = True
    named = sheet.edge_labels.get("lower_interface")
    if named is not None and (named & rim).any():
        return np.asarray(named & rim)
    if rims:
        held[max(rims, key=lambda loop: float(sheet.pos[loop, 1].mean()))] = True
    return held


def joints_of(posed: PosedBody) -> np.ndarray:
    """(J, 3) m: the joints in the pose."""
    joints = posed.body.shaped(posed.betas)[1]
    return np.asarray(np.einsum("jab,jb->ja", posed.transforms[:, :, :3], joints) + posed.transforms[:, :, 3])


def bones_of(posed: PosedBody) -> np.ndarray:
    """(W, 3) m: for every vertex of the skin the nearest points of the bones that it follows, in their mean by its weights."""
    body, skin, joints = posed.body, posed.surface, joints_of(posed)
    result = np.zeros_like(skin)
    for joint in range(len(joints)):
        rows = np.flatnonzero(body.weights[:, joint] > 0)
        ends = [joints[child] for child, parent in enumerate(body.parents) if parent == joint] or [joints[joint]]
        nearest, least = np.zeros((len(rows), 3)), np.full(len(rows), np.inf)
        for end in ends:
            bone = end - joints[joint]
            share = np.clip((skin[rows] - joints[joint]) @ bone / max(float(bone @ bone), 1e-12), 0.0, 1.0)
            there = joints[joint] + share[:, None] * bone
            distance = np.linalg.norm(skin[rows] - there, axis=1)
            nearer = distance < least
            nearest[nearer], least[nearer] = there[nearer], distance[nearer]
        result[rows] += body.weights[rows, joint, None] * nearest
    return result


def floor_at(height: float) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) [m] and faces (F, 3) of a floor, its normals upwards."""
    ticks = np.arange(-_FLOOR, _FLOOR + 0.5 * _SQUARE, _SQUARE)
    x, z = (grid.reshape(-1) for grid in np.meshgrid(ticks, ticks, indexing="ij"))
    number = np.arange(len(x)).reshape(len(ticks), -1)
    a, b, c, d = (part.reshape(-1) for part in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return np.stack([x, np.full_like(x, height), z], axis=1), faces


def limbs_in(rim: np.ndarray, posed: PosedBody) -> frozenset[str]:
    """Which of the trunk, the left and right arm and leg have a bone that passes through the opening with the rim (N, 3) [m].

    Head and neck are of the trunk, and both legs are as good as it, each below its hip or at it. Shoulders beside the trunk are
    not told: a wide neckline has them in it.
    """
    joints, parents = joints_of(posed), posed.body.parents
    after = np.roll(rim, -1, axis=0)
    middle = rim.mean(axis=0)
    found: set[str] = set()
    near: set[str] = set()
    hips: set[str] = set()
    for joint in range(1, min(len(parents), len(JOINTS))):
        limb, start, end = _limb(joint), joints[parents[joint]], joints[joint]
        end = start + _HAND * (end - start) if JOINTS[joint].endswith("wrist") else end
        if limb is not None and _passes(start, end, middle, rim, after):
            (near if JOINTS[joint].endswith("shoulder") else hips if JOINTS[joint].endswith("hip") else found).add(limb)
    if {"left leg", "right leg"} <= found | hips:
        found = (found - {"left leg", "right leg"}) | {"trunk"}
    return frozenset(found if "trunk" in found else found | near)


def _limb(joint: int) -> str | None:
    """What the bone that ends in a joint belongs to; None: to the collar."""
    side, _, name = JOINTS[joint].partition("_")
    if not name:
        return "trunk"
    kinds = {"arm": ("shoulder", "elbow", "wrist"), "leg": ("hip", "knee", "ankle", "foot")}
    kind = next((kind for kind, names in kinds.items() if name in names), None)
    return None if kind is None else f"{side} {kind}"


def _passes(start: np.ndarray, end: np.ndarray, middle: np.ndarray, rim: np.ndarray, after: np.ndarray) -> bool:
    """Whether a bone (3,) to (3,) meets the triangles between the middle of a rim and its edges an odd number of times."""
    way, first, second = end - start, rim - middle, after - middle
    normal = np.cross(way, second)
    det = (first * normal).sum(axis=1)
    safe = np.where(np.abs(det) > 1e-12, det, np.inf)
    u = (normal @ (start - middle)) / safe
    across = np.cross(start - middle, first)
    v = across @ way / safe
    t = (second * across).sum(axis=1) / safe
    hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0) & (t <= 1) & np.isfinite(safe)
    return bool(int(hit.sum()) % 2)


def held_limbs(
    faces: np.ndarray, pos: np.ndarray, posed: PosedBody, drawn: np.ndarray
) -> list[tuple[np.ndarray, frozenset[str]]]:
    """Openings of a garment at ``pos`` (V, 3) [m] and what is in them (:func:`limbs_in`), without slits and those that are not
    about plane at ``drawn`` (V, 3) [m]."""
    least = _LEAST_LENGTH * float(np.ptp(posed.surface, axis=0).max())
    found = []
    for loop in boundary_loops(faces):
        spread = np.linalg.svd(drawn[loop] - drawn[loop].mean(axis=0), compute_uv=False)
        if rim_length(pos, loop) >= least and spread[2] <= _PLANE * spread[1]:
            found.append((loop, limbs_in(pos[loop], posed)))
    return found


def _swapped(faces: np.ndarray, before: PosedBody, begun: np.ndarray, posed: PosedBody, pos: np.ndarray) -> tuple[str, ...]:
    """Openings that hold other limbs at ``pos`` than where they began, in words."""
    told = []
    for loop, holds in held_limbs(faces, pos, posed, begun):
        made = limbs_in(begun[loop], before)
        if {"trunk", *_ARMS} <= made:  # a cape: its hem may be above or below the arms
            made, holds = made - _ARMS, holds - _ARMS
        if made and holds and made != holds:
            told.append(f"the {' and the '.join(sorted(holds))}, not the {' and the '.join(sorted(made))}")
    return tuple(told)
