"""Pins that ride on the skin."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from workshop import Workshop

from hood.assets.body.body import Body, body_part
from hood.assets.garment.garment import Garment
from hood.assets.garment.pins import PinGroup
from hood.assets.motion.animated_mesh import load_mesh_sequence
from hood.assets.motion.mesh_sequence import MeshSequence
from hood.assets.motion.sequence import PoseSequence
from hood.scene.body_motion.mesh_motion import NoBody, mesh_motion
from hood.scene.body_motion.motion import body_motion
from hood.scene.following import SKIN_REACH, Held, held_by, ride_on, stiffness_of
from hood.scene.holding import Grasp, Holding
from hood.scene.scene import Scene, build_scene, dressed_scene
from hood.testing import grid, sphere


def group(vertices: np.ndarray, follows: str | tuple[int, ...] | None = "skin", weight: float = 1.0) -> PinGroup:
    return PinGroup(vertices, np.full(len(vertices), weight), follows)


def holding(scene: Scene, *groups: PinGroup) -> Scene:
    """The scene with what ``groups`` hold exactly pinned."""
    pinned = torch.zeros(scene.cloth.num_vertices, dtype=torch.bool)
    for one in groups:
        pinned[torch.as_tensor(one.vertices[one.exact])] = True
    held = held_by(groups, scene.motion, scene.garment)
    return replace(scene, cloth=replace(scene.cloth, pinned=pinned), held=held)


def test_beside_a_rigid_body_points_move_as_it_does() -> None:
    surface, faces = sphere(2, 0.3)
    points = 0.35 * surface[:7] / 0.3
    ride, dist = ride_on(points, np.arange(7), surface, faces)
    np.testing.assert_allclose(ride.places(surface), points, rtol=0, atol=1e-12)
    assert 0.0 < dist.min() <= dist.max() <= SKIN_REACH
    turn, shift = Rotation.from_rotvec([0.3, -1.2, 2.0]).as_matrix(), np.array([3.0, -1.0, 0.5])
    np.testing.assert_allclose(ride.places(surface @ turn.T + shift), points @ turn.T + shift, rtol=0, atol=1e-12)


def test_a_face_without_area_carries_nothing() -> None:
    surface, faces = sphere(1, 0.3)
    flat = np.concatenate([[[0, 0, 1]], faces])
    ride, _ = ride_on(surface[:1], np.arange(1), surface, flat)
    assert (ride.corners[0] != [0, 0, 1]).any()


def test_pins_keep_their_distance_from_their_points_of_a_moving_mesh(walk: PoseSequence, body: Body, garments: dict) -> None:
    """Stretched skin, too: the offset is kept in the triangle's frame, in metres."""
    skirt, motion = garments["skirt"], body_motion(body, walk, np.zeros(10))
    scene = dressed_scene(skirt, motion)
    rows = np.flatnonzero(skirt.pinned)
    scene = holding(scene, group(rows, "spine1"))
    ride = scene.held.ride
    allowed = motion.faces[body_part("spine1", motion.faces, motion.num_vertices, body)]
    assert {tuple(face) for face in ride.corners.tolist()} <= {tuple(face) for face in allowed.tolist()}
    first = None
    for frame in (0, 5, 14):
        origin = motion.translation[frame]
        surface = motion.surface(frame, origin).double().numpy()
        placed = scene.skinned(frame, origin)
        away = np.linalg.norm(placed[torch.as_tensor(ride.vertices)].double().numpy() - ride.skin(surface), axis=1)
        first = away if first is None else first
        np.testing.assert_allclose(away, first, rtol=0, atol=1e-6)
        others = np.setdiff1d(np.arange(len(placed)), rows)
        assert torch.equal(placed[others], motion.skinned(scene.garment, frame, origin)[others])
    state = scene.start()
    torch.testing.assert_close(state.pos[rows], motion.skinned(scene.garment, 0, state.origin[0].numpy())[rows])
    target = scene.step_input(4, state).pin_target
    torch.testing.assert_close(target, scene.skinned(5, state.origin[0].numpy()))


def test_bones_of_a_gltf_character(tmp_path: Path, garments: dict[str, Garment]) -> None:
    path = Workshop(tmp_path).body("gltf_skin")
    sequence = load_mesh_sequence(path)
    assert len(sequence.bones) == len(sequence.joints) == sequence.weights.shape[1]
    assert {"spine1", "left_wrist"} <= sequence.bones.keys()
    motion = mesh_motion(sequence)
    skirt = garments["skirt"]
    scene = dressed_scene(replace(skirt, lbs_weights=None, skin_pos=None), motion)
    rows = np.flatnonzero(skirt.pinned)
    ride = held_by([group(rows, "spine1")], motion, scene.garment).ride
    most = sequence.weights.argmax(axis=1) == sequence.joints.index("spine1")
    assert (most[ride.corners].sum(axis=1) >= 2).all()
    with pytest.raises(ValueError, match=r"unknown bone 'spin1': did you mean 'spine1'\? known are pelvis"):
        held_by([group(rows, "spin1")], motion, scene.garment)


def test_springs_and_their_stiffness(tank_scene: Scene) -> None:
    np.testing.assert_allclose(stiffness_of(np.array([0.0, 0.5, 0.9])), [0.0, 10.0, 90.0])
    low = np.array([3, 4])
    scene = holding(tank_scene, group(np.array([1, 2, 3]), "skin", 0.5), group(low, None))
    assert scene.held.stiffness.nonzero().squeeze(1).tolist() == [1, 2]  # the last group counts
    assert scene.held.ride.vertices.tolist() == [1, 2]
    step = scene.step_input(2, scene.start())
    assert torch.equal(step.pin_stiffness, scene.held.stiffness)
    assert step.pin_target is not None
    off = replace(scene, holding=Holding((Grasp(2, torch.arange(scene.cloth.num_vertices) == 1, False),)))
    assert off.step_input(1, scene.start()).pin_stiffness[:3].tolist() == [0.0, 10.0, 10.0]
    assert off.step_input(2, scene.start()).pin_stiffness[:3].tolist() == [0.0, 0.0, 10.0]


def test_plain_pins_are_as_ever(tank_scene: Scene) -> None:
    assert held_by([group(np.arange(3), None)], tank_scene.motion, tank_scene.garment) is None
    assert tank_scene.step_input(2, tank_scene.start()).pin_stiffness is None
    soft = holding(tank_scene, group(np.arange(3), None, 0.3))
    assert isinstance(soft.held, Held)
    assert soft.held.ride is None


def test_what_cannot_be_followed_is_told(tank_scene: Scene) -> None:
    motion, garment = tank_scene.motion, tank_scene.garment
    rows = np.arange(4)
    for follows, sentence in (
        ("left_foot", "from the nearest skin of what it is to follow \\(left_foot\\), beyond 0.3 m; let it follow"),
        ("spin1", "follows: part 'spin1': unknown joint 'spin1'"),
        ((1, 2, 10**6), "follows: vertex 1000000 of "),
        ((0,), "follows: no face of the body has two of its 1 vertices; name more"),
    ):
        with pytest.raises(ValueError, match=f"^pins: .*{sentence}"):
            held_by([group(rows, follows)], motion, garment)
    with pytest.raises(ValueError, match="^pins: follows=skin, but there is no body; leave follows out"):
        held_by([group(rows)], NoBody(3, 30.0), garment)


def test_a_rigid_mesh_carries_what_it_holds_exactly() -> None:
    """A sheet held by one edge above a ball that turns by a degree a frame, over 200 frames."""
    surface, faces = sphere(2, 0.3)
    turns = Rotation.from_rotvec(np.radians(np.arange(200))[:, None] * [0.0, 0.0, 1.0]).as_matrix()
    motion = mesh_motion(MeshSequence("ball", surface @ turns.transpose(0, 2, 1), faces, 30.0), dtype=torch.float64)
    pos, cloth_faces = grid(4, 3, 0.3)
    sheet = Garment("sheet", pos - pos.mean(axis=0) + [0.0, 0.32, 0.0], cloth_faces, np.arange(12) < 3)
    scene = holding(dressed_scene(sheet, motion), group(np.arange(3)))
    for frame in (0, 70, 199):
        found = scene.skinned(frame, np.zeros(3))[:3].numpy()
        np.testing.assert_allclose(found, sheet.rest_pos[:3] @ turns[frame].T, rtol=0, atol=1e-9)


def test_a_start_from_the_t_pose_has_the_same_points(garments: dict[str, Garment], body: Body, walk: PoseSequence) -> None:
    scene = holding(build_scene(garments["skirt"], body, walk.window(60, 72)), group(np.flatnonzero(garments["skirt"].pinned)))
    lead = scene.lead_in(0)
    rows = torch.as_tensor(scene.held.ride.vertices)
    origin, last = scene.motion.translation[0], lead.num_frames - 1
    torch.testing.assert_close(lead.skinned(last, origin)[rows], scene.skinned(0, origin)[rows], rtol=0, atol=1e-5)
