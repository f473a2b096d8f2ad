"""Options of ``configs/stepper``: one word names what takes the steps, in every command."""

from __future__ import annotations

from pathlib import Path

import pytest
from omegaconf import OmegaConf

from hood.app import setup
from hood.app.candidates import make_candidate
from hood.app.settings.compose import ConfigError, load_config, options
from hood.app.settings.rollout_settings import RolloutSettings
from hood.app.stepping.steppers import find_option, make_solver, option_of, with_stepper
from hood.cli.main import main
from hood.energies.potential import default_potential
from hood.steppers.network import NetworkStepper, build_simulator
from hood.steppers.newton import NewtonStepper
from hood.steppers.refined import GuessStepper, RefinedStepper


@pytest.mark.parametrize("name", options("stepper"))
def test_an_option_says_its_name(name: str) -> None:
    config = RolloutSettings.from_words([f"stepper={name}"])
    assert str(config.stepper) == name
    option = option_of(config)
    assert option.name == name
    assert option.network is (name in ("network", "auto"))
    assert find_option(name) == (None if option.network else option)


@pytest.mark.parametrize("name", options("stepper"))
def test_an_option_changes_no_further_key(name: str) -> None:
    """Its file is read by itself where a rollout that is composed takes another option."""
    composed = RolloutSettings.from_words([f"stepper={name}"])
    assert dict(with_stepper(RolloutSettings.from_words(["stepper=auto"]), name)) == dict(composed)
    assert dict(with_stepper(RolloutSettings.from_words(["stepper=newton"]), name)) == dict(composed)


def test_the_last_of_several_words_counts() -> None:
    assert (
        str(RolloutSettings.from_words(["stepper=auto", "stepper=newton", "losses=reference", "losses=default"]).stepper)
        == "newton"
    )


def test_another_option_takes_the_place_of_all_of_one() -> None:
    config = RolloutSettings.from_words(["stepper=network", "solver.target_rg=0.5"])
    other = with_stepper(config, "newton")
    assert option_of(other) == option_of(RolloutSettings.from_words(["stepper=newton"]))
    assert other.solver.target_rg == 0.5
    assert str(config.stepper) == "network"
    assert option_of(with_stepper(other, "network")) == option_of(config)


def test_evaluations_and_rollouts_make_the_same() -> None:
    config = load_config("evaluate")
    newton, guess, refined = (make_candidate(name, config) for name in ("newton", "guess", "guess+5"))
    assert type(newton.stepper) is NewtonStepper
    assert type(guess.stepper) is GuessStepper
    assert isinstance(refined.stepper, RefinedStepper)
    assert type(refined.stepper.inner) is GuessStepper
    rolled = make_solver(option_of(RolloutSettings.from_words(["stepper=newton"])), config, default_potential())
    assert rolled.config == newton.stepper.config
    for name, told in (("newton+5", "solved already"), ("refine", "give refine\\+5")):
        with pytest.raises(ConfigError, match=told):
            make_candidate(name, config)


@pytest.mark.parametrize(
    ("stepping", "told"),
    [
        (None, "either _target_"),
        ({"refinement": "may"}, "either _target_"),
        ({"_target_": "hood.steppers.newton.NewtonStepper", "network": True}, "either _target_"),
        ({"_target_": "hood.steppers.newton.NewtonStepper", "refinement": "maybe"}, "choose may, always, never"),
    ],
)
def test_options_that_are_not_written_right_are_refused(stepping: object, told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        option_of(OmegaConf.create({"stepper": "mine", "stepping": stepping}))


def test_keys_that_the_class_does_not_take_are_refused() -> None:
    option = option_of(RolloutSettings.from_words(["stepper=newton"]))
    option.made_by["share"] = 0.1
    with pytest.raises(ConfigError, match="stepper=newton: .* is called with a potential"):
        make_solver(option, load_config("evaluate"), default_potential())


@pytest.mark.parametrize(
    ("words", "step"),
    [
        (["device=cuda", "refine=0"], "captured"),
        (["device=cuda", "refine=5"], "plain"),
        (["device=cuda", "refine=0", "guard=repair"], "plain"),
        (["device=cuda", "refine=0", "size_end=1.1"], "plain"),
        (["device=cuda", "refine=0", "step=plain"], "plain"),
        (["refine=0"], "plain"),
        (["refine=0", "step=fixed"], "fixed"),
    ],
)
def test_a_gpu_takes_a_network_alone_as_a_graph(words: list[str], step: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def capture(simulator: NetworkStepper, mode: str, or_plain: bool) -> str:
        assert or_plain
        return mode

    monkeypatch.setattr(setup, "CapturedSimulator", capture)
    monkeypatch.setattr(setup, "require_device", lambda config: None)
    monkeypatch.setattr(setup, "has_graphs", lambda device: "device=cuda" in words)
    network = build_simulator("paper", "acceleration", "1x(mesh)", latent_dim=8).eval()
    stepper, config = setup._by_itself(network, RolloutSettings.from_words(["stepper=network", *words]))
    assert str(config.step) == step
    assert stepper == ("captured" if step == "captured" else network)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["stepper=null"], "stepper=null: cannot be left out; give one of auto, guess"),
        (["stepper=nwton"], "did you mean 'newton'"),
        (["stepper=guess", "step=fixed"], "steps of stepper=guess are plain"),
        (["stepper=newton", "refine=5"], "stepper=newton goes as far as solver"),
    ],
)
def test_words_that_cannot_be_meant_are_refused(
    words: list[str], told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["rollout", "garment=tank", "num_frames=2", *words]) == 2
    assert told in capsys.readouterr().err
