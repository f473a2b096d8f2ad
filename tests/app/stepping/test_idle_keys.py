"""Words that do nothing beside the others are told, one line each; those that do something are not."""

from __future__ import annotations

from pathlib import Path

import pytest

import hood
from hood.app.settings.compose import load_config
from hood.app.settings.rollout_settings import RolloutSettings
from hood.app.stepping.cautions import idle_in_rollout, idle_in_training
from hood.cli.main import main

IDLE = [
    (
        ["stepper=newton", "checkpoint=small-ours", "precision=bf16"],
        "checkpoint=small-ours precision=bf16 has no effect: with stepper=newton",
    ),
    (
        ["stepper=refine", "refine=2", "kernels=torch"],
        "kernels=torch has no effect: with stepper=refine no network takes the steps",
    ),
    (
        ["stepper=guess", "model=small", "model.latent_dim=8"],
        "model=small model.latent_dim=8 has no effect: with stepper=guess",
    ),
    (["fabrics_seam=0.1"], "fabrics_seam=0.1 has no effect: fabrics are not given"),
    (
        ["metrics={kind:strain,surface_every:2}"],
        "metrics={kind:strain,surface_every:2} has no effect: the surface is measured with kind:all alone",
    ),
    (["video=none", "sheet=false", "picture={thin_body:8}"], "picture={thin_body:8} has no effect: nothing is drawn"),
    (["video=none", "sheet=false", "colour=strain"], "colour=strain has no effect: nothing is drawn"),
    (
        ["cloth_contact={mode:off,friction:0.5}"],
        "cloth_contact={mode:off,friction:0.5} has no effect: there is no friction with mode:off",
    ),
]
BUSY = [
    ["checkpoint=small-ours", "precision=bf16"],
    ["stepper=network", "kernels=torch"],
    ["video=none", "picture={thin_body:8}"],
    ["video=none", "sheet=false", "colour=rg"],  # it is stored as well
    ["cloth_contact={friction:0.5}"],
]


@pytest.mark.parametrize(("words", "told"), IDLE, ids=lambda value: " ".join(value) if isinstance(value, list) else "")
def test_a_word_that_does_nothing_is_told(words: list[str], told: str) -> None:
    (line,) = idle_in_rollout(words, RolloutSettings.from_words(words))
    assert line.startswith(told)


@pytest.mark.parametrize("words", BUSY, ids=" ".join)
def test_a_word_that_does_something_is_not(words: list[str]) -> None:
    assert idle_in_rollout(words, RolloutSettings.from_words(words)) == []


def test_validation_that_never_happens_is_told() -> None:
    words = ["data.validation_sequences=[plie]", "validation_states=2"]
    assert idle_in_training(words, load_config("train", words)) == [
        "data.validation_sequences=[plie] has no effect: trainer.validate_every is 0",
        "validation_states=2 has no effect: trainer.validate_every is 0",
    ]
    words.append("trainer.validate_every=10")
    assert idle_in_training(words, load_config("train", words)) == []


def test_commands_and_python_say_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    quick = ["garment=tank", "num_frames=2", "metrics=none", "video=none", "sheet=false", f"output={tmp_path / 'out'}"]
    assert main(["rollout", *quick, "stepper=guess", "checkpoint=small-ours", "fail_on=nothing"]) == 0
    line = "checkpoint=small-ours has no effect: with stepper=guess no network takes the steps"
    assert capsys.readouterr().out.splitlines().count(line) == 1
    assert line in hood.simulate("tank", num_frames=2, stepper="guess", checkpoint="small-ours").notes
