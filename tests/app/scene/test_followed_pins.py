"""``pins=`` with weights and with what they follow: from words to the summary."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from hood.app.settings.rollout_settings import RolloutSettings
from hood.app.setup import make_scene
from hood.app.stepping.cloth_contact import potential_of
from hood.cli.main import main
from hood.rollouts.file.reader import read_rollout

SHORT = ["rollout", "garment=tank", "sequence=plie", "stepper=newton", "num_frames=4", "video=none", "sheet=false",
         "cloth_contact=off", "metrics=strain", "guard=off", "settle=0"]  # fmt: skip
UNTRAINED = ["checkpoint=untrained", "model=small", "model.latent_dim=4", "model.schedule='1x(mesh)'"]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HOOD_TRACEBACK", raising=False)


def test_the_summary_tells_what_is_held_by_what(capsys: pytest.CaptureFixture[str]) -> None:
    Path("pins.json").write_text(json.dumps({"vertices": [3, 4], "weights": [0.5, 1.0], "follows": "skin"}))
    words = "pins=[{vertices: hem, follows: below_spine2}, pins.json]"
    assert main([*SHORT, words, "output=run"]) == 0
    first, second = json.loads(Path("run/summary.json").read_text())["pins"]
    assert first["vertices"] > 20
    assert (first["soft"], first["follows"], first["off_soft_max_m"]) == (0, "below_spine2", None)
    assert first["off_max_m"] < 1e-5
    assert (second["vertices"], second["soft"], second["stiffness_N_per_m"], second["follows"]) == (2, 1, [10.0, 10.0], "skin")
    assert 0.0 < second["off_soft_max_m"] < 0.05
    said = capsys.readouterr().out
    assert "they follow below_spine2" in said
    assert "1 by springs of 10 N/m, at most" in said
    pinned = read_rollout("run/rollout.h5").still["pinned"]
    assert 4 in pinned
    assert 3 not in pinned


def test_without_a_body_springs_hold_and_can_be_let_go() -> None:
    words = [*SHORT, "body=none", "sequence=none", "num_frames=6", "output=run"]
    top = [f"pins={{vertices: {list(range(40))}, weights: 0.8}}"]
    assert main([*words, *top, "events=[{frame: 2, detach: pins}]"]) in (0, 3)
    free = read_rollout("run/rollout.h5").cloth_pos
    assert main([*words, *top]) in (0, 3)
    held = read_rollout("run/rollout.h5").cloth_pos
    assert np.array_equal(free[:3], held[:3])
    assert (held[5] - free[5])[:, 1].max() > 0.01  # fallen


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["pins={vertices: hem, follows: spin1}"], "pins: follows: part 'spin1': unknown joint 'spin1': did you mean"),
        (["pins={vertices: hem, follows: left_foot}"], "from the nearest skin of what it is to follow (left_foot), beyond"),
        (["pins={vertices: hem, weight: 1}"], "pins: unknown key 'weight': did you mean 'weights'?"),
        (["pins={vertices: [1], follows: [99999999]}"], "pins: follows: vertex 99999999 of "),
        (["pins={vertices: [1], follows: skin}", "body=none", "sequence=none"], "pins: follows=skin, but there is no body"),
        (
            ["pins={vertices: hem, weights: 0.5}", "stepper=network", "refine=0", *UNTRAINED],
            "pins: weights below 1 are springs, of which a network alone knows nothing; add refine=5, use stepper=newton",
        ),
        (["pins=[[1]]"], "pins=[[1]]: give vertex numbers, regions or lists"),
    ],
)
def test_what_cannot_hold_is_told_in_a_sentence(words: list[str], sentence: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*SHORT, *words, "output=run"]) == 2
    assert sentence in capsys.readouterr().err
    assert not Path("run").exists()


def test_the_potential_has_springs_only_where_pins_are_asked_for() -> None:
    assert "soft_pins" not in potential_of(RolloutSettings.from_words(["stepper=newton"])).terms
    assert "soft_pins" in potential_of(RolloutSettings.from_words(["stepper=newton", "pins={vertices: 1, weights: 0.5}"])).terms


def test_plain_pins_make_the_scene_that_they_made() -> None:
    assert make_scene(RolloutSettings.from_words(["garment=skirt", "pins=waistband"])).held is None


def test_prepared_garments_hold_vertices_alone(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["prepare", "garment=tank", "pins={vertices: hem, follows: skin}", "output=tank.npz"]) == 2
    assert "pins: tables of weights and of what pins follow are for pins= of hood rollout" in capsys.readouterr().err
    assert not Path("tank.npz").exists()
