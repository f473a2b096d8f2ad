"""From the keys of a config to what moves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hood.app.notices import collected
from hood.app.scene.motion import make_motion, motion_options
from hood.app.settings.compose import ConfigError
from hood.app.settings.rollout_settings import RolloutSettings
from hood.scene.body_motion.load import MotionOptions
from hood.scene.body_motion.mesh_motion import MeshMotion, NoBody
from hood.scene.body_motion.motion import BodyMotion
from hood.testing import sphere


def test_defaults_of_the_config_are_those_of_the_code() -> None:
    """Written once in the code; the file repeats them where it explains them."""
    assert motion_options(RolloutSettings.from_words([])) == MotionOptions(parts=[])


def test_every_key_reaches_the_options() -> None:
    words = (
        "fps=25 up=y file_fps=90 start=10f stop=2.5 loop=3 blend_in=[0.5,a] betas=[1,-2.5] gender=male hands=file "
        "unit=0.01 animation=Walk objects={body:[Body,Shoes]} num_frames=7"
    )
    expected = MotionOptions(
        fps=25.0, up="y", file_fps=90.0, start="10f", stop=2.5, loop=3, blend_in=0.5, blend_from="a", betas=[1, -2.5],
        gender="male", hands="file", trans_unit="cm", scale=0.01, animation="Walk", parts=["Body", "Shoes"], num_frames=7,
    )  # fmt: skip
    assert motion_options(RolloutSettings.from_words(words.split())) == expected

    other = motion_options(RolloutSettings.from_words(["unit=mm"]))
    assert (other.trans_unit, other.scale) == ("mm", 0.001)
    assert motion_options(RolloutSettings.from_words(["unit=0.3048"])).scale == 0.3048


@pytest.mark.parametrize(
    "word", ["file_fps=fast", "blend_in=[]", "betas=all", "betas=[true]", "objects={body:Body}", "unit=x", "unit=true"]
)
def test_values_of_the_wrong_kind_name_the_key(word: str) -> None:
    with pytest.raises(ConfigError, match=f"{word.split('=')[0]}="):
        motion_options(RolloutSettings.from_words([word]))


def test_what_is_not_performed_is_said(tmp_path: Path) -> None:
    points, faces = sphere(1, 0.5)
    np.savez(tmp_path / "ball.npz", verts=points, faces=faces)
    kinds = {
        "default": (BodyMotion, ""),
        str(tmp_path / "ball.npz"): (MeshMotion, "sequence=walk_proud is not used"),
        "none": (NoBody, "body=none does not move: sequence=walk_proud is not used"),
    }
    for body, (kind, words) in kinds.items():
        with collected() as said:
            assert isinstance(make_motion(RolloutSettings.from_words([f"body={body}"])), kind)
        assert words in " ".join(said)
        assert bool(said) == bool(words)
    with collected() as said:
        make_motion(RolloutSettings.from_words(["body=none", "sequence=none"]))
    assert not said


def test_a_motion_file_that_is_not_performed_is_refused(tmp_path: Path) -> None:
    points, faces = sphere(1, 0.5)
    np.savez(tmp_path / "ball.npz", verts=points, faces=faces)
    for body, words in ((str(tmp_path / "ball.npz"), "performs its own motion"), ("none", "does not move")):
        with pytest.raises(ConfigError, match=rf"sequence=mine\.npz: body=\S+ {words}; leave sequence out"):
            make_motion(RolloutSettings.from_words([f"body={body}", "sequence=mine.npz"]))
