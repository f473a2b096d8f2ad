"""The seven default garments: scalar fields around the T-posed body, and smooth cuts. Build time only.

The zero level of a field is the cloth: the body's signed distance minus the ease, plus *hanging*: cloth
below a wide place (chest, thigh, hip) does not follow the body back in. Such surfaces never intersect
themselves, and where two legs are closer than their ease they merge into a crotch.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from hood.assets.remesh import Array, Faces, closest

VOXEL = 0.006  # m
CLEARANCE = 0.005  # m, smallest distance to the body
ORIGIN, _HIGH = np.array([-0.78, -0.80, -0.30]), np.array([0.78, 0.72, 0.36])
_MIDDLE_Z = 0.035  # m, the plane between the front and the back of the body
_FAR = 1.0


@dataclass(frozen=True)
class Fields:
    """Voxel grid: broadcastable coordinates x, y, z [m] and the body's signed distance (nx,ny,nz) [m]."""

    x: Array
    y: Array
    z: Array
    body: Array

    def row(self, height: float) -> int:
        """Index of the slice at y = `height`."""
        return int(round((height - self.y.flat[0]) / VOXEL))


@dataclass(frozen=True)
class Pattern:
    """What a garment is: its field, its cuts (kept where positive) and how it follows the body.

    `field` maps Fields to the zero-level function; `cuts` map points (V,3) to scalars. `waist` is the
    height above which vertices are pinned; `flared` garments follow the pelvis below the
    waist; those without `legs` share the thighs' motion. `weight_reach` [m] is the length over which
    skinning weights are smoothed.
    """

    field: Callable[[Fields], Array]
    cuts: tuple[Callable[[Array], Array], ...]
    waist: float | None = None
    weight_reach: float = 0.04
    flared: bool = False
    legs: bool = False


def body_fields(verts: Array, faces: Faces) -> Fields:
    """Signed distance to the body on the grid, made left-right symmetric (the smaller distance counts)."""
    axes = [np.arange(low, high + VOXEL / 2, VOXEL) for low, high in zip(ORIGIN, _HIGH, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    dist = closest(grid.reshape(-1, 3), verts, faces).dist.numpy().reshape(grid.shape[:3])
    dist = np.minimum(dist, dist[::-1])
    return Fields(axes[0][:, None, None], axes[1][None, :, None], axes[2][None, None, :], dist)


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


def sleeves(fields: Fields, ease: float, narrowing: float) -> Array:
    """Tubes around both arms that hang outwards from the shoulder; far away from the arms."""
    loosened = fields.body - ease * np.clip(1.0 - (fields.y - 0.54) / 0.10, 0.6, 1.0)
    arms = np.where(fields.y > 0.40, loosened, _FAR)
    turned = np.swapaxes(arms, 0, 1)
    first, last = (int(round((x - ORIGIN[0]) / VOXEL)) for x in (0.215, 0.74))
    right = hang(turned[:, ::-1], turned.shape[1] - 1 - first, turned.shape[1] - 1 - last, narrowing)[:, ::-1]
    right = np.swapaxes(right, 0, 1)
    return np.where(fields.x > 0.215, right, np.where(fields.x < -0.215, right[::-1], arms))


def torso(fields: Fields, ease: float, narrowing: float, bottom: float = -0.3) -> Array:
    """Trunk without arms, hanging from the chest down to y = `bottom`."""
    # Cloth rests on the shoulders: less ease there than around the chest.
    shell = fields.body - ease * np.clip(1.0 - (fields.y - 0.48) / 0.20, 0.55, 1.0)
    trunk = np.maximum(shell, np.abs(fields.x) - 0.21 - ease)
    return np.where(fields.y > 0.45, shell, hang(trunk, fields.row(0.45), fields.row(bottom), narrowing))


def finish(fields: Fields, field: Array, blur: float) -> Array:
    """Rounds creases over `blur` [m] and keeps the surface outside the body."""
    return np.minimum(ndimage.gaussian_filter(field, blur / VOXEL), fields.body - CLEARANCE - 0.002)


def top_field(fields: Fields, ease: float, narrowing: float, sleeve_ease: float, sleeve_narrowing: float) -> Array:
    """Shirt: trunk and sleeves in one; the armpit is rounded."""
    both = np.minimum(torso(fields, ease, narrowing), sleeves(fields, sleeve_ease, sleeve_narrowing))
    return finish(fields, both, 0.010)


def leg_field(fields: Fields, ease: float, narrowing: float) -> Array:
    """Trousers: snug at the waist, legs hanging from the upper thigh."""
    loosened = fields.body - ease * np.clip((0.24 - fields.y) / 0.12, 0.45, 1.0)
    thigh, knee = fields.row(-0.07), fields.row(-0.31)
    upper = hang(loosened, thigh, knee, narrowing, shear=0.10)
    lower = hang(upper, knee, 0, narrowing, shear=0.0)
    return finish(fields, lower, 0.010)


def skirt_field(fields: Fields, ease: float, top: float, flare: float) -> Array:
    """A-line: flares from the hip downwards, one tube around both legs."""
    trunk = np.maximum(fields.body, np.abs(fields.x) - 0.30) - ease
    straight = hang(trunk, fields.row(top), fields.row(0.12), 0.0)
    return hang(straight, fields.row(0.12), fields.row(-0.60), -flare)


def dress_field(fields: Fields, ease: float, flare: float) -> Array:
    """Fitted sleeveless bodice that becomes an A-line skirt below the waist."""
    bodice = torso(fields, ease, 0.45)
    skirt = skirt_field(fields, ease, 0.28, flare)
    return finish(fields, np.where(fields.y > 0.28, bodice, np.minimum(bodice, skirt)), 0.014)


def below(height: float, tilt: float = 0.0) -> Callable[[Array], Array]:
    """Keeps what is under a plane at `height` that falls by `tilt` per metre towards the front."""
    return lambda p: height - tilt * (p[:, 2] - _MIDDLE_Z) - p[:, 1]


def above(height: float, tilt: float = 0.0) -> Callable[[Array], Array]:
    """Keeps what is over a plane at `height` that falls by `tilt` per metre towards the front."""
    return lambda p: p[:, 1] - height + tilt * (p[:, 2] - _MIDDLE_Z)


def within(reach: float, droop: float = 0.0) -> Callable[[Array], Array]:
    """Cuts sleeves square to the arm at |x| = `reach`; `droop` leans the cut along y."""
    return lambda p: reach - np.abs(p[:, 0]) + droop * (p[:, 1] - 0.545)


def scoop(half_width: float, front: float, back: float, top: float = 0.66) -> Callable[[Array], Array]:
    """Round neckline: an ellipse around (0, `top`), of depth `front` before and `back` behind the body."""

    def keep(p: Array) -> Array:
        share = np.clip((p[:, 2] - _MIDDLE_Z + 0.06) / 0.12, 0, 1)
        depth = back + (front - back) * share * share * (3 - 2 * share)
        radius = np.sqrt((p[:, 0] / half_width) ** 2 + ((p[:, 1] - top) / depth) ** 2)
        return np.minimum((radius - 1) * half_width, top - p[:, 1])

    return keep


def armhole(shoulder: float, side: float, hollow: float = 0.0) -> Callable[[Array], Array]:
    """Cuts off the arm along a line from |x| = `shoulder` at y = 0.61 to |x| = 0.19 at y = `side`.

    The line bends inwards by `hollow` between its ends, so that lowered arms do not pinch the cloth. What hangs well
    below the armpit is kept however wide it is.
    """

    def keep(p: Array) -> Array:
        share = (0.61 - p[:, 1]) / (0.61 - side)
        bend = 4.0 * hollow * np.clip(share * (1.0 - share), 0.0, None)
        return np.maximum(shoulder + (0.19 - shoulder) * share - bend - np.abs(p[:, 0]), side - 0.08 - p[:, 1])

    return keep


PATTERNS = {
    "tshirt": Pattern(
        lambda f: top_field(f, 0.016, 0.10, 0.018, -0.06),
        (scoop(0.088, 0.066, 0.030), within(0.365, 0.1), above(-0.02)),
    ),
    "tank": Pattern(
        lambda f: top_field(f, 0.012, 0.16, 0.012, 0.0),
        (scoop(0.088, 0.150, 0.085), armhole(0.138, 0.425), above(0.01)),
    ),
    "longsleeve": Pattern(
        lambda f: top_field(f, 0.015, 0.12, 0.016, 0.035),
        (scoop(0.088, 0.060, 0.030), within(0.655), above(-0.03)),
    ),
    "shorts": Pattern(
        lambda f: leg_field(f, 0.016, 0.0),
        (below(0.19, 0.12), above(-0.24)),
        waist=0.165,
        weight_reach=0.035,
        legs=True,
    ),
    "trousers": Pattern(
        lambda f: leg_field(f, 0.014, 0.075),
        (below(0.19, 0.12), above(-0.735)),
        waist=0.165,
        weight_reach=0.035,
        legs=True,
    ),
    "dress": Pattern(
        lambda f: dress_field(f, 0.012, 0.27),
        (scoop(0.066, 0.120, 0.075), armhole(0.150, 0.425, 0.020), above(-0.31)),
        weight_reach=0.05,
        flared=True,
    ),
    "skirt": Pattern(
        lambda f: finish(f, skirt_field(f, 0.010, 0.22, 0.32), 0.014),
        (below(0.21, 0.08), above(-0.26)),
        waist=0.19,
        weight_reach=0.05,
        flared=True,
    ),
}
SIZES = {"": 1000, "_4k": 4500}
EXTRA_SIZES = {"dress": {"_12k": 12000}}
