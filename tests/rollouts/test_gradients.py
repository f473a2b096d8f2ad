"""What gradients of loosely solved rollouts are off by, and where they have kinks."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import pytest
import torch
import trimesh
from torch import Tensor

import hood
from hood.cloth.state import State
from hood.mesh.shapes import grid, sphere
from hood.rollouts.gradients import DifferentiableFrames, Gradients

SHEET: dict[str, Any] = {"body": "none", "pins": [0, 3]}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("sheets")
    for name, (pos, faces) in {"sheet": grid(4, 4, 0.2), "ball": sphere(2, 0.1)}.items():
        lifted = pos + [-0.09, 0.104, -0.1] if name == "sheet" else pos
        trimesh.Trimesh(lifted, faces, process=False).export(made / f"{name}.obj")
    return made


def followed(folder: Path, target: float, **scene: Any) -> tuple[DifferentiableFrames, dict[str, Tensor]]:
    of = {"lame_mu": 2e4, "bending_stiffness": 1e-4}
    given: dict[str, Any] = {name: torch.tensor(value, dtype=torch.float64, requires_grad=True) for name, value in of.items()}
    keys: dict[str, Any] = {
        "num_frames": 5,
        "settle": 0,
        "stepper": "newton",
        "metrics": "none",
        "solver": {"target_rg": target},
        "worn": False,
    }
    return hood.differentiable(hood.simulate(str(folder / "sheet.obj"), **keys, **scene), **given), given


def loss(states: list[State]) -> Tensor:
    return torch.stack([state.pos.sin().sum() + state.pos[-1, 1].square() for state in states]).sum()


def quietly(frames: DifferentiableFrames) -> Gradients:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return frames.gradients(loss)


@pytest.mark.parametrize("target", [1e-1, 1e-2, 1e-3])
@pytest.mark.parametrize("kind", ["hanging", "ball"])
def test_the_estimate_covers_the_true_error(folder: Path, target: float, kind: str) -> None:
    scene = SHEET if kind == "hanging" else {"body": str(folder / "ball.obj"), "pins": "none"}
    found, exact = (quietly(followed(folder, to, **scene)[0]) for to in (target, 1e-10))
    for name, value in exact.by.items():
        off = float((found.by[name] / value - 1.0).abs())
        assert off <= found.error[name] <= max(10.0 * off, 1e-5), name
    assert max(step.rg for step in found.steps) <= target
    assert max(exact.error.values()) < 1e-5
    assert len(found.steps) == 4
    if kind == "hanging":
        assert found.jumps == []


def test_gradients_are_those_of_backward_and_loose_ones_warn(folder: Path) -> None:
    frames, given = followed(folder, 1e-1, **SHEET)
    with pytest.warns(UserWarning, match=r"gradients: that by \w+ is off by about [\d.]+%.*give a smaller solver\.target_rg"):
        found = frames.gradients(loss)
    value = loss(list(frames))
    value.backward()
    assert found.loss == pytest.approx(value.item())
    for name, tensor in given.items():
        assert tensor.grad is not None
        assert torch.equal(found.by[name], tensor.grad)


def test_what_has_no_gradient_is_said(folder: Path) -> None:
    frames, _ = followed(folder, 1e-2, **SHEET)
    with pytest.raises(ValueError, match="the loss does not depend on lame_mu or bending_stiffness"):
        frames.gradients(lambda states: states[0].pos.detach().sum())
    simulation = hood.simulate(str(folder / "sheet.obj"), **SHEET, settle=0, stepper="newton", num_frames=2, metrics="none")
    with pytest.raises(ValueError, match="nothing that was given requires a gradient"):
        hood.differentiable(simulation, lame_mu=2e4).gradients(loss)


def test_steps_that_ended_at_no_minimum_are_named() -> None:
    """Loosely solved, cloth that is pressed together ends where it has not buckled yet; its adjoint is solved all the same."""
    keys: dict[str, Any] = {"stepper": "newton", "metrics": "none", "solver": {"target_rg": 0.3}}
    mu = torch.tensor(23600.0, dtype=torch.float64, requires_grad=True)
    frames = hood.differentiable(hood.simulate("tank", "walk_brisk", num_frames=13, **keys), lame_mu=mu)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.filterwarnings("error", message="differentiable step: the adjoint system")
        found = frames.gradients(lambda states: states[-1].pos[:, 1].mean())
    assert 11 in found.indefinite
    assert min(found.indefinite) > 5
