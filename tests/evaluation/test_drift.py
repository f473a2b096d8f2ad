"""Drift to the side: known for a model that pushes, none for the solver, infinite for a broken one."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from hood.assets.body.load import load_body
from hood.assets.garment.garment import load_garment
from hood.energies.potential import default_potential
from hood.energies.problem import StepProblem
from hood.evaluation.table import ALL, Candidate, MeasuredRollout, candidate_rows
from hood.evaluation.validation import sideways_drift, standing_scene
from hood.scene.scene import Scene
from hood.solver.newton import NewtonSettings
from hood.steppers.network import NetworkStepper, Prediction, build_simulator
from hood.steppers.newton import NewtonStepper


@pytest.fixture(scope="module")
def scene() -> Scene:
    return standing_scene(load_garment("tank"), load_body(), 8)


def pusher(push: float) -> NetworkStepper:
    """Moves every vertex sideways by ``push`` [m] a step."""
    simulator = build_simulator("physical", "velocity_base", "1x(mesh)", latent_dim=4).eval()
    plain = simulator.predict

    def predict(problem: StepProblem, *rest: object) -> Prediction:
        prediction = plain(problem, *rest)  # type: ignore[arg-type]
        moved = problem.state.pos + torch.tensor([push, 0.0, 0.0])
        return Prediction(**{**vars(prediction), "next_pos": moved})

    simulator.predict = predict  # type: ignore[method-assign]
    return simulator


def test_the_body_stands_still_and_has_no_side(scene: Scene) -> None:
    first, last = (scene.motion.surface(frame, np.zeros(3)) for frame in (0, 7))
    assert torch.equal(first, last)
    assert float(first[:, 0].min() + first[:, 0].max()) == pytest.approx(0.0, abs=2e-3)
    assert float(first[:, 0].max()) > 1.5 * float(first[:, 2].max())


@pytest.mark.parametrize("push", [0.002, -0.003])
def test_a_push_is_found(scene: Scene, push: float) -> None:
    assert sideways_drift(pusher(push), scene, default_potential()) == pytest.approx(7 * abs(push), rel=1e-3)


def test_a_broken_model_drifts_without_end(scene: Scene) -> None:
    assert sideways_drift(pusher(float("nan")), scene, default_potential()) == float("inf")


def test_the_solver_stays(scene: Scene) -> None:
    potential = default_potential()
    assert sideways_drift(NewtonStepper(potential, NewtonSettings(target_rg=1e-2)), scene, potential) < 1e-3


def test_the_largest_drift_is_in_the_table() -> None:
    frames = [{"ms_total": 1.0, "strain_p99": 0.1, "relative_gradient": 1.0}]
    candidate = Candidate("newton", "none", NewtonStepper(default_potential(), NewtonSettings()))
    rows = candidate_rows(
        candidate, {"a": [MeasuredRollout(frames, drifts=[0.001])], "b": [MeasuredRollout(frames, drifts=[0.004])]}
    )
    assert {row["garment"]: row["drift"] for row in rows} == {"a": 0.001, "b": 0.004, ALL: 0.004}
