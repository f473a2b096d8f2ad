"""Earlier keys of ``hood rollout`` mean what they meant, and classes are found where they are today."""

from __future__ import annotations

import importlib
import json
import re
import shlex
from pathlib import Path
from typing import Any

import h5py
import pytest
import yaml
from omegaconf import DictConfig, OmegaConf

import hood
from hood.app.notices import collected
from hood.app.output.summary import summarise
from hood.app.plan_file import rollout_config, write_plan
from hood.app.settings import old_names
from hood.app.settings.compose import CONFIG_FOLDER, ConfigError, build, load_config, plain
from hood.app.settings.old_names import put_todays_keys
from hood.app.settings.record import read_record
from hood.app.settings.rollout_settings import measurement, objects, refinement
from hood.app.setup import check_config
from hood.cli.main import main
from hood.energies.contact import Collision
from hood.rollouts.file.reader import read_rollout


@pytest.fixture(autouse=True)
def unsaid() -> None:
    """Every sentence is said again."""
    old_names._tell.cache_clear()


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
        (
            "size_end=[1.1,1,1] size_seconds=3",
            "size_end={size:[1.1,1,1],seconds:3}",
            "size_seconds=3 is called size_end={size:[1.1,1,1],seconds:3} now",
        ),
        ("size_end=0.8 size_seconds=2", "size_end=0.8", "size_seconds=2 is called size_end=0.8 now"),
        ("size_seconds=3", "", "size_seconds=3 has no effect: size_end is not given"),
        ("doubts=refuse", "fail_on=doubts", "doubts=refuse is called fail_on=doubts now"),
        ("doubts=report", "", "doubts=report is called fail_on=unsound now"),
        ("doubts=report fail_on=nothing", "fail_on=nothing", "doubts=report is called fail_on=nothing now"),
        ("allow_unsound=true", "fail_on=nothing", "allow_unsound=true is called fail_on=nothing now"),
        ("allow_unsound=false", "", "allow_unsound=false is called fail_on=unsound now"),
        ("allow_unsound=false fail_on=doubts", "fail_on=doubts", "allow_unsound=false is called fail_on=doubts now"),
        ("trans_unit=cm", "unit=cm", "trans_unit=cm is called unit=cm now"),
        ("trans_unit=auto", "", "trans_unit=auto has no effect: the unit is found"),
        ("body_scale=0.01", "unit=0.01", "body_scale=0.01 is called unit=0.01 now"),
        ("wind=3 gusts=0.2", "wind=3 losses.terms.air.gusts=0.2", "gusts=0.2 is called losses.terms.air.gusts=0.2 now"),
        ("video_stride=3", "video=[mp4,3]", "video_stride=3 is called video=[mp4,3] now"),
        ("video_stride=3 video=gif", "video=[gif,3]", "video_stride=3 is called video=[gif,3] now"),
        ("video=none video_stride=3", "video=none", "video_stride=3 has no effect: video=none"),
        ("target_rg=0.1", "refine=0.1rg", "target_rg=0.1 is called refine=0.1rg now"),
        ("budget_ms=20 refine=auto", "refine=20ms", "budget_ms=20 is called refine=20ms now"),
        ("refine=0 budget_ms=20.0", "refine=20ms", "budget_ms=20.0 is called refine=20ms now"),
        ("max_strain=0.05", "refine=5%", "max_strain=0.05 is called refine=5% now"),
        (
            "max_strain=0.005 refine_most=9",
            "refine={goal:0.5%,most:9}",
            ["max_strain=0.005 is called refine=0.5% now", "refine_most=9 is called refine={goal:'0.5%',most:9} now"],
        ),
        ("target_rg=null", "", "target_rg=null has no effect: null asks for nothing"),
        ("blend_in=1.5 blend_from=a", "blend_in=[1.5,a]", "blend_from=a is called blend_in=[1.5,a] now"),
        ("blend_from=t blend_in=2", "blend_in=2", "blend_from=t is called blend_in=2 now"),
        ("blend_from=a", "", "blend_from=a has no effect: blend_in is 0"),
        (
            "refine=5 refine_method=sweeps",
            "refine={goal:5,method:sweeps}",
            "refine_method=sweeps is called refine={goal:5,method:sweeps} now",
        ),
        ("refine=5 refine_method=newton", "refine=5", "refine_method=newton has no effect: it is what is usual"),
        (
            "refine=20ms refine_most=9 refine_table=my_table.json",
            "refine={goal:20ms,most:9,table:my_table.json}",
            [
                "refine_most=9 is called refine={goal:'20ms',most:9} now",
                "refine_table=my_table.json is called refine={goal:'20ms',most:9,table:my_table.json} now",
            ],
        ),
        ("surface_stride=1", "metrics={surface_every:1}", "surface_stride=1 is called metrics={surface_every:1} now"),
        ("surface_stride=5", "", "surface_stride=5 has no effect: it is what is usual"),
        (
            "metrics=strain export=[rg] surface_stride=2",
            "metrics={kind:strain,surface_every:2,fields:[rg]}",
            [
                "surface_stride=2 is called metrics={kind:strain,surface_every:2} now",
                "export=[rg] is called metrics={kind:strain,surface_every:2,fields:[rg]} now",
            ],
        ),
        ("cloth_friction=0.5", "cloth_contact={friction:0.5}", "cloth_friction=0.5 is called cloth_contact={friction:0.5} now"),
        (
            "cloth_contact=on cloth_friction=0.5",
            "cloth_contact={mode:on,friction:0.5}",
            "cloth_friction=0.5 is called cloth_contact={mode:on,friction:0.5} now",
        ),
        ("body_parts=[Body]", "objects={body:[Body]}", "body_parts=[Body] is called objects={body:[Body]} now"),
        ("thin_body=8", "picture={thin_body:8}", "thin_body=8 is called picture={thin_body:8} now"),
        (
            "objects=[tank] body_parts=[Body]",
            "objects={garment:[tank],body:[Body]}",
            "body_parts=[Body] is called objects={garment:[tank],body:[Body]} now",
        ),
        ("accuracy=5mm", "plan=5mm", "accuracy=5mm is called plan=5mm now"),
        ("plan=auto accuracy=0.01", "plan=0.01", "accuracy=0.01 is called plan=0.01 now"),
    ],
)
def test_words_of_then_are_those_of_today_and_told_once(then: str, today: str, said: str | list[str]) -> None:
    with collected() as told:
        configs = [load_config("rollout", shlex.split(then)) for _ in range(2)]
    assert told == ([said] if isinstance(said, str) else said)
    assert [_said_by(config) for config in configs] == 2 * [_said_by(load_config("rollout", shlex.split(today)))]


def test_what_nothing_says_today_is_the_stricter() -> None:
    """Then doubts failed, and what was unsound did not."""
    with collected() as told:
        config = load_config("rollout", ["allow_unsound=true", "doubts=refuse"])
    assert config == load_config("rollout", ["fail_on=doubts"])
    assert told == [
        "allow_unsound=true has no effect: doubts=refuse is fail_on=doubts now, and unsound results fail as well",
        "doubts=refuse is called fail_on=doubts now",
    ]


@pytest.mark.parametrize(
    "words",
    [
        "settle=equilibrium relaxing_steps=3",
        "settle=2 relaxing_steps=3",
        "blend_in=[1,t] blend_from=a",
        "refine=5 budget_ms=20",
        "refine=20ms budget_ms=30",
        "target_rg=0.1 max_strain=0.1",
        "video=[mp4,2] video_stride=3",
        "losses.terms.air.gusts=0.1 gusts=0.2",
        "unit=m trans_unit=cm",
        "trans_unit=cm body_scale=0.1",
        "fail_on=doubts allow_unsound=true",
        "fail_on=nothing allow_unsound=false",
        "fail_on=unsound doubts=refuse",
        "fail_on=doubts doubts=report",
        "size_end={size:1.1,seconds:2} size_seconds=3",
        "refine={goal:5,method:newton} refine_method=sweeps",
        "metrics={surface_every:2} surface_stride=3",
        "cloth_contact={friction:0.1} cloth_friction=0.5",
        "plan=full accuracy=0.01",
        "plan=plan.json accuracy=0.01",
    ],
)
def test_words_that_contradict_each_other_are_refused(words: str) -> None:
    with pytest.raises(
        ConfigError, match=f"^{re.escape(words.replace(' ', ' and '))} contradict each other; give one of them$"
    ):
        load_config("rollout", words.split())


def _said_by(config: DictConfig) -> dict[str, Any]:
    """The keys; tables with names for what they hold."""
    return {**plain(config), "refine": refinement(config), "metrics": measurement(config), "objects": objects(config)}


#: Earlier keys and their defaults: every record of then has all of them.
THEN = {
    "relaxing_steps": 1,
    "events_speed": 0.25,
    "blend_from": "t",
    "size_seconds": 2.0,
    "allow_unsound": False,
    "doubts": "report",
    "trans_unit": None,
    "body_scale": None,
    "gusts": 0.0,
    "video_stride": 1,
    "target_rg": None,
    "budget_ms": None,
    "max_strain": None,
    "refine_method": "newton",
    "refine_most": 50,
    "refine_table": None,
    "surface_stride": 5,
    "export": [],
    "cloth_friction": 0.0,
    "body_parts": [],
    "thin_body": 0,
    "accuracy": None,
}


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
        ({"blend_in": 1.0, "blend_from": "a"}, {"blend_in": [1.0, "a"]}),
        ({"size_end": 0.8, "size_seconds": 3.0}, {"size_end": {"size": 0.8, "seconds": 3.0}}),
        ({"size_end": 0.8}, {"size_end": 0.8}),
        ({"doubts": "refuse"}, {"fail_on": "doubts"}),
        ({"allow_unsound": True}, {"fail_on": "nothing"}),
        ({"allow_unsound": True, "doubts": "refuse"}, {"fail_on": "doubts"}),
        ({"trans_unit": "mm"}, {"unit": "mm"}),
        ({"body_scale": 0.01}, {"unit": 0.01}),
        ({"video_stride": 2}, {"video": ["mp4", 2]}),
        ({"video": "none", "video_stride": 2}, {"video": "none"}),
        ({"refine": "auto", "target_rg": 0.1}, {"refine": "0.1rg"}),
        ({"refine": 0, "budget_ms": 20.0}, {"refine": "20ms"}),
        ({"refine": 0, "max_strain": 0.05}, {"refine": "5%"}),
        ({"refine": 5}, {"refine": 5}),
        (
            {"refine": 0, "budget_ms": 20.0, "refine_most": 9, "refine_table": "t.json"},
            {"refine": {"goal": "20ms", "most": 9, "table": "t.json"}},
        ),
        ({"refine": 4, "refine_method": "sweeps"}, {"refine": {"goal": 4, "method": "sweeps"}}),
        ({"surface_stride": 1, "export": ["rg"]}, {"metrics": {"kind": "all", "surface_every": 1, "fields": ["rg"]}}),
        ({"cloth_contact": "layers", "cloth_friction": 0.3}, {"cloth_contact": {"mode": "layers", "friction": 0.3}}),
        ({"objects": ["tank"], "body_parts": ["Skin"]}, {"objects": {"garment": ["tank"], "body": ["Skin"]}}),
        ({"blend_in": 1.0}, {"blend_in": 1.0}),
        ({"blend_from": "a"}, {}),
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


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("relaxing_steps=range(1,3)", "give one value"),
        ("relaxing_steps=[1", "close every bracket"),
        ("relaxing_steps=many", "unknown value for settle 'many'"),
        ("budget_ms=soon", "refine=soonms: give a whole number of iterations"),
        ("video_stride=0", r"video=\[mp4,0\]: give mp4, gif or png"),
        ("doubts=never", "unknown value for fail_on 'never'"),
        ("body_scale=x", "unit=x: give m, cm, mm"),
    ],
)
def test_values_that_never_were_are_refused(word: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        check_config(load_config("rollout", [word]))


def test_python_takes_and_notes_them() -> None:
    simulation = hood.simulate("tank", "plie", num_frames=1, stepper="newton", gusts=0.0, metrics="none", settle="paper")
    assert "gusts=0.0 is called losses.terms.air.gusts=0.0 now" in simulation.notes


def test_a_file_is_inspected_with_the_same_words() -> None:
    assert load_config("inspect", ["blend_in=1", "blend_from=a"]) == load_config("inspect", ["blend_in=[1,a]"])
    assert load_config("inspect", ["body_scale=0.01"]) == load_config("inspect", ["unit=0.01"])
    with pytest.raises(ConfigError, match="unknown key 'relaxing_steps'"):
        load_config("inspect", ["relaxing_steps=3"])


def test_the_record_in_a_folder_is_read_so(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text(yaml.safe_dump({**THEN, "sequence": "plie", "settle": "paper", "relaxing_steps": 2}))
    assert read_record(tmp_path / "config.yaml")["settle"] == 2


def test_records_of_other_commands_keep_their_keys() -> None:
    for command, word in (("evaluate", "refine_method=sweeps"), ("train", "data.trans_unit=cm")):
        record = plain(load_config(command, [word]))
        kept = dict(record)
        put_todays_keys(record)
        assert record == kept


def test_a_plan_of_then_is_followed(tmp_path: Path) -> None:
    write_plan(tmp_path / "plan.json", {"words": ["garment=tank", "settle=paper", "relaxing_steps=2"], "chosen": ["refine=0"]})
    config = rollout_config([f"plan={tmp_path / 'plan.json'}", "video_stride=3"])
    assert (config.garment, config.settle, config.video) == ("tank", 2, ["mp4", 3])
    with pytest.raises(ConfigError, match="settle=3: .* was made for settle=2"):
        rollout_config([f"plan={tmp_path / 'plan.json'}", "relaxing_steps=3"])


def test_a_rollout_of_then_is_resumed_and_summarised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["rollout", "stepper=refine", "garment=tank", "num_frames=2", "settle=paper", "guard=off", "sheet=false"]
    words += ["metrics=none", "video=none", "output=out", "resume=true"]
    assert main([*words, "refine=90%"]) == 0
    file = Path("out/rollout.h5")
    with h5py.File(file, "r+") as stored:
        for name in ("config", "asked"):
            settings = json.loads(stored.attrs[name])
            del settings["fail_on"], settings["unit"]
            settings |= {**THEN, "refine": "auto" if name == "asked" else 0, "max_strain": 0.9}
            stored.attrs[name] = json.dumps(settings)
    before = file.stat().st_mtime_ns
    assert main([*words, "max_strain=0.9"]) == 0
    assert file.stat().st_mtime_ns == before
    assert summarise(read_rollout(file))["refinement"]["asked"] == "refine=90%"
    assert main([*words, "refine=80%"]) == 0
    assert file.stat().st_mtime_ns != before


def test_keys_of_then_are_no_keys_of_today() -> None:
    keys = yaml.safe_load((CONFIG_FOLDER / "rollout.yaml").read_text(encoding="utf-8"))
    assert not THEN.keys() & keys.keys()
    assert THEN.keys() == old_names._OLD.keys()


def test_a_rollout_has_few_keys() -> None:
    """A new one is first looked for as a value of another."""
    keys = yaml.safe_load((CONFIG_FOLDER / "rollout.yaml").read_text(encoding="utf-8"))
    assert len(keys.keys() - {"defaults"}) <= 60


def test_every_module_of_today_is_there() -> None:
    for module in old_names._MOVED.values():
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
    old_names.rename_targets(node)
    assert node["list"][0]["_target_"] == "hood.steppers.newton.NewtonStepper"
    assert (node["list"][1], node["none"], node["_target_"]) == (1, None, "torch.optim.Adam")


def test_the_record_of_an_old_run_has_the_classes_of_today(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("losses:\n  terms:\n    inertia: {_target_: hood.losses.inertia.Inertia}\n")
    found = read_record(tmp_path / "config.yaml")["losses"]["terms"]["inertia"]["_target_"]
    assert found == "hood.energies.mass_points.Inertia"


def test_a_name_that_never_was_is_refused() -> None:
    with pytest.raises(ConfigError):
        build({"_target_": "hood.losses.collision.NoSuchClass"})
