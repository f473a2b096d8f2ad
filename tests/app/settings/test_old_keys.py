"""Earlier keys of ``hood rollout``: words and records that have them mean what they meant."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from hood.app.notices import collected
from hood.app.settings import old_keys
from hood.app.settings.compose import CONFIG_FOLDER, ConfigError, load_config, plain
from hood.app.settings.old_keys import put_todays_keys
from hood.app.settings.record import read_record


@pytest.fixture(autouse=True)
def unsaid() -> None:
    """Every sentence is said again."""
    old_keys._tell.cache_clear()


@pytest.mark.parametrize(
    ("then", "today", "said"),
    [
        ("settle=paper relaxing_steps=3", "settle=3", "relaxing_steps=3 is called settle=3 now"),
        ("relaxing_steps=0", "settle=0", "relaxing_steps=0 is called settle=0 now"),
        ("settle=paper relaxing_steps=1", "settle=paper", "relaxing_steps=1 is called settle=paper now"),
        ("relaxing_steps=1", "", "relaxing_steps=1 has no effect: settle=equilibrium takes none"),
        (
            "events=[{time:1,close:a},{time:2,open:a},{time:3,close:a,speed:2}] events_speed=0.5",
            "events=[{time:1,close:a,speed:0.5},{time:2,open:a},{time:3,close:a,speed:2}]",
            "events_speed=0.5 is called events=[{time:1,close:a,speed:0.5},{time:2,open:a},{time:3,close:a,speed:2}] now",
        ),
        ("events_speed=0.5", "", "events_speed=0.5 has no effect: events are not given"),
    ],
)
def test_words_of_then_are_those_of_today_and_told_once(then: str, today: str, said: str) -> None:
    with collected() as told:
        configs = [load_config("rollout", then.split()) for _ in range(2)]
    assert told == [said]
    assert configs == 2 * [load_config("rollout", today.split())]


@pytest.mark.parametrize(
    "words",
    [
        "settle=equilibrium relaxing_steps=3",
        "settle=2 relaxing_steps=3",
    ],
)
def test_words_that_contradict_each_other_are_refused(words: str) -> None:
    with pytest.raises(ConfigError, match=f"^{words.replace(' ', ' and ')} contradict each other; give one of them$"):
        load_config("rollout", words.split())


#: Earlier keys and their defaults: every record of then has all of them.
THEN = {"relaxing_steps": 1, "events_speed": 0.25}


@pytest.mark.parametrize(
    ("then", "today"),
    [
        ({}, {}),
        ({"settle": "paper"}, {"settle": "paper"}),
        ({"settle": "paper", "relaxing_steps": 3}, {"settle": 3}),
        ({"settle": "equilibrium", "relaxing_steps": 0}, {"settle": 0}),  # of what has a start of its own
        (
            {"events": [{"frame": 3, "attach": "hem"}], "events_speed": 1.0},
            {"events": [{"frame": 3, "attach": "hem", "speed": 1.0}]},
        ),
        ({"events": [{"frame": 3, "close": "zip"}]}, {"events": [{"frame": 3, "close": "zip"}]}),
    ],
)
def test_records_of_then_are_read_as_those_of_today(then: dict[str, object], today: dict[str, object]) -> None:
    usual = plain(load_config("rollout"))
    record = {**usual, **THEN, **then}
    put_todays_keys(record)
    assert record == {**usual, **today}
    put_todays_keys(record)
    assert record == {**usual, **today}


def test_the_record_in_a_folder_is_read_so(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text(yaml.safe_dump({**THEN, "settle": "paper", "relaxing_steps": 2}))
    assert read_record(tmp_path / "config.yaml")["settle"] == 2


def test_keys_of_then_are_no_keys_of_today() -> None:
    keys = yaml.safe_load((CONFIG_FOLDER / "rollout.yaml").read_text(encoding="utf-8"))
    assert not THEN.keys() & keys.keys()
    assert THEN.keys() == old_keys._OLD.keys()
