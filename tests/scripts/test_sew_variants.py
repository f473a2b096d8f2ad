"""The script that sews random variants of the own designs into a folder."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hood.assets.garment.garment import garments_in, load_garment
from hood.assets.pattern.designs import DESIGNS

PROGRAM: dict[str, Any] = runpy.run_path(str(Path(__file__).parents[2] / "scripts" / "sew_variants.py"))


def test_options_are_those_of_the_design_and_of_the_seed() -> None:
    for design, known in DESIGNS.items():
        drawn = [PROGRAM["draw_options"](design, 0, number) for number in range(20)]
        assert drawn == [PROGRAM["draw_options"](design, 0, number) for number in range(20)]
        assert drawn[0] != PROGRAM["draw_options"](design, 1, 0)
        for options in drawn:
            assert list(options) == list(known.options)
            for key, value in options.items():
                choices = known.options[key]
                assert value in choices if isinstance(value, str) else choices[1] <= value <= choices[2]


def test_a_folder_is_filled_and_what_is_there_stays(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [str(tmp_path), "--designs", "tank", "shorts", "--edge", "0.06", "--count", "1"]
    assert PROGRAM["main"](words) == 0
    (file,) = garments_in(tmp_path)
    assert file.name == "000_tank.npz"
    assert np.isfinite(load_garment(file).rest_pos).all()
    written = file.stat().st_mtime_ns
    assert PROGRAM["main"](words) == 0
    assert capsys.readouterr().out.count(f"1 of 1 garments in {tmp_path}") == 2
    assert file.stat().st_mtime_ns == written
    assert list(tmp_path.iterdir()) == [file]


def test_what_cannot_be_sewn_is_told_and_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert PROGRAM["main"]([str(tmp_path), "--count", "1", "--designs", "tank", "--edge", "0.2"]) == 1
    said = capsys.readouterr().out
    assert said.count("edge=0.2") == 5
    assert "0 of 1 garments" in said
    assert not list(tmp_path.iterdir())
