"""``refine=auto`` and ``stepper=auto``: what a scene needs is chosen, said and written down; keys that are given win."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

import hood
from hood.app.batch import batch
from hood.app.batch.batch import find_jobs
from hood.app.notices import collected
from hood.app.settings.rollout_settings import RolloutSettings
from hood.app.stepping import automatic
from hood.app.stepping.automatic import Measured
from hood.cli.main import main
from hood.energies.potential import default_potential
from hood.scene.scene import Scene
from hood.steppers.checkpoint import load_simulator, save_simulator
from hood.steppers.network import build_simulator
from hood.steppers.newton import NewtonStepper
from hood.steppers.ranges import Conditions, scene_conditions
from hood.steppers.refined import RefinedStepper

QUICK = ["rollout", "video=none", "sheet=false", "metrics=none", "fail_on=nothing", "garment=tank", "num_frames=3",
         "checkpoint=small.safetensors", "output=out"]  # fmt: skip


@pytest.fixture(autouse=True)
def weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tank_scene: Scene) -> Conditions:
    """Weights in the working folder that know garments of a tenth of a tank's vertices; the ranges of the tank itself."""
    monkeypatch.chdir(tmp_path)
    torch.manual_seed(0)
    model = build_simulator("paper", "acceleration", "1x(mesh)", latent_dim=8).eval()
    known = scene_conditions(tank_scene.garment, tank_scene.cloth, tank_scene.dt, default_potential())
    model.trained_for = replace(known, spans={**known.spans, "vertices": (90.0, 100.0)})
    save_simulator(tmp_path / "small.safetensors", model)
    model.trained_for = known
    save_simulator(tmp_path / "known.safetensors", model)
    model.trained_for = None
    save_simulator(tmp_path / "silent.safetensors", model)
    return known


def summary() -> dict[str, Any]:
    return json.loads(Path("out/summary.json").read_text())


#: What is found of the solver.
SOLVER = Measured(20.0, 0.01)


def measured(monkeypatch: pytest.MonkeyPatch, network: Measured | None, newton: Measured = SOLVER) -> None:
    """What is measured: of a network, refined or not, and of the solver."""

    def measure(stepper: Any, *_: Any, **__: Any) -> Measured | None:
        return newton if stepper.config.get("stepper") == "newton" else network

    monkeypatch.setattr(automatic, "_measure", measure)


def test_a_larger_garment_is_not_left_to_the_network(capsys: pytest.CaptureFixture[str], weights: Conditions) -> None:
    count = weights.spans["vertices"][1]
    assert main(QUICK) == 0
    sentence = f"refine=5: tank has {count:,.0f} vertices, small.safetensors was trained on 100 at most (refine=0 leaves it"
    assert sentence in capsys.readouterr().out
    found = summary()
    assert found["choice"]["stepper"] == "network"
    assert found["choice"]["refine"] == 5
    assert found["refinement"]["asked"] == "refine=5"
    assert found["refinement"]["iterations_max"] > 0


@pytest.mark.parametrize(
    "key", ["refine=0", "refine=2", "refine=0.5rg", "checkpoint=known.safetensors", "checkpoint=silent.safetensors"]
)
def test_what_is_given_wins_and_what_is_known_needs_nothing(key: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*QUICK, key]) == 0
    assert "refine=5: " not in capsys.readouterr().out
    asked = {"refine=2": "refine=2", "refine=0.5rg": "refine=0.5rg"}.get(key)
    assert summary().get("refinement", {}).get("asked") == asked


def test_on_a_cpu_the_solver_is_the_default_and_nothing_is_measured(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(automatic, "_measure", lambda *_, **__: pytest.fail("a timing decides"))
    for words in ([], ["stepper=auto"]):
        assert main([*(word for word in QUICK if "checkpoint" not in word), *words]) == 0
        told = capsys.readouterr().out
        line = "stepper=newton: the solver, the default on a CPU; checkpoint=… or refine=… takes a network"
        assert told.count(line) == 1
        assert "kernels=auto" not in told
        assert summary()["choice"] == {"stepper": "newton", "refine": 0, "ms": {}, "why": [line]}
        assert "solver_steps_not_converged" in summary()
    simulation = hood.simulate("tank", num_frames=2)
    assert simulation.notes == [line]
    assert isinstance(simulation.stepper, NewtonStepper)


@pytest.mark.parametrize(
    ("words", "stepper"),
    [
        (["checkpoint=quickstart"], "network"),
        (["refine=5"], "network"),
        (["refine=0"], "network"),
        (["stepper=auto", "refine=0.1rg"], "network"),
        (["refine=9ms"], "network"),
        (["precision=bf16"], "network"),
        (["model=small", "model.latent_dim=8"], "network"),
        (["step=compiled"], "network"),
        (["step=plain"], "auto"),
        (["material=denim", "solver.target_rg=0.1"], "auto"),
        (["stepper=newton", "checkpoint=quickstart"], "newton"),
        (["stepper=refine", "refine=5"], "refine"),
    ],
)
def test_a_key_of_the_network_keeps_the_network(words: list[str], stepper: str) -> None:
    config = RolloutSettings.from_words(words)
    assert config.stepper == stepper
    assert config.stepping == RolloutSettings.from_words([f"stepper={stepper}"]).stepping


@pytest.mark.parametrize(
    ("network", "stepper"),
    [
        (Measured(9.0, 0.01), "network"),
        (Measured(9.0, 0.2), "newton"),  # faster, and less exact
        (Measured(90.0, 0.001), "newton"),
        (Measured(9.0, float("nan")), "newton"),
        (None, "newton"),
    ],
)
def test_elsewhere_the_network_has_to_be_faster_and_as_accurate(
    network: Measured | None, stepper: str, monkeypatch: pytest.MonkeyPatch, tank_scene: Scene
) -> None:
    measured(monkeypatch, network)
    config = RolloutSettings.from_words(["garment=tank"])  # choose() is asked where the device leaves something to measure
    choice = automatic.choose(config, build_simulator("paper", "acceleration", "1x(mesh)", latent_dim=8), tank_scene)
    assert choice.stepper == stepper
    (why,) = choice.why
    if network is None:
        assert why == "stepper=newton: the motion is too short to measure which is faster"
        return
    assert f"stepper={stepper}: a frame of the solver takes 20 ms here, one of the network {network.ms:.0f} ms; " in why
    assert "the relative gradient is 0.01 with the solver, " in why
    assert choice.settle(config).stepper == stepper


def test_what_is_measured_is_of_the_scene(tank_scene: Scene) -> None:
    potential = default_potential()
    found = automatic._measure(NewtonStepper(potential), tank_scene, potential)
    assert found is not None
    assert found.ms > 0
    assert 0 < found.rg < 0.05
    assert automatic._measure(NewtonStepper(potential), tank_scene, potential, "none")


def test_many_motions_have_one_stepper(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    Path("list.txt").write_text("walk_proud\nplie\n")
    command = [*(word for word in QUICK if "checkpoint" not in word), "sequence=list.txt"]
    assert main(command) == 0
    assert capsys.readouterr().out.count("stepper=newton: the solver, the default") == 1
    assert main([*command, "resume=true"]) == 0
    assert "2 of them finished before and skipped now" in capsys.readouterr().out
    asked: list[Any] = []
    monkeypatch.setattr(batch, "decided", lambda config: (config, []))  # as on a GPU
    monkeypatch.setattr(batch, "make_stepper", lambda config: (None, ""))
    monkeypatch.setattr(batch, "choose", lambda *_: asked.append(1) or automatic.Choice("network", why=["measured"]))
    jobs = find_jobs("list.txt", Path("other"))
    assert jobs is not None
    with collected() as said:
        assert batch.with_one_stepper(RolloutSettings.from_words(["garment=tank"]), jobs).stepper == "network"
    assert said[-1].endswith("measured")
    assert len(asked) == 1


def test_what_was_begun_with_the_network_goes_on_with_it(capsys: pytest.CaptureFixture[str]) -> None:
    """As a batch of a time when the network was the default."""
    Path("list.txt").write_text("walk_proud\nplie\n")
    Path("one.txt").write_text("walk_proud\n")
    usual = [word for word in QUICK if "checkpoint" not in word]
    assert main([*usual, "sequence=one.txt", "stepper=network"]) == 0
    capsys.readouterr()
    assert main([*usual, "sequence=list.txt", "resume=true"]) == 0
    told = capsys.readouterr().out
    assert "resume=true: stepper=network, as in out/walk_proud" in told
    assert "1 of them finished before and skipped now" in told
    assert json.loads(Path("out/plie/summary.json").read_text())["choice"]["stepper"] == "network"
    assert main([*usual, "sequence=list.txt", "resume=true", "material=denim"]) == 0
    told = capsys.readouterr().out
    assert "stepper=newton: the solver, the default on a CPU" in told
    assert "out/walk_proud was made with other settings and is made again" in told


def test_advice_is_given_where_the_solver_is_faster(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    longer = [*QUICK, "num_frames=10", "refine=0"]
    measured(monkeypatch, None, Measured(1e-3, 0.01))
    assert main(longer) == 0
    assert "the solver alone takes 0 ms a frame here, the network" in capsys.readouterr().out
    measured(monkeypatch, None, Measured(1e9, 0.01))
    assert main(longer) == 0
    assert "the solver alone" not in capsys.readouterr().out
    measured(monkeypatch, None, Measured(1e-3, 0.01))
    assert main([*QUICK, "refine=0"]) == 0  # too short to say
    assert "the solver alone" not in capsys.readouterr().out


def test_refined_networks_are_measured_as_they_would_run(monkeypatch: pytest.MonkeyPatch, tank_scene: Scene) -> None:
    seen: list[Any] = []
    monkeypatch.setattr(automatic, "_measure", lambda stepper, *_, **__: seen.append(stepper))
    config = RolloutSettings.from_words(["garment=tank"])  # choose() is asked where the device leaves something to measure
    config = config.with_values(checkpoint="small.safetensors")
    automatic.choose(config, load_simulator(Path("small.safetensors")), tank_scene)
    assert isinstance(seen[0], RefinedStepper)
