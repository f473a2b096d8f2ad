"""Validation rollouts: their gap, and which weights count as better."""

from __future__ import annotations

from dataclasses import replace

import pytest

from hood.energies.potential import default_potential
from hood.evaluation.gap import REFERENCE
from hood.evaluation.validation import Rollout, Validation, score, summarise_validation
from hood.rollouts.loop import simulate
from hood.scene.scene import Scene
from hood.steppers.network import NetworkStepper, build_simulator


@pytest.fixture(scope="module")
def idle() -> NetworkStepper:
    """A model whose cloth moves with the body and does nothing else."""
    return build_simulator("physical", "velocity_base", "1x(mesh)", latent_dim=4, output_init=0.0).eval()


def test_gap_and_frames_are_those_of_the_rollout(idle: NetworkStepper, band_scene: Scene) -> None:
    potential = default_potential()
    reference = replace(REFERENCE, max_iterations=60)
    motion = band_scene.motion
    validation = Validation(motion.body, [band_scene.garment], [motion.sequence], potential, 6, 2, reference)
    seen = []
    rollout = validation.rollout(idle, 0, lambda scene, frame: seen.append(frame))
    frames = list(simulate(idle, band_scene, potential, 6))
    assert [frame.index for frame in seen] == [frame.index for frame in frames]
    assert all(bool((a.world_pos == b.world_pos).all()) for a, b in zip(seen, frames, strict=True))
    strains = sorted(frame.metrics["strain_p99"] for frame in frames[1:])
    assert rollout.metrics["strain_p99"] == pytest.approx(strains[2])
    assert rollout.finite
    assert len(rollout.gaps) == 2
    assert min(rollout.gaps) > 1e-3  # without gravity and inertia no step is a minimum
    values = validation(idle)
    assert values["gap"] == pytest.approx(sum(rollout.gaps) / 2)
    assert values["score"] == pytest.approx(values["gap"] * values["strain_p99"])


def figures(strain: float, share: float) -> dict[str, float]:
    surface = {"cut_face_share": share, "cut_face_share_worst": 3 * share, "self_crossings": 100 * share}
    return {"strain_p99": strain, "penetration_share": share, "relative_gradient": 1.0, **surface}


def result(gap: float, strain: float, finite: bool = True) -> dict[str, float]:
    return summarise_validation([Rollout("band", figures(strain, 0.0), (gap,), finite)])


def test_better_in_either_is_better_and_broken_is_worst() -> None:
    best = result(0.5, 0.1)["score"]
    assert best < result(0.6, 0.1)["score"]
    assert best < result(0.5, 0.12)["score"]
    assert result(0.25, 0.2)["score"] == pytest.approx(best)
    assert result(1e-6, 1e-6, finite=False)["score"] == float("inf")
    assert score({"gap": float("nan"), "strain_p99": 0.1, "non_finite": 0.0}) == float("inf")


def test_several_garments_are_summed_up() -> None:
    rows = [
        Rollout(f"g{i}", figures(s, p), (g, 3 * g), True)
        for i, (s, p, g) in enumerate([(0.1, 0.0, 1.0), (0.3, 0.06, 2.0), (0.2, 0.0, 10.0)])
    ]
    values = summarise_validation(rows)
    assert (values["strain_p99"], values["strain_p99_worst"], values["penetration_share"]) == pytest.approx((0.2, 0.3, 0.02))
    surface = [values[key] for key in ("cut_face_share", "cut_face_share_worst", "self_crossings")]
    assert surface == pytest.approx([0.02, 0.18, 2.0])
    assert values["gap"] == pytest.approx(4.5)  # of 1, 2, 3, 6, 10, 30
    assert values["gap_p95"] == pytest.approx(25.0)
