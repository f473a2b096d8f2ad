"""Bodies that jump take the cloth along."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from hood.assets.body.body import Body
from hood.assets.files.library import names
from hood.assets.garment.garment import Garment
from hood.assets.motion.load import load_sequence
from hood.assets.motion.mesh_sequence import MeshSequence
from hood.assets.motion.sequence import PoseSequence
from hood.energies.potential import default_potential
from hood.rollouts.loop import simulate
from hood.scene.body_motion.mesh_motion import mesh_motion
from hood.scene.body_motion.motion import Motion, body_motion
from hood.scene.jumps import Jump, carried, describe_jumps, find_jumps
from hood.scene.scene import Scene, build_scene
from hood.solver.newton import NewtonSettings
from hood.steppers.newton import NewtonStepper
from hood.studies.envelope.extreme_files import write_motion


def jumping(walk: PoseSequence, shift: tuple[float, float, float], turn: float = 0.0, frame: int = 4) -> PoseSequence:
    """The walk, cut after a frame: from there it goes on elsewhere and looks another way."""
    poses, transl = walk.poses[:10].copy(), walk.transl[:10].copy()
    about = Rotation.from_rotvec([0.0, turn, 0.0])
    transl[frame + 1 :] = about.apply(transl[frame + 1 :] - transl[frame + 1]) + transl[frame + 1] + shift
    poses[frame + 1 :, 0] = (about * Rotation.from_rotvec(poses[frame + 1 :, 0])).as_rotvec()
    return replace(walk, poses=poses, transl=transl)


def test_no_motion_of_the_package_jumps_at_any_speed(body: Body) -> None:
    for name in names("motions"):
        for fps, file_fps in ((30.0, None), (120.0, None), (5.0, None), (30.0, 480.0)):
            motion = body_motion(body, load_sequence(name, fps, file_fps=file_fps), np.zeros(10))
            assert find_jumps(motion, fps) == {}, (name, fps, file_fps)


@pytest.mark.parametrize("fps", [15.0, 30.0, 60.0, 240.0])
def test_a_jump_is_found_at_every_frame_rate(body: Body, tmp_path: Path, fps: float) -> None:
    write_motion(tmp_path / "m.npz", "teleport:0.7", 1.0)
    found = find_jumps(body_motion(body, load_sequence(tmp_path / "m.npz", fps), np.zeros(10)), fps)
    assert sum(jump.metres for jump in found.values()) == pytest.approx(0.7)
    assert sum(jump.degrees for jump in found.values()) == pytest.approx(0.0, abs=1e-6)
    assert all(abs(frame / fps - 0.5) <= 1.5 / min(fps, 60.0) for frame in found)


@pytest.mark.parametrize("fps", [15.0, 30.0, 60.0])
@pytest.mark.parametrize("mesh", [False, True])
def test_a_cut_that_only_turns_the_body_is_found(body: Body, walk: PoseSequence, fps: float, mesh: bool) -> None:
    cut = replace(jumping(walk, (0.0, 0.0, 0.0), turn=1.5), fps=fps)
    motion: Motion = body_motion(body, cut, np.zeros(10))
    if mesh:
        verts = np.stack([motion.surface(frame, np.zeros(3)).numpy() for frame in range(cut.num_frames)])
        motion = mesh_motion(MeshSequence("scan", verts, motion.faces, fps))
    found = find_jumps(motion, fps)
    assert list(found) == [4]
    assert found[4].metres < 0.1
    assert found[4].degrees == pytest.approx(np.degrees(1.5), abs=8.0)
    text = describe_jumps(motion, found)
    assert "turns by up to 8" in text or "turns by up to 9" in text
    assert "jumps" not in text
    assert "after frame 4, as at a cut" in text


@pytest.mark.parametrize("name", ["spin:4", "stop:10", "offset:10000", "rest"])
def test_what_is_fast_and_goes_on_is_no_jump(body: Body, tmp_path: Path, name: str) -> None:
    write_motion(tmp_path / "m.npz", name, 2.0)
    for fps in (10.0, 30.0, 120.0):
        assert find_jumps(body_motion(body, load_sequence(tmp_path / "m.npz", fps), np.zeros(10)), fps) == {}


def test_cloth_and_body_go_as_one(garments: dict[str, Garment], body: Body, walk: PoseSequence) -> None:
    scene = build_scene(garments["tank"], body, jumping(walk, (0.4, 0.0, 3.0), turn=2.0), dtype=torch.float64)
    state = scene.start(4)
    moved, step = carried(scene, 4, state)
    plain = scene.step_input(4, state)
    assert step.obstacle is not None
    assert plain.obstacle is not None
    for one, other in ((state.pos, moved.pos), (plain.obstacle.pos, step.obstacle.pos)):
        torch.testing.assert_close(torch.cdist(one[:50], one[-50:]), torch.cdist(other[:50], other[-50:]))
    near = torch.cdist(state.pos[:50], plain.obstacle.pos[::20])
    torch.testing.assert_close(torch.cdist(moved.pos[:50], step.obstacle.pos[::20]), near)
    # What is left are the limbs: a frame of walking, no more.
    left = (step.obstacle.next_pos - step.obstacle.pos).norm(dim=1)
    assert float((plain.obstacle.next_pos - plain.obstacle.pos).norm(dim=1).min()) > 2.0
    assert float(left.median()) < 0.02
    torch.testing.assert_close(moved.vel.norm(dim=1), state.vel.norm(dim=1))
    assert float(moved.pos.norm(dim=1).max()) < 2.0  # the local frame has come along


@pytest.mark.parametrize(("shift", "turn"), [((0.5, 0.0, 0.0), 0.0), ((1000.0, 0.0, -700.0), 0.0), ((0.0, 0.0, 0.0), 2.0)])
def test_a_rollout_over_a_cut(
    garments: dict[str, Garment], body: Body, walk: PoseSequence, shift: tuple[float, float, float], turn: float
) -> None:
    plain, cut = (
        rollout(build_scene(garments["tank"], body, motion, dtype=torch.float64), warns)
        for motion, warns in ((walk.window(0, 10), False), (jumping(walk, shift, turn), True))
    )
    strain = [max(metrics["strain_p99"] for metrics in found) for found in (plain, cut)]
    assert strain[1] < 1.2 * strain[0]
    assert max(metrics["penetration_depth"] for metrics in cut) < 5e-3


def rollout(scene: Scene, warns: bool) -> list[dict[str, float]]:
    potential = default_potential()
    frames = simulate(NewtonStepper(potential, NewtonSettings(target_rg=1e-2)), scene, potential, 10)
    if not warns:
        return [dict(frame.metrics) for frame in frames]
    how = "(jumps by up to .*|turns by up to .* at once) after frame 4, as at a cut: the cloth is carried along there"
    with pytest.warns(UserWarning, match=how):
        return [dict(frame.metrics) for frame in frames]


def test_many_jumps_are_named_in_short(body: Body, walk: PoseSequence) -> None:
    motion = body_motion(body, walk, np.zeros(10))
    text = describe_jumps(motion, dict.fromkeys(range(10, 70, 10), Jump(0.3, 120.0)))
    assert "jumps by up to 0.3 m and turns by up to 120° at once" in text
    assert "after frames 10, 20, 30, 40 and 2 more" in text
