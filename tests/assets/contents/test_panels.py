"""Panels: what the objects, groups and materials of an OBJ file become, and that they stay with their faces."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hood.assets.fitting import alterations
from hood.assets.formats.mesh_file import read_mesh_file
from hood.assets.formats.raw_mesh import MOST_PANELS
from hood.assets.garment.garment import Garment, load_garment, save_garment
from hood.assets.garment.record import start_fitting

POINTS = "".join(f"v {x} {y} 0\n" for y in range(3) for x in range(4))
#: A quad and triangles of two objects, with groups and materials across them.
PANELLED = f"""mtllib cloth.mtl
{POINTS}o front left
g default
usemtl denim
f 1 2 6 5
g yoke seams
f 2 3 7
usemtl None
o back
f 2 7 6
g
f 3 4 8
f 3 8 7
usemtl denim
f 5 6 10
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "shirt.obj"
    path.write_text(text)
    return path


def test_names_of_polygons_are_panels(tmp_path: Path) -> None:
    mesh = read_mesh_file(write(tmp_path, PANELLED), split_polygons=True)
    assert mesh.panels is not None
    faces = {name: np.flatnonzero(mask).tolist() for name, mask in mesh.panels.items()}
    assert faces == {"front left": [0, 1, 2], "denim": [0, 1, 2, 6], "yoke": [2, 3], "seams": [2, 3], "back": [3, 4, 5, 6]}
    np.testing.assert_array_equal(mesh.faces[0:2].max(axis=0) < 6, True)


def test_names_of_panels_are_folded(tmp_path: Path) -> None:
    given = "Schößchen", "Übertritt", "Schoesschen", "ns:front", "Shirt.001", "Scho\u0308\u00dfchen", "左袖", "pièce (2)", "§"
    text = "".join(f"usemtl {name}\nf 1 2 6\n" for name in given)
    panels = read_mesh_file(write(tmp_path, POINTS + text)).panels
    assert panels is not None
    assert {name: np.flatnonzero(mask).tolist() for name, mask in panels.items()} == {
        "Schoesschen_2": [0], "Uebertritt": [1], "Schoesschen": [2], "ns_front": [3], "Shirt.001": [4], "Schoesschen_3": [5],
        "u5de6u8896": [6], "piece_2": [7], "_": [8],
    }  # fmt: skip


@pytest.mark.parametrize("names", ["", "o shirt\n", "o shirt\ng default\nusemtl None\n", "g off\n"])
def test_a_name_of_all_faces_is_no_panel(tmp_path: Path, names: str) -> None:
    text = POINTS + names + "f 1 2 6\nf 2 7 6\n"
    assert read_mesh_file(write(tmp_path, text)).panels is None


def test_too_many_names_are_said_and_not_kept(tmp_path: Path) -> None:
    faces = "".join(f"g face{k}\nf 1 2 6\n" for k in range(MOST_PANELS + 1))
    mesh = read_mesh_file(write(tmp_path, POINTS + faces))
    assert mesh.panels is None
    assert mesh.notes == (
        f"{MOST_PANELS + 1} names of objects, groups and materials are more than {MOST_PANELS}; none is kept",
    )


def test_panels_stay_with_their_faces_through_repairs(tmp_path: Path) -> None:
    """A face without area goes, one that is wound the wrong way is turned, a seam is welded."""
    lines = ["v 0 0 0", "v 1 0 0", "v 1 1 0", "v 0 1 0", "v 1 0 0", "v 1 1 0", "v 2 0 0", "v 2 1 0"]
    text = (
        "\n".join([*lines, "g left", "f 1 2 3", "f 1 1 3", "f 1 3 4", "g right", "f 5 7 8", "f 5 6 8", "g gone", "f 7 7 8"])
        + "\n"
    )
    fitting = start_fitting(load_unchecked(write(tmp_path, text)))
    alterations.sew(fitting, 1e-3)
    alterations.clean(fitting)
    panels = fitting.garment.panels
    assert panels is not None
    assert len(fitting.garment.rest_pos) == 6
    assert {name: mask.tolist() for name, mask in panels.items()} == {
        "left": [True, True, False, False],
        "right": [False, False, True, True],
    }
    right = fitting.garment.rest_pos[fitting.garment.faces[panels["right"]]]
    assert right[..., 0].min() == 1.0


def load_unchecked(path: Path) -> Garment:
    from hood.assets.garment.garment import garment_of_mesh

    return garment_of_mesh(path, read_mesh_file(path))


def test_a_garment_file_keeps_them(tmp_path: Path) -> None:
    pos = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    faces, panels = np.array([[0, 1, 2], [1, 3, 2]]), {"front left": np.array([True, False]), "a/b": np.array([False, True])}
    save_garment(tmp_path / "g.npz", Garment("g", pos, faces, np.zeros(4, bool), panels=panels))
    kept = load_garment(tmp_path / "g.npz").panels
    assert kept is not None
    assert {name: mask.tolist() for name, mask in kept.items()} == {"front left": [True, False], "a/b": [False, True]}
    for wrong in (np.array([True]), np.array([0, 1])):
        np.savez(tmp_path / "g.npz", rest_pos=pos, faces=faces, panel_front=wrong)
        with pytest.raises(ValueError, match=r"panel_front is .*; give one bool a face, \(2,\)"):
            load_garment(tmp_path / "g.npz")
