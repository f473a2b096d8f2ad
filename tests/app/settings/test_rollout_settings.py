"""The settings of a rollout have the keys of its configuration, typed."""

from __future__ import annotations

import types
import typing
from dataclasses import FrozenInstanceError, fields

import pytest
import yaml

from hood.app.settings.compose import CONFIG_FOLDER, ConfigError, load_config, plain
from hood.app.settings.rollout_settings import (
    ClothContact,
    Measurement,
    Objects,
    Refinement,
    RolloutSettings,
    cloth_contact,
    measurement,
    objects,
    refinement,
    with_value,
)


def test_every_key_is_a_field_and_its_default_is_of_the_type() -> None:
    keys = yaml.safe_load((CONFIG_FOLDER / "rollout.yaml").read_text(encoding="utf-8")).keys() - {"defaults"}
    groups = {"material", "losses", "model", "solver", "stepper", "stepping"}
    assert {field.name for field in fields(RolloutSettings)} == keys | groups
    settings, types_of = RolloutSettings.from_words([]), typing.get_type_hints(RolloutSettings)
    for key in keys - {"losses"}:
        wanted = types_of[key]
        if wanted is not typing.Any:
            kinds = typing.get_args(wanted) if isinstance(wanted, types.UnionType) else (wanted,)
            assert isinstance(settings[key], (*kinds, int) if float in kinds else kinds), key


def test_they_are_the_configuration() -> None:
    words = ["garment=[tank,skirt]", "refine={goal:5,method:sweeps}", "stepper=network", "model=small"]
    config, settings = load_config("rollout", words), RolloutSettings.from_words(words)
    assert plain(settings) == plain(config)
    assert "model" in settings
    assert "model" not in RolloutSettings.from_words([])
    assert len(settings) == len(list(settings)) == len(config)
    with pytest.raises(KeyError):
        settings["colours"]


def test_they_do_not_change_but_are_copied_with_other_values() -> None:
    settings = RolloutSettings.from_words([])
    with pytest.raises(FrozenInstanceError):
        settings.num_frames = 3  # type: ignore[misc]
    assert settings.with_values(num_frames=3).num_frames == 3
    assert settings.with_words(["num_frames=4", "solver.target_rg=0.1"]).solver.target_rg == 0.1
    assert settings.num_frames == 150
    with pytest.raises(ConfigError, match="no such key"):
        settings.with_words(["frames=4"])


def test_the_usual_parts_of_a_table_are_what_the_configuration_says() -> None:
    usual = RolloutSettings.from_words([])
    for read, kind in ((refinement, Refinement), (measurement, Measurement), (cloth_contact, ClothContact), (objects, Objects)):
        assert read(usual) == kind()


def test_a_value_alone_is_the_first_part_of_a_table() -> None:
    assert measurement({"metrics": "strain"}) == Measurement("strain")
    assert measurement({"metrics": {"fields": ["rg"]}}) == Measurement(fields=("rg",))
    assert objects({"objects": ["tank"]}).garment == ("tank",)
    assert refinement({}).most == 50
    assert with_value(3, "goal", 5) == 5
    assert with_value({"method": "sweeps"}, "goal", 5) == {"method": "sweeps", "goal": 5}


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (
            {"kind": "all", "every": 3},
            "'every' is no part of it; give a value, or a table of some of kind, surface_every, fields",
        ),
        ({"surface_every": 1.5}, "surface_every: give a whole number, not 1.5"),
        ({"surface_every": True}, "surface_every: give a whole number"),
        ({"fields": "rg"}, "fields: give a list of names in brackets, not rg"),
    ],
)
def test_parts_that_are_none_are_told(given: dict[str, object], told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        measurement({"metrics": given})
    with pytest.raises(ConfigError, match="friction: give a number, not firm"):
        cloth_contact({"cloth_contact": {"friction": "firm"}})
