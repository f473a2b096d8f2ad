"""A sheet with its thickness is a closed shell, by a library that is not ours."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from hood.mesh.editing.subdivision import Extrusion
from hood.testing import cylinder, grid, sphere

THICK = 3e-3


def _mesh(pos: np.ndarray, shell: Extrusion, thickness: float = THICK) -> trimesh.Trimesh:
    return trimesh.Trimesh(shell.positions(pos, np.full((len(pos), 2), thickness / 2.0)), shell.faces, process=False)


def _moebius(count: int = 24, width: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    """One side only: no winding of its faces agrees everywhere."""
    angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    rows = []
    for side in (-width, width):
        out = 1.0 + side * np.cos(angle / 2.0)
        rows.append(np.stack([out * np.cos(angle), out * np.sin(angle), side * np.sin(angle / 2.0)], axis=1))
    faces = []
    for here in range(count):
        low, high = (here + 1, here + 1 + count) if here + 1 < count else (count, 0)
        faces += [[here, low, here + count], [here + count, low, high]]
    return np.concatenate(rows), np.array(faces)


LEAVES = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]])
SHEETS = {
    "tube": cylinder(24, 12, 0.2, 0.5),
    "closed": sphere(2, 0.3),
    "pocket": (LEAVES, np.array([[0, 1, 2], [1, 0, 3], [1, 0, 4]])),
    "wound against each other": (LEAVES, np.array([[0, 1, 2], [0, 1, 3]])),
    "touching in a vertex": (LEAVES, np.array([[0, 1, 2], [0, 3, 4]])),
    "one side": _moebius(),
}


def test_a_flat_square_is_a_plate() -> None:
    pos, faces = grid(5)
    pos = pos @ np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0].T + [3.0, -1.0, 2.0]
    shell = Extrusion(faces, len(pos))
    mesh, sheet = _mesh(pos, shell), trimesh.Trimesh(pos, faces, process=False)
    rims = trimesh.grouping.group_rows(sheet.edges_sorted, require_count=1)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(sheet.area * THICK, rel=1e-9)
    outer, inner = mesh.vertices[: len(pos)], mesh.vertices[len(pos) :]
    np.testing.assert_allclose(np.linalg.norm(outer - inner, axis=1), THICK, rtol=1e-9)
    np.testing.assert_allclose((outer + inner) / 2.0, pos, atol=1e-12)
    assert len(shell.faces) == 2 * len(faces) + 2 * len(rims)


@pytest.mark.parametrize("name", SHEETS)
def test_every_sheet_becomes_a_closed_shell(name: str) -> None:
    pos, faces = SHEETS[name]
    shell = Extrusion(faces, len(pos))
    mesh = _mesh(pos, shell)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(trimesh.Trimesh(pos, faces, process=False).area * THICK, rel=0.02)
    np.testing.assert_array_equal(shell.vertex[: len(pos)], np.arange(len(pos)))
    np.testing.assert_array_equal(shell.vertex[shell.faces], faces.reshape(-1)[shell.source])


def test_what_is_kept_does_not_move_and_has_no_second_layer() -> None:
    pos, faces = grid(3)
    ball, ball_faces = sphere(1, 0.1)
    both, together = np.concatenate([pos, ball]), np.concatenate([faces, ball_faces + len(pos)])
    kept = np.arange(len(together)) >= len(faces)
    alone, shell = Extrusion(faces, len(pos)), Extrusion(together, len(both), kept)
    points = shell.positions(both, np.full((len(both), 2), THICK))
    np.testing.assert_array_equal(points[len(pos) : len(both)], ball)
    assert len(shell.faces) == len(alone.faces) + len(ball_faces)
    assert len(points) == len(both) + len(pos)
    np.testing.assert_allclose(
        points[[*range(len(pos)), *range(len(both), len(points))]], alone.positions(pos, np.full((len(pos), 2), THICK))
    )
