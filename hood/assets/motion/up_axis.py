"""The up axis of a recorded motion, found from the poses."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from hood.assets.motion.recording import Recording

#: The pelvis points along an axis where its component there is beyond the first, and the body stands along it with that in
#: this share of the frames.
_ALONG, _MOSTLY = 0.7, 0.8
#: Heights [m] of the pelvis above a floor at 0, lying and standing.
_LYING, _STANDING = (-0.1, 0.4), (0.5, 1.5)


class Bearing(NamedTuple):
    """The up axis by the poses; ``sure`` unless a body that lies on the floor of its layout's world would look the same."""

    axis: str  # "y" or "z"
    sure: bool


def find_bearing(recording: Recording) -> Bearing:
    """The axis along which the body stands; that of the layout where the poses do not tell."""
    up = Rotation.from_rotvec(recording.poses[:, 0]).apply([0.0, 1.0, 0.0])
    other = "y" if recording.up == "z" else "z"
    column = "xyz".index(other)
    if float((up[:, column] > _ALONG).mean()) < _MOSTLY:
        return Bearing(recording.up, True)
    # A body that lies along that axis all the time: low above the floor of its layout, and not at a standing height else.
    height, along = np.median(recording.transl[:, "xyz".index(recording.up)]), np.median(recording.transl[:, column])
    lies = _LYING[0] < height < _LYING[1] and not _STANDING[0] < along < _STANDING[1]
    return Bearing(other, not lies)


def bearing_notice(path: Path, recording: Recording) -> tuple[str, str | None]:
    """The up axis to take, and the sentence that says so where it is not that of the layout; None where it is."""
    found = find_bearing(recording)
    if found.axis == recording.up:
        return recording.up, None
    what = f"{path}: its body stands along {found.axis}, though {recording.up} is up in files with its keys"
    if found.sure:
        return found.axis, f"{what}; it is taken as {found.axis} up (up={found.axis} says so, up={recording.up} lays it down)"
    return recording.up, f"{what}, or it lies on the floor; pass up={found.axis} if it stands, up={recording.up} if it lies"
