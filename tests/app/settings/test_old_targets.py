"""Configs and records of earlier versions name classes where they were then; they are found where they are today."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from hood.app.settings import old_targets
from hood.app.settings.compose import ConfigError, build
from hood.app.settings.record import read_record
from hood.energies.contact import Collision


def test_every_module_of_today_is_there() -> None:
    for module in old_targets._MOVED.values():
        importlib.import_module(module)


def test_a_term_of_an_old_config_is_built() -> None:
    given = {"_target_": "hood.losses.potential.Potential", "terms": {"a": {"_target_": "hood.losses.collision.Collision"}}}
    potential = build(given)
    assert type(potential.terms["a"]) is Collision
    assert given["_target_"].startswith("hood.losses.")  # what was given stays as it is


@pytest.mark.parametrize("make", [dict, OmegaConf.create])
def test_lists_and_other_values_stay(make) -> None:
    node = make(
        {"list": [{"_target_": "hood.dynamics.stepper.NewtonStepper"}, 1], "none": None, "_target_": "torch.optim.Adam"}
    )
    old_targets.rename_targets(node)
    assert node["list"][0]["_target_"] == "hood.steppers.newton.NewtonStepper"
    assert (node["list"][1], node["none"], node["_target_"]) == (1, None, "torch.optim.Adam")


def test_the_record_of_an_old_run_has_the_classes_of_today(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("losses:\n  terms:\n    inertia: {_target_: hood.losses.inertia.Inertia}\n")
    found = read_record(tmp_path / "config.yaml")["losses"]["terms"]["inertia"]["_target_"]
    assert found == "hood.energies.mass_points.Inertia"


def test_a_name_that_never_was_is_refused() -> None:
    with pytest.raises(ConfigError):
        build({"_target_": "hood.losses.collision.NoSuchClass"})
