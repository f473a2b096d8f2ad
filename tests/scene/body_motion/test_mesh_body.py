"""Rollouts on bodies without a skeleton: as on the parametric one, and without any."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from hood.assets.body.body import Body
from hood.assets.files.library import locate
from hood.assets.garment.garment import Garment
from hood.assets.motion.animated_mesh import load_mesh_sequence
from hood.assets.motion.sequence import PoseSequence
from hood.energies.potential import default_potential
from hood.rollouts.loop import simulate
from hood.scene.body_motion.mesh_motion import NoBody, mesh_motion
from hood.scene.scene import build_scene, dressed_scene
from hood.solver.newton import NewtonSettings
from hood.steppers.checkpoint import load_simulator
from hood.steppers.newton import NewtonStepper, Stepper


def make_stepper(kind: str) -> Stepper:
    if kind == "network":
        return load_simulator(locate("weights", "quickstart")).eval()
    return NewtonStepper(default_potential(), NewtonSettings(target_rg=5e-2))


def largest_gap(kind: str, count: int, garment: Garment, body: Body, walk: PoseSequence, folder: Path) -> float:
    """Largest distance [m] between a rollout on the parametric body and one on its vertices, written to a file."""
    walk = walk.window(60, 60 + count)
    surface = body.surface(walk, np.zeros(10), torch.float64).numpy()
    np.savez(folder / "walk.npz", verts=surface + body.translation(walk, np.zeros(10))[:, None], faces=body.faces, fps=30.0)
    parametric = build_scene(garment, body, walk)
    start = parametric.start(0)
    pos, vel = start.pos.double().numpy() + start.origin.numpy(), start.vel.double().numpy()
    worn = replace(parametric.garment, lbs_weights=None, skin_pos=pos)
    on_mesh = dressed_scene(worn, mesh_motion(load_mesh_sequence(folder / "walk.npz")))
    rollouts = []
    for scene in (parametric, on_mesh):
        given = replace(scene, start_pos=pos, start_vel=vel)
        rollouts.append([frame.world_pos for frame in simulate(make_stepper(kind), given, default_potential(), count, 0)])
    moved = float((rollouts[0][-1] - rollouts[0][0]).norm(dim=1).max())
    assert moved > 2e-3 * count  # it is a motion
    return max(float((a - b).norm(dim=1).max()) for a, b in zip(*rollouts, strict=True))


@pytest.mark.parametrize("kind, count", [("network", 5), ("newton", 2)])
def test_vertices_from_a_file_are_the_body(
    kind: str, count: int, body: Body, walk: PoseSequence, garments: dict[str, Garment], tmp_path: Path
) -> None:
    assert largest_gap(kind, count, garments["tank"], body, walk, tmp_path) < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["network", "newton"])
def test_fifty_frames_on_vertices_from_a_file(
    kind: str, body: Body, walk: PoseSequence, garments: dict[str, Garment], tmp_path: Path
) -> None:
    assert largest_gap(kind, 50, garments["dress"], body, walk, tmp_path) < 1e-4


@pytest.mark.parametrize("kind", ["network", "newton"])
def test_without_a_body_pins_hold_and_the_rest_falls(kind: str, garments: dict[str, Garment]) -> None:
    skirt = garments["skirt"]
    for pinned in (skirt.pinned, np.zeros_like(skirt.pinned)):
        scene = dressed_scene(replace(skirt, pinned=pinned), NoBody(4, 30.0))
        frames = list(simulate(make_stepper(kind), scene, default_potential(), 4, 0))
        assert len(frames) == 4
        assert frames[0].body_pos.shape == (0, 3)
        fall = (frames[0].world_pos - frames[-1].world_pos)[:, 1].numpy()
        assert all(bool(frame.world_pos.isfinite().all()) for frame in frames)
        assert frames[-1].metrics["penetration_count"] == 0
        if pinned.any():
            np.testing.assert_allclose(frames[-1].world_pos[torch.as_tensor(pinned)], skirt.rest_pos[pinned], atol=1e-6)
        elif kind == "newton":
            # Three steps of free fall, implicit Euler: g dt² (1 + 2 + 3).
            np.testing.assert_allclose(fall, 9.81 / 900 * 6, atol=2e-3)
