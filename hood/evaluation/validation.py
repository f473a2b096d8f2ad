"""Own-rollout validation: the states a model reaches itself, on motions it was not trained on.

Sideways drift: what a model does to a garment on a body that stands still and prefers no side.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.assets.material import Material
from hood.assets.motion.sequence import PoseSequence
from hood.assets.motion.sequence_edit import A_POSE_ANGLE, arms_down
from hood.energies.potential import Potential
from hood.evaluation.gap import REFERENCE, StepSample, gap
from hood.rollouts.frame import Frame
from hood.rollouts.loop import simulate
from hood.scene.scene import Scene, build_scene
from hood.solver.newton import NewtonSettings
from hood.steppers.network import NetworkStepper

if TYPE_CHECKING:
    from hood.steppers.newton import Stepper


def standing_scene(
    garment: Garment,
    body: Body,
    num_frames: int,
    material: Material | None = None,
    fps: float = 30.0,
    device: torch.device | str = "cpu",
) -> Scene:
    """The garment on a body of mean shape that stands still with its arms half down, the same to the left and to the right."""
    still = arms_down(A_POSE_ANGLE)
    poses, transl = np.repeat(still.poses, num_frames, axis=0), np.repeat(still.transl, num_frames, axis=0)
    standing = replace(still, name="standing", poses=poses, transl=transl, fps=fps)
    return build_scene(garment, body, standing, material, device=device)


def sideways_drift(stepper: Stepper, scene: Scene, potential: Potential) -> float:
    """How far [m] the garment's centre goes to either side of where it starts, over all frames of the scene.

    Infinite when a frame is not finite. The body of :func:`standing_scene` faces along z, so that x is sideways.
    """
    start, largest = None, 0.0
    for frame in simulate(stepper, scene, potential, metrics="none"):
        centre = float(frame.world_pos[:, 0].mean())
        start = centre if start is None else start
        away = abs(centre - start)
        if not np.isfinite(away):
            return float("inf")
        largest = max(largest, away)
    return largest


_MEANS: dict[str, Callable[..., float]] = {
    "strain_p99": np.median,
    "penetration_share": np.mean,
    "cut_face_share": np.mean,
    "self_crossings": np.mean,
    "relative_gradient": np.median,
}


@dataclass(frozen=True)
class Rollout:
    """What one validation rollout gave."""

    garment: str
    metrics: dict[str, float]  # over its finite frames; NaN where there is none
    gaps: tuple[float, ...]  # γ of the states looked at
    finite: bool


@dataclass(frozen=True)
class Validation:
    """Short rollouts of every garment on one motion each (motions go round), default fabric, mean shape.

    Args:
        states: steps of every rollout whose gap γ is computed; 0 for none.
        reference: how far the minimisations behind a gap go.
        device: where the model runs.
    """

    body: Body
    garments: Sequence[Garment]
    motions: Sequence[PoseSequence]
    potential: Potential
    num_frames: int = 60
    states: int = 2
    reference: NewtonSettings = replace(REFERENCE, max_iterations=100)
    device: str = "cpu"

    def __call__(self, simulator: NetworkStepper) -> dict[str, float]:
        """Figures over all rollouts, see :func:`summarise_validation`."""
        return summarise_validation([self.rollout(simulator, index) for index in range(len(self.garments))])

    def rollout(self, simulator: NetworkStepper, index: int, see: Callable[[Scene, Frame], None] | None = None) -> Rollout:
        """The rollout of garment ``index``; ``see`` is shown every frame."""
        motion = self.motions[index % len(self.motions)]
        scene = build_scene(self.garments[index], self.body, motion, device=self.device)
        count = min(self.num_frames, scene.num_frames)
        sample = StepSample(range(1, count), self.states)
        rows = []
        for frame in simulate(simulator, scene, self.potential, count, observe=sample if self.states else None):
            rows.append(frame.metrics)
            if see is not None:
                see(scene, frame)
        table = {key: np.array([row.get(key, np.nan) for row in rows[1:]]) for key in _MEANS}
        finite = bool(np.isfinite(table["strain_p99"]).all())
        gaps = [gap(self.potential, problem, step.next_pos, settings=self.reference) for problem, step in sample.steps]
        metrics = {key: _reduce(_MEANS[key], values) for key, values in table.items()}
        metrics["cut_face_share_worst"] = _reduce(np.max, table["cut_face_share"])
        return Rollout(self.garments[index].name, metrics, tuple(float(item.gamma) for item in gaps), finite)


def summarise_validation(rollouts: Sequence[Rollout]) -> dict[str, float]:
    """Medians over garments of p99 strain and rg, mean shares of vertices inside the body and of triangles
    cut by it, the worst such frame, crossing pairs of triangles, worst strain, number of non-finite rollouts, gap γ
    (median and 95th percentile over all states) and ``score``."""
    strain = [item.metrics["strain_p99"] for item in rollouts]
    gaps = np.array([value for item in rollouts for value in item.gaps])
    values = {
        "strain_p99": _reduce(np.median, strain),
        "strain_p99_worst": _reduce(np.max, strain),
        "penetration_share": _reduce(np.mean, [item.metrics["penetration_share"] for item in rollouts]),
        "cut_face_share": _reduce(np.mean, [item.metrics["cut_face_share"] for item in rollouts]),
        "cut_face_share_worst": _reduce(np.max, [item.metrics["cut_face_share_worst"] for item in rollouts]),
        "self_crossings": _reduce(np.mean, [item.metrics["self_crossings"] for item in rollouts]),
        "relative_gradient": _reduce(np.median, [item.metrics["relative_gradient"] for item in rollouts]),
        "non_finite": float(sum(not item.finite for item in rollouts)),
    }
    if len(gaps):
        values |= {"gap": float(np.median(gaps)), "gap_p95": float(np.quantile(gaps, 0.95))}
    return values | {"score": score(values)}


def score(values: dict[str, float]) -> float:
    """What picks the best weights, less is better: γ times p99 strain of own rollouts; infinite when one is not finite.

    The product weighs a relative improvement of either the same: a rollout that comes to rest stretched out of shape has a
    small gap, one that hangs in the air little strain. Without γ, rg² stands in for it.
    """
    accuracy = values["gap"] if "gap" in values else values["relative_gradient"] ** 2
    product = max(accuracy, 0.0) * values["strain_p99"]
    return product if values["non_finite"] == 0 and math.isfinite(product) else math.inf


def _reduce(function: Callable[..., float], values: Sequence[float] | np.ndarray) -> float:
    known = np.asarray(values, dtype=np.float64)
    known = known[np.isfinite(known)]
    return float(function(known)) if len(known) else math.nan
