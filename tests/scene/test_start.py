"""The settled start: bounded strain, outside the body."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.assets.material import Material
from hood.assets.motion.load import load_sequence
from hood.assets.motion.sequence import PoseSequence
from hood.cloth.cloth import build_cloth
from hood.cloth.state import Obstacle
from hood.contact.contact import find_contact
from hood.scene.scene import build_scene
from hood.scene.start import free_stretch, push_out_of_body, settle
from hood.solver.step_figures import strain_metrics
from hood.testing import grid, sphere


@pytest.mark.parametrize("name", ["tshirt", "tank", "longsleeve", "shorts", "trousers", "dress", "skirt"])
def test_default_garments_start_well(name: str, garments: dict[str, Garment], body: Body, walk: PoseSequence) -> None:
    scene = build_scene(garments[name], body, walk.window(0, 2))
    state = scene.start(0)
    obstacle = scene.motion.obstacle(0, state.origin[0].numpy(), static=True)
    contact = find_contact(state.pos, scene.cloth.vertex_scene, obstacle)
    assert float(contact.dist.min()) > -2e-3
    assert float(contact.dist[scene.cloth.free].min()) > scene.clearance - 1e-4
    assert strain_metrics(scene.cloth, state.pos)["strain_p99"] <= 0.15


def ball(radius: float) -> Obstacle:
    pos, faces = sphere(3, radius)
    now = torch.as_tensor(pos)
    return Obstacle(now, now, now, torch.as_tensor(faces), torch.zeros(len(pos)).long(), torch.zeros(len(faces)).long())


def test_stretched_cloth_is_brought_back_without_a_body() -> None:
    cloth = build_cloth(*grid(8, 8, 0.3), Material(), dtype=torch.float64)
    settled = settle(cloth, cloth.rest_pos * 1.4, None, iterations=200)
    assert strain_metrics(cloth, cloth.rest_pos * 1.4)["strain_p50"] == pytest.approx(0.4)
    assert strain_metrics(cloth, settled)["strain_p99"] < 0.08
    # Cloth within the limits is left alone.
    torch.testing.assert_close(settle(cloth, cloth.rest_pos * 1.03, None), cloth.rest_pos * 1.03)


def test_pinned_vertices_stay() -> None:
    pinned = np.zeros(64, dtype=bool)
    pinned[:8] = True
    cloth = build_cloth(*grid(8, 8, 0.3), Material(), pinned, dtype=torch.float64)
    start = cloth.rest_pos * 1.4 + torch.tensor([0.0, 0.05, 0.0]).double()
    settled = settle(cloth, start, ball(0.2))
    assert torch.equal(settled[:8], start[:8])
    assert not torch.equal(settled[8:], start[8:])


def test_cloth_inside_a_ball_is_pushed_out() -> None:
    pos, faces = grid(6, 6, 0.2)
    cloth = build_cloth(pos, faces, Material(), dtype=torch.float64)
    inside = cloth.rest_pos + torch.tensor([-0.1, 0.27, -0.1]).double()
    obstacle = ball(0.3)
    assert float(find_contact(inside, cloth.vertex_scene, obstacle).dist.min()) < -0.02
    outside = push_out_of_body(cloth, inside, obstacle, clearance=2e-3)
    assert float(find_contact(outside, cloth.vertex_scene, obstacle).dist.min()) >= 2e-3 - 1e-4
    assert torch.equal(push_out_of_body(cloth, inside, None, 2e-3), inside)


def test_cloth_far_inside_is_not_sent_across_the_body() -> None:
    """Deeper than the cap nothing is known about the way out."""
    cloth = build_cloth(*grid(3, 3, 0.02), Material(), dtype=torch.float64)
    centre = cloth.rest_pos - 0.01
    assert torch.equal(push_out_of_body(cloth, centre, ball(0.3), 2e-3), centre)


@pytest.mark.parametrize(
    ("name", "motion", "frame"), [("trousers", "kicks", 60), ("shorts", "squats", 60), ("skirt", "jumps", 60)]
)
def test_starts_in_the_midst_of_a_wild_motion(
    name: str, motion: str, frame: int, garments: dict[str, Garment], body: Body
) -> None:
    """A bent hip: cloth has to slide along the thigh, and the waistband must not fold with the belly."""
    scene = build_scene(garments[name], body, load_sequence(motion).window(frame, frame + 2))
    state = scene.start(0, relaxed=False, thorough=True)
    start, end = scene.cloth.edges.unbind(dim=1)
    rest = (scene.cloth.rest_pos[end] - scene.cloth.rest_pos[start]).norm(dim=1)
    assert float(((state.pos[end] - state.pos[start]).norm(dim=1) / rest - 1).max()) < 0.1
    obstacle = scene.motion.obstacle(0, state.origin[0].numpy(), static=True)
    assert float(find_contact(state.pos, scene.cloth.vertex_scene, obstacle).dist.min()) > -2e-3


def test_a_thorough_start_slides_cloth_along_itself() -> None:
    """A long strip with all its stretch at one end: in the end every edge has a share, and the held end stays."""
    pos, faces = grid(4, 40, 0.1)
    held = pos[:, 2] == pos[:, 2].min()
    cloth = build_cloth(pos, faces, Material(), held, dtype=torch.float64)
    start = cloth.rest_pos.clone()
    start[pos[:, 2] > 0.8 * pos[:, 2].max()] += torch.tensor([0.0, 0.0, 0.1]).double()
    assert float(free_stretch(cloth, settle(cloth, start, None, iterations=10)).max()) > 0.3
    settled = settle(cloth, start, None, thorough=True)
    assert float(free_stretch(cloth, settled).max()) <= 0.08
    assert torch.equal(settled[held], start[held])
    assert settled.isfinite().all()
