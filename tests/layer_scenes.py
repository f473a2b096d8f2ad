"""Scenes in which cloth meets cloth; all of them start clean."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.cloth.state import Obstacle
from hood.energies.problem import StepProblem
from hood.testing import box, grid, make_problem, sphere


def _obstacle(pos: np.ndarray, faces: np.ndarray) -> Obstacle:
    there, index = torch.as_tensor(pos), torch.as_tensor(faces)
    vertex, face = torch.zeros(len(pos), dtype=torch.int64), torch.zeros(len(faces), dtype=torch.int64)
    return Obstacle(there, there, there, index, vertex, face)


def _problem(
    rest: np.ndarray, faces: np.ndarray, pos: np.ndarray, obstacle: Obstacle, dt: float, pinned: np.ndarray | None = None
):
    cloth = build_cloth(rest, faces, Material(), pinned=pinned, dtype=torch.float64)
    problem = make_problem(cloth, pos, dt=dt)
    return replace(problem, step=replace(problem.step, obstacle=obstacle))


def _stacked(sheet: tuple[np.ndarray, np.ndarray], count: int, gap: float) -> tuple[np.ndarray, np.ndarray]:
    pos, faces = sheet
    shift = np.array([0.011, gap, 0.007])
    return np.concatenate([pos + i * shift for i in range(count)]), np.concatenate([faces + i * len(pos) for i in range(count)])


def _floor() -> Obstacle:
    pos, faces = grid(2, 2, 4.0)
    return _obstacle(pos - np.array([2.0, 0.0, 2.0]), faces)


def folding_strip(dt: float, n: int = 100) -> StepProblem:
    """A strip that stands on its short edge and folds as it falls on the floor."""
    flat, faces = grid(n, 4, 1.0)
    pos = flat * np.array([1.0, 1.0, 0.06])
    standing = np.stack([0.002 * np.sin(40.0 * pos[:, 0]), 0.02 + pos[:, 0], pos[:, 2]], axis=1)
    return _problem(pos, faces, standing, _floor(), dt)


def sheet_over_bar(dt: float, n: int = 21) -> StepProblem:
    """A sheet that falls over a bar so thin that its halves close below it."""
    pos, faces = grid(n, n, 0.5)
    bar, sides = box(6, 1.0)
    long = bar * np.array([0.02, 0.02, 0.8])
    return _problem(pos, faces, pos + np.array([-0.24, 0.02, -0.25]), _obstacle(long, sides), dt)


def sheets_on_sphere(dt: float, n: int = 21, count: int = 2, gap: float = 0.01) -> StepProblem:
    """Sheets over each other that fall on a ball."""
    pos, faces = _stacked(grid(n, n, 0.6), count, gap)
    start = pos + np.array([-0.3, 0.16, -0.3])
    return _problem(pos, faces, start, _obstacle(*sphere(3, 0.15)), dt)


def stack(dt: float, n: int = 9, count: int = 10) -> StepProblem:
    """Sheets that fall on each other on the floor."""
    pos, faces = _stacked(grid(n, n, 0.3), count, 0.006)
    return _problem(pos, faces, pos + np.array([0.0, 0.005, 0.0]), _floor(), dt)


SCENES = {
    "folding_strip": folding_strip,
    "sheet_over_bar": sheet_over_bar,
    "sheets_on_sphere": sheets_on_sphere,
    "stack": stack,
}


def sheet_on_slope(dt: float, degrees: float, gap: float = 1.2e-3) -> tuple[StepProblem, int, np.ndarray]:
    """A small sheet at rest above a held one that is inclined; the first vertex of the small one, and the way down (3,)."""
    under, sides = grid(9, 9, 0.4)
    over, faces = grid(5, 5, 0.1)
    rest = np.concatenate([under, over + np.array([0.1513, gap, 0.1497])])
    turn = np.deg2rad(degrees)
    down = np.array([np.cos(turn), -np.sin(turn), 0.0])
    frame = np.stack([down, [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]], axis=1)
    pinned = np.arange(len(rest)) < len(under)
    cloth = build_cloth(rest, np.concatenate([sides, faces + len(under)]), Material(), pinned=pinned, dtype=torch.float64)
    problem = make_problem(cloth, rest @ frame.T, dt=dt)
    return replace(problem, step=replace(problem.step, pin_target=problem.state.pos)), len(under), down
