"""``refine=auto`` and ``stepper=auto``: what a scene needs is chosen, said and written down; keys that are given win."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from hood.cli import main
from hood.commands import automatic
from hood.dynamics.checkpoint import save_simulator
from hood.dynamics.ranges import Conditions, scene_conditions
from hood.dynamics.refine import RefinedStepper
from hood.dynamics.simulator import build_simulator
from hood.dynamics.stepper import NewtonStepper
from hood.losses.potential import default_potential
from hood.scene.scene import Scene

QUICK = ["rollout", "video=none", "sheet=false", "metrics=none", "allow_unsound=true", "garment=tank", "num_frames=3",
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


def taken(monkeypatch: pytest.MonkeyPatch, **ms: float) -> None:
    """Times of a frame as measured: of a network, refined or not, and of the solver."""

    def measured(stepper: Any, *_: Any) -> float:
        return ms["newton"] if stepper.config.get("stepper") == "newton" else ms["network"]

    monkeypatch.setattr(automatic, "_ms", measured)


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
    "key", ["refine=0", "refine=2", "target_rg=0.5", "checkpoint=known.safetensors", "checkpoint=silent.safetensors"]
)
def test_what_is_given_wins_and_what_is_known_needs_nothing(key: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*QUICK, key]) == 0
    assert "refine=5" not in capsys.readouterr().out
    asked = {"refine=2": "refine=2", "target_rg=0.5": "target_rg=0.5"}.get(key)
    assert summary().get("refinement", {}).get("asked") == asked


def test_auto_takes_the_faster_one(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    taken(monkeypatch, network=90.0, newton=20.0)
    assert main([*QUICK, "stepper=auto"]) == 0
    assert "stepper=newton: a frame of the solver takes 20 ms here, one of the network 90 ms" in capsys.readouterr().out
    found = summary()
    assert found["choice"] | {"why": 0} == {"stepper": "newton", "refine": 0, "ms": {"network": 90, "newton": 20}, "why": 0}
    assert "solver_steps_not_converged" in found
    assert "refinement" not in found
    taken(monkeypatch, network=9.0, newton=20.0)
    assert main([*QUICK, "stepper=auto", "checkpoint=known.safetensors"]) == 0
    assert "stepper=network: a frame of the solver takes 20 ms here, one of the network 9 ms" in capsys.readouterr().out
    assert "solver_steps_not_converged" not in summary()


def test_finished_rollouts_are_known_by_what_was_asked(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    taken(monkeypatch, network=90.0, newton=20.0)
    Path("list.txt").write_text("walk_proud\n")
    for repeated in (False, True):
        assert main([*QUICK, "stepper=auto", "sequence=list.txt", "resume=true"]) == 0
        assert ("stepper=newton:" in capsys.readouterr().out) is not repeated


def test_times_are_measured_on_the_scene(tank_scene: Scene) -> None:
    potential = default_potential()
    ms = automatic._ms(NewtonStepper(potential), tank_scene, potential)
    assert ms is not None
    assert ms > 0


def test_advice_is_given_where_the_solver_is_faster(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    longer = [*QUICK, "num_frames=10", "refine=0"]
    taken(monkeypatch, network=0.0, newton=1e-3)
    assert main(longer) == 0
    assert "the solver alone takes 0 ms a frame here, the network" in capsys.readouterr().out
    taken(monkeypatch, network=0.0, newton=1e9)
    assert main(longer) == 0
    assert "the solver alone" not in capsys.readouterr().out
    taken(monkeypatch, network=0.0, newton=1e-3)
    assert main([*QUICK, "refine=0"]) == 0  # too short to say
    assert "the solver alone" not in capsys.readouterr().out


def test_refined_networks_are_measured_as_they_would_run(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[Any] = []

    def measured(stepper: Any, *_: Any) -> float:
        seen.append(stepper)
        return 1.0

    monkeypatch.setattr(automatic, "_ms", measured)
    assert main([*QUICK, "stepper=auto"]) == 0
    assert isinstance(seen[0], RefinedStepper)
