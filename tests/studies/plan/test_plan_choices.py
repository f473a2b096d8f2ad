"""Other meshes and time steps of a rollout: which there are, and where there are none."""

from __future__ import annotations

import pytest

from hood.app.settings.compose import ConfigError
from hood.app.settings.rollout_settings import RolloutSettings
from hood.studies.plan.choices import choices_of, choose_choices, levels_of, settled_with
from hood.studies.plan.parts import choose_parts, parts_of


def names(*words: str) -> dict[str, bool]:
    return {one.name: one.finer for one in choices_of(RolloutSettings.from_words(["stepper=newton", "refine=0", *words]))}


def test_levels_are_ordered_and_of_the_same_garment() -> None:
    assert list(levels_of("dress")) == list(levels_of("dress_12k")) == ["dress", "dress_4k", "dress_12k"]
    assert list(levels_of("shirt")) == ["shirt"]
    assert levels_of("mine.obj") == {}


def test_coarser_and_finer_are_told_apart() -> None:
    assert names("garment=dress_4k") == {"mesh dress": False, "mesh dress_12k": True, "60 fps": True}
    assert names("garment=dress", "fps=60") == {"mesh dress_4k": True, "mesh dress_12k": True, "30 fps": False, "120 fps": True}
    assert names("garment=[tank,skirt]") == {"60 fps": True}
    default = choose_choices(RolloutSettings.from_words(["garment=dress_4k", "stepper=newton"]), [])
    assert [one.name for one in default] == ["mesh dress", "60 fps"]


def test_steps_and_frames_go_together() -> None:
    (one,) = choose_choices(RolloutSettings.from_words(["stepper=newton", "fps=60", "num_frames=101"]), ["30 fps"])
    assert (one.words, one.pace) == (("fps=30", "num_frames=51"), 0.5)


@pytest.mark.parametrize("word", ["pins=[0,1]", "fabrics={mine.txt:silk}"])
def test_numbers_of_vertices_belong_to_one_mesh(word: str) -> None:
    assert names("garment=dress_4k", word) == {"60 fps": True}


def test_networks_and_events_keep_their_time_step() -> None:
    network = choices_of(RolloutSettings.from_words(["garment=dress_4k"]))
    assert [one.name for one in network] == ["mesh dress", "mesh dress_12k"]
    assert names("garment=shirt", "events=[{time: 1.0, open: front_buttons}]") == {}


def test_ways_to_take_the_steps_exclude_each_other() -> None:
    config = RolloutSettings.from_words(["stepper=newton", "refine=0"])
    ways = [part for part in parts_of(config, True) if part.instead]
    assert {part.rivals for part in ways} == {"steps"}
    assert {part.name for part in ways} == {
        "8 iterations",
        "4 iterations",
        "2 iterations",
        "network",
        "network with 5 iterations",
    }
    assert not any(part.instead for part in parts_of(config))
    for part in ways:
        settled = settled_with(part.words, config)
        assert settled.stepper == part.words[0].partition("=")[2]
        assert settled.stepping != config.stepping
    network = RolloutSettings.from_words(["refine=0"])
    assert [part.name for part in parts_of(network, True) if part.instead] == ["newton"]


def test_a_row_may_be_a_part_or_a_choice() -> None:
    config = RolloutSettings.from_words(["stepper=newton", "refine=0"])
    assert choose_parts(config, ["mesh dress_4k"], False, ["mesh dress_4k"]) == []
    with pytest.raises(ConfigError, match="mesh dress_4k"):
        choose_parts(config, ["mesh dres_4k"], False, ["mesh dress_4k"])
