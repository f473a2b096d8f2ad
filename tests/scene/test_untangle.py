"""Garments of an outfit are taken apart before the first step."""

import numpy as np
import pytest
import torch

from hood.assets.body.load import load_body
from hood.assets.garment.garment import load_garment
from hood.assets.garment.outfit import join_garments
from hood.assets.material import Material
from hood.assets.motion.load import load_sequence
from hood.cloth.cloth import build_cloth
from hood.cloth.state import Obstacle
from hood.contact.contact import find_contact
from hood.mesh.penetration.crossing import self_crossings
from hood.scene.scene import build_scene
from hood.scene.untangle import Outfit, TangledError, crossing_pairs, likely_orders, separate, smooth_out
from hood.testing import cylinder

CLEARANCE = 2e-3


def tubes(*radii, pinned=(), wave=0.0):
    """Tubes around one axis, the second turned; ``wave`` [m] is how far they swing about their radii."""
    meshes = [cylinder(around=24, rows=10, radius=radius, height=0.4) for radius in radii]
    pos = [points @ _turned(0.1 * number) for number, (points, _) in enumerate(meshes)]
    swung = [
        p * (1.0 + wave / radii[0] * np.sin(9 * np.arctan2(p[:, 2], p[:, 0]) + n)[:, None] * [1, 0, 1])
        for n, p in enumerate(pos)
    ]
    starts = np.cumsum([0, *(len(p) for p in pos[:-1])])
    faces = np.concatenate([rows + start for (_, rows), start in zip(meshes, starts, strict=True)])
    piece = np.repeat(np.arange(len(pos)), [len(p) for p in pos])
    held = np.isin(piece, pinned)
    cloth = build_cloth(np.concatenate(pos), faces, Material(), held, dtype=torch.float64)
    return Outfit(cloth, faces, piece, tuple("abcd"[: len(pos)])), torch.as_tensor(np.concatenate(swung))


def _turned(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def trunk(radius):
    points, faces = cylinder(around=48, rows=12, radius=radius, height=0.6)
    pos, none = torch.as_tensor(points), torch.zeros(len(points), dtype=torch.long)
    return Obstacle(pos, pos, pos, torch.as_tensor(faces), none, torch.zeros(len(faces), dtype=torch.long), none.bool())


def heights(outfit, pos, over, under):
    """Mean distance from the axis of a garment less that of another [m]."""
    away = np.linalg.norm(pos.numpy()[:, [0, 2]], axis=1)
    return away[outfit.piece == over].mean() - away[outfit.piece == under].mean()


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_crossed_tubes_come_apart_in_either_order(order):
    outfit, pos = tubes(0.2, 0.201, wave=6e-3)
    found = separate(outfit, pos, trunk(0.19), CLEARANCE, order)
    assert found.before == len(crossing_pairs(outfit, pos)) > 100
    assert (found.after, found.order) == (0, order)
    assert len(crossing_pairs(outfit, found.pos)) == 0
    assert heights(outfit, found.pos, order[1], order[0]) > 2e-3
    assert found.stretch < 0.1


def test_the_likely_order_is_the_one_most_vertices_have():
    outfit, pos = tubes(0.2, 0.206, 0.212, wave=4e-3)
    orders = likely_orders(outfit, pos, trunk(0.19))
    assert orders[0] == (0, 1, 2)
    assert len(orders) == 6
    found = separate(outfit, pos, trunk(0.19), CLEARANCE)
    assert (found.after, found.order) == (0, (0, 1, 2))


def test_a_held_garment_is_the_inner_one_where_the_places_leave_it_open():
    for held in (0, 1):
        outfit, pos = tubes(0.2, 0.2, pinned=(held,), wave=6e-3)
        assert likely_orders(outfit, pos, trunk(0.19))[0] == (held, 1 - held)
    outfit, pos = tubes(0.2, 0.21, pinned=(1,), wave=2e-3)
    assert likely_orders(outfit, pos, trunk(0.19))[0] == (0, 1)


def test_a_garment_that_is_inside_out_has_its_outside_away_from_the_body():
    outfit, pos = tubes(0.2, 0.206, wave=4e-3)
    turned = outfit._replace(faces=np.where(outfit.piece[outfit.faces[:, :1]] == 0, outfit.faces[:, ::-1], outfit.faces))
    assert likely_orders(turned, pos, trunk(0.19))[0] == (0, 1)
    assert separate(turned, pos, trunk(0.19), CLEARANCE, (0, 1)).after == 0


def test_held_garments_stay_and_the_others_give_way():
    outfit, pos = tubes(0.2, 0.203, pinned=(1,), wave=4e-3)
    found = separate(outfit, pos, trunk(0.18), CLEARANCE, (0, 1))
    assert found.after == 0
    assert torch.equal(found.pos[outfit.piece == 1], pos[outfit.piece == 1])


def test_garments_apart_stay_as_they_are():
    outfit, pos = tubes(0.2, 0.23)
    found = separate(outfit, pos, trunk(0.19), CLEARANCE)
    assert (found.before, found.after, found.order) == (0, 0, (0, 1))
    assert found.pos is pos


@pytest.mark.parametrize("order", [None, (1, 0)])
def test_garments_in_the_same_place_are_laid_over_each_other(order):
    outfit, pos = tubes(0.2, 0.23)
    pos[outfit.piece == 1] = pos[outfit.piece == 0]
    assert len(crossing_pairs(outfit, pos)) == 0  # so nothing else would tell them apart
    found = separate(outfit, pos, trunk(0.19), CLEARANCE, order)
    assert found.lifted
    assert found.order == (order or (0, 1))
    assert heights(outfit, found.pos, *reversed(found.order)) == pytest.approx(3e-3, abs=3e-4)
    inner = torch.as_tensor(outfit.piece == found.order[0])
    assert torch.equal(found.pos[inner], pos[inner])


def test_garments_that_share_a_seam_stay_where_they_are():
    outfit, pos = tubes(0.2, 0.23)
    ring = np.flatnonzero(outfit.piece == 0)[:24]
    pos[np.flatnonzero(outfit.piece == 1)[:24]] = pos[ring]
    assert not separate(outfit, pos, trunk(0.19), CLEARANCE).lifted


@pytest.mark.parametrize("outer", [0.206, 0.23])
def test_a_garment_wholly_under_another_is_taken_over_it(outer):
    outfit, pos = tubes(0.2, outer)
    found = separate(outfit, pos, trunk(0.19), CLEARANCE, (1, 0))
    assert (found.before, found.after, found.turned) == (0, 0, ((0, 1),))
    assert heights(outfit, found.pos, 0, 1) > 2e-3
    assert len(crossing_pairs(outfit, found.pos)) == 0


def test_held_garments_that_lie_the_other_way_are_refused_by_name():
    outfit, pos = tubes(0.2, 0.206, pinned=(0, 1))
    with pytest.raises(TangledError, match=r"'a' lies under 'b' at the start, not over it .*layers=auto"):
        separate(outfit, pos, trunk(0.19), CLEARANCE, (1, 0))


def test_without_a_body_the_winding_says_what_is_outside():
    outfit, pos = tubes(0.2, 0.203, wave=4e-3)
    found = separate(outfit, pos, None, CLEARANCE)
    assert (found.after, found.order) == (0, (0, 1))


def test_held_garments_that_cross_are_refused_by_name():
    outfit, pos = tubes(0.2, 0.201, pinned=(0, 1), wave=6e-3)
    with pytest.raises(TangledError, match=r"pairs of triangles of 'a' and 'b' pass .*layers=\[inner,outer\]"):
        separate(outfit, pos, trunk(0.18), CLEARANCE, (0, 1))


@pytest.mark.parametrize(
    ("names", "order"), [(("tank", "skirt"), (1, 0)), (("tshirt", "trousers"), (1, 0)), (("tank", "longsleeve"), (0, 1))]
)
def test_embedded_outfits_come_apart(names, order):
    garment = join_garments([load_garment(name) for name in names])
    scene = build_scene(garment, load_body(), load_sequence("plie", 30.0))
    start = scene.start(0, relaxed=False, thorough=True)
    obstacle = scene.motion.obstacle(0, start.origin[0].numpy(), static=True)
    found = separate(Outfit(scene.cloth, garment.faces, garment.piece, names), start.pos, obstacle, CLEARANCE)
    assert found.before > 20
    assert found.order == order
    pairs = self_crossings(found.pos.double().numpy(), garment.faces)
    assert not (garment.piece[garment.faces[pairs[:, 0], 0]] != garment.piece[garment.faces[pairs[:, 1], 0]]).any()
    assert found.stretch < 0.14
    assert found.seconds > 0.0
    dist = find_contact(found.pos, scene.cloth.vertex_scene, obstacle).dist
    assert float(dist[scene.cloth.free].min()) > CLEARANCE - 1e-4


def test_a_place_where_a_garment_passes_through_itself_is_smoothed():
    outfit, pos = tubes(0.2)
    pricked = pos.clone()
    pricked[24 * 4 + 3] *= torch.tensor([-1.05, 1.0, -1.05])  # through the other side
    assert len(self_crossings(pricked.numpy(), outfit.faces)) > 3
    body = trunk(0.05)
    smooth = smooth_out(outfit.cloth, outfit.faces, pricked, body, CLEARANCE)
    assert len(self_crossings(smooth.numpy(), outfit.faces)) == 0
    moved = (smooth - pricked).norm(dim=1) > 0
    assert moved[24 * 4 + 3]
    assert moved.sum() < 60
    assert smooth_out(outfit.cloth, outfit.faces, pos, body, CLEARANCE) is pos


def test_held_vertices_are_not_smoothed():
    outfit, pos = tubes(0.2, pinned=(0,))
    pricked = pos.clone()
    pricked[24 * 4 + 3] *= torch.tensor([-1.05, 1.0, -1.05])
    assert smooth_out(outfit.cloth, outfit.faces, pricked, trunk(0.05), CLEARANCE) is pricked


def test_orders_of_many_garments_are_not_all_tried():
    """One, from the inside out: seven tubes have 5,040 orders."""
    radii = [0.26, 0.2, 0.32, 0.23, 0.29, 0.35, 0.38]
    outfit, pos = tubes(*radii)
    outfit = outfit._replace(names=tuple("abcdefg"))
    assert likely_orders(outfit, pos, trunk(0.15)) == [tuple(np.argsort(radii).tolist())]
