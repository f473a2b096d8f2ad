"""Runs that go on: with the settings that they were begun with, and told where there is nothing to go on with."""

from __future__ import annotations

from pathlib import Path

import pytest
from omegaconf import OmegaConf, open_dict

from hood.app.settings.compose import ConfigError, load_config
from hood.app.settings.record import require_same_config, save_run_record
from hood.cli.main import main

TINY = [
    "model=small", "model.schedule=1x(mesh)", "model.latent_dim=8", "trainer.iterations=1", "trainer.batch_size=1",
    "trainer.statistics_iterations=0", "trainer.horizon.start=1", "trainer.workers=0", "trainer.kernels=torch",
    "data.garments=[tank]",
]  # fmt: skip


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("trainer.iterations=12", r"trainer\.iterations is 1 there, 12 in this command; resume with"),
        ("trainer.horizon.start=2", r"trainer\.horizon\.start is 1 there, 2 in this command"),
        ("data.garments=[tank,skirt]", r"data\.garments is \[tank\] there, \[tank,skirt\] in this command"),
        ("seed=7", r"seed is 0 there, 7 in this command"),
    ],
)
def test_the_setting_that_differs_is_named_with_both_values(given: str, words: str, tmp_path: Path) -> None:
    save_run_record(tmp_path, load_config("train", TINY), 0)
    require_same_config(load_config("train", [*TINY, "trainer.log_every=7"]), tmp_path, (), ("log_every",))
    with pytest.raises(ConfigError, match=words):
        require_same_config(load_config("train", [*TINY, given]), tmp_path, ())


def test_a_run_that_was_begun_before_a_key_was_there_goes_on(tmp_path: Path) -> None:
    earlier = load_config("train", TINY)
    with open_dict(earlier):
        for key in ("person", "trans_unit", "file_fps"):
            earlier.data.pop(key)
    save_run_record(tmp_path, earlier, 0)
    require_same_config(load_config("train", TINY), tmp_path, ())
    with pytest.raises(ConfigError, match=r"data\.trans_unit is null there, cm in this command"):
        require_same_config(load_config("train", [*TINY, "data.trans_unit=cm"]), tmp_path, ())


#: Keys of trainings that runs of before them do not have.
LATER = {
    "model": ("output_init", "normalizer_decay"),
    "trainer": ("by_rollout", "relaxed_velocity"),
    "trainer.horizon": ("with_relaxing",),
    "data.sampling": ("uniform", "by_centroids", "noise", "noise_on_pinned", "still_fraction"),
}


def test_a_training_of_before_the_released_recipe_goes_on(tmp_path: Path) -> None:
    words = ["experiment=paper", "data.garments=[tank]"]
    earlier = load_config("train", words)
    with open_dict(earlier):
        for group, keys in LATER.items():
            for key in keys:
                OmegaConf.select(earlier, group).pop(key)
    save_run_record(tmp_path, earlier, 0)
    require_same_config(load_config("train", words), tmp_path, ())
    for given, said in (
        ("trainer.by_rollout=true", r"trainer\.by_rollout is null there, true in this command"),
        ("trainer.relaxed_velocity=own", r"trainer\.relaxed_velocity is null there, own in this command"),
        ("trainer.horizon.with_relaxing=true", r"trainer\.horizon\.with_relaxing is null there"),
        ("data.sampling.noise=3e-3", r"data\.sampling\.noise is null there, 0\.003 in this command"),
        ("model.normalizer_decay=0", r"model\.normalizer_decay is null there"),
    ):
        with pytest.raises(ConfigError, match=said):
            require_same_config(load_config("train", [*words, given]), tmp_path, ())


def test_a_training_that_has_nothing_to_resume_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["train", *TINY, f"output={tmp_path / 'run'}", "resume=true"]
    assert main(command) == 0
    assert f"resume=true: no training in {tmp_path / 'run'} yet, this one begins" in capsys.readouterr().out
    assert main(command) == 0
    assert "this one begins" not in capsys.readouterr().out
