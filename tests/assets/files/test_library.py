"""Names of embedded assets and the messages for those that do not exist."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hood.assets.files.library import locate, motion_split, names, read_arrays, unknown


@pytest.mark.parametrize(
    "kind, what, given, near",
    [
        ("garments", "garment", "tshrt", "tshirt"),
        ("motions", "sequence", "walk_prod", "walk_proud"),
        ("body", "body", "defautl", "default"),
    ],
)
def test_a_misspelt_name_names_its_neighbour(kind: str, what: str, given: str, near: str) -> None:
    with pytest.raises(FileNotFoundError, match=f"unknown {what} '{given}': did you mean '{near}'"):
        locate(kind, given)


def test_a_name_like_nothing_lists_what_exists() -> None:
    with pytest.raises(FileNotFoundError) as error:
        locate("garments", "zzzzzz")
    assert "did you mean" not in str(error.value)
    assert all(name.removesuffix("_4k").removesuffix("_12k") in str(error.value) for name in names("garments"))


def test_a_missing_path_is_named(tmp_path: Path) -> None:
    for given in ("folder/shirt", "shirt.obj", tmp_path / "shirt.obj"):
        with pytest.raises(FileNotFoundError, match="no such file"):
            locate("garments", given)


def test_embedded_names_win_and_files_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "dress").write_text("not the dress")
    (tmp_path / "mine.npz").write_text("")
    assert locate("garments", "dress").name == "dress.npz"
    assert locate("garments", "mine.npz") == Path("mine.npz")
    # A folder is no file.
    with pytest.raises(FileNotFoundError):
        locate("garments", tmp_path)


@pytest.mark.parametrize("name", ["ours", "fine15", "fine48"])
def test_a_former_name_finds_the_same_file_and_says_its_name_of_today(name: str) -> None:
    with pytest.warns(UserWarning, match=f"checkpoint {name} is called small-{name} now: a small model, not the paper's"):
        assert locate("weights", name).name == f"small-{name}.safetensors"
    assert name not in names("weights")


def test_unknown_without_any_known() -> None:
    assert unknown("weights name", "quick", []) == "unknown weights name 'quick': known are none"


def test_sizes_of_a_garment_are_named_once() -> None:
    known = ["dress", "dress_12k", "dress_4k", "tank", "tank_4k", "two_4k"]
    assert unknown("garment", "drss_4k", known) == (
        "unknown garment 'drss_4k': did you mean 'dress_4k'? known are dress, tank, two_4k, most also with _4k, _12k"
    )


def test_split_names_exist_and_do_not_overlap() -> None:
    split = motion_split()
    assert set(split) == {"train", "validation"}
    assert not set(split["train"]) & set(split["validation"])
    assert set(split["train"]) | set(split["validation"]) <= set(names("motions"))


def test_arrays_are_never_unpickled(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", data=np.arange(3), note=np.array([{"x": 1}], dtype=object))
    assert set(read_arrays(tmp_path / "a.npz", ("data",), "thing")) == {"data"}
    with pytest.raises(ValueError, match=r"a\.npz: not a readable thing"):
        read_arrays(tmp_path / "a.npz", ("note",), "thing")
    with pytest.raises(ValueError, match="key 'missing' is missing"):
        read_arrays(tmp_path / "a.npz", ("missing",), "thing")
    with pytest.raises(FileNotFoundError):
        read_arrays(tmp_path / "none.npz", ("data",), "thing")
