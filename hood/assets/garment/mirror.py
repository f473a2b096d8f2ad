"""Mirror images x → −x of bodies and garments: a world in which nothing prefers a side.

Reflection is done on geometry, vertex by vertex, so bodies and garments need no symmetry and no table of left and right
partners. Windings are reversed, so that outward stays outward.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.assets.garment.pins import MARKS
from hood.assets.motion.sequence import PoseSequence
from hood.mesh.flat import SIDE_TABLES

_SIDES = np.array([-1.0, 1.0, 1.0])


def _other_side(name: str) -> str:
    """The region that `name` becomes in a mirror: left and right change places."""
    head, _, side = name.rpartition("_")
    return f"{head}_{'right' if side == 'left' else 'left'}" if side in ("left", "right") else name


#: Region (len(MARKS),) that each region becomes in a mirror.
_OTHER_SIDE = np.array([MARKS.index(_other_side(name)) for name in MARKS])
#: Corner tables of a garment: turned over with its faces.
_CORNERS = ("faces", "uv_faces", "normal_faces", *SIDE_TABLES)


def reflect(values: Tensor) -> Tensor:
    """Points or vectors (..., 3) with the first coordinate negated; exact, and its own inverse."""
    return values * torch.as_tensor(_SIDES).to(values)


@dataclass(frozen=True)
class MirroredBody(Body):
    """The mirror image of ``original``: what it performs is the mirror image of the motion it is given.

    Vertex ``k`` is the image of vertex ``k``, so the left hand's indices lie in a right hand. Whatever poses the original
    poses the image, to the last bit.
    """

    original: Body = None  # type: ignore[assignment]

    def transforms(self, sequence: PoseSequence, betas: np.ndarray, dtype: torch.dtype = torch.float32) -> Tensor:
        """(T, J, 3, 4): S [R | t] S for the original's [R | t], S = diag(−1, 1, 1)."""
        posed = self.original.transforms(sequence, betas, dtype)
        sides = torch.as_tensor(np.append(_SIDES, 1.0)).to(posed)
        return sides[:3, None] * posed * sides

    def translation(self, sequence: PoseSequence, betas: np.ndarray) -> np.ndarray:
        """(T, 3) m, float64: the image of the original's."""
        return self.original.translation(sequence, betas) * _SIDES

    def surface(self, sequence: PoseSequence, betas: np.ndarray, dtype: torch.dtype = torch.float32) -> Tensor:
        """Posed vertices (T, W, 3) [m] relative to :meth:`translation`."""
        return reflect(self.original.surface(sequence, betas, dtype))


def mirror_body(body: Body) -> MirroredBody:
    """The image of ``body``."""
    kept = {spec.name: getattr(body, spec.name) for spec in fields(Body)}
    image = {
        "name": _image_name(body.name),
        "v_template": body.v_template * _SIDES,
        "shapedirs": body.shapedirs * _SIDES[:, None],
        "faces": np.ascontiguousarray(body.faces[:, ::-1]),
    }
    return MirroredBody(**kept | image, original=body)


def mirror_garment(garment: Garment) -> Garment:
    """The image of a garment, bound to the image of the body it was bound to."""
    image: dict[str, Any] = {"rest_pos": garment.rest_pos * _SIDES}
    image |= {key: _reversed(table) for key in _CORNERS if (table := getattr(garment, key)) is not None}
    if garment.flat is not None:
        image["flat"] = _reversed(garment.flat) * [-1.0, 1.0]
    if garment.shapedirs is not None:
        image["shapedirs"] = garment.shapedirs * _SIDES[:, None]
    if garment.skin_pos is not None:
        image["skin_pos"] = garment.skin_pos * _SIDES
    if garment.rest_turn is not None:
        image["rest_turn"] = _SIDES[:, None] * garment.rest_turn * _SIDES
    if garment.region is not None:
        image["region"] = _OTHER_SIDE[garment.region]
    if garment.riders is not None:
        riders = garment.riders
        uv_faces = None if riders.uv_faces is None else _reversed(riders.uv_faces)
        image["riders"] = replace(riders, pos=riders.pos * _SIDES, faces=_reversed(riders.faces), uv_faces=uv_faces)
    if garment.bound_to is not None:
        image["bound_to"] = _image_name(garment.bound_to)
    return replace(garment, **image)


#: Corner tables of a garment: turned over with its faces.
_CORNERS = ("faces", "uv_faces", "normal_faces", *SIDE_TABLES)


def _reversed(faces: np.ndarray) -> np.ndarray:
    """Triangles (F, 3) of the other winding."""
    return np.ascontiguousarray(faces[:, ::-1])


def _image_name(name: str) -> str:
    return f"{name} (mirrored)"
