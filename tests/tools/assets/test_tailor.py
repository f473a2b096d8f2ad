"""What the tailor sewed into the committed garments."""

from __future__ import annotations

import numpy as np
import pytest

from hood.assets.files.library import DATA_FOLDER, names
from hood.assets.garment.pins import MARKS
from tools.assets.patterns import PATTERNS
from tools.assets.tailor import firmness


@pytest.mark.parametrize("name", [name for name in names("garments") if name.split("_")[0] in PATTERNS])
def test_bindings_and_linings_are_stiffer(name: str) -> None:
    with np.load(DATA_FOLDER / "garments" / f"{name}.npz", allow_pickle=False) as archive:
        arrays = {key: archive[key] for key in archive.files}
    pattern = PATTERNS[name.split("_")[0]]
    verts, faces = arrays["rest_pos"].astype(np.float64), arrays["faces"].astype(np.int64)
    expected = firmness(pattern.firm, verts, faces, arrays["region"])
    if expected is None:
        assert "stiffness" not in arrays
        return
    np.testing.assert_array_equal(arrays["stiffness"], expected)
    assert set(expected.tolist()) == {1.0, 2.0}
    where = verts[expected > 1.0]
    if pattern.legs:
        assert np.abs(where[:, 0]).max() < 0.08
        assert where[:, 1].max() < 0.04
    else:
        assert (expected[np.isin(arrays["region"], [MARKS.index("neckline"), MARKS.index("armhole_left")])] == 2.0).all()
    assert 0.01 < (expected > 1.0).mean() < 0.08
