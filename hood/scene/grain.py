"""Warp of a garment's faces: where the threads run that go along a piece of the pattern."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

#: A face within this sine of the horizontal has its warp along z: the vertical does not tell one there.
_LEVEL = 0.1
#: Texture triangles whose edges have a smaller sine between them have no directions.
_FLAT = 1e-6


def grain_of(pos: np.ndarray, faces: np.ndarray, uv: tuple[np.ndarray, np.ndarray] | None = None) -> np.ndarray:
    """Warp of every face as shares of its edges x₁ - x₀ and x₂ - x₀, (F, 2): a direction in the cloth, however it is shaped.

    The warp runs along v of the texture coordinates, the weft across it in the face, about along u. Where there are none it
    runs along the vertical at rest, and along z on faces that are horizontal.

    Args:
        pos: (V, 3) m at rest, y up.
        faces: (F, 3).
        uv: texture coordinates (U, 2) and which the corners of every face have, (F, 3).
    """
    edges = pos[faces[:, 1:]] - pos[faces[:, :1]]  # (F, edge, axis)
    metric = np.einsum("fix,fjx->fij", edges, edges)
    normal = np.cross(edges[:, 0], edges[:, 1])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    level = np.hypot(normal[:, 0], normal[:, 2]) < _LEVEL
    axis = np.where(level[:, None], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0])
    grain = np.linalg.solve(metric, np.einsum("fix,fx->fi", edges, axis)[..., None])[..., 0]
    if uv is not None:
        table = uv[0][uv[1][:, 1:]] - uv[0][uv[1][:, :1]]
        area = table[:, 0, 0] * table[:, 1, 1] - table[:, 0, 1] * table[:, 1, 0]
        laid = np.abs(area) > _FLAT * np.linalg.norm(table, axis=2).prod(axis=1)
        along = np.stack([-table[:, 1, 0], table[:, 0, 0]], axis=1) / np.where(laid, area, 1.0)[:, None]
        grain = np.where(laid[:, None], along, grain)
    # Of the length of a typical edge: what textures count in is no matter.
    return grain / np.sqrt(np.einsum("fi,fij,fj->f", grain, metric, grain) / np.einsum("fii->f", metric))[:, None]


def along_grain(rest_inverse: Tensor, grain: Tensor) -> Tensor:
    """Inverse rest edge matrices (F, 2, 2) [1/m] in frames whose first axis is the warp (F, 2); as given where that is zero."""
    ((a, b), (c, d)) = (row.unbind(dim=1) for row in rest_inverse.unbind(dim=1))
    first, second = grain.unbind(dim=1)
    x, y = d * first - b * second, a * second - c * first  # the warp in the frame as it is, times the determinant
    length = torch.hypot(x, y)
    scale = torch.where(length > 0, length, 1.0)
    cos, sin = torch.where(length > 0, x / scale, 1.0), y / scale
    return torch.stack([a * cos + b * sin, b * cos - a * sin, c * cos + d * sin, d * cos - c * sin], dim=1).reshape(-1, 2, 2)
