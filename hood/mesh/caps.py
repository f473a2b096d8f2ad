"""Faces without height: a corner lies on the opposite edge."""

from __future__ import annotations

import numpy as np

from hood.mesh.defects import aspects

#: Faces lower than this share of their longest edge are caps.
FLAT = 1e-3


def find_caps(pos: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F,) bool: faces (F, 3) of ``pos`` (V, 3) whose height is less than :data:`FLAT` of their longest edge, but not 0."""
    found = aspects(pos, faces)
    return np.asarray(np.isfinite(found) & (found * FLAT > 1.0))


def turn_caps(pos: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Every cap and the face behind its longest edge divided along the other diagonal; a cap without one left out.

    Returns:
        The corners of the new faces (F', 3, 2), each as (face, corner) of the old one that it is taken from; the old face
        (F',) that stands for each, the one that is no cap; and how many caps there were. Caps whose neighbour cannot be
        divided stay.
    """
    corners = np.stack([np.repeat(np.arange(len(faces))[:, None], 3, axis=1), np.tile(np.arange(3), (len(faces), 1))], axis=2)
    parent, kept, touched, count = np.arange(len(faces)), np.ones(len(faces), bool), np.zeros(len(faces), bool), 0
    caps = np.flatnonzero(find_caps(pos, faces))
    owners: dict[tuple[int, int], list[int]] = {}
    if len(caps):
        for face, row in enumerate(faces.tolist()):
            for i in range(3):
                owners.setdefault((row[i], row[(i + 1) % 3]), []).append(face)
    for cap in caps.tolist():
        sides = np.linalg.norm(pos[faces[cap]] - pos[np.roll(faces[cap], -1)], axis=1)
        i = int(sides.argmax())  # from a to b; n lies on it
        a, b = int(faces[cap, i]), int(faces[cap, (i + 1) % 3])
        behind, same = owners.get((b, a), []), owners.get((a, b), [])
        if touched[cap] or len(same) != 1 or len(behind) > 1 or any(touched[behind]):
            continue
        count += 1
        touched[cap] = True
        if not behind:
            kept[cap] = False
            continue
        (other,) = behind
        touched[other] = True
        j = int(np.flatnonzero(faces[other] == b)[0])
        n, at_b, at_a, d = (cap, (i + 2) % 3), (other, j), (other, (j + 1) % 3), (other, (j + 2) % 3)
        corners[cap], corners[other] = (n, at_a, d), (at_b, n, d)
        parent[cap] = other
    return corners[kept], parent[kept], count
