"""A room with a floor and a wall, and obstacles made of surfaces, for tests of contact."""

import numpy as np
import torch

from hood.cloth.state import Obstacle
from hood.testing import grid


def obstacle(pos: np.ndarray, faces: np.ndarray, later: np.ndarray | None = None) -> Obstacle:
    now, after = torch.as_tensor(pos), torch.as_tensor(pos if later is None else later)
    return Obstacle(now, after, now, torch.as_tensor(faces), torch.zeros(len(pos)).long(), torch.zeros(len(faces)).long())


def corner() -> tuple[np.ndarray, np.ndarray]:
    """A floor, y = 0, and a wall on it, x = 0, whose free side is x < 0; the wall's vertices are the second half."""
    floor, faces = grid(17, 17, 0.8)
    floor = floor.copy() - [0.4, 0.0, 0.4]
    wall = floor[:, [1, 0, 2]] + [0.0, 0.4, 0.0]
    down = np.cross(*(floor[faces[0, i]] - floor[faces[0, 0]] for i in (1, 2)))[1] < 0
    side = np.cross(*(wall[faces[0, i]] - wall[faces[0, 0]] for i in (1, 2)))[0] > 0
    both = [faces[:, ::-1] if turned else faces for turned in (down, side)]
    return np.concatenate([floor, wall]), np.concatenate([both[0], both[1] + len(floor)])
