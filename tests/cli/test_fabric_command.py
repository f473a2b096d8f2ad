"""``hood fabric``: what it prints and writes, and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from hood.app.settings.compose import options
from hood.assets.material import Material
from hood.cli.fabric import described
from hood.cli.main import main


def test_without_names_all_fabrics_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fabric"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[2 : 2 + len(options("material"))]] == options("material")
    denim = next(line.split() for line in lines if line.startswith("denim_12oz"))
    assert denim[1:] == ["407", "24000", "10000", "507", "169", "90/45", "25.7"]
    assert "drapes the fabrics that are named" in lines[-1]


def test_a_plain_fabric_is_told_as_the_isotropic_one_it_is() -> None:
    fabric = described("default")
    default = Material()
    assert not fabric.measured
    assert fabric.stretch == fabric.simulated_stretch
    assert fabric.stretch[0] == fabric.stretch[1]
    assert fabric.shear == pytest.approx(default.lame_mu * default.thickness)
    assert fabric.bending == pytest.approx((0.25 * default.bending_stiffness,) * 2)
    assert described("linen").measured


def test_woven_cloth_is_simulated_as_it_was_measured(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fabric", "denim_12oz", "linen", "default", "woven=true", "edges=[]"]) == 0
    rows = {line.split()[0]: line.split() for line in capsys.readouterr().out.splitlines() if line}
    assert rows["denim_12oz"][2:6] == ["24000", "10000", "24000/10000", "169"]
    assert rows["linen"][2:6] == ["20000", "14000", "20000/14000", "45"]
    assert rows["default"][4] == rows["default"][2]
    assert described("linen", woven=True).simulated_stretch == pytest.approx((20000.0, 14000.0))
    assert described("linen").simulated_stretch == pytest.approx((135.0, 135.0))


def test_fabrics_are_draped_and_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib")
    words = ["fabric", "chiffon", "denim_12oz", "edges=[0.03,0.025]", f"output={tmp_path}"]
    assert main(words) == 0
    out = capsys.readouterr().out
    record = json.loads((tmp_path / "fabrics.json").read_text())
    assert list(record) == ["chiffon", "denim_12oz"]
    for name, fabric in record.items():
        assert [found["edge"] for found in fabric["drape"]] == [0.03, 0.025]
        coarse, fine = fabric["drape"]
        assert coarse["vertices"] < fine["vertices"]
        assert fine["states"][0]["coefficient"] == fine["coefficient"]
        row = [line.split() for line in out.splitlines() if line.startswith(name)][-1]
        assert row[1:3] == [f"{100 * found['coefficient']:.1f}%" for found in fabric["drape"]]
    assert record["chiffon"]["drape"][1]["coefficient"] < record["denim_12oz"]["drape"][1]["coefficient"]
    assert record["denim_12oz"]["stretch_weft"] == 10000.0
    assert record["denim_12oz"]["simulated"]["bending_stiffness"] == pytest.approx(4 * 67.5e-6)
    assert (tmp_path / "shadows.png").stat().st_size > 5_000


def test_without_a_drape_test_only_the_table_is_written(tmp_path: Path) -> None:
    assert main(["fabric", "linen", "edges=[]", f"output={tmp_path}"]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["fabrics.json"]
    assert json.loads((tmp_path / "fabrics.json").read_text())["linen"]["drape"] == []


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["silk_habotay"], "unknown fabric 'silk_habotay': did you mean 'silk_habotai'"),
        (["linen", "linen"], "fabrics: 'linen' is given twice"),
        (["linen", "edges=[0.1]"], "edges: 0.1 is no edge of a mesh; give metres from 0.002 to 0.03"),
        (["linen", "edges=[a]"], "edges: 'a' is no edge of a mesh"),
        (["linen", "edges=[0.01,0.01]"], "edges: 0.01 is given twice"),
        (["linen", "edge=0.01"], "unknown key 'edge': did you mean 'edges'"),
        (["linen", "woven=yes please"], "woven=yes please: give true or false, such as woven=false"),
        (["linen", "--json"], "unknown option '--json'"),
    ],
)
def test_what_cannot_be_draped_is_refused(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fabric", *words]) == 2
    assert message in capsys.readouterr().err
