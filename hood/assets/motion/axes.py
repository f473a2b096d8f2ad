"""The axes that can point up in a file, and the turn that makes y of each."""

from __future__ import annotations

import numpy as np

#: The turn (3, 3) that makes y of an axis which points up in a file, by the axis. Row 1 is the axis itself; z (AMASS) goes
#: (x, y, z) → (x, z, -y), and -y, of cameras, (x, -y, -z).
UP_AXES = {
    "y": np.eye(3),
    "z": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "x": np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    "-y": np.diag([1.0, -1.0, -1.0]),
    "-z": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "-x": np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
}
Z_UP_TO_Y_UP = UP_AXES["z"]


def require_up(up: str) -> None:
    """Raise ValueError unless ``up`` is an axis of :data:`UP_AXES` or "auto"."""
    if up not in (*UP_AXES, "auto"):
        raise ValueError(f"up={up}: give z (AMASS), y, x, -y (cameras), -z, -x or auto, the axis that points up in the file")
