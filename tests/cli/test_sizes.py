"""``hood sizes``: a size run in words and on one sheet."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hood.cli.main import main


def test_sizes_on_bodies_give_a_table_a_record_and_a_sheet(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [
        "garment=trousers",
        "sizes={XS:0.8,L:[1.1,1,1.1]}",
        "shapes=[[],[2]]",
        "num_frames=3",
        f"output={tmp_path / 'run'}",
    ]
    assert main(["sizes", *words]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[0].split()[:3] == ["shape", "size", "sits"]
    assert [line.split()[:2] for line in printed[1:5]] == [["mean", "XS"], ["mean", "L"], ["[2]", "XS"], ["[2]", "L"]]
    rows = json.loads((tmp_path / "run" / "sizes.json").read_text())
    by = {(row["size"], len(row["shape"])): row for row in rows}
    assert by["XS", 0]["word"] == "tight"
    assert by["L", 0]["word"] == "fits"
    assert by["XS", 0]["gap"][1] < by["L", 0]["gap"][1]
    assert by["XS", 1]["stretch"] > by["XS", 0]["stretch"]  # a wider body, the same pattern
    sheet = np.asarray(Image.open(tmp_path / "run" / "sheet.png"))
    assert sheet.shape == (2 * 460, 2 * 300, 3)
    assert len(np.unique(sheet.reshape(-1, 3), axis=0)) > 1000


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("sizes=[1,2]", "sizes=[1,2]: give names and factors"),
        ("sizes={M:9}", "size=9"),
        ("shapes=[1]", "shapes=[1]: give lists of shape coefficients"),
        ("fit=everybody", "unknown value for fit 'everybody'"),
        ("body=none", "there is nobody who wears the garment"),
        ("garment=tshrt", "did you mean 'tshirt'"),
    ],
)
def test_what_is_no_size_run_is_refused_in_a_sentence(
    word: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["sizes", word, "num_frames=1", f"output={tmp_path / 'run'}"]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()[-1:]
    assert line.startswith("hood: error:")
    assert message in line
