"""Groups of vertices that share no element and can move at the same time, and the elements around each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hood.scene.cloth import Cloth
from hood.scene.state import Attachments
from hood.solver.pattern import BlockPattern, Scatter, upper_pairs
from hood.solver.plan import SolverPlan


@dataclass(frozen=True)
class Incidence:
    """Elements that touch the n vertices of a colour; each touches one of them, its *own* corner, and only that."""

    element: Tensor  # (M,) rows of the element table
    own: Tensor  # (M,) position of the own corner in its row
    gradient_sum: Scatter  # (3, M) → (n, 3)
    matrix_sum: Scatter  # upper triangles (6, M) → (n, 3, 3)


@dataclass(frozen=True)
class Colour:
    """One group of free vertices and what acts on them."""

    vertices: Tensor  # (n,)
    faces: Incidence
    hinges: Incidence
    attachments: Incidence | None


def greedy_colours(pattern: BlockPattern) -> np.ndarray:
    """Colour (N,) of every block row, none shared between coupled rows; rows with most couplings choose first."""
    colour = np.full(pattern.size, -1, dtype=np.int64)
    starts, cols = pattern.starts.tolist(), pattern.cols
    for row in np.argsort(-np.diff(pattern.starts), kind="stable").tolist():
        taken = set(colour[cols[starts[row] : starts[row + 1]]].tolist())
        choice = 0
        while choice in taken:
            choice += 1
        colour[row] = choice
    return colour


def colours_of(plan: SolverPlan, cloth: Cloth, attachments: Attachments | None) -> list[Colour]:
    """The colours of a plan's free vertices, computed on first use."""
    if "colours" not in plan.cache:
        plan.cache["colours"] = _build(plan, cloth, attachments)
    colours = plan.cache["colours"]
    assert isinstance(colours, list)
    return colours


def _build(plan: SolverPlan, cloth: Cloth, attachments: Attachments | None) -> list[Colour]:
    colour = greedy_colours(plan.pattern)
    vertices = plan.vertices.cpu().numpy()
    tables = [cloth.faces, cloth.hinges] + ([] if attachments is None else [attachments.edges])
    numpy_tables = [table.cpu().numpy() for table in tables]
    device = cloth.faces.device
    colours = []
    for index in range(int(colour.max(initial=-1)) + 1):
        group = vertices[colour == index]
        place = np.full(cloth.num_vertices, -1, dtype=np.int64)
        place[group] = np.arange(len(group))
        around = [_incidence(table, place, len(group), device) for table in numpy_tables]
        group_index = torch.as_tensor(group, device=device)
        colours.append(Colour(group_index, around[0], around[1], around[2] if len(around) > 2 else None))
    return colours


def _incidence(table: np.ndarray, place: np.ndarray, size: int, device: torch.device) -> Incidence:
    element, own = np.nonzero(place[table] >= 0)
    target = place[table[element, own]]
    axis, count = np.arange(3)[:, None], len(target)
    mirrored = sorted({(k, *pair) for k, (p, q) in enumerate(upper_pairs(3)) for pair in ((p, q), (q, p))})
    source, row, col = (np.array(part)[:, None] for part in zip(*mirrored, strict=True))
    return Incidence(
        torch.as_tensor(element, device=device),
        torch.as_tensor(own, device=device),
        Scatter(3 * target + axis, axis * count + np.arange(count), 3 * size, 3 * count),
        Scatter(9 * target + 3 * row + col, source * count + np.arange(count), 9 * size, 6 * count),
    )
