"""``hood plan`` of a training: times that add up, terms, and draws that are those of the training."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from hood.app.settings.compose import load_config
from hood.app.train import make_trainer
from hood.assets.material import RANGES
from hood.cli.main import main
from hood.steppers.protocol import Stopwatch
from hood.studies.plan.plan import is_training
from hood.studies.plan.training import _empty_bands

WORDS = [
    "experiment=quickstart",
    "model=small",
    "trainer.batch_size=2",
    "data.garments=[tank,skirt]",
    "data.sequences=[plie,jog]",
]


@pytest.fixture(scope="module")
def planned(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("plan")
    assert main(["plan", *WORDS, "updates=1", "scenes=2", f"output={folder}"]) == 0
    assert [path.name for path in folder.iterdir() if path.suffix == ".json"] == ["training_plan.json"]
    found: dict[str, Any] = json.loads((folder / "training_plan.json").read_text(encoding="utf-8"))
    return found


def test_parts_add_up_to_an_update(planned: dict[str, Any]) -> None:
    rows = {row["part"]: row for row in planned["rows"]}
    assert set(rows) == {"scenes", "search", "features", "network", "losses", "backward", "optimiser", "rest"}
    assert sum(row["share"] for row in rows.values()) == pytest.approx(1.0)
    assert sum(row["ms"] for row in rows.values()) == pytest.approx(planned["ms"])
    for name in ("scenes", "features", "network", "losses", "backward", "optimiser"):
        assert rows[name]["ms"] > 0.0
    assert planned["hours"] == pytest.approx(planned["ms"] * planned["iterations"] / 3.6e6)
    # Horizons grow from 4 to 60 by one every 25 updates: 1,400 updates of growth, 1,000 more of the longest.
    growing = [min(4 + index // 25, 60) + 1 for index in range(2400)]
    assert planned["steps_per_scene"] == pytest.approx(np.mean(growing))


def test_terms_that_teach_are_told_from_those_that_do_not(planned: dict[str, Any]) -> None:
    terms = planned["terms"]
    assert terms["attachment"] == {"share": 0.0, "teaches": False}  # neither garment is buttoned
    for name in ("stretching", "inertia", "gravity"):
        assert terms[name]["teaches"]
        assert terms[name]["share"] > 1e-3


def test_draws_are_those_of_the_training(planned: dict[str, Any]) -> None:
    trainer = make_trainer(load_config("train", [*WORDS, "trainer.workers=0"]))
    cloth = trainer.slots.batch(4).cloth
    drawn = planned["drawn"]
    assert drawn["garments"] == {"tank": 1, "skirt": 1}
    assert drawn["garments_never"] == []
    again = [trainer.slots.scene(index, 0).window.scene.cloth for index in range(2)]
    assert torch.equal(torch.cat([one.lame_mu for one in again]), cloth.lame_mu)
    assert len(drawn["motions_never"]) == 2 - drawn["motions"]
    assert drawn["fabrics_never"].keys() <= RANGES.keys()
    assert drawn["fabrics_never"]  # two scenes cannot have every fifth of every range


def test_looking_changes_nothing() -> None:
    """Losses with a stopwatch and an observer are those without, to the bit."""
    reports = []
    for looked_at in (False, True):
        trainer = make_trainer(load_config("train", [*WORDS, "trainer.workers=0"]))
        seen: list[float] = []
        if looked_at:
            trainer.stopwatch = Stopwatch()
            trainer.observe = lambda problem, potential, prediction, residual, seen=seen: seen.append(float(residual.median()))
        reports.append([trainer.update() for _ in range(2)])
        if looked_at:
            assert seen == [report["relative_gradient"] for report in reports[-1]]
    assert reports[0] == reports[1]


def test_bands_without_a_scene_are_named() -> None:
    low, high = RANGES["density"]
    values = {name: list(np.geomspace(*span, 50)) for name, span in RANGES.items()}
    assert _empty_bands(values, False) == {}
    values["density"] = [low, 1.1 * low]
    (bands,) = _empty_bands(values, False).values()
    assert len(bands) == 4
    assert bands[-1][1] == pytest.approx(high)
    assert bands[0][0] == pytest.approx(low * (high / low) ** 0.2)
    assert _empty_bands(values, True) == {}


def test_words_tell_a_training_from_a_rollout() -> None:
    assert is_training(["experiment=quickstart"])
    assert is_training(["trainer.batch_size=2"])
    assert is_training(["data.garments=[tank]"])
    assert not is_training(["garment=tank", "model=small", "checkpoint=untrained"])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["experiment=quickstart", "accuracy=0.01"], "accuracy=0.01: belongs to the plan of a rollout"),
        (["experiment=quickstart", "updates=0"], "updates=0"),
        (["experiment=quickstrat"], "quickstart"),
        (["garment=tank", "scenes=5"], "scenes=5: belongs to the plan of a training"),
    ],
)
def test_bad_words_are_told_in_a_line(words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", *words, f"output={tmp_path / 'plan'}"]) == 2
    told = capsys.readouterr().err
    assert said in told
    assert told.count("\n") == 1
    assert not (tmp_path / "plan").exists()
