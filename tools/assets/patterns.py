"""The nine default garments: scalar fields around the T-posed body, and smooth cuts.

The zero level of a field is the cloth: the body's signed distance minus the ease, plus *hanging*: cloth
below a wide place (chest, thigh, hip) does not follow the body back in. Such surfaces never intersect
themselves, and where two legs are closer than their ease they merge into a crotch.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from hood.assets.garment.binding import PosedBody
from hood.mesh.editing.remeshing import Array, closest

VOXEL = 0.006  # m
CLEARANCE = 0.005  # m, smallest distance to the body
ORIGIN, _HIGH = np.array([-0.78, -0.80, -0.30]), np.array([0.78, 0.72, 0.36])
_MIDDLE_Z = 0.035  # m, the plane between the front and the back of the body
_FAR = 1.0
_LEFT_ARM = (16, 18, 20)
#: x, y [m] of the shoulder.
_SHOULDER = (0.177, 0.559)
#: x, y [m] of the armpit of the cloth; bare arms get lower holes than sleeves.
_ARMPIT, _BARE_ARMPIT = (0.172, 0.440), (0.152, 0.405)
#: x, y [m] of a point of the seam between trunk and sleeve, where the cloth folds under the arm.
_SLEEVE_SEAM = (0.185, 0.443)
#: Share of the ease around the trunk at heights [m]. Cloth rests on the shoulders. Where bare arms leave it, whatever is too
#: wide stands off at the sides, because the straps pull front and back against the chest: there it is close.
_ROOM = ((0.44, 1.0), (0.54, 0.5))
_BARE_ROOM = ((0.22, 1.0), (0.37, 0.4))


@dataclass(frozen=True)
class Arm:
    """Where the left arm is in the pose a garment is drafted in [m]."""

    shoulder: Array  # (3,)
    elbow: Array  # (3,)
    wrist: Array  # (3,)


@dataclass(frozen=True)
class Fields:
    """Voxel grid: broadcastable coordinates x, y, z [m], the body's signed distance (nx,ny,nz) [m] and its arm."""

    x: Array
    y: Array
    z: Array
    body: Array
    arm: Arm

    def row(self, height: float) -> int:
        """Index of the slice at y = `height`."""
        return int(round((height - self.y.flat[0]) / VOXEL))


@dataclass(frozen=True)
class Front:
    """How a garment is fastened in front: the ``name`` of the row, and every how many pairs of vertices one is fastened."""

    name: str
    every: int


@dataclass(frozen=True)
class Pattern:
    """What a garment is: its field, its cuts (kept where positive) and how it follows the body.

    `field` maps Fields to the zero-level function; `cuts` map points (V,3) to scalars. `waist` is the
    height above which vertices are pinned; `flared` garments follow the pelvis below the
    waist; those without `legs` share the thighs' motion. `weight_reach` [m] is the length over which
    skinning weights are smoothed. `parts` are negative on what is cut from panels of its own, a leg or a sleeve. `arms` is how
    far the arms hang down [degrees] in the pose it is drafted in: sleeves drafted for level arms crumple at the armpit of
    lowered ones. `firm` names what is sewn stiffer: ``rims`` (neckline and armholes) or ``crotch``. With a `front` it is open
    there, and made in the smallest size alone.
    """

    field: Callable[[Fields], Array]
    cuts: tuple[Callable[[Array], Array], ...]
    waist: float | None = None
    weight_reach: float = 0.04
    flared: bool = False
    legs: bool = False
    parts: tuple[Callable[[Array], Array], ...] = ()
    arms: float = 0.0
    firm: str | None = None
    front: Front | None = None


def body_fields(posed: PosedBody) -> Fields:
    """Signed distance to a posed body, made left-right symmetric (the smaller counts)."""
    axes = [np.arange(low, high + VOXEL / 2, VOXEL) for low, high in zip(ORIGIN, _HIGH, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    dist = closest(grid.reshape(-1, 3), posed.surface, posed.faces).dist.numpy().reshape(grid.shape[:3])
    dist = np.minimum(dist, dist[::-1])
    joints = posed.body.shaped(posed.betas)[1]
    shoulder, elbow, wrist = (
        posed.transforms[joint, :, :3] @ joints[joint] + posed.transforms[joint, :, 3] for joint in _LEFT_ARM
    )
    arm = Arm(shoulder, elbow, wrist)
    return Fields(axes[0][:, None, None], axes[1][None, :, None], axes[2][None, None, :], dist, arm)


def hang(field: Array, first: int, last: int, narrowing: float, shear: float = 0.0) -> Array:
    """Cloth that falls along -y from slice `first` to `last`: f(y) = min(f(y), f(y + dy) + narrowing · dy).

    `narrowing` is the slope at which the cloth may come back towards the body (negative: it flares).
    `shear` moves each slice by that many metres of |x| per metre of y, for limbs that are not vertical.
    """
    result = field.copy()
    half = field.shape[0] // 2
    above = result[:, first]
    for row in range(first - 1, last - 1, -1):
        if shear:
            step = shear  # voxels per voxel
            right = ndimage.shift(above[half:], (step, 0), order=1, mode="nearest")
            left = ndimage.shift(above[: half + 1], (-step, 0), order=1, mode="nearest")
            above = np.concatenate([left[:-1], right])
        above = np.minimum(field[:, row], above + narrowing * VOXEL)
        result[:, row] = above
    return result


def sleeve(fields: Fields, ease: float, radii: tuple[tuple[float, float], ...]) -> Array:
    """Tubes around both arms: where `radii` (distance from the shoulder, radius) say, and `ease` off the skin at least."""
    arm = fields.arm
    half = len(fields.x) // 2
    points = np.stack(np.broadcast_arrays(fields.x[half:], fields.y, fields.z), axis=-1)
    upper, lower = _along(points, arm.shoulder, arm.elbow), _along(points, arm.elbow, arm.wrist)
    on_upper = upper.dist <= lower.dist
    length = float(np.linalg.norm(arm.elbow - arm.shoulder))
    along = np.where(on_upper, upper.along, length + lower.along)
    left = np.where(on_upper, upper.dist, lower.dist) - np.interp(along, *np.array(radii).T)
    tube = np.concatenate([left[:0:-1], left])
    return np.maximum(np.minimum(tube, fields.body - ease), -_arm_side(fields, _ARMPIT) - 0.02)


class _Place(NamedTuple):
    along: Array  # m from the start of a bone, clipped to it
    dist: Array  # m from its axis


def _along(points: Array, start: Array, end: Array) -> _Place:
    length = float(np.linalg.norm(end - start))
    along = np.clip((points - start) @ ((end - start) / length), 0.0, length)
    return _Place(along, np.linalg.norm(points - start - along[..., None] * (end - start) / length, axis=-1))


def _arm_side(fields: Fields, armpit: tuple[float, float]) -> Array:
    """Distance [m] beyond the plane through the armpit that halves the angle between arm and trunk; the arm's side counts."""
    arm = fields.arm
    reach = arm.elbow - arm.shoulder
    halving = reach[:2] / np.linalg.norm(reach[:2]) + np.array([0.0, -1.0])
    halving /= np.linalg.norm(halving)
    return (np.abs(fields.x) - armpit[0]) * -halving[1] + (fields.y - armpit[1]) * halving[0]


def torso(fields: Fields, ease: float, narrowing: float, bare: bool, bottom: float = -0.3) -> Array:
    """Trunk without arms, hanging from the armpit down to y = `bottom`."""
    room, armpit = (_BARE_ROOM, _BARE_ARMPIT) if bare else (_ROOM, _ARMPIT)
    loose = ease * np.interp(fields.y, *np.array(room).T)
    shell = fields.body - loose
    trunk = np.maximum(shell, _arm_side(fields, armpit) - loose)
    chest = armpit[1]
    return np.where(fields.y > chest, shell, hang(trunk, fields.row(chest), fields.row(bottom), narrowing))


def finish(fields: Fields, field: Array, blur: float) -> Array:
    """Rounds creases over `blur` [m] and keeps the surface outside the body."""
    return np.minimum(ndimage.gaussian_filter(field, blur / VOXEL), fields.body - CLEARANCE - 0.001)


def top_field(fields: Fields, ease: float, narrowing: float, radii: tuple[tuple[float, float], ...] = ()) -> Array:
    """Shirt: trunk and sleeves in one; the armpit is rounded."""
    trunk = torso(fields, ease, narrowing, bare=not radii)
    return finish(fields, np.minimum(trunk, sleeve(fields, 0.009, radii)) if radii else trunk, 0.010)


def _snug(fields: Fields) -> Array:
    """Share of the ease by height: a waistband lies on the skin, hips have room."""
    return np.asarray(np.clip((0.24 - fields.y) / 0.12, 0.3, 1.0))


def leg_field(fields: Fields, ease: float, narrowing: float) -> Array:
    """Trousers: snug at the waist, legs hanging from the upper thigh."""
    loosened = fields.body - ease * _snug(fields)
    thigh, knee = fields.row(-0.07), fields.row(-0.31)
    upper = hang(loosened, thigh, knee, narrowing, shear=0.10)
    lower = hang(upper, knee, 0, narrowing, shear=0.0)
    return finish(fields, lower, 0.010)


def skirt_field(fields: Fields, ease: float, top: float, flare: float) -> Array:
    """A-line: flares from the hip downwards, one tube around both legs."""
    # No more than the hips: the flare follows level sets, and those of lowered hands would widen it.
    trunk = np.maximum(fields.body, np.abs(fields.x) - 0.21) - ease * _snug(fields)
    straight = hang(trunk, fields.row(top), fields.row(0.12), 0.0)
    return hang(straight, fields.row(0.12), fields.row(-0.60), -flare)


def dress_field(fields: Fields, ease: float, flare: float) -> Array:
    """Fitted sleeveless bodice that becomes an A-line skirt below the waist."""
    bodice = torso(fields, ease, 0.45, bare=True)
    skirt = skirt_field(fields, ease, 0.28, flare)
    return finish(fields, np.where(fields.y > 0.28, bodice, np.minimum(bodice, skirt)), 0.014)


def below(height: float, tilt: float = 0.0) -> Callable[[Array], Array]:
    """Keeps what is under a plane at `height` that falls by `tilt` per metre towards the front."""
    return lambda p: height - tilt * (p[:, 2] - _MIDDLE_Z) - p[:, 1]


def above(height: float, tilt: float = 0.0) -> Callable[[Array], Array]:
    """Keeps what is over a plane at `height` that falls by `tilt` per metre towards the front."""
    return lambda p: p[:, 1] - height + tilt * (p[:, 2] - _MIDDLE_Z)


def scoop(half_width: float, front: float, back: float, top: float = 0.66) -> Callable[[Array], Array]:
    """Round neckline: an ellipse around (0, `top`), of depth `front` before and `back` behind the body."""

    def keep(p: Array) -> Array:
        share = np.clip((p[:, 2] - _MIDDLE_Z + 0.06) / 0.12, 0, 1)
        depth = back + (front - back) * share * share * (3 - 2 * share)
        radius = np.sqrt((p[:, 0] / half_width) ** 2 + ((p[:, 1] - top) / depth) ** 2)
        return np.minimum((radius - 1) * half_width, top - p[:, 1])

    return keep


def sleeve_end(reach: float) -> Callable[[Array], Array]:
    """Cuts sleeves square to arms of an A-pose, `reach` [m] beyond the shoulder; the trunk below them is kept."""

    def keep(p: Array) -> Array:
        x, y = np.abs(p[:, 0]) - _SHOULDER[0], p[:, 1] - _SHOULDER[1]
        along, across = math.sqrt(0.5) * (x - y), math.sqrt(0.5) * (x + y)
        return np.maximum(reach - along, -0.10 - across)

    return keep


def armhole(shoulder: float, width: float, side: float, hollow: float) -> Callable[[Array], Array]:
    """Cuts off the arm along a line from |x| = `shoulder` at y = 0.61 to |x| = `width` at y = `side`.

    The line bends inwards by `hollow` between its ends, so that lowered arms do not pinch the cloth, and the lower end runs
    out level. What hangs well below is kept however wide it is.
    """

    def keep(p: Array) -> Array:
        share = (0.61 - p[:, 1]) / (0.61 - side)
        inside = np.clip(share, 0.0, 1.0)
        line = shoulder + (width - shoulder) * inside**3 - 4.0 * hollow * inside * (1.0 - inside)
        return np.maximum(line - np.abs(p[:, 0]), side - p[:, 1])

    return keep


def right_leg(p: Array) -> Array:
    """Negative on the right leg."""
    return np.asarray(p[:, 0])


def beyond_armpit(side: float) -> Callable[[Array], Array]:
    """Negative on the left (`side` 1) or right (-1) sleeve, beyond the plane that halves the angle of an A-pose's armpit."""
    x, y = _SLEEVE_SEAM
    return lambda p: (x - side * p[:, 0]) * math.cos(math.pi / 8) + (y - p[:, 1]) * math.sin(math.pi / 8)


_SLEEVES = (beyond_armpit(1.0), beyond_armpit(-1.0))
PATTERNS = {
    "tshirt": Pattern(
        lambda f: top_field(f, 0.015, 0.10, ((0.0, 0.070), (0.10, 0.062), (0.19, 0.0548))),
        (scoop(0.088, 0.066, 0.030), sleeve_end(0.175), above(-0.02)),
        arms=45.0,
        parts=_SLEEVES,
    ),
    "tank": Pattern(
        lambda f: top_field(f, 0.012, 0.16),
        (scoop(0.088, 0.150, 0.085), armhole(0.132, 0.180, 0.395, 0.012), above(0.01)),
        arms=45.0,
    ),
    "longsleeve": Pattern(
        lambda f: top_field(f, 0.015, 0.12, ((0.0, 0.068), (0.10, 0.061), (0.26, 0.053), (0.36, 0.045), (0.47, 0.0345))),
        (scoop(0.088, 0.060, 0.030), sleeve_end(0.470), above(-0.03)),
        arms=45.0,
        parts=_SLEEVES,
    ),
    "shirt": Pattern(
        lambda f: top_field(f, 0.019, 0.06, ((0.0, 0.072), (0.10, 0.065), (0.21, 0.058))),
        (scoop(0.084, 0.062, 0.030), sleeve_end(0.190), above(-0.05)),
        arms=45.0,
        parts=_SLEEVES,
        front=Front("front_buttons", 2),
    ),
    "jacket": Pattern(
        lambda f: top_field(f, 0.022, 0.08, ((0.0, 0.074), (0.10, 0.067), (0.26, 0.060), (0.36, 0.053), (0.47, 0.043))),
        (scoop(0.086, 0.052, 0.026), sleeve_end(0.465), above(-0.04)),
        arms=45.0,
        parts=_SLEEVES,
        front=Front("front_zip", 1),
    ),
    "shorts": Pattern(
        lambda f: leg_field(f, 0.016, 0.0),
        (below(0.19, 0.12), above(-0.24)),
        waist=0.165,
        weight_reach=0.035,
        legs=True,
        parts=(right_leg,),
        firm="crotch",
    ),
    "trousers": Pattern(
        lambda f: leg_field(f, 0.016, 0.065),
        (below(0.19, 0.12), above(-0.735)),
        waist=0.165,
        weight_reach=0.035,
        legs=True,
        parts=(right_leg,),
        firm="crotch",
    ),
    "dress": Pattern(
        lambda f: dress_field(f, 0.012, 0.27),
        (scoop(0.066, 0.120, 0.075), armhole(0.146, 0.180, 0.395, 0.006), above(-0.31)),
        arms=45.0,
        weight_reach=0.05,
        flared=True,
        firm="rims",
    ),
    "skirt": Pattern(
        lambda f: finish(f, skirt_field(f, 0.010, 0.22, 0.32), 0.014),
        (below(0.21, 0.08), above(-0.26)),
        waist=0.19,
        weight_reach=0.05,
        flared=True,
    ),
}
#: Vertices of each size, and the greatest share by which a garment may miss them. Shipped weights know 969 vertices and more.
SIZES = {"": (1000, 0.03), "_4k": (4500, 0.035), "_12k": (12000, 0.035)}
