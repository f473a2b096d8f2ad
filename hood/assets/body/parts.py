"""Parts of a body by name: what follows a joint, what is above or below one, listed vertices."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hood.assets.body.body import JOINTS, Body
from hood.assets.files.library import unknown
from hood.assets.files.text import read_indices


def body_part(part: str, faces: np.ndarray, num_vertices: int, body: Body | None) -> np.ndarray:
    """(G,) bool: the faces of a part of a body. A face is of the side of its centre, or of most of its corners.

    Args:
        part: a joint, whose part is what follows it most (``left_wrist``); ``above_JOINT`` or ``below_JOINT``, by the height in
            T-pose; or the path of a ``.txt`` or ``.json`` list of vertices.
        faces: (G, 3) of the body's surface.
        num_vertices: W.
        body: whose joints are meant; None where the surface has none, and is known by its vertices alone.

    Raises:
        ValueError: the body has no such part, or no face in it; names what there is.
    """
    side, _, joint = part.partition("_")
    if Path(part).suffix.lower() in (".txt", ".json"):
        found = _listed(Path(part).expanduser(), faces, num_vertices)
    elif side in ("above", "below") and joint:
        of, number = _joint(part, joint, body)
        height = of.v_template[faces].mean(axis=1)[:, 1]
        level = of.shaped(np.zeros(0))[1][number, 1]
        found = height > level if side == "above" else height <= level
    else:
        of, number = _joint(part, part, body)
        follows = of.weights.argmax(axis=1) == number
        found = follows[faces].sum(axis=1) >= 2
    if not found.any():
        raise ValueError(f"part {part!r}: no face of the body is in it; leave it out, or choose another")
    return np.asarray(found)


def _joint(part: str, name: str, body: Body | None) -> tuple[Body, int]:
    """The body, and the number of its joint ``name``."""
    if body is None:
        raise ValueError(f"part {part!r}: this body has no joints; give a .txt or .json list of its vertices")
    if name not in JOINTS:
        raise ValueError(f"part {part!r}: {unknown('joint', name, JOINTS)}; above_JOINT, below_JOINT, or a list of vertices")
    if JOINTS.index(name) >= body.num_joints:
        raise ValueError(f"part {part!r}: the body has {body.num_joints} joints and no {name}; give another part")
    return body, JOINTS.index(name)


def _listed(path: Path, faces: np.ndarray, count: int) -> np.ndarray:
    numbers = read_indices(path)
    outside = (numbers < 0) | (numbers >= count)
    if outside.any():
        raise ValueError(f"{path}: vertex {int(numbers[np.argmax(outside)])} of {count} of the body; they are numbered from 0")
    inside = np.zeros(count, dtype=bool)
    inside[numbers] = True
    return np.asarray(inside[faces].sum(axis=1) >= 2)
