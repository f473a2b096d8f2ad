"""Warp of the faces of a garment: from its texture, from the vertical, and through what happens to a cloth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.assets.garment.outfit import join_garments
from hood.assets.material import Material
from hood.assets.motion.sequence import PoseSequence
from hood.cloth.cloth import along_grain, build_cloth, grain_of
from hood.energies.membrane import Stretching
from hood.scene.scene import build_scene
from hood.scene.sizing import resized
from hood.testing import cylinder, grid, make_problem

F64 = torch.float64
WOVEN = Material(warp=20.0, weft=5.0, shear=0.5)


def directions(pos: np.ndarray, faces: np.ndarray, grain: np.ndarray) -> np.ndarray:
    """(F, 3) unit vectors of the warp."""
    edges = pos[faces[:, 1:]] - pos[faces[:, :1]]
    along = np.einsum("fi,fix->fx", grain, edges)
    return along / np.linalg.norm(along, axis=1, keepdims=True)


def test_without_a_texture_the_warp_is_the_vertical_in_the_face() -> None:
    pos, faces = cylinder(9, 5)
    np.testing.assert_allclose(directions(pos, faces, grain_of(pos, faces)), [[0.0, 1.0, 0.0]] * len(faces), atol=1e-12)
    leaning = pos * [1.0, 1.0, 1.0] + 0.4 * pos[:, [1]] * [1.0, 0.0, 0.0]
    found = directions(leaning, faces, grain_of(leaning, faces))
    normal = np.cross(leaning[faces[:, 1]] - leaning[faces[:, 0]], leaning[faces[:, 2]] - leaning[faces[:, 0]])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    expected = [0.0, 1.0, 0.0] - normal * normal[:, [1]]
    np.testing.assert_allclose(found, expected / np.linalg.norm(expected, axis=1, keepdims=True), atol=1e-12)


def test_a_horizontal_sheet_has_its_warp_along_z() -> None:
    pos, faces = grid(4, 4)
    np.testing.assert_allclose(directions(pos, faces, grain_of(pos, faces)), [[0.0, 0.0, 1.0]] * len(faces), atol=1e-12)


@pytest.mark.parametrize("degrees", [0.0, 30.0, 90.0, 200.0])
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_the_warp_runs_along_v_of_the_texture_whatever_its_unit_and_mirror(degrees: float, scale: float) -> None:
    pos, faces = grid(4, 5)
    angle = np.radians(degrees)
    v = np.array([np.cos(angle), np.sin(angle)])  # in x and z
    uv = scale * np.stack([pos[:, [0, 2]] @ [-v[1], v[0]], pos[:, [0, 2]] @ v], axis=1)
    for table in (uv, uv * [-1.0, 1.0] + 7.0):
        found = directions(pos, faces, grain_of(pos, faces, (table, faces)))
        np.testing.assert_allclose(found, [[v[0], 0.0, v[1]]] * len(faces), atol=1e-9)


def test_where_the_texture_is_folded_flat_the_vertical_counts() -> None:
    pos, faces = cylinder(6, 3)
    uv = np.stack([pos[:, 1], pos[:, 0]], axis=1)  # the warp would run around the tube
    uv_faces = faces.copy()
    uv_faces[3] = uv_faces[3][0]  # all corners in one point
    found = directions(pos, faces, grain_of(pos, faces, (uv, uv_faces)))
    np.testing.assert_allclose(found[3], [0.0, 1.0, 0.0], atol=1e-12)
    assert np.isfinite(found).all()
    assert np.abs(found[:3, 1]).max() < 0.9


def test_frames_are_turned_and_nothing_else() -> None:
    """The strain in the new frame has the length of the warp first; the determinant and the area stay."""
    pos, faces = cylinder(7, 4)
    cloth = build_cloth(pos, faces, Material(), dtype=F64)
    grain = torch.as_tensor(grain_of(pos, faces))
    turned = along_grain(cloth.rest_inverse, grain)
    torch.testing.assert_close(turned.det(), cloth.rest_inverse.det(), rtol=1e-12, atol=0)
    taller = cloth.rest_pos * torch.tensor([1.0, 1.3, 1.0], dtype=F64)
    corners = taller[cloth.faces]
    edges = torch.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], dim=2)
    gradient = edges @ turned
    lengths = gradient.norm(dim=1)
    torch.testing.assert_close(lengths, torch.tensor([1.3, 1.0], dtype=F64).expand_as(lengths), rtol=1e-12, atol=0)
    assert torch.equal(along_grain(cloth.rest_inverse, torch.zeros_like(grain)), cloth.rest_inverse)


@pytest.mark.parametrize("factors", [(1.2, 1.2, 1.2), (1.0, 1.4, 0.8)])
def test_a_woven_cloth_that_has_grown_is_one_that_was_made_so(factors: tuple[float, float, float]) -> None:
    pos, faces = cylinder(9, 5)
    uv = (pos[:, :2] @ [[0.8, -0.6], [0.6, 0.8]], faces)
    start = build_cloth(pos, faces, WOVEN, dtype=F64, uv=uv)
    grown = resized(start, (1.0, 1.0, 1.0), factors)
    made = build_cloth(pos * factors, faces, WOVEN, dtype=F64, uv=uv)
    torch.testing.assert_close(grown.rest_inverse, made.rest_inverse, rtol=1e-10, atol=1e-10)
    at = made.rest_pos * 1.1
    energies = [float(Stretching()(make_problem(cloth), at, at)) for cloth in (grown, made)]
    assert energies[0] == pytest.approx(energies[1], rel=1e-11)


def test_a_garment_is_woven_along_its_texture(garments: dict[str, Garment], body: Body, walk: PoseSequence) -> None:
    tank = garments["tank"]
    assert tank.uv is not None
    turned = replace(tank, uv=tank.uv[:, ::-1].copy())
    bare = replace(tank, uv=None, uv_faces=None)
    cloths = [build_scene(garment, body, walk, WOVEN).cloth for garment in (tank, turned, bare)]
    found = [
        directions(cloth.rest_pos.numpy(), cloth.faces.numpy(), cloth.grain.numpy())  # type: ignore[union-attr]
        for cloth in cloths
    ]
    vertical = np.abs(np.stack([one[:, 1] for one in found]))
    assert np.median(vertical[0]) > 0.95
    assert np.median(vertical[1]) < 0.2
    assert (np.einsum("fx,fx->f", found[0], found[2]) > 0.9).mean() > 0.9
    assert build_scene(tank, body, walk).cloth.weave is None


def test_garments_of_an_outfit_keep_their_own_warp(garments: dict[str, Garment], body: Body, walk: PoseSequence) -> None:
    tank, skirt = garments["tank"], garments["skirt"]
    bare = replace(skirt, uv=None, uv_faces=None)
    both = build_scene(join_garments([tank, bare]), body, walk, WOVEN).cloth
    alone = [build_scene(garment, body, walk, WOVEN).cloth for garment in (tank, bare)]
    torch.testing.assert_close(both.grain, torch.cat([cloth.grain for cloth in alone]), rtol=1e-4, atol=1e-4)  # type: ignore[misc]


def test_networks_are_told_of_the_isotropic_fabric(garments: dict[str, Garment], body: Body, walk: PoseSequence) -> None:
    plain, woven = (build_scene(garments["tank"], body, walk, fabric).cloth for fabric in (Material(), WOVEN))
    for name in ("vertex_fabric", "edge_fabric", "lame_mu", "lame_lambda", "mass"):
        assert torch.equal(getattr(plain, name), getattr(woven, name))
