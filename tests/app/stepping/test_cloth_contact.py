"""``cloth_contact=``: what it asks for, what the summary says, and where it cannot be had."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from belt import write_belt, write_walk

from hood.app.settings.rollout_settings import RolloutSettings
from hood.app.stepping.cloth_contact import _why_not, describe_cloth_contact, summarise_cloth_contact
from hood.cli.main import main
from hood.energies.contact import Collision
from hood.energies.friction import CodedFriction, WeightFriction
from hood.energies.potential import Potential, coded_potential, default_potential, reference_potential
from hood.solver.step_figures import LAYER_METRICS

COMMAND = ["rollout", "stepper=newton", "sequence=walk.npz", "num_frames=4", "video=none", "sheet=false"]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_walk(Path("walk.npz"), 6)


def _run(*more: str) -> tuple[dict[str, Any], np.ndarray]:
    assert main([*COMMAND, *more, "output=out"]) in (0, 3)
    with h5py.File("out/rollout.h5", "r") as file:
        pos = file["cloth/pos"][:]
    return json.loads(Path("out/summary.json").read_text()), pos


@pytest.mark.usefixtures("compiled_layers")
def test_cloth_that_meets_none_moves_to_the_bit_as_without(capsys: pytest.CaptureFixture[str]) -> None:
    write_belt(Path("belt.obj"))
    auto, with_contact = _run("garment=belt.obj", "metrics=strain")
    said = capsys.readouterr().out
    off, without = _run("garment=belt.obj", "metrics=strain", "cloth_contact=off")
    assert auto["cloth_contact"]["used"] == "on"
    assert auto["cloth_contact"]["frames_with_contact"] == 0
    assert "cloth against cloth: no frame" in said
    assert off["cloth_contact"] == {"asked": "off", "used": "off"}
    assert "cloth against cloth" not in capsys.readouterr().out
    np.testing.assert_array_equal(with_contact, without)


@pytest.mark.usefixtures("compiled_layers")
def test_a_sleeve_that_meets_itself_is_kept_apart() -> None:
    """From when the elbows are bent."""
    found, _ = _run("garment=longsleeve", "sequence=dance_mixed", "start=0.8", "metrics={surface_every:1}")
    assert found["cloth_contact"]["frames_with_contact"] > 0
    assert found["cloth_contact"]["frames_with_crossed_cloth"] == []
    assert found["surface"]["self_crossings"]["worst"] == 0


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        (["stepper=network", "refine=0", "cloth_contact=on"], "a network alone does not keep layers of cloth apart"),
        (["stepper=refine", "refine={goal:2,method:sweeps}", "cloth_contact=on"], "use method:newton"),
        (["step=fixed", "cloth_contact=layers"], "use step=plain"),
        (["cloth_contact=maybe"], "cloth_contact"),
        (["cloth_contact={friction:-0.1}"], "give a coefficient of at least 0"),
    ],
)
def test_what_cannot_be_had_is_refused(more: list[str], sentence: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*COMMAND, "garment=longsleeve", *more]) == 2
    assert sentence in capsys.readouterr().err


@pytest.mark.parametrize(
    ("more", "reason", "said"),
    [
        (["step=fixed"], "step=fixed has fixed shapes", "cloth_contact=auto: off; step=fixed has fixed shapes"),
        (["stepper=refine", "refine={goal:1,method:sweeps}"], "use method:newton", "method:sweeps,…} moves"),
        (["losses=reference"], "cloth_contact=on adds it", "are those of published code"),
        (["stepper=network", "refine=0", "checkpoint=untrained", "model=small"], "add refine=5", ""),
    ],
)
def test_auto_that_cannot_act_says_why(more: list[str], reason: str, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    write_belt(Path("belt.obj"))
    found, _ = _run("garment=belt.obj", "metrics=strain", *more)
    assert found["cloth_contact"]["used"] == "off"
    assert reason in found["cloth_contact"]["reason"]
    out = capsys.readouterr().out
    assert said in out
    assert ("cloth_contact" in out) == bool(said)  # a network alone is not expected to


class OwnCollision(Collision):
    """Contact that somebody has written."""


@pytest.mark.usefixtures("compiled_layers")
def test_only_losses_of_published_code_have_no_contact_of_cloth_by_themselves() -> None:
    config, default = RolloutSettings.from_words(["stepper=newton"]), default_potential()
    without = Potential({name: term for name, term in default.terms.items() if name not in ("collision", "friction")})
    for potential in (default, without, default.with_terms(collision=OwnCollision()), without.with_terms(other=OwnCollision())):
        assert _why_not(config, potential) == ""
    assert _why_not(config, default.with_terms(friction=WeightFriction())) == ""
    published = reference_potential(), coded_potential(), without.with_terms(friction=CodedFriction())
    for potential in published:
        assert "are those of published code" in _why_not(config, potential)
    assert _why_not(config, reference_potential().with_terms(collision=OwnCollision())) == ""


@pytest.mark.usefixtures("compiled_layers")
def test_layers_are_kept_apart_without_contact_with_the_body() -> None:
    write_belt(Path("belt.obj"))
    found, pos = _run("garment=belt.obj", "metrics=strain", "losses.terms.collision=null", "losses.terms.friction=null")
    assert found["cloth_contact"]["used"] == "on"
    assert np.isfinite(pos).all()


def test_garments_that_nothing_keeps_apart_are_warned_about(capsys: pytest.CaptureFixture[str]) -> None:
    write_belt(Path("belt.obj"))
    write_belt(Path("band.obj"))
    found, _ = _run("garment=[belt.obj,band.obj]", "checkpoint=untrained", "model=small", "stepper=network", "refine=0")
    said = capsys.readouterr()
    assert "the 2 garments are not kept apart, and not taken apart at the start: a network alone does not" in said.err
    assert any("the 2 garments are not kept apart" in sentence for sentence in found["warnings"])
    assert "layers=" not in said.err
    assert "cloth against cloth: off; a network alone does not keep layers of cloth apart; add refine=5" in said.out


def test_an_order_without_contact_has_no_effect_and_that_is_told() -> None:
    write_belt(Path("belt.obj"))
    write_belt(Path("band.obj"))
    garments = ("garment=[belt.obj,band.obj]", "layers=[band,belt]", "metrics=none", "settle=paper")
    found, _ = _run(*garments, "cloth_contact=off")
    assert "outfit: layers=… has no effect where cloth_contact is off" in found["warnings"]


def test_sentences_name_crossed_starts_and_forced_and_late_pins() -> None:
    columns = {name: np.zeros(5) for name in LAYER_METRICS}
    columns["layer_contacts"][2:] = 7
    columns["layer_crossed"][3] = 12
    columns["layer_forced"][4] = 2
    found = summarise_cloth_contact({"cloth_contact": "auto"}, columns)
    rough = summarise_cloth_contact({"cloth_contact": {"friction": 0.5}}, columns)
    assert (found["cloth_contact"]["friction"], rough["cloth_contact"]["friction"]) == (0.0, 0.5)
    text = "\n".join(describe_cloth_contact(found))
    assert "3 frames (2 to 4), up to 7 pairs" in text
    assert "1 steps (the first to frame 3) began with cloth through cloth, up to 12 pairs of triangles" in text
    assert "in 1 steps (the first to frame 4) held vertices drive cloth through cloth" in text
    assert "short of" not in text
    assert found["cloth_contact"]["pin_lag_max"] == 0.0
    columns["pin_lag"][2:4] = 0.5e-3, 3.2e-3
    late = summarise_cloth_contact({"cloth_contact": "auto"}, columns)
    assert late["cloth_contact"]["frames_with_late_pins"] == [2, 3]
    text = "\n".join(describe_cloth_contact(late))
    assert "in 2 frames (the first 2) held vertices stop up to 3.2 mm short of where they should be" in text
    del columns["pin_lag"]  # a file from before
    assert summarise_cloth_contact({"cloth_contact": "auto"}, columns) == found
