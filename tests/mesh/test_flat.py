"""Rest shapes that are flat patterns: exact cases, what keeps them, and a rollout."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import hood
from hood.assets.garment.garment import Garment, load_garment, save_garment
from hood.assets.garment.outfit import join_garments
from hood.assets.material import Material
from hood.cloth.cloth import Cloth, build_cloth, concatenate_cloths
from hood.energies.membrane import Stretching
from hood.energies.potential import default_potential
from hood.mesh.flat import edge_extents, edge_lengths, followed, inverse, laid_out
from hood.scene.sizing import resized
from hood.testing import cylinder, grid, make_problem
from hood.training.scenes import mirror_garment


def _tube(
    columns: int = 12, rows: int = 5, width: float = 0.05, height: float = 0.04
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A flat sheet, rolled and closed: positions, faces (F, 3), and their flat corners (F, 3, 2)."""
    radius, turn = 0.5 * width / np.sin(np.pi / columns), 2.0 * np.pi / columns
    angle, level = np.meshgrid(turn * np.arange(columns), height * np.arange(rows))
    pos = np.stack([radius * np.sin(angle), level, radius * np.cos(angle)], axis=-1).reshape(-1, 3)
    faces, flat = [], []
    for row in range(rows - 1):
        for column in range(columns):
            right = (column + 1) % columns
            a, b, c, d = (r * columns + k for r, k in ((row, column), (row, right), (row + 1, right), (row + 1, column)))
            x, y = width * column, height * row
            corners = np.array([[x, y], [x + width, y], [x + width, y + height], [x, y + height]])
            faces += [[a, b, c], [a, c, d]]
            flat += [corners[[0, 1, 2]], corners[[0, 2, 3]]]
    return pos, np.array(faces), np.array(flat)


def _stretch(cloth: Cloth, pos: np.ndarray) -> float:
    return float(Stretching()(make_problem(cloth), torch.as_tensor(pos), torch.zeros(len(pos), 3)).sum())


def test_a_rolled_sheet_is_not_stretched_and_wants_to_be_flat() -> None:
    pos, faces, flat = _tube()
    cloth = build_cloth(pos, faces, Material(), dtype=torch.float64, flat=flat)
    assert _stretch(cloth, pos) < 1e-18
    assert not bool(cloth.rest_angle.any())
    assert _stretch(cloth, 1.01 * pos) > 1e-4
    assert float(cloth.rest_area.sum()) == pytest.approx(12 * 0.05 * 4 * 0.04)
    assert float(cloth.mass.sum()) == pytest.approx(float((cloth.rest_area * cloth.density).sum()))
    along = pos[cloth.edges[:, 1]] - pos[cloth.edges[:, 0]]
    np.testing.assert_allclose(cloth.rest_length, np.linalg.norm(along, axis=1), rtol=1e-12)


def test_lengths_are_those_of_the_pattern_and_gathers_have_the_mean() -> None:
    pos, faces, flat = _tube()
    draped = pos * [1.2, 0.9, 1.1]
    cloth = build_cloth(draped, faces, Material(), dtype=torch.float64, flat=flat)
    exact = build_cloth(pos, faces, Material(), dtype=torch.float64)
    for name in ("rest_length", "rest_area", "hinge_rest_length", "hinge_area", "mass"):
        torch.testing.assert_close(getattr(cloth, name), getattr(exact, name))
    wider = flat.copy()
    lower = faces.max(axis=1) < 2 * 12  # the faces of the lowest row
    wider[lower, :, 0] *= 2.0
    gathered = build_cloth(draped, faces, Material(), dtype=torch.float64, flat=wider)
    seam = ((cloth.edges >= 12) & (cloth.edges < 24)).all(dim=1)
    torch.testing.assert_close(gathered.rest_length[seam], torch.full((12,), 0.075, dtype=torch.float64))


def test_the_gradient_is_that_of_autograd() -> None:
    pos, faces, flat = _tube()
    cloth = build_cloth(1.1 * pos, faces, Material(), dtype=torch.float64, flat=flat)
    potential, problem = default_potential(), make_problem(cloth)
    state = torch.as_tensor(pos) + 1e-3 * torch.randn(len(pos), 3, dtype=torch.float64)
    at = state.clone().requires_grad_()
    potential.total(potential.prepare(problem), at).sum().backward()
    found, _ = potential.gradient(potential.prepare(problem), state)
    torch.testing.assert_close(found, at.grad, rtol=1e-7, atol=1e-9)


def test_the_warp_runs_along_the_pattern() -> None:
    pos, faces, flat = _tube()
    angle = np.radians(30.0)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    cloth = build_cloth(pos, faces, Material(warp=4.0), dtype=torch.float64, flat=flat @ turn.T)
    assert cloth.grain is not None
    edges = torch.as_tensor((flat[:, 1:] - flat[:, :1]) @ turn.T)
    warp = torch.einsum("fi,fix->fx", cloth.grain, edges)
    off = torch.rad2deg(torch.atan2(warp[:, 0], warp[:, 1]).abs())
    assert float(off.max()) < 1e-6


def test_sizes_scale_the_pattern() -> None:
    pos, faces, flat = _tube()
    cloth = build_cloth(pos * [1.2, 0.9, 1.1], faces, Material(), dtype=torch.float64, flat=flat)
    larger = resized(cloth, (1.0, 1.0, 1.0), (1.5, 1.5, 1.5))
    for name, power in (("rest_length", 1), ("rest_area", 2), ("hinge_rest_length", 1), ("mass", 2), ("rest_inverse", -1)):
        torch.testing.assert_close(getattr(larger, name), 1.5**power * getattr(cloth, name))
    longer = resized(build_cloth(pos, faces, Material(), dtype=torch.float64, flat=flat), (1.0,) * 3, (1.0, 1.3, 1.0))
    up = pos[longer.edges[:, 0], 1] != pos[longer.edges[:, 1], 1]
    flat_up = (longer.edges[:, 1] - longer.edges[:, 0]) == 12
    torch.testing.assert_close(longer.rest_length[flat_up], torch.full((48,), 1.3 * 0.04, dtype=torch.float64))
    assert torch.allclose(longer.rest_length[torch.as_tensor(~up)], torch.tensor(0.05, dtype=torch.float64))
    assert not bool(longer.rest_angle.any())


def test_a_turn_leaves_the_pattern_as_it_is() -> None:
    pos, faces, flat = _tube()
    turned = pos @ np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))[0]
    np.testing.assert_allclose(followed(flat, faces, pos, turned), flat, atol=1e-12)
    twice = followed(flat, faces, pos, 2.0 * turned)
    np.testing.assert_allclose(twice[:, 1:] - twice[:, :1], 2 * (flat[:, 1:] - flat[:, :1]), atol=1e-12)


def test_outfits_mix_patterns_and_meshes() -> None:
    pos, faces, flat = _tube()
    none = np.zeros(len(pos), dtype=bool)
    sewn, plain = Garment("sewn", 1.1 * pos, faces, none, flat=flat), Garment("plain", pos + [1.0, 0, 0], faces, none)
    both = join_garments([sewn, plain])
    assert both.flat is not None
    cloth = build_cloth(both.rest_pos, both.faces, Material(), dtype=torch.float64, flat=both.flat)
    alone = build_cloth(plain.rest_pos, faces, Material(), dtype=torch.float64)
    torch.testing.assert_close(cloth.rest_area[len(faces) :], alone.rest_area)
    torch.testing.assert_close(cloth.rest_angle[-len(alone.hinges) :], alone.rest_angle)
    assert not bool(cloth.rest_angle[: -len(alone.hinges)].any())
    batch = concatenate_cloths([build_cloth(1.1 * pos, faces, Material(), flat=flat), build_cloth(pos, faces, Material())])
    torch.testing.assert_close(batch.rest_length[: len(alone.edges)], batch.rest_length[len(alone.edges) :])
    mirrored = mirror_garment(sewn)
    assert mirrored.flat is not None
    assert np.allclose(np.linalg.det(mirrored.flat[:, 1:] - mirrored.flat[:, :1]), 0.05 * 0.04)


def test_faces_laid_out_have_their_shape() -> None:
    pos, faces = (torch.as_tensor(table) for table in cylinder(9, 4))
    flat = laid_out(pos.double(), faces.long())
    plain = build_cloth(*cylinder(9, 4), Material(), dtype=torch.float64)
    torch.testing.assert_close(inverse(flat), plain.rest_inverse)


def test_files_keep_it_and_bad_ones_are_named(tmp_path: Path) -> None:
    pos, faces, flat = _tube()
    garment = Garment("tube", 1.1 * pos, faces, np.zeros(len(pos), dtype=bool), flat=flat)
    save_garment(tmp_path / "tube.npz", garment)
    assert np.array_equal(load_garment(tmp_path / "tube.npz").flat, flat)
    broken = flat.copy()
    broken[3, 2] = broken[3, 1]
    for bad, word in ((flat[1:], "shape"), (broken, "face 3")):
        save_garment(tmp_path / "bad.npz", replace(garment, flat=bad))
        with pytest.raises(ValueError, match=f"bad.npz: flat .*{word}"):
            load_garment(tmp_path / "bad.npz")


def test_a_rollout_has_the_lengths_of_the_pattern() -> None:
    skirt = load_garment("skirt")
    corners = laid_out(torch.as_tensor(skirt.rest_pos), torch.as_tensor(skirt.faces)).numpy()
    flat = 1.03 * np.concatenate([np.zeros((len(corners), 1, 2)), corners], axis=1)
    garment = replace(skirt, flat=flat)
    frames = list(hood.simulate(garment, "plie", num_frames=3, pins="waistband"))
    assert all(frame.metrics["strain_p99"] < 0.15 for frame in frames)
    scene = hood.build_scene(garment, hood.load_body(), hood.load_sequence("plie"), size=1.1)
    plain = hood.build_scene(skirt, hood.load_body(), hood.load_sequence("plie"), size=1.1)
    torch.testing.assert_close(scene.cloth.rest_length, 1.03 * plain.cloth.rest_length, rtol=1e-5, atol=1e-8)
    shaped = hood.build_scene(garment, hood.load_body(), hood.load_sequence("plie"), betas=np.array([2.0, -1.0]))
    grown = hood.build_scene(skirt, hood.load_body(), hood.load_sequence("plie"), betas=np.array([2.0, -1.0]))
    torch.testing.assert_close(shaped.cloth.rest_length, 1.03 * grown.cloth.rest_length, rtol=1e-5, atol=1e-8)


def test_a_flat_sheet_is_as_without() -> None:
    pos, faces = grid(6, 5, 0.3)
    plain = build_cloth(pos, faces, Material(), dtype=torch.float64)
    across = np.flatnonzero(np.ptp(pos, axis=0) > 0)
    cloth = build_cloth(pos, faces, Material(), dtype=torch.float64, flat=pos[faces][:, :, across])
    for name in ("rest_length", "rest_area", "mass", "hinge_area", "edge_length_sq"):
        torch.testing.assert_close(getattr(cloth, name), getattr(plain, name))


def test_the_sides_of_gathers_have_two_lengths() -> None:
    faces, edges = torch.tensor([[0, 1, 2], [1, 0, 3]]), torch.tensor([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3]])
    one, twice = torch.tensor([[1.0, 0.0], [0.0, 1.0]]), torch.tensor([[2.0, 0.0], [0.0, 1.0]])
    least, most = edge_extents(torch.stack([one, twice]), faces, edges)
    assert (least[0], most[0]) == (1.0, 2.0)
    assert torch.equal(least[1:], most[1:])
    assert least[1] == 1.0
    assert edge_lengths(torch.stack([one, twice]), faces, edges)[0] == 1.5
