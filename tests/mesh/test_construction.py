"""Elastic, folds and layers as numbers of the sides of faces: what they do to a cloth, and what keeps them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import hood
from hood.assets.body.body import Body
from hood.assets.fitting.alterations import keep_faces
from hood.assets.garment.garment import Garment, checked_garment, load_garment, save_garment
from hood.assets.garment.outfit import join_garments
from hood.assets.garment.parts import elasticated, part_faces
from hood.assets.garment.pins import region_loop
from hood.assets.material import Material
from hood.assets.pattern.making import band_along, sides_between
from hood.cloth.cloth import Cloth, build_cloth
from hood.energies.potential import default_potential
from hood.mesh.flat import Construction, laid_out, stretched_sides
from hood.mesh.topology import unique_edges
from hood.scene.sizing import resized
from hood.testing import cylinder, grid, make_problem
from hood.training.scenes import mirror_garment

F64 = torch.float64


def _made() -> Garment:
    """A tube with elastic in its lowest row, a fold around it and one stiff row of edges."""
    pos, faces = cylinder(10, 5, 0.1, 0.2)
    low = (faces < 20).all(axis=1)
    edges = laid_out(torch.as_tensor(pos), torch.as_tensor(faces)).numpy()
    elastic = np.where(low[:, None], stretched_sides(edges, np.tile([1.0, 0.3], (len(faces), 1)), 0.8, 0.95), 1.0)
    turn = np.arange(10)
    fold = np.where(sides_between(faces, np.stack([20 + turn, 20 + (turn + 1) % 10], axis=1)), 0.5, np.nan)
    bending = np.where(sides_between(faces, np.stack([30 + turn, 30 + (turn + 1) % 10], axis=1)), 3.0, 1.0)
    none = np.zeros(len(pos), dtype=bool)
    return Garment("tube", pos, faces, none, elastic=elastic, fold=fold, bending=bending)


def _cloth(garment: Garment) -> Cloth:
    return build_cloth(garment.rest_pos, garment.faces, Material(), dtype=F64, flat=garment.flat, made=garment.construction)


def _energy(garment: Garment, pos: np.ndarray) -> float:
    terms = default_potential().terms
    problem, at = make_problem(_cloth(garment)), torch.as_tensor(pos)
    return float(sum(terms[name](problem, at, torch.zeros_like(at)).sum() for name in ("stretching", "bending")))


def test_a_face_gets_the_shape_that_its_sides_ask_for() -> None:
    rng = np.random.default_rng(0)
    edges = rng.standard_normal((50, 2, 2))
    axis = rng.standard_normal((50, 2))
    factors = stretched_sides(edges, axis, 0.7, 1.2)
    unit = axis / np.linalg.norm(axis, axis=1, keepdims=True)
    normal = np.stack([-unit[:, 1], unit[:, 0]], axis=1)
    stretch = 0.7 * np.einsum("fi,fj->fij", unit, unit) + 1.2 * np.einsum("fi,fj->fij", normal, normal)
    found, density = Construction(factors).contracted(torch.as_tensor(edges), torch.ones(50, dtype=F64))
    np.testing.assert_allclose(found.numpy(), edges @ stretch, atol=1e-9)
    np.testing.assert_allclose(density.numpy(), 1.0 / (0.7 * 1.2))
    assert np.array_equal(stretched_sides(edges, np.zeros((50, 2)), 0.5), np.ones((50, 3)))


def test_elastic_weighs_what_it_is_cut_with_and_sizes_scale_it() -> None:
    garment = _made()
    cloth, plain = _cloth(garment), _cloth(replace(garment, elastic=None))
    torch.testing.assert_close(cloth.mass, plain.mass)
    assert float(cloth.rest_area.sum()) < 0.98 * float(plain.rest_area.sum())
    larger = resized(cloth, (1.0,) * 3, (1.4,) * 3)
    torch.testing.assert_close(larger.rest_length, 1.4 * cloth.rest_length)
    torch.testing.assert_close(larger.mass, 1.4**2 * plain.mass)
    taller = resized(cloth, (1.0,) * 3, (1.0, 1.3, 1.0))
    folds = cloth.rest_angle.abs() == 0.5
    assert int(folds.sum()) == 10
    assert torch.equal(taller.rest_angle.abs() == 0.5, folds)


def test_threads_of_drawn_cloth_are_not_taut() -> None:
    """Elastic resists as it is, whatever the threads around it do."""
    garment, woven = _made(), Material(warp=100.0, weft=60.0, shear=0.5)
    cloth = build_cloth(garment.rest_pos, garment.faces, woven, made=garment.construction)
    drawn = (garment.elastic != 1.0).any(axis=1)  # type: ignore[union-attr]
    assert cloth.weave is not None
    assert 0 < int(drawn.sum()) < len(drawn)
    assert set(map(tuple, cloth.weave[torch.as_tensor(drawn)].tolist())) == {(1.0, 1.0, 1.0)}
    assert set(map(tuple, cloth.weave[torch.as_tensor(~drawn)].tolist())) == {(100.0, 60.0, 0.5)}


def test_every_change_of_the_mesh_keeps_the_energy() -> None:
    garment = _made()
    pos = garment.rest_pos * [1.1, 0.9, 1.2] + 0.01 * np.random.default_rng(1).standard_normal(garment.rest_pos.shape)
    exact = _energy(garment, pos)
    plain = _energy(replace(garment, elastic=None, fold=None, bending=None), pos)
    assert abs(exact / plain - 1.0) > 0.01
    image = mirror_garment(garment)
    assert _energy(image, pos * [-1, 1, 1]) == pytest.approx(exact, rel=1e-9)
    turned = replace(
        garment, faces=garment.faces[:, [1, 2, 0]], **{k: v[:, [1, 2, 0]] for k, v in vars(garment.construction).items()}
    )
    assert _energy(turned, pos) == pytest.approx(exact, rel=1e-9)
    some = np.arange(len(garment.faces)) % 3 == 0
    over = replace(
        garment,
        faces=np.where(some[:, None], garment.faces[:, ::-1], garment.faces),
        **vars(garment.construction.turned(some)),
    )
    assert _energy(over, pos) == pytest.approx(exact, rel=1e-9)
    other = replace(_made(), name="plain", elastic=None, fold=None, bending=None)
    both = join_garments([other, garment])
    assert _energy(both, np.concatenate([other.rest_pos, pos])) == pytest.approx(exact, rel=1e-9)
    half = keep_faces(garment, np.arange(len(garment.faces)) < 40)
    assert half.elastic is not None
    assert np.array_equal(half.elastic, garment.elastic[:40])  # type: ignore[index]


def test_files_keep_it_and_bad_ones_are_named(tmp_path: Path) -> None:
    garment, path = _made(), tmp_path / "tube.npz"
    save_garment(path, garment)
    again = load_garment(path)
    for key, value in vars(garment.construction).items():
        np.testing.assert_array_equal(getattr(again, key), value)
    assert checked_garment(again) is again
    assert load_garment("tank").construction == Construction()
    flat, thin = garment.elastic.copy(), garment.bending.copy()  # type: ignore[union-attr]
    flat[7], thin[5, 1] = [0.3, 1.0, 2.0], 0.0
    for change, word in (
        ({"elastic": garment.faces[1:] * 1.0}, "elastic has shape"),
        ({"elastic": flat}, "elastic of face 7 is .* shares with which its sides still make a triangle"),
        ({"bending": thin}, "bending of face 5 is .* give a factor above 0"),
        ({"fold": np.full(garment.faces.shape, 4.0)}, "fold of face 0 is .* an angle between"),
    ):
        save_garment(path, replace(garment, **change))
        with pytest.raises(ValueError, match=f"tube.npz: {word}"):
            load_garment(path)


def test_a_band_lies_along_its_line() -> None:
    pos, faces = grid(11, 11, 0.2)
    flat = pos[faces][:, :, np.flatnonzero(np.ptp(pos, axis=0) > 0)]
    line = np.array([[[0.0, 0.0], [0.2, 0.0]]])
    band = band_along(flat, np.ones(len(faces), dtype=bool), line, 0.02)
    assert np.array_equal(band.inside, flat.mean(axis=1)[:, 1] < 0.02)
    assert np.allclose(band.way[:, 1], 0.0)
    start, end = np.roll(flat, -1, axis=1), np.roll(flat, -2, axis=1)
    up = (start[..., 1] - end[..., 1] != 0) & (np.minimum(start[..., 1], end[..., 1]) < 1e-9)
    assert (band.share[up] == 1.0).all()
    assert not band.share[np.minimum(start[..., 1], end[..., 1]) > 0.03].any()


def test_a_waistband_is_drawn_together_around_the_waist(garments: dict[str, Garment], body: Body) -> None:
    trousers = garments["trousers"]
    band = part_faces("waistband", trousers, body)
    rim = region_loop(trousers, body, "waistband")
    assert 0.02 < band.mean() < 0.15
    assert np.isin(trousers.faces[band], rim).any(axis=1).mean() > 0.3
    drawn = elasticated(trousers, {"waistband": 0.8}, body)
    cloth, plain = _cloth(drawn), _cloth(trousers)
    ratio = (cloth.rest_length / plain.rest_length).numpy()
    edges = unique_edges(trousers.faces)
    around = np.isin(edges, rim).all(axis=1)
    np.testing.assert_allclose(ratio[around], 0.8, atol=0.02)
    far = ~np.isin(edges, trousers.faces[band]).any(axis=1)
    np.testing.assert_allclose(ratio[far], 1.0, rtol=1e-9)
    sleeves = elasticated(garments["longsleeve"], {"cuff_left": 0.7}, body)
    cuff = region_loop(sleeves, body, "cuff_left")
    ends = np.isin(unique_edges(sleeves.faces), cuff).all(axis=1)
    ratio = (_cloth(sleeves).rest_length / _cloth(garments["longsleeve"]).rest_length).numpy()
    np.testing.assert_allclose(ratio[ends], 0.7, atol=0.03)


def test_scenes_and_steps_have_it(garments: dict[str, Garment], body: Body) -> None:
    skirt = elasticated(garments["skirt"], {"waistband": 0.9}, body)
    plie = hood.load_sequence("plie")
    for betas in (np.zeros(10), np.array([2.0, -1.0])):
        drawn, plain = (hood.build_scene(one, body, plie, betas=betas).cloth for one in (skirt, garments["skirt"]))
        torch.testing.assert_close(drawn.mass, plain.mass, rtol=1e-5, atol=0)
        ratio = drawn.rest_length / plain.rest_length
        assert float(ratio.min()) == pytest.approx(0.9, abs=2e-3)
