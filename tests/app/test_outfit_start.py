"""Outfits of the command line: in which order they are worn, and that they start and stay apart."""

import json
from pathlib import Path

import pytest

from hood.app.scene.garments import layer_order
from hood.app.settings.compose import ConfigError
from hood.cli.main import main


def test_layers_are_named_from_the_body_outwards() -> None:
    assert layer_order("auto", ["tank", "skirt"]) is None
    assert layer_order(["skirt", "tank"], ["tank", "skirt"]) == (1, 0)
    assert layer_order(["b", "a"], ["clothes/a.obj", "clothes/b.obj"]) == (1, 0)
    assert layer_order(["tank", "tank"], ["tank", "tank"]) == (0, 1)


@pytest.mark.parametrize("given", [["tank"], ["tank", "tank"], ["tank", "skirt", "dress"], "skirt"])
def test_layers_that_are_not_the_garments_are_refused(given: object) -> None:
    with pytest.raises(ConfigError, match=r"give all garments from the body outwards, layers=\[tank,skirt\] or another order"):
        layer_order(given, ["tank", "skirt"])


@pytest.mark.usefixtures("compiled_layers")
@pytest.mark.parametrize("keys", [("stepper=newton",), ("stepper=refine", "refine=5", "layers=[trousers,tshirt]")])
def test_an_outfit_starts_and_stays_apart(keys: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    common = (
        "garment=[tshirt,trousers]",
        "num_frames=6",
        f"output={out}",
        "video=none",
        "sheet=false",
        "metrics={surface_every:1}",
    )
    assert main(["rollout", *common, *keys]) == 0
    summary = json.loads((out / "summary.json").read_text())
    assert summary["surface"]["garment_crossings"]["worst"] == 0
    assert summary["cloth_contact"]["used"] == "on"
    said = capsys.readouterr().err
    assert "taken apart; from the body outwards: trousers, tshirt" in said
    assert ("or another order settles it" in said) == ("layers=[trousers,tshirt]" not in keys)
    assert summary["strain_p99"] < 0.15


def test_without_contact_an_outfit_starts_as_it_is_put_on(tmp_path: Path) -> None:
    out = tmp_path / "out"
    keys = ("garment=[tank,skirt]", "sequence=plie", "stepper=newton", "cloth_contact=off", "settle=paper", "num_frames=2")
    assert main(["rollout", *keys, f"output={out}", "video=none", "sheet=false"]) == 3
    summary = json.loads((out / "summary.json").read_text())
    assert [reason["kind"] for reason in summary["reasons"]] == ["garments_through_each_other"]
    assert summary["surface"]["garment_crossings"]["worst"] > 100
    assert summary["cloth_contact"] == {"asked": "off", "used": "off"}
