"""Moving meshes and no body at all: what cloth collides with, what pins and first velocities follow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.assets.motion.mesh_sequence import MeshSequence
from hood.assets.motion.sequence import PoseSequence
from hood.assets.motion.sequence_edit import arms_down
from hood.scene.body_motion.mesh_motion import NoBody, mesh_motion
from hood.scene.body_motion.motion import body_motion
from hood.scene.scene import Scene, dressed_scene
from hood.scene.start import free_stretch
from hood.testing import cylinder, grid, sphere

POINTS, FACES = sphere(3, 0.5)
TUBE = Garment("tube", cylinder(16, 6, 0.53, 0.4)[0] - [0, 0.2, 0], cylinder(16, 6, 0.53, 0.4)[1], np.arange(96) < 16)


def turning(num_frames: int = 6, speed: float = 0.2) -> tuple[MeshSequence, list[Rotation], np.ndarray]:
    """A ball that turns about a slanted axis and flies."""
    turns = [Rotation.from_rotvec(speed * frame * np.array([0.3, 0.9, 0.2])) for frame in range(num_frames)]
    path = np.outer(np.arange(num_frames), [0.02, 0.05, -0.01])
    verts = np.stack([turn.apply(POINTS) + shift for turn, shift in zip(turns, path, strict=True)])
    return MeshSequence("ball", verts, FACES, 30.0), turns, path


def exported(body: Body, walk: PoseSequence, betas: np.ndarray) -> MeshSequence:
    """The parametric body as moving vertices, with its joints."""
    translation = body.translation(walk, betas)
    verts = body.surface(walk, betas, torch.float64).numpy() + translation[:, None]
    bones = body.transforms(walk, betas, torch.float64).numpy()
    bones[..., 3] += translation[:, None]
    return MeshSequence("exported", verts, body.faces, walk.fps, bones)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_same_obstacle_as_the_parametric_body(dtype: torch.dtype, body: Body, walk: PoseSequence) -> None:
    """Rounded once from float64 each: equal to the last bit in single precision."""
    part, betas = walk.window(60, 66), np.linspace(-1, 1, 10)
    motion = body_motion(body, part, betas, dtype)
    mesh = mesh_motion(exported(body, part, betas), dtype=dtype)
    assert (mesh.num_frames, mesh.fps, mesh.num_vertices) == (motion.num_frames, motion.fps, motion.num_vertices)
    origin = np.array([0.5, 1.0, -0.5])
    for frame, static in ((0, False), (2, False), (2, True)):
        first, second = motion.obstacle(frame, origin, static), mesh.obstacle(frame, origin, static)
        for name in ("pos", "next_pos", "prev_pos"):
            gap = float((getattr(first, name) - getattr(second, name)).abs().max())
            assert gap <= (0 if dtype == torch.float32 else 1e-12), name
        assert torch.equal(first.faces, second.faces)
    frames = np.array([4, 0])
    np.testing.assert_allclose(motion.some_points(frames, 50), mesh.some_points(frames, 50), rtol=0, atol=1e-12)
    assert NoBody(6, 30.0, dtype, torch.device("cpu")).some_points(frames, 50).shape == (2, 0, 3)


def test_garments_turn_with_what_is_next_to_them() -> None:
    sequence, turns, path = turning()
    motion = mesh_motion(sequence, dtype=torch.float64)
    for frame in range(6):
        expected = turns[frame].apply(TUBE.rest_pos) + path[frame]
        np.testing.assert_allclose(motion.skinned(TUBE, frame, np.zeros(3)), expected, rtol=0, atol=1e-9)
    scene = dressed_scene(TUBE, motion)
    velocity = (turns[1].apply(TUBE.rest_pos) + path[1] - TUBE.rest_pos) * 30
    np.testing.assert_allclose(scene.start_velocity(0), velocity, atol=1e-7)
    # Pins reach where the body carries them.
    state = scene.start(0)
    target = scene.step_input(0, state).pin_target.numpy() + state.origin.numpy()
    np.testing.assert_allclose(target[:16], (turns[1].apply(TUBE.rest_pos) + path[1])[:16], atol=1e-9)


def test_the_garment_starts_where_it_was_given() -> None:
    """A garment that fits starts as it is; ``skin_pos`` says where where the rest shape does not."""
    motion = mesh_motion(turning()[0])
    state = dressed_scene(TUBE, motion).start(0)
    np.testing.assert_allclose(state.pos.double().numpy() + state.origin.numpy(), TUBE.rest_pos, atol=1e-6)
    elsewhere = replace(TUBE, rest_pos=TUBE.rest_pos @ Rotation.from_euler("x", 1).as_matrix() + 3, skin_pos=TUBE.rest_pos)
    np.testing.assert_array_equal(elsewhere.worn_pos, TUBE.rest_pos)
    scene = dressed_scene(elsewhere, motion)
    np.testing.assert_allclose(scene.cloth.rest_pos, elsewhere.rest_pos, atol=1e-6)
    pos = scene.start(0).pos.double().numpy() + scene.start(0).origin.numpy()
    np.testing.assert_allclose(pos, TUBE.rest_pos, atol=1e-6)


def test_vertices_inside_the_body_start_outside() -> None:
    motion = mesh_motion(turning()[0])
    tight = replace(TUBE, rest_pos=TUBE.rest_pos * [0.935, 1, 0.935])  # 4 mm inside at the equator
    scene = dressed_scene(tight, motion)
    state = scene.start(0)
    world = state.pos.double().numpy() + state.origin.numpy()
    free = ~TUBE.pinned
    assert np.linalg.norm(tight.rest_pos[free], axis=1).min() < 0.4975
    assert np.linalg.norm(world[free], axis=1).min() > 0.4985


def test_garments_elsewhere_are_refused(garments: dict[str, Garment], body: Body, walk: PoseSequence) -> None:
    motion = mesh_motion(exported(body, walk.window(60, 63), np.zeros(10)))
    with pytest.raises(ValueError, match="'skirt': not worn by 'exported' in its first frame.*weights"):
        dressed_scene(garments["skirt"], motion)
    with pytest.raises(ValueError, match="'skirt': not worn by 'exported' in its first frame"):
        dressed_scene(replace(garments["skirt"], lbs_weights=None, bound_to=None), motion)
    # A sheet may well fall on the body from afar.
    sheet, faces = grid(5, 5, 0.4)
    with pytest.warns(UserWarning, match="'sheet': half of it is over"):
        dressed_scene(Garment("sheet", sheet + [0.0, 3.0, 0.0], faces, np.zeros(25, dtype=bool)), motion)
    inside = replace(TUBE, rest_pos=TUBE.rest_pos * 0.8)
    with pytest.raises(ValueError, match=r"'tube': not worn by 'ball'.*% of the vertices are deeper than 2 cm"):
        dressed_scene(inside, mesh_motion(turning()[0]))


def in_t_pose(garment: Garment) -> Garment:
    """The garment modelled where it is worn in the T-pose, bound to nothing."""
    pos = garment.tpose(np.zeros(10))
    return Garment(garment.name, pos, garment.faces, garment.pinned)


def test_a_garment_that_a_limb_passes_through_is_refused(garments: dict[str, Garment], body: Body) -> None:
    """A shirt as it is worn in the T-pose, near the skin of a body in A-pose but for the sleeves."""
    shirt = in_t_pose(garments["tshirt"])
    verts = [body.surface(arms_down(angle), np.zeros(10), torch.float64).numpy() for angle in (0.0, 45.0)]
    right, wrong = (dressed_scene(shirt, mesh_motion(MeshSequence("still", v, body.faces, 30.0))) for v in verts)
    assert float(free_stretch(right.cloth, right.start(0, thorough=True).pos).max()) < 0.01
    with pytest.raises(ValueError, match="'tshirt': passes through 'still' in frame 0 .*hood prepare"):
        wrong.start(0, thorough=True)
    assert wrong.start(0).pos.isfinite().all()  # training measures its starts itself


def test_weights_for_the_meshs_joints(garments: dict[str, Garment], body: Body, walk: PoseSequence) -> None:
    """A bound garment on the exported body follows its joints as it follows the parametric one."""
    part = walk.window(60, 64)
    mesh = mesh_motion(exported(body, part, np.zeros(10)), dtype=torch.float64)
    motion = body_motion(body, part, np.zeros(10), torch.float64)
    skirt = replace(garments["skirt"], bound_to=None)
    for frame in (0, 3):
        first, second = (m.skinned(skirt, frame, np.zeros(3)) for m in (mesh, motion))
        np.testing.assert_allclose(first, second, rtol=0, atol=1e-9)
    assert dressed_scene(skirt, mesh).start(0).pos.isfinite().all()
    with pytest.raises(ValueError, match="weights for 20 joints, 'exported' has 24"):
        dressed_scene(replace(skirt, lbs_weights=skirt.lbs_weights[:, :20]), mesh)
    # Weights that belong to another body do not count.
    with pytest.raises(ValueError, match="not worn"):
        dressed_scene(replace(skirt, bound_to="default"), mesh)


def test_garments_around_the_rest_pose_of_a_skinned_mesh(garments: dict[str, Garment], body: Body, walk: PoseSequence) -> None:
    """They are bound to its skin, as to a parametric body; garments worn in the first frame stay as they are."""
    part = walk.window(60, 64)
    skinned = replace(exported(body, part, np.zeros(10)), rest=body.v_template, weights=body.weights)
    mesh = mesh_motion(skinned, dtype=torch.float64)
    motion = body_motion(body, part, np.zeros(10), torch.float64)
    shirt = in_t_pose(garments["longsleeve"])
    bound, expected = mesh.dressed(shirt), motion.dressed(shirt)
    assert bound.bound_to == "exported"
    for frame in (0, 3):
        first, second = mesh.skinned(bound, frame, np.zeros(3)), motion.skinned(expected, frame, np.zeros(3))
        np.testing.assert_allclose(first, second, rtol=0, atol=1e-9)
    assert mesh.dressed(bound) is bound
    worn = replace(shirt, rest_pos=motion.skinned(expected, 0, np.zeros(3)).numpy())
    assert mesh.dressed(worn) is worn
    np.testing.assert_allclose(mesh.skinned(worn, 0, np.zeros(3)), worn.rest_pos, atol=1e-9)
    with pytest.raises(ValueError, match="around the mesh's rest pose"):
        mesh.dressed(replace(garments["longsleeve"], skin_pos=shirt.rest_pos + 2))


def test_far_from_the_origin_nothing_is_lost() -> None:
    sequence = turning()[0]
    far = np.array([1e4, 0.0, -1e4])
    near_motion, far_motion = mesh_motion(sequence), mesh_motion(replace(sequence, verts=sequence.verts + far))
    for frame in (0, 3):
        first, second = near_motion.surface(frame, np.zeros(3)), far_motion.surface(frame, far)
        assert float((first - second).abs().max()) < 1e-6
    np.testing.assert_allclose(far_motion.translation - near_motion.translation, np.tile(far, (6, 1)), atol=1e-9)


def test_a_still_mesh_is_held() -> None:
    motion = mesh_motion(MeshSequence("rock", POINTS[None], FACES, 60.0), 40)
    assert motion.num_frames == 40
    obstacle = motion.obstacle(38, np.zeros(3))
    assert torch.equal(obstacle.pos, obstacle.next_pos)
    assert torch.equal(obstacle.pos, obstacle.prev_pos)
    scene = dressed_scene(TUBE, motion)
    assert scene.dt == pytest.approx(1 / 60)
    assert not bool(scene.start_velocity(0).abs().max() > 1e-9)


def test_a_given_start_is_taken_as_it_is(tank_scene: Scene) -> None:
    rng = np.random.default_rng(0)
    pos = tank_scene.start(0).pos.double().numpy() + tank_scene.start(0).origin.numpy() + [7.0, 0, -3]
    vel = rng.normal(size=pos.shape)
    given = replace(tank_scene, start_pos=pos, start_vel=vel)
    state = given.start(0)
    np.testing.assert_allclose(state.pos.double().numpy() + state.origin.numpy(), pos, atol=1e-7)
    np.testing.assert_allclose(state.vel, vel, atol=1e-6)
    assert not bool(given.start(0, relaxed=False).vel.any())
    assert float(state.pos.abs().max()) < 1.5  # the frame is next to the cloth
    torch.testing.assert_close(given.start(3).pos, tank_scene.start(3).pos)  # later starts are the scene's own


def test_no_body() -> None:
    motion = NoBody(5, 30.0)
    assert motion.obstacle(0, np.zeros(3)) is None
    assert motion.surface(2, np.zeros(3)).shape == (0, 3)
    assert motion.faces.shape == (0, 3)
    far = replace(TUBE, rest_pos=TUBE.rest_pos + [100.0, 0, 0])
    scene = dressed_scene(far, motion)
    state = scene.start(0)
    np.testing.assert_allclose(state.pos.double().numpy() + state.origin.numpy(), far.rest_pos, atol=1e-5)
    step = scene.step_input(0, state)
    assert step.obstacle is None
    assert torch.equal(step.pin_target, state.pos)
    assert not bool(state.vel.any())
