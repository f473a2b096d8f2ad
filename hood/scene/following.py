"""Pins that go with the skin: points of the body's surface that held vertices ride on, and springs towards them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hood.assets.body.body import body_part
from hood.assets.garment.garment import Garment
from hood.assets.garment.pins import PinGroup
from hood.mesh.closest_point.search import search_surface
from hood.scene.body_motion.mesh_motion import MeshMotion
from hood.scene.body_motion.motion import BodyMotion, Motion

#: A vertex farther than this [m] from what it is to follow is not worn there.
SKIN_REACH = 0.3
#: Spring constant [N/m] of a vertex of weight ½; of a weight w it is this times w / (1 - w).
STIFFNESS = 10.0
#: The whole surface, as what pins follow.
SKIN = "skin"


def stiffness_of(weights: np.ndarray) -> np.ndarray:
    """Spring constants [N/m] (P,) of soft pins of weights (P,) from 0 to below 1: 10 w / (1 - w)."""
    return STIFFNESS * weights / (1.0 - weights)


def part_of(motion: Motion, part: str) -> np.ndarray:
    """(G,) bool: the faces of a part of the body, as :func:`hood.assets.body.body.body_part` names them.

    Raises:
        ValueError: the body has no such part; names what there is.
    """
    body = motion.body if isinstance(motion, BodyMotion) else None
    bones = motion.sequence.bones if isinstance(motion, MeshMotion) else None
    return body_part(part, motion.faces, motion.num_vertices, body, bones)


@dataclass(frozen=True)
class Ride:
    """Points that keep their places beside triangles of the body: P vertices of the garment, each with one of its own."""

    vertices: np.ndarray  # (P,) of the garment
    corners: np.ndarray  # (P, 3) vertices of the body
    shares: np.ndarray  # (P, 3) barycentric coordinates of the nearest point of the skin
    offset: np.ndarray  # (P, 3) m from there: along the first edge, across it in the plane, along the normal

    def skin(self, surface: np.ndarray) -> np.ndarray:
        """(P, 3) m: their points of the body ``surface`` (W, 3)."""
        return np.asarray(np.einsum("pc,pcx->px", self.shares, surface[self.corners]))

    def places(self, surface: np.ndarray) -> np.ndarray:
        """(P, 3) m: where they are beside the body ``surface`` (W, 3)."""
        return self.skin(surface) + np.einsum("pa,pax->px", self.offset, _frames(surface[self.corners]))


def _frames(corners: np.ndarray) -> np.ndarray:
    """(P, 3, 3): of triangles (P, 3, 3) the direction of the first edge, that across it and the normal, as rows."""
    normal = _unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    along = _unit(corners[:, 1] - corners[:, 0])
    return np.stack([along, np.cross(normal, along), normal], axis=1)


def _unit(rows: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(rows, axis=1, keepdims=True)
    return np.asarray(rows / np.where(length > 0, length, 1.0))


def ride_on(pos: np.ndarray, vertices: np.ndarray, surface: np.ndarray, faces: np.ndarray) -> tuple[Ride, np.ndarray]:
    """What carries ``vertices`` (P,) at ``pos`` (P, 3) [m] along with the nearest points of the triangles ``faces`` (G, 3) of
    ``surface`` (W, 3), and how far [m] (P,) these are."""
    corners = surface[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    faces = faces[area > 0]  # others have no frame
    tables = [torch.as_tensor(np.ascontiguousarray(table)) for table in (pos, surface, faces)]
    scenes = [torch.zeros(len(table), dtype=torch.int64) for table in tables]
    hit = search_surface(tables[0], scenes[0], tables[1], tables[2], scenes[1], scenes[2])
    ride = Ride(vertices, faces[hit.face.numpy()], hit.bary.double().numpy(), np.zeros((len(pos), 3)))
    away = pos - ride.skin(surface)
    offset = np.einsum("pax,px->pa", _frames(surface[ride.corners]), away)
    return Ride(ride.vertices, ride.corners, ride.shares, offset), np.linalg.norm(away, axis=1)


@dataclass(frozen=True)
class Held:
    """How the vertices that ``pins`` names are held: what they ride on, and springs in place of a hold."""

    groups: tuple[PinGroup, ...]  # what ``pins`` names; of a vertex in several the last counts
    ride: Ride | None = None  # of those that follow the skin
    stiffness: Tensor | None = None  # (V,) N/m of springs, 0 where there is none; None: all are held exactly

    def placed(self, pos: Tensor, surface: Tensor) -> Tensor:
        """``pos`` (V, 3) [m] of the skinned garment with what rides on the skin beside the ``surface`` (W, 3)."""
        if self.ride is None:
            return pos
        there = self.ride.places(surface.detach().cpu().double().numpy())
        rows = torch.as_tensor(self.ride.vertices, device=pos.device)
        return pos.index_copy(0, rows, torch.as_tensor(there).to(pos))


def held_by(groups: Sequence[PinGroup], motion: Motion, garment: Garment) -> Held | None:
    """What holds a dressed ``garment`` in ``motion`` as ``groups`` say, from the first frame on; None where all of it is held
    exactly and goes with the skinned garment. Of a vertex in several groups the last counts.

    Raises:
        ValueError: there is no body, no such part of it, or none near a vertex that is to follow it.
    """
    if all(group.follows is None and group.exact.all() for group in groups):
        return None
    count, stiffness = len(garment.rest_pos), np.zeros(len(garment.rest_pos))
    last = np.full(count, -1)
    for number, group in enumerate(groups):
        stiffness[group.vertices] = np.where(group.exact, 0.0, stiffness_of(np.where(group.exact, 0.0, group.weights)))
        last[group.vertices] = number
    origin = motion.translation[0]
    pos = motion.skinned(garment, 0, origin).cpu().double().numpy()
    surface = motion.surface(0, origin).cpu().double().numpy()
    rides = []
    for number, group in enumerate(groups):
        rows = np.flatnonzero(last == number)
        if group.follows is not None and len(rows):
            rides.append(_ride(group, rows, pos, surface, motion))
    ride = None
    if rides:
        ride = Ride(*(np.concatenate([getattr(one, name) for one in rides]) for name in Ride.__dataclass_fields__))
    springs = torch.as_tensor(stiffness).to(motion.device, motion.dtype) if stiffness.any() else None
    return Held(tuple(groups), ride, springs)


def _ride(group: PinGroup, rows: np.ndarray, pos: np.ndarray, surface: np.ndarray, motion: Motion) -> Ride:
    if not len(surface):
        raise ValueError(f"{group.where}: follows={group.whom}, but there is no body; leave follows out")
    ride, dist = ride_on(pos[rows], rows, surface, motion.faces[_followed_faces(group, motion)])
    far = int(dist.argmax())
    if dist[far] > SKIN_REACH:
        raise ValueError(
            f"{group.where}: vertex {rows[far]} is {dist[far]:.2f} m from the nearest skin of what it is to follow "
            f"({group.whom}), beyond {SKIN_REACH:g} m; let it follow another part, or leave follows out"
        )
    return ride


def _followed_faces(group: PinGroup, motion: Motion) -> np.ndarray:
    """(G,) bool: the faces of the body that a group follows."""
    if group.follows == SKIN:
        return np.ones(len(motion.faces), dtype=bool)
    if isinstance(group.follows, str):
        try:
            return part_of(motion, group.follows)
        except ValueError as error:
            raise ValueError(f"{group.where}: follows: {error}") from error
    numbers = np.array(group.follows)
    outside = (numbers < 0) | (numbers >= motion.num_vertices)
    if outside.any():
        raise ValueError(
            f"{group.where}: follows: vertex {numbers[outside.argmax()]} of {motion.num_vertices} of the body; they are "
            "numbered from 0"
        )
    inside = np.isin(motion.faces, numbers).sum(axis=1) >= 2
    if not inside.any():
        raise ValueError(f"{group.where}: follows: no face of the body has two of its {len(numbers)} vertices; name more")
    return np.asarray(inside)
