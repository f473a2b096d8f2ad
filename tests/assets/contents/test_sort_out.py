"""Every kind of file becomes the cloth that it shows, and one sentence says how."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from garment_kinds import (
    KINDS,
    Mesh,
    button,
    clean,
    eyelet,
    front_places,
    halves,
    joined,
    part,
    quarters,
    shell,
    write_mesh,
    write_objects,
)
from scipy.spatial import cKDTree

from hood.assets.body.load import load_body
from hood.assets.contents.objects import items_of
from hood.assets.contents.sort_out import mend, metres_per_unit, take_objects
from hood.assets.formats.mesh_file import read_mesh_file
from hood.assets.garment.garment import Garment, garment_of_mesh
from hood.assets.garment.record import Fitting, Wanted, start_fitting
from hood.mesh.editing.repair import duplicate_faces
from hood.mesh.parts import find_parts


def sorted_out(path: Path, wanted: Wanted | None = None) -> Fitting:
    mesh, wanted, surface = read_mesh_file(path, split_polygons=True), wanted or Wanted(), load_body().v_template
    fitting = start_fitting(garment_of_mesh(path, mesh), mesh.stitches)
    take_objects(fitting, wanted, surface)
    mend(fitting, wanted, surface)
    return fitting


def read(path: Path) -> Garment:
    return garment_of_mesh(path, read_mesh_file(path, split_polygons=True))


def told(fitting: Fitting) -> str:
    return " ".join(change.text for change in fitting.changes)


@pytest.mark.parametrize("name", KINDS)
def test_a_file_becomes_the_cloth_that_it_shows(name: str, tmp_path: Path) -> None:
    kind = KINDS[name]
    fitting = sorted_out(kind.write(tmp_path))
    garment = fitting.garment
    assert kind.says in told(fitting)
    assert bool(kind.says) == bool(fitting.changes)
    if kind.shows is not None:
        pos, faces = kind.shows()
        assert same_surface(garment.rest_pos, garment.faces, pos, faces, kind.tolerance)
    pieces = 1 if garment.piece is None else int(garment.piece.max()) + 1
    assert pieces == kind.pieces
    groups = 0 if garment.riders is None else garment.riders.num_groups
    assert groups == kind.riders or (kind.riders < 0 and groups > 3)
    thick = 0.0 if garment.thickness is None else float(np.median(garment.thickness))
    assert thick == pytest.approx(kind.thickness, rel=0.02)
    assert not duplicate_faces(garment.faces).any()


def same_surface(pos: np.ndarray, faces: np.ndarray, others: np.ndarray, table: np.ndarray, tolerance: float) -> bool:
    """Whether two meshes have the same triangles, in any order and winding."""
    if len(faces) != len(table):
        return False
    centres, theirs = pos[faces].mean(axis=1), others[table].mean(axis=1)
    dist, nearest = cKDTree(theirs).query(centres)
    return bool(len(np.unique(nearest)) == len(table) and dist.max() <= tolerance)


@pytest.mark.parametrize("gap", [0.0, 1.5e-3, 3e-3, 5e-3])
def test_panels_become_one_garment_with_its_openings(gap: float, tmp_path: Path) -> None:
    """Sewn vertices lie in the middle of those that they were, all others where they were."""
    garment = sorted_out(write_mesh(tmp_path / "panels.obj", joined(*quarters(clean("tank"), gap)))).garment
    (own,) = find_parts(garment.rest_pos, garment.faces)
    (whole,) = find_parts(*clean("tank"))
    assert [len(rim) for rim in own.rims] == [len(rim) for rim in whole.rims]
    assert len(garment.rest_pos) == len(clean("tank")[0])
    pos = np.sort(garment.rest_pos[:, 1])
    np.testing.assert_allclose(pos, np.sort(clean("tank")[0][:, 1]), atol=1e-9)  # the panels were moved level


@pytest.mark.parametrize(
    ("wanted", "parts"),
    [(Wanted(sew=False), 4), (Wanted(gap=1e-3), 4), (Wanted(gap=8e-3), 1)],
    ids=["none", "too little", "more"],
)
def test_keys_say_what_is_sewn(wanted: Wanted, parts: int, tmp_path: Path) -> None:
    path = write_mesh(tmp_path / "panels.obj", joined(*quarters(clean("tank"), 3e-3)))
    garment = sorted_out(path, wanted).garment
    assert len(find_parts(garment.rest_pos, garment.faces)) == parts


@pytest.mark.parametrize("name", ["tank", "skirt", "jacket", "shirt", "dress", "longsleeve", "trousers"])
def test_a_tidy_garment_is_left_as_it_is(name: str, tmp_path: Path) -> None:
    """The open front of a jacket is 4 mm wide and stays open."""
    path = write_mesh(tmp_path / f"{name}.obj", clean(name))
    fitting, file = sorted_out(path), read(path)
    assert fitting.changes == []
    assert np.array_equal(fitting.garment.rest_pos, file.rest_pos)
    assert np.array_equal(fitting.garment.faces, file.faces)
    assert fitting.garment.file_numbers is None


def test_two_garments_whose_rims_are_near_each_other_stay_two(tmp_path: Path) -> None:
    """A top that ends where a skirt begins is no dress; a gap that somebody asks for makes it one."""
    pos, faces = clean("dress")
    waist = pos[faces].mean(axis=1)[:, 1] > float(np.quantile(pos[:, 1], 0.5))
    top, skirt = part((pos + [0.0, 1e-3, 0.0], faces), waist), part((pos - [0.0, 1e-3, 0.0], faces), ~waist)
    path = write_objects(tmp_path / "two.obj", [("top", top), ("bottom", skirt)])
    assert sorted_out(path).garment.piece is not None
    assert (
        len(find_parts(sorted_out(path, Wanted(gap=4e-3)).garment.rest_pos, sorted_out(path, Wanted(gap=4e-3)).garment.faces))
        == 1
    )


def over_waistband(off: float, lift: Callable[[np.ndarray], np.ndarray]) -> Mesh:
    """A tank whose hem is ``off`` [m] outside the waistband of a skirt, and the skirt; ``lift`` is how high [m] over the
    waistband, by the angle around the body."""
    (pos, faces), skirt = clean("tank"), clean("skirt")
    (top,), (bottom,) = find_parts(pos, faces), find_parts(*skirt)
    hem = min(top.rims, key=lambda rim: float(pos[rim, 1].mean()))
    band = skirt[0][max(bottom.rims, key=lambda rim: float(skirt[0][rim, 1].mean()))]
    middle, own = band.mean(axis=0), pos[hem] - pos[hem].mean(axis=0)
    turn, places = np.arctan2(own[:, 2], own[:, 0]), np.arctan2(*(band - middle)[:, [2, 0]].T)
    radius, height = (
        np.interp(turn, np.sort(places), row[np.argsort(places)], period=2 * np.pi)
        for row in (np.hypot(*(band - middle)[:, [0, 2]].T) + off, band[:, 1])
    )
    there = np.stack([middle[0] + radius * np.cos(turn), height + lift(turn), middle[2] + radius * np.sin(turn)], axis=1)
    dist, nearest = cKDTree(pos[hem]).query(pos)
    moved = pos + np.clip(1.0 - dist / 0.5, 0.0, 1.0)[:, None] * (there - pos[hem])[nearest]
    return joined((moved, faces), skirt)


@pytest.mark.parametrize("seed", [None, 0])
@pytest.mark.parametrize(
    "lift",
    [
        lambda turn: 0.0 * turn - 0.004,
        lambda turn: 0.03 * np.cos(2 * turn) - 0.015,
        lambda turn: 0.035 * np.cos(2 * turn) - 0.03,
        lambda turn: 0.02 * np.sin(turn),
        lambda turn: 0.02 * np.sin(turn) - 0.02,
    ],
    ids=["4 mm over it", "crossing it four times", "at the sides", "short in front", "at one place"],
)
def test_a_hem_over_a_waistband_is_not_sewn(lift: Callable[[np.ndarray], np.ndarray], seed: int | None, tmp_path: Path) -> None:
    """However the vertices are numbered."""
    pos, faces = over_waistband(0.002, lift)
    number = np.arange(len(pos)) if seed is None else np.random.default_rng(seed).permutation(len(pos))
    garment = sorted_out(write_mesh(tmp_path / "outfit.obj", (pos[np.argsort(number)], number[faces]))).garment
    assert len(garment.rest_pos) == len(pos)
    assert garment.piece is not None


def sock(leg: Mesh, over: float) -> Mesh:
    """A closed sock that begins ``over`` [m] above the lower rim of the left leg, 2 mm inside of it."""
    pos, faces = leg
    rim = min(find_parts(pos, faces)[0].rims, key=lambda own: (round(float(pos[own, 1].mean()), 2), -float(pos[own, 0].mean())))
    middle, count, rows = pos[rim].mean(axis=0), len(rim), 12
    out = pos[rim] - middle
    ring = out * (1.0 - 2e-3 / np.linalg.norm(out, axis=1, keepdims=True))
    widths = np.concatenate([[1.0], np.linspace(0.6, 0.5, rows - 1)])
    rings = [middle + width * ring + [0.0, over - 0.035 * row, 0.0] for row, width in enumerate(widths)]
    here, after = np.arange(count), np.roll(np.arange(count), -1)
    table = [
        np.stack(face, axis=1) + row * count
        for row in range(rows - 1)
        for face in ((here, after, here + count), (after, after + count, here + count))
    ]
    toe = np.stack([here + (rows - 1) * count, after + (rows - 1) * count, np.full(count, rows * count)], axis=1)
    return np.concatenate([*rings, [rings[-1].mean(axis=0) - [0.0, 0.01, 0.0]]]), np.concatenate([*table, toe])


@pytest.mark.parametrize(("over", "names"), [(4e-3, None), (4e-3, ("trousers", "sock")), (-1e-3, ("trousers", "sock"))])
def test_a_sock_at_a_trouser_leg_is_not_sewn(over: float, names: tuple[str, str] | None, tmp_path: Path) -> None:
    trousers = clean("trousers")
    things = (trousers, sock(trousers, over))
    path = write_objects(tmp_path / "outfit.obj", list(zip(names or ("", ""), things, strict=True)))
    garment = sorted_out(path).garment
    assert len(find_parts(garment.rest_pos, garment.faces)) == 2
    assert garment.piece is not None


@pytest.mark.parametrize("gap", [0.0, 2e-3, 5e-3])
@pytest.mark.parametrize("name", ["tshirt", "longsleeve", "dress", "trousers", "shirt"])
def test_left_and_right_halves_are_sewn(name: str, gap: float, tmp_path: Path) -> None:
    mesh = clean(name)
    left = mesh[0][mesh[1]].mean(axis=1)[:, 0] > 0.0
    pos, faces = part(mesh, left)
    path = write_mesh(tmp_path / "halves.obj", joined(part(mesh, ~left), (pos + [gap, 0.0, 0.0], faces)))
    garment = sorted_out(path).garment
    assert len(find_parts(garment.rest_pos, garment.faces)) == 1
    assert garment.piece is None


def test_shells_and_copies_can_be_kept(tmp_path: Path) -> None:
    path = write_mesh(tmp_path / "shell.obj", shell(clean("tank"), 2e-3))
    kept = sorted_out(path, Wanted(shells="keep"))
    assert kept.changes == []
    assert len(kept.garment.rest_pos) == 2 * len(clean("tank")[0])


def test_small_parts_are_left_out_or_taken_for_cloth(tmp_path: Path) -> None:
    buttons = [button(*place) for place in front_places(clean("tank"))]
    path = write_mesh(tmp_path / "buttons.obj", joined(clean("tank"), *buttons))
    out, cloth = (sorted_out(path, Wanted(small_parts=way)).garment for way in ("leave_out", "simulate"))
    assert out.riders is None
    assert len(out.rest_pos) == len(clean("tank")[0])
    assert len(cloth.rest_pos) == len(out.rest_pos) + sum(len(pos) for pos, _ in buttons)


def test_objects_are_chosen_by_name_or_number(tmp_path: Path) -> None:
    path = write_objects(tmp_path / "two.obj", [("Oberteil", clean("tank")), ("Röckchen", clean("skirt"))])
    for names in (("Roeckchen",), ("Röckchen",), ("part_2",)):
        garment = sorted_out(path, Wanted(objects=names)).garment
        np.testing.assert_allclose(garment.rest_pos, clean("skirt")[0], atol=1e-6)
    with pytest.raises(ValueError, match="objects=skirt: no object, .* there are Oberteil, Roeckchen, part_1, part_2"):
        sorted_out(path, Wanted(objects=("skirt",)))


def test_numbers_of_the_file_still_name_its_vertices(tmp_path: Path) -> None:
    """Of panels that were sewn, both vertices are the one; of an avatar that was left out none is there."""
    mesh = joined(*quarters(clean("tank"), 3e-3))
    garment = sorted_out(write_mesh(tmp_path / "panels.obj", mesh)).garment
    assert garment.file_numbers is not None
    moved = np.linalg.norm(garment.rest_pos[garment.file_numbers] - mesh[0], axis=1)
    assert moved.max() < 4e-3
    body, tank = load_body(), clean("tank")
    path = write_objects(tmp_path / "avatar.obj", [("Avatar", (body.v_template, body.faces)), ("tank", tank)])
    garment = sorted_out(path).garment
    count = len(body.v_template)
    assert len(garment.numbers_of(np.arange(count), "pins")) == 0
    assert garment.numbers_of(np.array([count + 5]), "pins").tolist() == [5]
    with pytest.raises(ValueError, match=f"pins: vertex 99999 of {count + len(tank[0])}"):
        garment.numbers_of(np.array([99999]), "pins")


def test_textures_and_names_stay_on_the_faces(tmp_path: Path) -> None:
    """Where an edge is cut, texture coordinates are linear along it."""
    pos, faces = joined(*halves(clean("tank"), 2e-3))
    front = len(halves(clean("tank"), 2e-3)[0][1])
    garment = Garment(
        "tank", pos, faces, np.zeros(len(pos), dtype=bool), uv=pos[:, :2].copy(), uv_faces=faces.copy(),
        panels={"front": np.arange(len(faces)) < front},
    )  # fmt: skip
    fitting = start_fitting(replace(garment))
    mend(fitting, Wanted(), None)
    sewn = fitting.garment
    assert sewn.uv is not None
    assert sewn.uv_faces is not None
    assert sewn.panels is not None
    np.testing.assert_allclose(sewn.uv[sewn.uv_faces], sewn.rest_pos[sewn.faces][..., :2], atol=1e-3 + 1e-9)
    assert (sewn.rest_pos[sewn.faces[sewn.panels["front"]]].mean(axis=1)[:, 2] > pos[:, 2].mean() - 0.02).all()


def test_objects_are_listed_with_what_they_seem_to_be(tmp_path: Path) -> None:
    body = load_body()
    things = [
        ("Avatar", (body.v_template, body.faces)), ("tank", clean("tank")), ("thick", shell(clean("skirt"), 2e-3)),
        ("ring", eyelet(*front_places(clean("tank"))[0])),
    ]  # fmt: skip
    garment = read(write_objects(tmp_path / "all.obj", things))
    assert metres_per_unit(garment.rest_pos, garment.faces, body.v_template) == 1.0
    found = {item.name: item.seems for item in items_of(garment, 1.0, body.v_template)}
    assert found == {
        "Avatar": "a body", "tank": "cloth with 4 openings", "thick": "cloth 2.0 mm thick, closed",
        "ring": "a small thing such as a button",
    }  # fmt: skip
