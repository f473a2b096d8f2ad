"""Curvature of a surface at its vertices: known bodies, both forms, shapes that have none."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from hood.mesh.closest_point import tree
from hood.mesh.closest_point.search import build_incidence
from hood.mesh.geometry import MOST_CURVATURE, convex_curvature
from hood.testing import Mesh, cylinder, grid, sphere

F64 = torch.float64


def curvature(mesh: Mesh, dtype: torch.dtype = F64) -> torch.Tensor:
    """At the vertices: by the compiled search for points that lie there, where there is one, else in torch."""
    pos, faces = torch.as_tensor(mesh[0]).to(dtype), torch.as_tensor(mesh[1])
    incidence = build_incidence(faces, len(pos))
    scene, face_scene = (torch.zeros(len(part), dtype=torch.long) for part in (pos, faces))
    found = tree.search(pos, scene, pos, faces, face_scene, incidence.adjacency, pos, curved=True)
    if found is None:
        return convex_curvature(pos, faces, incidence)
    assert found.curvature is not None
    return found.curvature


@pytest.fixture(params=["compiled", "torch"])
def form(request, monkeypatch) -> str:
    """Both forms, where there is a compiler."""
    if request.param == "torch":
        monkeypatch.setattr(tree, "library", lambda: None)
    elif tree.library() is None:
        pytest.skip("no C++ compiler")
    return request.param


def fans() -> Mesh:
    """Two open fans that meet in a vertex alone, an edge with three faces, one wound the other way."""
    ring = [[1, 0, 0.1], [0.8, 0.7, -0.2], [0, 1, 0.1], [-1, 0, -0.3], [-0.7, -0.8, 0.2], [0.2, -1, 0.1]]
    pos = np.array([[0, 0, 0], *ring, [0.5, 0.3, 0.9]])
    faces = np.array([[0, 1, 2], [2, 3, 0], [0, 4, 5], [5, 6, 0], [2, 0, 7], [1, 7, 2], [0, 3, 6]])
    return 0.1 * pos, faces


def bumpy(seed: int = 0) -> Mesh:
    """An uneven surface, open and closed parts, one face without area, one vertex without faces.

    The last three vertices cannot be told apart by where they are, or are not found there.
    """
    rng = np.random.default_rng(seed)
    pos, faces = sphere(2, 0.08)
    sheet, others = grid(6, 5, 0.2)
    points = np.concatenate([pos, sheet + 0.4]) + rng.normal(size=(len(pos) + len(sheet), 3)) * 4e-3
    points = np.concatenate([points, points[-1:], [[9.0, 9.0, 9.0]]])
    last = len(points) - 2
    return points, np.concatenate([faces, others + len(pos), [[last, last - 1, last - 2]]])


@pytest.mark.usefixtures("form")
@pytest.mark.parametrize("radius", [0.03, 0.06, 0.5])
def test_a_sphere_has_one_over_its_radius(radius: float) -> None:
    found = curvature(sphere(3, radius))
    torch.testing.assert_close(found, torch.full_like(found, 1 / radius), rtol=0.1, atol=0)


@pytest.mark.usefixtures("form")
def test_a_tube_has_that_of_its_cross_section_and_inside_out_none() -> None:
    pos, faces = cylinder(32, 12, 0.05, 0.3)
    found = curvature((pos, faces)).view(-1)
    outward = float(found.max()) > 1.0
    other = curvature((pos, faces[:, ::-1].copy()))
    bulging, hollow = (found, other) if outward else (other, found)
    assert float(bulging.median()) == pytest.approx(20.0, rel=0.05)
    # Diagonals of the hollow side are bent the other way as well.
    assert float(hollow.max()) < 0.05


@pytest.mark.usefixtures("form")
def test_flat_and_tiny_surfaces_are_bounded() -> None:
    assert float(curvature(grid(7, 7, 1.0)).abs().max()) == 0.0
    assert float(curvature(sphere(2, 1e-3)).min()) == pytest.approx(MOST_CURVATURE)


def test_both_forms_agree(monkeypatch) -> None:
    if tree.library() is None:
        pytest.skip("no C++ compiler")
    for mesh, rows in ((bumpy(), -3), (bumpy(1), -3), (fans(), None), (sphere(3, 0.06), None)):
        found = [curvature(mesh), curvature(mesh, torch.float32)]
        with monkeypatch.context() as patched:
            patched.setattr(tree, "library", lambda: None)
            expected = [curvature(mesh), curvature(mesh, torch.float32)]
        for one, other, bound in zip(found, expected, (1e-12, 1e-3), strict=True):
            torch.testing.assert_close(one[:rows], other[:rows], rtol=bound, atol=bound)


def test_a_vertex_without_faces_has_none() -> None:
    pos, faces = (torch.as_tensor(part) for part in bumpy())
    assert float(convex_curvature(pos, faces, build_incidence(faces, len(pos)))[-1]) == 0.0


@pytest.mark.usefixtures("form")
def test_places_that_are_no_numbers_have_none_and_spoil_no_others() -> None:
    pos, faces = sphere(3, 0.06)
    sound = curvature((pos, faces))
    pos = pos.copy()
    pos[0] = np.nan
    found = curvature((pos, faces))
    assert torch.isfinite(found).all()
    far = torch.as_tensor(np.linalg.norm(sphere(3, 0.06)[0] - sphere(3, 0.06)[0][0], axis=1) > 0.06)
    torch.testing.assert_close(found[far], sound[far])


@pytest.mark.usefixtures("form")
def test_order_and_place_play_no_role() -> None:
    pos, faces = bumpy()
    rng = np.random.default_rng(3)
    order, rows = rng.permutation(len(pos)), rng.permutation(len(faces))
    shuffled = np.argsort(order)[faces][rows][:, [1, 2, 0]]
    found = torch.empty(len(pos), dtype=F64)
    found[torch.as_tensor(order)] = curvature((pos[order] + 0.5, shuffled))
    torch.testing.assert_close(found[:-3], curvature((pos, faces))[:-3], rtol=1e-6, atol=1e-6)
