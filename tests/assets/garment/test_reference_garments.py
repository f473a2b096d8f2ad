"""Garments in pickles of the reference implementation."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hood.assets.garment.garment import load_garment
from hood.testing import grid


def entry() -> dict[str, Any]:
    pos, faces = grid(4, 4, 0.3)
    node_type = np.zeros((16, 1), dtype=np.int64)
    node_type[:4] = 3
    weights = np.random.default_rng(0).uniform(0.1, 1, (16, 24))
    return {
        "rest_pos": pos.astype(np.float32),
        "faces": faces.astype(np.int32),
        "node_type": node_type,
        "lbs": {
            "v": (pos + [0, 1, 0]).astype(np.float32),
            "f": faces,
            "shapedirs": np.zeros((16, 3, 10)),
            "posedirs": np.zeros((207, 48)),
            "lbs_weights": weights,
        },
        "center": [5, 6],
        "coarse_edges": {
            5: {0: np.array([[0, 2], [2, 8]]), 1: np.array([[0, 8]])},
            6: {0: np.array([[1, 3]]), 1: np.array([[1, 3]])},
        },
    }


def write(path: Path, content: Any) -> Path:
    path.write_bytes(pickle.dumps(content))
    return path


def test_a_garment_chosen_by_name(tmp_path: Path) -> None:
    content = entry()
    path = write(tmp_path / "garments_dict.pkl", {"dress": content, "cape": {**content, "node_type": None}})
    dress = load_garment(f"{path}:dress")
    assert dress.name == "dress"
    assert dress.bound
    assert dress.bound_to is None
    np.testing.assert_array_equal(np.flatnonzero(dress.pinned), [0, 1, 2, 3])
    np.testing.assert_allclose(dress.lbs_weights.sum(axis=1), 1.0)
    np.testing.assert_allclose(dress.tpose(np.zeros(10)) - dress.shaped(np.zeros(10)), [[0, 1, 0]] * 16, atol=1e-6)
    assert [level.tolist() for level in dress.coarse_edges] == [[[0, 2], [2, 8]], [[0, 8]]]
    assert not load_garment(f"{path}:cape").pinned.any()


def test_a_template_and_a_single_entry(tmp_path: Path) -> None:
    content = entry()
    template = {
        "vertices": content["rest_pos"],
        "faces": content["faces"],
        "center": 5,
        "coarse_edges": content["coarse_edges"],
    }
    garment = load_garment(write(tmp_path / "cape.pkl", template))
    assert garment.name == "cape"
    assert not garment.bound
    assert len(garment.coarse_edges) == 2
    assert load_garment(write(tmp_path / "one.pkl", {"vest": content})).name == "vest"


def spoilt(change: dict[str, Any]) -> dict[str, Any]:
    return {"dress": {**entry(), **change}}


REFUSED = {
    "name": (spoilt({}), "dres", "did you mean 'dress'"),
    "which": ({"a": entry(), "b": entry()}, None, r"holds 2 garments; choose one, garments\.pkl:a"),
    "list": ([1, 2], None, "holds list"),
    "other": ({"pose": np.zeros(3)}, None, "not a garment file"),
    "shape": (spoilt({"rest_pos": np.zeros((16, 2))}), None, r"rest_pos has shape \(16, 2\)"),
    "text": (spoilt({"rest_pos": "zero"}), None, "rest_pos is"),
    "types": (spoilt({"node_type": np.zeros(5)}), None, "5 rows for 16 vertices"),
    "weights": (spoilt({"lbs": {"lbs_weights": np.zeros((16, 24))}}), None, "sum to zero"),
    "faces": (spoilt({"faces": entry()["faces"] + 0.5}), None, "not whole numbers"),
    "level": (spoilt({"coarse_edges": {0: np.array([[0, 99]])}}), None, "no such vertex"),
    "odd": (spoilt({"coarse_edges": {0: np.zeros(3)}}), None, "not pairs"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refusals_name_file_and_field(tmp_path: Path, case: str) -> None:
    content, name, words = REFUSED[case]
    path = write(tmp_path / "garments.pkl", content)
    with pytest.raises(ValueError, match=words) as error:
        load_garment(f"{path}:{name}" if name else path)
    assert "garments.pkl" in str(error.value)
    assert "\n" not in str(error.value)
