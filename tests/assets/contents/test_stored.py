"""What rides on a garment, its thickness and the names of its garments are kept in its file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from garment_kinds import KINDS

from hood.assets.body.load import load_body
from hood.assets.contents.sort_out import mend
from hood.assets.formats.mesh_file import read_mesh_file
from hood.assets.garment.garment import Garment, checked_garment, garment_of_mesh, load_garment, save_garment
from hood.assets.garment.outfit import join_garments
from hood.assets.garment.parts import tailored
from hood.assets.garment.record import Wanted, start_fitting
from hood.training.scenes import mirror_garment


def made(name: str, folder: Path) -> Garment:
    path = KINDS[name].write(folder)
    fitting = start_fitting(garment_of_mesh(path, read_mesh_file(path)))
    mend(fitting, Wanted(), load_body().v_template)
    return fitting.garment


@pytest.fixture
def buttoned(tmp_path: Path) -> Garment:
    return made("buttons", tmp_path)


def test_riders_and_thickness_are_read_back(buttoned: Garment, tmp_path: Path) -> None:
    thick = replace(buttoned, thickness=np.full(len(buttoned.rest_pos), 2e-3))
    save_garment(tmp_path / "stored.npz", thick)
    found = load_garment(tmp_path / "stored.npz")
    assert found.riders is not None
    assert buttoned.riders is not None
    for key, table in vars(buttoned.riders).items():
        np.testing.assert_array_equal(getattr(found.riders, key), table)
    np.testing.assert_array_equal(found.thickness, thick.thickness)
    assert found.file_numbers is None
    assert checked_garment(found) is found


def test_names_of_garments_are_read_back(tmp_path: Path) -> None:
    outfit = made("two garments by o", tmp_path)
    save_garment(tmp_path / "stored.npz", outfit)
    assert load_garment(tmp_path / "stored.npz").name == "tank+skirt"
    save_garment(tmp_path / "alone.npz", replace(outfit, piece=None))
    assert load_garment(tmp_path / "alone.npz").name == "alone"


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("rider_faces", None, "has rider_pos and no rider_faces"),
        ("rider_anchors", [99999], "rider_anchors holds 99999; give numbers from 0 to 1015"),
        ("rider_faces", [[0, 1, 900]], "rider_faces holds 900"),
        ("rider_group", [0, 1, 2, 3], "do not fit each other"),
        ("rider_pos", [[0.0, np.nan, 0.0]], "row 0, which is not finite"),
        ("rider_anchor_group", [[0]], "must be"),
    ],
)
def test_riders_that_do_not_fit_are_refused(buttoned: Garment, tmp_path: Path, key: str, value: list | None, says: str) -> None:
    save_garment(tmp_path / "stored.npz", buttoned)
    with np.load(tmp_path / "stored.npz") as archive:
        arrays = dict(archive)
    del arrays[key]
    if value is not None:
        arrays[key] = np.array(value)
    np.savez(tmp_path / "broken.npz", **arrays)
    with pytest.raises(ValueError, match=says):
        load_garment(tmp_path / "broken.npz")


def test_riders_go_where_their_garment_goes(buttoned: Garment, tmp_path: Path) -> None:
    """Joined to others, mirrored, and on a garment that is cut larger, where they keep their size."""
    outfit = join_garments([made("a pocket", tmp_path), buttoned])
    assert outfit.riders is not None
    assert buttoned.riders is not None
    count = len(buttoned.riders.pos)
    there = outfit.riders.positions(outfit.rest_pos * 1.0 + 1.0, outfit.rest_pos)
    np.testing.assert_allclose(there[-count:], buttoned.riders.pos + 1.0, atol=1e-9)
    image = mirror_garment(buttoned)
    assert image.riders is not None
    np.testing.assert_allclose(
        image.riders.positions(image.rest_pos, image.rest_pos), buttoned.riders.pos * [-1.0, 1.0, 1.0], atol=1e-9
    )
    large = tailored(buttoned, {buttoned.name: 1.2})
    assert large.riders is not None
    size = [np.ptp(riders.pos[riders.group == 0], axis=0).max() for riders in (buttoned.riders, large.riders)]
    assert size[1] == pytest.approx(size[0], rel=0.1)
