"""Rollouts of cloth with warp and weft: by the solver, and by a refined network."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from hood.assets.body.body import Body
from hood.assets.files.library import locate
from hood.assets.garment.garment import Garment
from hood.assets.material import Material
from hood.assets.motion.sequence import PoseSequence
from hood.energies.potential import default_potential
from hood.rollouts.loop import simulate
from hood.scene.scene import build_scene
from hood.solver.newton import NewtonSettings
from hood.steppers.checkpoint import load_simulator
from hood.steppers.newton import NewtonStepper, Stepper
from hood.steppers.refined import RefinedStepper
from hood.steppers.stopping import Count

WOVEN = Material(warp=30.0, weft=20.0)


@pytest.fixture(scope="module")
def stretched(garments: dict[str, Garment], body: Body, walk: PoseSequence) -> Any:
    """Positions (T, V, 3) and median stretch of a rollout of the tank."""

    def run(stepper: Stepper, material: Material) -> tuple[np.ndarray, float]:
        scene = build_scene(garments["tank"], body, walk.window(10, 16), material)
        frames = list(simulate(stepper, scene, default_potential()))
        return np.stack([frame.world_pos for frame in frames]), float(
            np.median([frame.metrics["strain_p99"] for frame in frames])
        )

    return run


def test_the_solver_stretches_woven_cloth_less(stretched: Any) -> None:
    stepper = NewtonStepper(default_potential(), NewtonSettings())
    pos, strain = stretched(stepper, WOVEN)
    _, isotropic = stretched(stepper, Material())
    assert np.isfinite(pos).all()
    assert strain < 0.5 * isotropic


def test_refinement_moves_a_network_towards_woven_cloth(stretched: Any) -> None:
    simulator, potential = load_simulator(locate("weights", "quickstart")), default_potential()
    exact, _ = stretched(NewtonStepper(potential, NewtonSettings()), WOVEN)
    refined, strain = stretched(RefinedStepper(simulator, potential, Count(10)), WOVEN)
    _, isotropic = stretched(RefinedStepper(simulator, potential, Count(10)), Material())
    assert strain < 0.7 * isotropic
    assert np.linalg.norm(refined[-1] - exact[-1], axis=1).mean() < 5e-3
