"""What refinement does to whole rollouts of the embedded weights."""

from __future__ import annotations

import numpy as np
import pytest

from hood.assets.body.body import Body
from hood.assets.files.library import locate
from hood.assets.garment.garment import Garment
from hood.assets.motion.sequence import PoseSequence
from hood.energies.potential import default_potential
from hood.rollouts.loop import simulate
from hood.scene.scene import build_scene
from hood.steppers.checkpoint import load_simulator
from hood.steppers.newton import Stepper
from hood.steppers.refined import RefinedStepper
from hood.steppers.stopping import Count


@pytest.mark.slow
@pytest.mark.parametrize("count", [5, 10])
def test_refined_rollouts_are_less_strained_and_penetrate_no_more(
    count: int, garments: dict[str, Garment], body: Body, walk: PoseSequence
) -> None:
    """A second in the middle of a walk; before the cloth swings, the network's own strain is low as well."""
    scene, potential = build_scene(garments["tshirt"], body, walk.window(0, 50)), default_potential()
    simulator = load_simulator(locate("weights", "quickstart"))

    def medians(stepper: Stepper) -> dict[str, float]:
        frames = list(simulate(stepper, scene, potential))[20:]
        names = ("strain_p99", "penetration_share", "penetration_depth", "relative_gradient")
        return {name: float(np.median([frame.metrics[name] for frame in frames])) for name in names}

    plain, refined = medians(simulator), medians(RefinedStepper(simulator, potential, Count(count)))
    assert refined["strain_p99"] < plain["strain_p99"]
    assert refined["penetration_share"] <= plain["penetration_share"]
    assert refined["penetration_depth"] <= plain["penetration_depth"] + 1e-4
    assert refined["relative_gradient"] < 0.2 * plain["relative_gradient"]
