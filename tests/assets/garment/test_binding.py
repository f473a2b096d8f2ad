"""Garments bound in other poses than T, pushed out of the skin, joined, and their units and poses guessed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from hood.assets.body.body import Body, linear_blend_skinning
from hood.assets.fitting.placement import find_scale, require_metres, used
from hood.assets.garment.binding import bind_garment, bind_posed, hold_on_trunk, posed_body, push_out, signed_distances
from hood.assets.garment.garment import Garment, load_garment, save_garment
from hood.assets.garment.outfit import join_garments
from hood.assets.motion.load import load_sequence
from hood.assets.motion.sequence import PoseSequence
from hood.assets.motion.sequence_edit import arms_down, holds_pose, read_pose
from hood.mesh import topology
from hood.testing import sphere


def bare(garment: Garment) -> Garment:
    """The garment as a mesh file has it."""
    return Garment(garment.name, garment.tpose(np.zeros(10)), garment.faces, garment.pinned)


@pytest.mark.parametrize("angle", [0.0, 45.0])
def test_where_it_is_worn_is_apart_from_its_rest_shape(garments: dict[str, Garment], body: Body, angle: float) -> None:
    """Moved vertices are where skinning leads to; the mesh as it is given stays the rest shape."""
    betas = np.array([0.8, -1.0, *[0.0] * 8])
    posed = posed_body(body, arms_down(angle), 0, betas)
    given = bare(garments["tank"])
    worn = given.rest_pos + 0.01 * np.random.default_rng(0).normal(size=given.rest_pos.shape)
    bound = bind_posed(given, posed, worn)
    skin = np.c_[bound.tpose(betas), np.ones(len(worn))]
    np.testing.assert_allclose(np.einsum("vj,jab,vb->va", bound.lbs_weights, posed.transforms, skin), worn, atol=1e-9)
    np.testing.assert_allclose(bound.shaped(betas), given.rest_pos, atol=1e-9)


@pytest.mark.parametrize("frame", [0, 40])
def test_undoing_a_pose_is_exact(garments: dict[str, Garment], body: Body, walk: PoseSequence, frame: int) -> None:
    """Skinned back into the pose it was given in, every vertex is where it was given, in the world."""
    betas = np.array([0.8, -1.0, *[0.0] * 8])
    posed = posed_body(body, walk, frame, betas)
    template = garments["trousers"]
    rest = np.concatenate([template.shaped(betas), np.ones((len(template.rest_pos), 1))], axis=1)
    given = np.einsum("vj,jab,vb->va", template.lbs_weights, posed.transforms, rest)
    bound = bind_posed(replace(bare(template), rest_pos=given), posed)
    again = np.concatenate([bound.tpose(betas), np.ones((len(given), 1))], axis=1)
    np.testing.assert_allclose(np.einsum("vj,jab,vb->va", bound.lbs_weights, posed.transforms, again), given, atol=1e-9)
    np.testing.assert_allclose(bound.shaped(betas), given, atol=1e-9)
    # In T-pose it is near the garment that was posed.
    assert np.median(np.linalg.norm(bound.tpose(betas) - template.shaped(betas), axis=1)) < 5e-3


def test_the_t_pose_needs_no_undoing(garments: dict[str, Garment], body: Body) -> None:
    bound = bind_posed(bare(garments["tank"]), posed_body(body, arms_down(0.0), 0, np.zeros(10)))
    assert bound.skin_pos is None
    np.testing.assert_allclose(bound.lbs_weights, bind_garment(bare(garments["tank"]), body).lbs_weights, atol=1e-9)


def test_posed_garments_survive_the_file(tmp_path: Path, garments: dict[str, Garment], body: Body) -> None:
    garment = bind_posed(bare(garments["tank"]), posed_body(body, arms_down(30.0), 0, np.zeros(10)))
    garment = replace(garment, coarse_edges=(np.array([[0, 5], [5, 9]]), np.array([[0, 9]])), colours=np.ones((1016, 3)))
    save_garment(tmp_path / "tank.npz", garment)
    again = load_garment(tmp_path / "tank.npz")
    for key in ("rest_pos", "skin_pos", "rest_turn", "lbs_weights", "shapedirs", "colours"):
        np.testing.assert_allclose(getattr(again, key), getattr(garment, key), atol=1e-12)
    assert again.bound_to == "default"
    assert [len(level) for level in again.coarse_edges] == [2, 1]
    assert bind_garment(again, body) is again


def test_an_interrupted_write_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, garments: dict[str, Garment]
) -> None:
    save_garment(tmp_path / "g.npz", garments["tank"])
    before = (tmp_path / "g.npz").read_bytes()
    monkeypatch.setattr("os.replace", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(OSError, match="No space"):
        save_garment(tmp_path / "g.npz", garments["skirt"])
    assert (tmp_path / "g.npz").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["g.npz"]


def test_pushing_out_of_a_ball() -> None:
    """Vertices inside go straight out to the clearance; those outside stay."""
    surface, faces = sphere(3, radius=0.5)
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(200, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    radius = np.where(np.arange(200) < 60, 0.47, 0.6)
    points = direction * radius[:, None]
    pushed = push_out(points, surface, faces, 2e-3)
    assert pushed.num_inside == 60
    assert pushed.depth == pytest.approx(0.03, abs=2e-3)
    np.testing.assert_array_equal(pushed.pos[60:], points[60:])
    np.testing.assert_allclose(signed_distances(pushed.pos[:60], surface, faces), 2e-3, atol=2e-4)
    moved = pushed.pos[:60] - points[:60]
    assert (np.einsum("vi,vi->v", moved, direction[:60]) > 0.99 * np.linalg.norm(moved, axis=1)).all()


@pytest.mark.parametrize("factor", [1.0, 0.01, 0.001])
def test_units(garments: dict[str, Garment], body: Body, factor: float) -> None:
    for garment in garments.values():
        assert find_scale(garment.rest_pos / factor, body.v_template) == factor
    if factor == 1.0:
        require_metres(garment.rest_pos, body.v_template, "g")
    else:
        with pytest.raises(ValueError, match=f"multiply it by {factor:g}"):
            require_metres(garment.rest_pos / factor, body.v_template, "g")


def test_units_that_are_alike_are_all_named(garments: dict[str, Garment], body: Body) -> None:
    """The size alone cannot tell a shirt in inches from a smaller one in centimetres."""
    with pytest.raises(ValueError, match=r"may be in inches \(scale=0.0254\) or centimetres .* finds out which fits"):
        require_metres(garments["tank"].rest_pos / 0.0254, body.v_template, "g")


def test_sizes_of_no_unit_and_strays(body: Body, garments: dict[str, Garment]) -> None:
    tank = garments["tank"]
    assert find_scale(tank.rest_pos * 1e6, body.v_template) is None
    with pytest.raises(ValueError, match="scale=FACTOR"):
        require_metres(tank.rest_pos * 1e-6, body.v_template, "g")
    assert len(used(np.concatenate([tank.rest_pos, [[1e3, 0, 0]]]), tank.faces)) == len(tank.rest_pos)


def test_an_outfit_is_its_parts(garments: dict[str, Garment], body: Body) -> None:
    top, skirt = garments["tank"], garments["skirt"]
    plain = bind_garment(replace(bare(skirt), colours=np.zeros((len(skirt.rest_pos), 3))), body)
    posed = bind_posed(bare(top), posed_body(body, arms_down(30.0), 0, np.zeros(10)))
    outfit = join_garments([top, plain, posed])
    assert outfit.name == "tank+skirt+tank"
    betas = np.array([1.0, 0.5])
    np.testing.assert_allclose(outfit.shaped(betas), np.concatenate([g.shaped(betas) for g in (top, plain, posed)]))
    np.testing.assert_allclose(outfit.tpose(betas), np.concatenate([g.tpose(betas) for g in (top, plain, posed)]))
    start = len(top.rest_pos)
    np.testing.assert_array_equal(outfit.faces[len(top.faces) : len(top.faces) + len(plain.faces)], plain.faces + start)
    assert outfit.uv_faces.max() < len(outfit.uv)
    assert outfit.pinned[start : start + len(skirt.rest_pos)].sum() == skirt.pinned.sum()
    np.testing.assert_array_equal(outfit.colours[:start], 1.0)
    np.testing.assert_array_equal(outfit.piece, np.repeat([0, 1, 2], [start, len(skirt.rest_pos), start]))
    np.testing.assert_array_equal(join_garments([plain, outfit]).piece[len(skirt.rest_pos) :], outfit.piece + 1)
    dress = garments["dress"]
    np.testing.assert_array_equal(join_garments([top, dress]).stiffness, np.r_[np.ones(start), dress.stiffness])
    assert outfit.stiffness is None
    assert join_garments([top]) is top
    assert not join_garments([top, bare(skirt)]).bound


def test_poses_from_files(tmp_path: Path) -> None:
    pose = 0.1 * np.random.default_rng(0).normal(size=72)
    np.save(tmp_path / "p.npy", pose)
    (tmp_path / "p.txt").write_text(", ".join(map(repr, pose.tolist())))
    (tmp_path / "p.json").write_text(str([row.tolist() for row in pose.reshape(24, 3)]))
    for name in ("p.npy", "p.txt", "p.json"):
        found = read_pose(tmp_path / name).poses
        np.testing.assert_allclose(found[0, :22], pose.reshape(24, 3)[:22])
        assert not found[0, 22:].any()
    for name, text in (("short.txt", "1 2 3"), ("word.txt", "a b"), ("nan.json", str([float("nan")] * 72))):
        (tmp_path / name).write_text(text)
        with pytest.raises(ValueError, match=name):
            read_pose(tmp_path / name)


def test_arrays_of_many_frames_are_no_pose(tmp_path: Path) -> None:
    """A motion of Motion-X, poses without keys, and content by key."""
    for name, table in (("x", np.zeros((60, 322))), ("poses", np.zeros((9, 72))), ("keys", np.array({"a": 1}, dtype=object))):
        np.save(tmp_path / f"{name}.npy", table, allow_pickle=True)
        assert not holds_pose(tmp_path / f"{name}.npy"), name
    with pytest.raises(ValueError, match=r"x\.npy: 19320 numbers; a pose has 72"):
        read_pose(tmp_path / "x.npy")
    np.save(tmp_path / "one.npy", np.zeros((1, 24, 3)))
    assert holds_pose(tmp_path / "one.npy")
    assert holds_pose(tmp_path / "one.txt")
    assert not holds_pose(tmp_path / "one.npz")


def test_a_held_waistband_follows_the_trunk_alone(garments: dict[str, Garment], body: Body) -> None:
    """It keeps its girth; nothing else changes, nor does anything in the T-pose."""
    shorts = garments["shorts"]
    held = hold_on_trunk(shorts, body)
    assert shorts.lbs_weights[shorts.pinned][:, [1, 2]].max() > 0.1
    assert not held.lbs_weights[shorts.pinned][:, [1, 2]].any()
    np.testing.assert_allclose(held.lbs_weights.sum(axis=1), 1.0)
    np.testing.assert_array_equal(held.lbs_weights[~shorts.pinned], shorts.lbs_weights[~shorts.pinned])
    squat = load_sequence("squats").window(60, 61)
    edges = topology.unique_edges(shorts.faces)
    edges = edges[shorts.pinned[edges].all(axis=1)]
    changes = []
    for garment in (shorts, held):
        bones = body.transforms(squat, np.zeros(10), torch.float64)
        pos = linear_blend_skinning(torch.as_tensor(garment.rest_pos), torch.as_tensor(garment.lbs_weights), bones)[0].numpy()
        length, rest = (np.linalg.norm(p[edges[:, 1]] - p[edges[:, 0]], axis=1) for p in (pos, garment.rest_pos))
        changes.append(float(np.abs(length / rest - 1).max()))
    assert changes[0] > 0.15
    assert changes[1] < 0.02


def test_what_is_held_at_the_legs_follows_them(garments: dict[str, Garment], body: Body) -> None:
    trousers = garments["trousers"]
    ankles = replace(trousers, pinned=trousers.rest_pos[:, 1] < trousers.rest_pos[:, 1].min() + 0.3)
    assert hold_on_trunk(ankles, body) is ankles
    loose = replace(trousers, pinned=np.zeros_like(trousers.pinned))
    assert hold_on_trunk(loose, body) is loose
