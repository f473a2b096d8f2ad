"""A garment that has been sewn around a body, and the verdict on it: what crosses, what is stretched, where it is worn."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from hood.assets.body.body import JOINTS
from hood.assets.fitting.suspicions import find_openings
from hood.assets.garment.binding import signed_distances
from hood.mesh.flat import edge_extents
from hood.mesh.parts import rim_length
from hood.mesh.penetration.crossing import crossings, self_crossings
from hood.mesh.topology import boundary_loops

if TYPE_CHECKING:
    from hood.assets.garment.binding import PosedBody
    from hood.cloth.cloth import Cloth

#: A garment that is sewn well: strain p99, and what its top has sunk or risen by [m], are no more.
STRAIN, SUNK = 0.25, 0.15
#: A coarse mesh is stretched by less than this where a fine one can come to rest.
_COARSE_STRAIN = 0.6
#: In the last step the vertices move by no more than this [m/s] in the mean.
REST_SPEED = 2e-3
#: A held waist is no farther from the skin [m], in the mean; a hem is no deeper under the floor [m].
_LOOSE, _UNDER = 0.04, 5e-3
#: A forearm with its hand is so many times as long as to the wrist.
_HAND = 1.7
#: Of the limbs.
_ARMS = frozenset({"left arm", "right arm"})
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

    @property
    def faults(self) -> list[str]:
        """What is wrong with it, in words; none where it is sewn well."""
        limits = (
            (self.body_crossings > 0, f"{self.body_crossings} pairs of triangles pass through the body"),
            (self.self_crossings > 0, f"{self.self_crossings} pairs of its own triangles pass through each other"),
            (not self.strain_p99 <= STRAIN, f"it is stretched by {self.strain_p99:.0%} (p99; {STRAIN:.0%} is allowed)"),
            (self.empty_openings > 0, f"{self.empty_openings} of {self.openings} openings hold no part of the body"),
            (bool(self.swapped), f"an opening holds {'; another '.join(self.swapped)}"),
            (self.sunk > SUNK, f"its top has sunk by {1e2 * self.sunk:.0f} cm"),
            (self.sunk < -SUNK, f"its top has risen by {-1e2 * self.sunk:.0f} cm"),
            (self.loose > _LOOSE, f"its waist stands off the body by {1e2 * self.loose:.0f} cm, it is too wide"),
            (self.under > _UNDER, f"it reaches {1e2 * self.under:.0f} cm below the floor"),
            (not self.speed <= REST_SPEED, f"it still moves by {1e3 * self.speed:.1f} mm a second"),
        )
        return [text for bad, text in limits if bad]

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
    faces: np.ndarray,
    posed: PosedBody,
    cut: np.ndarray,
    pos: np.ndarray,
    begun: np.ndarray,
    held: np.ndarray,
    speed: float,
    before: PosedBody | None = None,
    closed: np.ndarray | None = None,
) -> SewnFigures:
    """:class:`SewnFigures` of cloth, cut as ``cut`` (F, 3, 2) [m], at ``pos`` (V, 3) [m], that began at ``begun`` (V, 3) [m]
    on the body ``before``, or on the same; ``held`` (V,) bool. Openings are those of ``closed`` (G, 3), else of all faces."""
    if not np.isfinite(pos).all():
        return SewnFigures(0, 0, math.inf, 0, 0, math.inf, math.inf)
    assert cloth.flat is not None
    start, end = cloth.edges.numpy().T
    length = np.linalg.norm(pos[end] - pos[start], axis=1)
    known = torch.cat([cloth.flat, torch.as_tensor(cut[:, 1:] - cut[:, :1])])
    least, most = (side.numpy() for side in edge_extents(known, torch.cat([cloth.faces] * 2), cloth.edges))
    strain = np.maximum(length / most - 1.0, 1.0 - length / least).clip(min=0.0)
    closed = faces if closed is None else closed
    openings = find_openings(pos, closed, posed.surface, posed.faces)
    return SewnFigures(
        len(crossings(pos, faces, posed.surface, posed.faces).pairs),
        len(self_crossings(pos, faces)),
        float(np.quantile(strain, 0.99)),
        openings.num,
        openings.num_empty,
        float(begun[:, 1].max() - pos[:, 1].max()),
        speed,
        float(signed_distances(pos[held], posed.surface, posed.faces).mean()) if held.any() else 0.0,
        float(posed.surface[:, 1].min() - pos[:, 1].min()),
        _swapped(closed, before or posed, begun, posed, pos),
    )


def joints_of(posed: PosedBody) -> np.ndarray:
    """(J, 3) m: the joints in the pose."""
    joints = posed.body.shaped(posed.betas)[1]
    return np.asarray(np.einsum("jab,jb->ja", posed.transforms[:, :, :3], joints) + posed.transforms[:, :, 3])


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
