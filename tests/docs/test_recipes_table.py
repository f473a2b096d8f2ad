"""The table of recipes in hood/studies/notes/training.md: every key is there, with the value that it has in each experiment."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml
from omegaconf import OmegaConf

from hood.app.settings.compose import load_config, plain

PAGE = Path(__file__).parents[2] / "hood" / "studies" / "notes" / "training.md"
TEXT = PAGE.read_text(encoding="utf-8").split("<!-- recipes: begin -->\n")[1].split("<!-- recipes: end -->")[0]
HEAD, _, *LINES = [[cell.strip() for cell in line.strip("|").split("|")] for line in TEXT.strip().splitlines()]
EXPERIMENTS = HEAD[1:-1]


def test_the_table_has_all_differences() -> None:
    assert EXPERIMENTS == ["paper", "released", "quickstart"]
    assert len({line[0] for line in LINES}) == len(LINES) == 14


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_values_are_those_of_the_experiment(experiment: str) -> None:
    config = load_config("train", [f"experiment={experiment}"])
    for line in LINES:
        key, told = line[0].strip("`"), line[1 + EXPERIMENTS.index(experiment)]
        absent = object()
        value = OmegaConf.select(config, key, default=absent)
        if told:
            assert value is not absent, key
            assert plain(value) == yaml.safe_load(told), key
        else:
            assert value is absent, f"{key}: {value}"


def test_what_differs_is_in_the_table() -> None:
    """Of the trainer and of the sampling nothing else tells the paper from the released code."""
    keys = {line[0].strip("`") for line in LINES}
    paper, released = (plain(load_config("train", [f"experiment={name}"])) for name in ("paper", "released"))
    for group in ("trainer", "data"):
        assert differences(paper[group], released[group], group) <= keys


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_what_the_text_below_says(experiment: str) -> None:
    config = load_config("train", [f"experiment={experiment}"])
    assert (config.trainer.clip_norm, config.trainer.statistics_iterations) == (1.0, 100)
    of_paper = experiment != "quickstart"
    assert (config.trainer.optimizer == "adam") == of_paper
    assert config.data.sampling.mirror == config.data.sampling.random_yaw == (not of_paper)
    assert (config.losses == load_config("train", ["losses=reference_as_coded"]).losses) == (experiment == "released")


def test_the_page_about_own_files_has_every_key_of_data_with_a_value_that_it_takes() -> None:
    rows = [
        [re.findall(r"`([^`]+)`", cell) for cell in line.split("|")[1:3]]
        for line in (Path(__file__).parents[2] / "docs" / "own_data.md").read_text(encoding="utf-8").splitlines()
        if line.startswith("| `data.")
    ]
    words = [f"{key}={value}" for keys, values in rows for key, value in zip(keys, values, strict=True)]
    data = plain(load_config("train", words).data)
    sampling = data.pop("sampling")
    expected = [*(f"data.{key}" for key in data), *(f"data.sampling.{key}" for key in sampling)]
    assert sorted(word.partition("=")[0] for word in words) == sorted(expected)


def differences(first: dict, second: dict, path: str) -> set[str]:
    found: set[str] = set()
    assert first.keys() == second.keys()
    for key, value in first.items():
        place = f"{path}.{key}"
        if isinstance(value, dict):
            found |= differences(value, second[key], place)
        elif value != second[key]:
            found.add(place)
    return found
