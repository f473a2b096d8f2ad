"""Configs: composed, checked, resolved; what is misspelt is named with its neighbour."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

from hood.app.settings import compose
from hood.app.settings.compose import ConfigError, build, groups, load_config, options, plain, require_choice, with_words
from hood.app.settings.record import save_run_record
from hood.assets.material import Material
from hood.energies.potential import Potential, default_potential
from hood.steppers.network import NetworkStepper
from hood.training.curriculum import WarmupCosine
from hood.training.settings import TrainerSettings


def test_contact_without_weight_is_named_by_the_keys_of_the_command() -> None:
    for name, keys in (
        ("rollout", "losses.terms.collision.weight=0"),
        ("train", "trainer.collision.start=0 trainer.collision.end=0"),
    ):
        with pytest.raises(ConfigError, match=f"or give {keys} instead"):
            load_config(name, ["losses.terms.collision=null"])
        load_config(name, keys.split())
        load_config(name, ["losses.terms.collision=null", "losses.terms.friction=null"])


def test_defaults_of_every_command_load() -> None:
    for name in ("train", "rollout", "evaluate", "tradeoff"):
        assert load_config(name).device == "cpu"


def test_overrides_of_keys_groups_and_keys_inside_groups() -> None:
    config = load_config("rollout", ["num_frames=7", "material=denim", "material.density=0.3", "betas=[1,-0.5]"])
    assert config.num_frames == 7
    assert config.material.density == 0.3
    assert config.material.lame_mu == load_config("rollout", ["material=denim"]).material.lame_mu
    assert plain(config.betas) == [1, -0.5]


def test_a_chosen_model_brings_its_keys() -> None:
    config = load_config("rollout", ["model=small", "model.latent_dim=12"])
    assert config.model.latent_dim == 12
    assert load_config("rollout").get("model") is None


def test_integers_are_fine_where_numbers_are_real() -> None:
    assert load_config("rollout", ["fps=60"]).fps == 60


def test_names_that_look_like_numbers_are_names() -> None:
    assert str(load_config("rollout", ["garment=12"]).garment) == "12"


@pytest.mark.parametrize(
    "overrides, words",
    [
        (["garmnet=dress"], ("'garmnet'", "'garment'")),
        (["material.densty=0.3"], ("'material.densty'", "'material.density'")),
        (["material=demin"], ("unknown material", "'demin'", "'denim'")),
        (["num_frames=abc"], ("num_frames=abc: give a whole number, such as num_frames=150",)),
        (["num_frames=2.5"], ("num_frames=2.5: give a whole number",)),
        (["num_frames=null"], ("num_frames=null: give a whole number",)),
        (["sheet=3"], ("sheet=3: give true or false, such as sheet=true",)),
        (
            ["video=false"],
            ("such as video=mp4; hood rollout --help says of video: mp4, gif or none; png: transparent",),
        ),
        (["sequence=null"], ("sequence=null: give text, such as sequence=walk_proud",)),
        (["sequence=[walk_proud,plie]"], ("give one text, not a list", "a list file")),
        (["size=big"], ("size=big: give a number or a list in brackets, such as size=1",)),
        (["seed=abc"], ("seed=abc: give a whole number",)),
        (["kernels=false"], ("kernels=false: give text, such as kernels=auto; see hood rollout --help",)),
        (["events=1"], ("events=1: give a list in brackets, the default is events=[]",)),
        (["material.density=heavy"], ("material.density=heavy: give a number, such as material.density=0.20022",)),
        (["losses.terms.collision=null"], ("losses.terms.collision=null: losses.terms.friction takes values", "friction=null")),
        (["--video=mp4"], ("'--video=mp4': keys have no dashes; write video=mp4",)),
        (["-v"], ("'-v': keys have no dashes; write key=value, hood rollout --help",)),
        (["losses.terms.friction.coefficient=nan"], ("losses.terms.friction.coefficient=nan", "finite", "0.5")),
        (["solver.target_rg=inf"], ("solver.target_rg=inf", "finite", "0.01")),
        (["sequence=[a,b]"], ("sequence",)),
        (["garment={a:1}"], ("garment",)),
        (["+speed=3"], ("+speed=3",)),
        (["~garment"], ("~garment",)),
        (["num_frames"], ("'num_frames'", "key=value")),
        (["garment=a=b(("], ("garment",)),
        (["garment=dress,skirt"], ("garment",)),
        (["garment=${missing}"], ("missing",)),
        (["hydra.run.dir=x"], ("hydra.run.dir",)),
        (["model.latent_dim=3"], ("model.latent_dim",)),
    ],
)
def test_mistakes_are_one_line_with_the_near_miss(overrides: list[str], words: tuple[str, ...]) -> None:
    with pytest.raises(ConfigError) as error:
        load_config("rollout", overrides)
    message = str(error.value)
    assert "\n" not in message
    assert all(word in message for word in words), message


def test_training_config_builds_what_it_says() -> None:
    config = load_config("train", ["experiment=quickstart", "model=small", "trainer.schedule.warmup=7"])
    settings = build(config.trainer)
    assert isinstance(settings, TrainerSettings)
    assert settings.schedule == WarmupCosine(7, config.trainer.schedule.floor)
    assert isinstance(build(config.model), NetworkStepper)


def test_the_papers_models_may_begin_with_small_predictions() -> None:
    last = {}
    for word in ("null", "0.01"):
        torch.manual_seed(0)
        model = build(load_config("train", ["model=ours", "model.latent_dim=8", f"model.output_init={word}"]).model)
        last[word] = model.network.decoder.third.weight
    torch.testing.assert_close(last["0.01"], 0.01 * last["null"])


def test_default_losses_are_the_librarys(rollout_losses: Potential) -> None:
    library = default_potential()
    assert list(rollout_losses.terms) == list(library.terms)
    for name, term in library.terms.items():
        assert type(rollout_losses.terms[name]) is type(term)
        assert vars(rollout_losses.terms[name]) == vars(term)


@pytest.fixture
def rollout_losses() -> Potential:
    return build(load_config("rollout").losses)


def test_friction_follows_the_collision_weight() -> None:
    losses = build(load_config("rollout", ["losses.terms.collision.weight=1e4"]).losses)
    assert losses.terms["friction"].weight == losses.terms["collision"].weight == 1e4


def test_default_material_is_the_librarys() -> None:
    assert build(load_config("rollout").material) == Material()


@pytest.mark.parametrize("target", ["os.system", "subprocess.run", "builtins.eval", "hoodwink.run", "torch.load"])
def test_foreign_targets_are_refused(target: str) -> None:
    with pytest.raises(ConfigError, match=f"_target_ '{target}' is not allowed"):
        build(load_config("rollout", [f"material._target_={target}"]).material)
    with pytest.raises(ConfigError, match="not allowed"):
        build({"_target_": "hood.energies.potential.Potential", "terms": {"a": {"_target_": target}}})


@pytest.mark.parametrize(
    "target", ["hood.rollouts.file.recorder.os.system", "hood.app.settings.compose.Path", "hood.cli.main.sys.exit"]
)
def test_foreign_objects_behind_own_modules_are_refused(target: str) -> None:
    with pytest.raises(ConfigError, match="not allowed"):
        build({"_target_": target})


def test_arguments_that_the_target_does_not_take() -> None:
    with pytest.raises(ConfigError, match="weigth"):
        build({"_target_": "hood.energies.contact.Collision", "weigth": 1.0})
    with pytest.raises(ConfigError):
        build({"_target_": "hood.assets.material.Materiel"})


def test_the_targets_own_complaint_comes_through() -> None:
    with pytest.raises(ValueError, match="material 'density'"):
        build(load_config("rollout", ["material.density=-1"]).material)


def test_every_option_of_every_group_loads() -> None:
    assert {"model", "trainer", "material", "losses"} <= set(groups())
    for model in options("model"):
        assert load_config("train", [f"model={model}"]).model.schedule
    for trainer in options("trainer"):
        assert isinstance(build(load_config("train", [f"trainer={trainer}"]).trainer), TrainerSettings)
    for material in options("material"):
        assert isinstance(build(load_config("rollout", [f"material={material}"]).material), Material)
    for experiment in options("experiment"):
        assert load_config("train", [f"experiment={experiment}"])


def test_require_choice() -> None:
    config = load_config("rollout", ["video=mp5"])
    with pytest.raises(ConfigError, match="video 'mp5': did you mean 'mp4'"):
        require_choice(config, "video", ("mp4", "gif", "none"))


@pytest.mark.parametrize(
    ("command", "word", "key"),
    [
        ("rollout", "motion", "sequence"),
        ("rollout", "avatar", "body"),
        ("rollout", "sequnce", "sequence"),
        ("evaluate", "motion", "sequences"),
    ],
)
def test_another_word_for_a_key(command: str, word: str, key: str) -> None:
    with pytest.raises(ConfigError, match=f"unknown key '{word}': did you mean '{key}'"):
        load_config(command, [f"{word}=walk"])


def test_run_record(tmp_path: Path) -> None:
    config = load_config("rollout", ["garment=skirt"])
    save_run_record(tmp_path / "run", config, seed=5)
    text = (tmp_path / "run" / "config.yaml").read_text()
    assert "garment: skirt" in text
    assert "${" not in text
    record = json.loads((tmp_path / "run" / "versions.json").read_text())
    assert record["seed"] == 5
    assert {"hood", "python", "torch", "numpy", "platform"} <= set(record)


def test_words_more_are_those_of_the_command_line():
    config = load_config("rollout", ["garment=tank"])
    words = ["cloth_contact=off", "losses.terms.bending=null", "solver.target_rg=0.1", "gravity=0"]
    assert with_words(config, words) == load_config("rollout", ["garment=tank", *words])
    assert config == load_config("rollout", ["garment=tank"])
    with pytest.raises(ConfigError, match="gravty=0: no such key"):
        with_words(config, ["gravty=0"])


@pytest.mark.parametrize(
    ("command", "word", "values"),
    [
        ("rollout", "--multirun", "seed"),
        ("rollout", "seed=0,1", "for x in 0 1; do hood rollout seed=$x output=outputs/seed_$x; done"),
        ("rollout", "seed=range(3)", "for x in …; do hood rollout seed=$x output"),
        ("rollout", "num_frames=choice(3,4)", "for x in …; do hood rollout num_frames=$x"),
        ("rollout", "material=denim,silk", "for x in denim silk; do hood rollout material=$x output=outputs/material_$x; done"),
    ],
)
def test_several_values_of_a_key_are_refused_with_the_loop(command: str, word: str, values: str) -> None:
    with pytest.raises(
        ConfigError, match="a command takes one value of a key, a loop of the shell runs several: for x in"
    ) as told:
        load_config(command, [word])
    assert values in str(told.value)
    assert "\n" not in str(told.value)


@pytest.mark.parametrize("word", ["trainer.learning_rate=1e-3,1e-4", "model=ours,small", "seed=range(3)"])
def test_several_values_of_a_training_are_refused_with_the_sweep(word: str) -> None:
    with pytest.raises(ConfigError, match=f"hood train -m {re.escape(word.partition('=')[0])}="):
        load_config("train", [word])


def test_trainers_have_the_same_keys() -> None:
    """A key that one of them lacks could not be given beside it."""
    keys = {name: {*load_config("train", [f"trainer={name}"]).trainer} for name in options("trainer")}
    assert len(keys) >= 3
    assert len({frozenset(found) for found in keys.values()}) == 1, keys


@pytest.mark.parametrize(
    "words",
    [
        ["num_frames=7", "garment=[tank,skirt]", "betas=[1.5,0]"],
        ["material=denim", "material.density=0.4", "losses=reference", "losses.terms.friction.coefficient=0.2"],
        [
            "losses.terms.bending=null",
            "losses.terms.collision.weight=3e6",
            "solver.target_rg=1e-3",
            "solver={max_iterations: 3}",
        ],
        ["size={sleeves: 1.05}", "events=[{time: 2.0, open: front_buttons}]", "stepper=refine", "refine=5"],
    ],
)
def test_keys_in_a_kept_composition_are_those_that_hydra_sets(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    compose._loaded.cache_clear()
    quick = OmegaConf.to_yaml(load_config("rollout", words))
    monkeypatch.setattr(compose, "_with_keys", lambda known, keys: None)
    compose._loaded.cache_clear()
    assert OmegaConf.to_yaml(load_config("rollout", words)) == quick
    compose._loaded.cache_clear()
