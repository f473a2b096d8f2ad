"""The key ``picture``: what it says, and one sentence for what it cannot say."""

from __future__ import annotations

import pytest

from hood.app.common import picture_of
from hood.app.settings.compose import ConfigError, load_config
from hood.app.settings.rollout_settings import RolloutSettings


def said(word: str, film: str = "mp4"):
    return picture_of(RolloutSettings.from_words([word]), film)


def test_what_is_usual() -> None:
    usual = picture_of(load_config("rollout"))
    assert (usual.width, usual.height, usual.views, usual.background) == (1280, 720, ("front", "back"), "studio")
    assert picture_of(load_config("rollout"), "gif")[1:3] == (640, 360)
    assert picture_of(load_config("rollout"), "png").background == "transparent"


@pytest.mark.parametrize(
    ("word", "part", "value"),
    [
        ("picture={height:1080}", "width", 1920),
        ("picture={width:640}", "height", 360),
        ("picture={width:720,height:1280}", "height", 1280),
        ("picture={views:side}", "views", ("side",)),
        ("picture={views:[front,turntable,45]}", "views", ("front", "turntable", 45)),
        ("picture={background:[0,128,255]}", "background", (0, 128, 255)),
        ("picture={thin_body:8}", "thin_body", 8),
    ],
)
def test_a_part_is_read(word: str, part: str, value: object) -> None:
    assert getattr(said(word), part) == value


@pytest.mark.parametrize(
    ("word", "sentence"),
    [
        ("picture=big", "give a table"),
        ("picture={widht:640}", "'widht' is no part of it"),
        ("picture={width:641}", "an even number of pixels"),
        ("picture={height:10000}", "64 to 4096"),
        ("picture={width:100}", "too small for 2 views"),
        ("picture={views:[]}", "one to four of front"),
        ("picture={views:[above]}", "one to four of front"),
        ("picture={camera:handheld}", "give follow, fixed or orbit"),
        ("picture={background:transparent}", "add video=png"),
        ("picture={background:[0,0,300]}", "from 0 to 255"),
        ("picture={fabric_looks:1}", "true or false"),
        ("picture={thin_body:true}", "millimetres"),
    ],
)
def test_what_it_cannot_say_is_refused(word: str, sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence.replace("[", r"\[")):
        said(word)
