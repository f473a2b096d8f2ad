"""Cloth that is held farther off where a step left its triangles in the skin.

Contact acts at vertices, and how far off it holds them is an estimate of how deep the flat triangles between them sag
(:mod:`hood.scene.reach`). Where cloth is heavy, very soft or coarse, or lands fast, the estimate can be too small. Where a step
has left triangles in the skin is known afterwards: their corners are held farther off, and the step is taken to its end again.
"""

from __future__ import annotations

import weakref
from dataclasses import replace
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from hood.mesh.compiled_crossing import Eights, eights
from hood.mesh.crossing import crossings
from hood.mesh.kept import forget
from hood.scene.cloth import Cloth
from hood.scene.contact import Contact
from hood.scene.state import Obstacle

#: Up to this share of a garment's triangles may be in the skin.
CUT_SHARE = 0.005
#: Corners of a triangle in the skin are held off by so much more [m], by twice as much where that was not enough, and by no
#: more than that in all.
RISE, MOST = 3e-3, 45e-3


def hold_off(
    next_pos: Tensor, cloth: Cloth, obstacle: Obstacle, contact: Contact, scenes: Tensor | None = None
) -> Contact | None:
    """The contact of a step that holds the triangles farther off that its solution ``next_pos`` (V, 3) [m] has left in the
    skin; None where these are few, or cannot be held farther off.

    Args:
        scenes: (B,) bool, where that may be done; None for everywhere.
    """
    before = torch.zeros_like(contact.dist) if contact.raised is None else contact.raised
    rows = torch.zeros_like(contact.valid)
    for cut in _cut_faces(next_pos, cloth, obstacle):
        rows[cut.reshape(-1)] = True
    after = (2.0 * before + RISE).clamp_max(MOST)
    rows &= contact.valid & cloth.free & (before + 0.5 * RISE < MOST)
    if scenes is not None:
        rows &= scenes[cloth.vertex_scene]
    return replace(contact, raised=torch.where(rows, after, before)) if bool(rows.any()) else None


def num_in_skin(next_pos: Tensor, cloth: Cloth, obstacle: Obstacle) -> Tensor:
    """Number (B,) int64 of the triangles of every scene that are in the skin at ``next_pos`` (V, 3) [m]."""
    return torch.tensor([len(cut) for _, cut in _cut(next_pos, cloth, obstacle)], device=next_pos.device)


def _cut_faces(next_pos: Tensor, cloth: Cloth, obstacle: Obstacle) -> list[Tensor]:
    """Corners (N, 3) of the triangles in the skin, of every scene that has more than :data:`CUT_SHARE`."""
    if not bool(torch.isfinite(next_pos).all()):
        return []
    found = _cut(next_pos, cloth, obstacle)
    return [faces[torch.as_tensor(cut, device=faces.device)] for faces, cut in found if len(cut) > CUT_SHARE * len(faces)]


def _cut(next_pos: Tensor, cloth: Cloth, obstacle: Obstacle) -> list[tuple[Tensor, np.ndarray]]:
    """Faces (F, 3) of the cloth of every scene, and the numbers of those in the skin."""
    found = []
    pos, skin = next_pos.double().cpu().numpy(), obstacle.next_pos.double().cpu().numpy()
    for faces, body in _by_scene(cloth, obstacle):
        cut = np.empty(0, dtype=np.int64)
        if len(faces) and len(body):
            both = _ordered(faces, pos), _ordered(body, skin)
            given = None if both[0] is None or both[1] is None else (both[0], both[1])
            cut = np.unique(crossings(pos, faces.cpu().numpy(), skin, body.cpu().numpy(), given).pairs[:, 0])
        found.append((faces, cut))
    return found


def _by_scene(cloth: Cloth, obstacle: Obstacle) -> list[tuple[Tensor, Tensor]]:
    """Faces of the cloth and of the body of every scene; scenes lie in one place and must not be compared."""
    if cloth.num_scenes == 1:
        return [(cloth.faces, obstacle.faces)]
    ends = np.cumsum([0, *cloth.scene_sizes])
    scenes = enumerate(pairwise(ends))
    first = cloth.faces[:, 0]
    return [(cloth.faces[(first >= a) & (first < b)], obstacle.faces[obstacle.face_scene == n]) for n, (a, b) in scenes]


_Known = tuple[weakref.ref[Tensor], Eights | None]
_EIGHTS: dict[int, _Known] = {}


def _ordered(faces: Tensor, pos: np.ndarray) -> Eights | None:
    """The faces (F, 3) in the order of a search, kept as long as they live."""
    known = _EIGHTS.get(id(faces))
    if known is None or known[0]() is not faces:
        known = _EIGHTS[id(faces)] = weakref.ref(faces, forget(_EIGHTS, id(faces))), eights(faces.cpu().numpy(), pos)
    return known[1]
