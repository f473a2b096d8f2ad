"""``body_friction=``: from words to the scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hood.app.scene.fabrics import checked_friction
from hood.app.settings.compose import ConfigError
from hood.app.settings.rollout_settings import RolloutSettings
from hood.app.setup import make_scene
from hood.cli.main import main
from hood.rollouts.file.reader import read_rollout

SHORT = ["garment=skirt", "sequence=plie", "stepper=newton", "num_frames=4", "video=none", "sheet=false"]


def test_parts_have_their_factors_and_later_ones_count() -> None:
    words = ["garment=tank", "num_frames=3", "body_friction={below_pelvis:0,left_knee:4}"]
    grip = make_scene(RolloutSettings.from_words(words)).friction_scale
    assert grip is not None
    assert set(grip.tolist()) == {0.0, 1.0, 4.0}
    assert make_scene(RolloutSettings.from_words(words[:2])).friction_scale is None


def test_a_factor_of_one_is_the_same_rollout_and_another_is_not(tmp_path: Path) -> None:
    found = []
    for name, words in (("a", []), ("b", ["body_friction={spine1:1}"]), ("c", ["body_friction={above_left_knee:0}"])):
        assert main(["rollout", *SHORT, *words, f"output={tmp_path / name}"]) == 0
        found.append(read_rollout(tmp_path / name / "rollout.h5").cloth_pos)
    assert np.array_equal(found[0], found[1])
    assert abs(found[2] - found[0]).max() > 1e-5


def test_a_network_says_that_it_was_trained_on_even_bodies(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["rollout", "garment=tank", "num_frames=2", "refine=0", "video=none", "sheet=false", f"output={tmp_path / 'a'}"]
    assert main([*words, "body_friction={above_spine3:4}"]) == 0
    assert "quickstart was not trained for material.friction=4 (trained on 1)" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("body_friction=3", "body_friction=3: give factors by part"),
        ("body_friction={left_knee:-1}", "body_friction: left_knee is -1; give a finite factor >= 0"),
        ("body_friction={left_knee:high}", "body_friction: left_knee is 'high'"),
    ],
)
def test_what_is_no_table_of_factors_is_refused(word: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        checked_friction(RolloutSettings.from_words([word]))


def test_parts_that_there_are_not_are_told_with_the_key(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["rollout", *SHORT, "body_friction={left_nee:2}", "output=none"]) == 2
    assert "body_friction: part 'left_nee': unknown joint" in capsys.readouterr().err
    alone = ["rollout", "garment=skirt", "body=none", "sequence=none", "stepper=newton", "num_frames=3", "output=none"]
    assert main([*alone, "body_friction={left_knee:2}"]) == 2
    assert "body_friction: there is no body; leave it out" in capsys.readouterr().err
