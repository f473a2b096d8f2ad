"""Doubts about a body in motion: its file was probably meant another way than it was read.

Doubts about fabrics: values that no cloth has, mostly those of another unit.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from hood.assets.files.said import Doubt
from hood.cloth.cloth import Cloth
from hood.limits import (
    BENDING_KNOWN,
    BODY_JUMP,
    BODY_OVERLAP,
    BODY_SPEED,
    DENSITY_KNOWN,
    FLOOR_OFF,
    HEAD_DOWN,
    SHEAR_KNOWN,
    STRETCH_KNOWN,
    TOLERATED,
    Range,
)
from hood.mesh.penetration.compiled import eights
from hood.mesh.penetration.crossing import self_crossings
from hood.mesh.topology import connected_components, unique_edges
from hood.rollouts.verdict.frames import mask_of, name_frames
from hood.scene.body_motion.motion import BodyMotion, Motion
from hood.scene.jumps import describe_jumps, find_jumps

#: Frames that are looked at, at most; and of them those in which the body is held against itself.
_LOOKED_AT, _HELD_AGAINST_ITSELF = 30, 12
#: Of the vertices that tell head from soles one in so many is posed.
_STRIDE = 4
#: Head and soles: this share of the template's height from its top and from its bottom; hands: of its width from its sides.
_ENDS = 0.07
#: Hands that carry the body are the lowest part of it, but for this [m].
_ON_HANDS = 0.1
#: A body lies where its head is higher than its soles by less than this share of its height.
_LIES = 0.35
#: A part of the mesh with a smaller share of its faces is none of the body's limbs: eyes, teeth, hair.
_LIMB = 0.2


def doubt_body(motion: Motion, num_frames: int) -> list[Doubt]:
    """What is doubtful about ``motion`` in its first ``num_frames`` frames; nothing without a body."""
    if not motion.num_vertices:
        return []
    count = min(num_frames, motion.num_frames)
    looked = np.unique(np.linspace(0, count - 1, min(count, _LOOKED_AT)).astype(np.int64))
    doubts = [*_speed(motion, count), *_jump(motion, count), *_overlap(motion, looked)]
    if isinstance(motion, BodyMotion):  # of a mesh nobody knows which end is the head, and whether it has a floor
        heights = motion.some_points(looked, _STRIDE)[:, :, 1]
        doubts = [*_orientation(motion, looked, heights), *_floor(motion, looked, heights.min(axis=1)), *doubts]
    return doubts


def _orientation(motion: BodyMotion, looked: np.ndarray, heights: np.ndarray) -> Iterator[Doubt]:
    """Head down in most frames, and not on its hands; or lying in most, far from the floor."""
    ends = _ends_of(motion.body.v_template[::_STRIDE])
    head, soles, hands = (heights[:, end].mean(axis=1) for end in ends)
    lowest, size = heights.min(axis=1), float(np.ptp(motion.body.v_template[:, 1]))
    down = (head < soles) & (hands > lowest + _ON_HANDS)
    lies = (np.abs(head - soles) < _LIES * size) & (np.abs(lowest) > FLOOR_OFF.value)
    for which, what in ((down, "head down, and not on its hands,"), (lies, "lying in the air")):
        if which.mean() > HEAD_DOWN.value:
            yield Doubt(
                "orientation",
                f"{motion.name!r}: the body is {what} in {which.mean():.0%} of the frames; if it should stand, another axis "
                "of its file points up: up=-y for most files in the space of a camera, up=y or up=z for others",
                tuple(looked[which].tolist()),
                float(which.mean()),
                HEAD_DOWN.unit,
            )
            return


def _floor(motion: BodyMotion, looked: np.ndarray, lowest: np.ndarray) -> Iterator[Doubt]:
    """Its lowest point is mostly far from the floor at height 0."""
    usual = float(np.median(lowest))
    if abs(usual) > FLOOR_OFF.value:
        where = "below" if usual < 0 else "above"
        yield Doubt(
            "floor",
            f"{motion.name!r}: the lowest point of the body is mostly {abs(usual):.2f} m {where} the floor at height 0; the "
            "translation of its file has another origin or unit; the cloth does not mind, floors in pictures and exports do",
            (),
            usual,
            "m",
        )
        return
    under = lowest < -FLOOR_OFF.value
    if under.any():
        yield Doubt(
            "floor",
            f"{motion.name!r}: the body sinks up to {-lowest.min():.2f} m below its own floor, in "
            f"{name_frames(mask_of(looked[under]))}; start=… and stop=… leave these frames out",
            tuple(looked[under].tolist()),
            float(lowest.min()),
            "m",
        )


def _speed(motion: Motion, count: int) -> Iterator[Doubt]:
    """Faster than people are, in more than single steps: those are jumps."""
    way = np.linalg.norm(np.diff(np.asarray(motion.translation[:count], dtype=np.float64), axis=0), axis=1)
    fast = way * motion.fps > BODY_SPEED.value
    if len(fast) and fast.mean() > TOLERATED.value and fast.sum() > 1:
        yield Doubt(
            "speed",
            f"{motion.name!r}: the body moves at up to {way.max() * motion.fps:.0f} m/s, in {name_frames(fast)}; nobody is "
            f"faster than {BODY_SPEED.value:g}: its translation may be in centimetres, or file_fps=… too high",
            tuple(np.flatnonzero(fast).tolist()),
            float(way.max() * motion.fps),
            "m/s",
        )


def _jump(motion: Motion, count: int) -> Iterator[Doubt]:
    carried = {frame: jump for frame, jump in find_jumps(motion, motion.fps).items() if frame < count - 1}
    if carried:  # the same sentence as the rollout's
        worst = max(jump.metres for jump in carried.values())
        yield Doubt("jump", describe_jumps(motion, carried), tuple(sorted(carried)), worst, "m")
    found = find_jumps(motion, motion.fps, BODY_JUMP.value)
    small = {frame: jump for frame, jump in found.items() if frame < count - 1 and frame not in carried}
    if small:
        worst = max(jump.metres for jump in small.values())
        frames = name_frames(mask_of(sorted(small)))
        what = f"{motion.name!r}: the body is displaced by up to {worst:.2g} m from one frame to the next, after {frames}"
        yield Doubt(
            "jump", f"{what}; repair the motion there, or leave it out (start=…, stop=…)", tuple(sorted(small)), worst, "m"
        )


def _overlap(motion: Motion, looked: np.ndarray) -> Iterator[Doubt]:
    """Limbs that pass through each other: cloth between them has no place to be."""
    chosen = looked[np.unique(np.linspace(0, len(looked) - 1, min(len(looked), _HELD_AGAINST_ITSELF)).astype(np.int64))]
    faces = _limbs(motion.faces, motion.num_vertices)
    known, shares = None, []
    for pos in motion.some_points(chosen, 1):
        known = known or eights(faces, pos)
        shares.append(len(np.unique(self_crossings(pos, faces, known))) / max(len(faces), 1))
    share = np.array(shares)
    if (share > BODY_OVERLAP.value).any():
        frames = chosen[share > BODY_OVERLAP.value]
        yield Doubt(
            "body_overlap",
            f"{motion.name!r}: parts of the body lie in each other, {share.max():.1%} of its triangles pass through others in "
            f"frame {int(chosen[share.argmax()])}; cloth between them has no place: give another pose, shape (betas=…) or part "
            "of the motion (start=…, stop=…)",
            tuple(frames.tolist()),
            float(share.max()),
            BODY_OVERLAP.unit,
        )


def _limbs(faces: np.ndarray, num_vertices: int) -> np.ndarray:
    """The faces of the body's large parts."""
    part = connected_components(num_vertices, unique_edges(faces))[faces[:, 0]]
    share = np.bincount(part) / len(faces)
    return faces[share[part] >= _LIMB] if (share >= _LIMB).any() else faces


def _ends_of(template: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(W,) bool: head, soles and hands of a body in T-pose."""
    low, high = template.min(axis=0), template.max(axis=0)
    height, across = (template - low)[:, 1] / (high - low)[1], np.abs(template[:, 0]) / np.abs(template[:, 0]).max()
    return height > 1.0 - _ENDS, height < _ENDS, across > 1.0 - _ENDS


_WAYS_OUT = {
    "density": "density is in kg/m²: 0.2 for a cloth of 200 g/m²",
    "shear stiffness": "it is thickness times lame_mu, in metres and pascals",
    "stretch stiffness": "it is thickness times (2 lame_mu + lame_lambda) times warp or weft, in metres and pascals",
    "bending stiffness": "bending_stiffness is in N·m, four times the bending rigidity: 4e-5 for a cotton shirt",
}


def doubt_fabric(cloth: Cloth, name: str) -> list[Doubt]:
    """What is doubtful about the fabric of garment ``name``: areal density [kg/m²], shear stiffness and, of
    woven cloth, stretch stiffness [N/m], bending [N·m]."""
    stretch = None
    if cloth.weave is not None:
        stretch = cloth.thickness * (2.0 * cloth.lame_mu + cloth.lame_lambda) * cloth.weave[:, :2].min(dim=1).values
    return [
        *_doubt("density", cloth.density, DENSITY_KNOWN, name),
        *_doubt("shear stiffness", cloth.thickness * cloth.lame_mu, SHEAR_KNOWN, name),
        *_doubt("stretch stiffness", stretch, STRETCH_KNOWN, name),
        *_doubt("bending stiffness", cloth.bending_stiffness, BENDING_KNOWN, name),
    ]


def _doubt(what: str, values: Tensor | None, known: Range, name: str) -> Iterator[Doubt]:
    if values is None or not values.numel():
        return
    low, high = (float(edge(values.double())) for edge in (torch.min, torch.max))
    strange = high if high > known.most else low if low < known.least else None
    if strange is None:
        return
    yield Doubt(
        "fabric",
        f"garment {name!r}: its {what} is {strange:.3g} {known.unit}, cloth has {known.least:g} to {known.most:g} "
        f"({known.reason}); {_WAYS_OUT[what]}",
        (),
        strange,
        known.unit,
    )
