"""What a rollout says of its steps holds for the positions in its file, and why steps ended is told."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from belt import write_belt, write_walk
from omegaconf import OmegaConf

from hood.app.settings.compose import build
from hood.app.setup import make_scene
from hood.cli.main import main
from hood.cloth.state import State
from hood.energies.potential import relative_gradient
from hood.energies.problem import StepProblem
from hood.rollouts.file.reader import RolloutData, read_rollout

ROLLOUT = ["rollout", "garment=belt.obj", "sequence=walk.npz", "num_frames=5", "video=none", "sheet=false", "output=out"]
NETWORK = ["checkpoint=untrained", "model=small", "model.latent_dim=4", "model.schedule='1x(mesh)'"]
SOLVED = {
    "newton": ["stepper=newton", "solver.target_rg=1e-3"],
    "guess": ["stepper=refine", "refine=8"],
    "sweeps": ["stepper=refine", "refine={goal:4,method:sweeps}"],
    "network": [*NETWORK, "refine=0.01rg"],
    "fixed": [*NETWORK, "model.features=paper", "model.output=acceleration", "step=fixed", "refine=5"],
}


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_belt(Path("belt.obj"))
    write_walk(Path("walk.npz"), 8)


def residual(data: RolloutData, frame: int) -> float:
    """Relative gradient of the step that led to ``frame``, from the file's positions in three frames."""
    config = OmegaConf.create(json.loads(data.attributes["config"]))
    scene, potential = make_scene(config), build(config.losses)
    before, now, after = (torch.as_tensor(data.cloth_pos[frame - k]).double() for k in (2, 1, 0))
    origin = now.mean(dim=0)
    state = State(now - origin, (now - before) / scene.dt, origin.unsqueeze(0))
    step = scene.step_input(frame - 1, state)
    problem = potential.prepare(StepProblem(scene.cloth, state, step, gravity=torch.tensor([0.0, -9.81, 0.0]).double()))
    gradient, _ = potential.gradient(problem, after - origin)
    return float(relative_gradient(problem, gradient * scene.cloth.free.unsqueeze(1)))


@pytest.mark.parametrize("kind", SOLVED)
def test_the_stored_positions_are_as_good_as_said(kind: str) -> None:
    assert main([*ROLLOUT, *SOLVED[kind], "fail_on=nothing"]) == 0
    data = read_rollout(Path("out/rollout.h5"))
    assert data.cloth_pos.dtype == data.rest_pos.dtype == np.float64
    said = data.metrics["relative_gradient"]
    for frame in range(2, 5):
        assert residual(data, frame) == pytest.approx(said[frame], rel=1e-2)
    if kind == "newton":
        assert data.metrics["solver_converged"][1:].tolist() == [1.0] * 4
        assert said[1:].max() <= 1e-3
    else:
        np.testing.assert_allclose(data.metrics["refine_rg"][1:], said[1:], rtol=1e-2)


@pytest.mark.parametrize("words", [NETWORK, ["stepper=newton", "solver.double=false"]], ids=["network", "float32 solver"])
def test_what_is_computed_in_float32_is_stored_so(words: list[str]) -> None:
    assert main([*ROLLOUT, *words, "num_frames=2", "fail_on=nothing"]) == 0
    assert read_rollout(Path("out/rollout.h5")).cloth_pos.dtype == np.float32


def test_why_the_solver_stopped(capsys: pytest.CaptureFixture[str]) -> None:
    missed = [*ROLLOUT, "stepper=newton", "solver.max_iterations=1", "solver.target_rg=1e-9"]
    assert main([*missed, "metrics=strain"]) == 3
    assert main(missed) == 0  # a tenth of a millimetre from the minimum
    assert "4 steps did not reach solver.target_rg (4 max iterations)" in capsys.readouterr().out
    found = json.loads(Path("out/summary.json").read_text())
    assert found["solver_steps_ended"] == {"max iterations": 4}


def test_why_refinements_stopped(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*ROLLOUT, "stepper=refine", "refine={goal:0.5rg,most:30}"]) == 0
    assert "frames met it" in capsys.readouterr().out
    assert json.loads(Path("out/summary.json").read_text())["refinement"]["steps_ended"] == {"stopped": 4}
    assert main([*ROLLOUT, "stepper=refine", "refine=2", "fail_on=nothing"]) == 0
    assert "; steps ended: 4 max iterations\n" in capsys.readouterr().out
