"""Skin through cloth and cloth through cloth: what counts, what the start had, what nobody sees."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from stored import frames, stored, tube

from hood.mesh.penetration.crossing import crossings
from hood.rollouts.file.reader import RolloutData
from hood.rollouts.verdict.rule import judge_rollout
from hood.rollouts.verdict.skin import way_through
from hood.rollouts.verdict.surface import meshes_of, sampled, surface_metrics, visible

COUNT = 16


def sheet(centre: tuple[float, float, float], across: int, size: float = 0.4, cells: int = 8) -> tuple[np.ndarray, np.ndarray]:
    """A square of cloth at ``centre`` [m], at right angles to the axis ``across``."""
    ticks = np.linspace(-size / 2, size / 2, cells + 1)
    plane = np.stack(np.meshgrid(ticks, ticks, indexing="ij"), axis=-1).reshape(-1, 2)
    pos = np.insert(plane, across, 0.0, axis=1) + np.array(centre)
    corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    faces = [
        np.stack([corner, corner + 1, corner + cells + 2], 1),
        np.stack([corner, corner + cells + 2, corner + cells + 1], 1),
    ]
    return pos, np.concatenate(faces)


def crossed(apart: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Two sheets, one through the middle of the other, or so far beside it."""
    one, faces = sheet((0.0, 1.0, 0.0), 2)
    other, _ = sheet((0.003 + apart, 1.013, 0.007), 0)
    return np.concatenate([one, other]), np.concatenate([faces, faces + len(one)])


POST, POST_FACES = tube(0.10, 0.0, 1.0, 96, 100)
SLEEVE, SLEEVE_FACES = tube(0.105, 0.3, 0.7, 96, 40)


def worn(dents: np.ndarray, size: int) -> RolloutData:
    """A sleeve around a post whose middle is pushed ``dents`` (T,) metres into it, over ``size`` by ``size`` vertices."""
    count = len(dents)
    cloth = np.repeat(SLEEVE[None], count, axis=0)
    pushed = (20 + np.arange(size))[:, None] * 96 + 10 + np.arange(size)
    outwards = SLEEVE[pushed.ravel()] * [1.0, 0.0, 1.0]
    cloth[:, pushed.ravel()] -= dents[:, None, None] * outwards / np.linalg.norm(outwards, axis=1, keepdims=True)
    return stored(count, {"strain_p99": frames(count)}, cloth=cloth, faces=SLEEVE_FACES, body=POST,
                  body_faces=POST_FACES.astype(np.int32))  # fmt: skip


def kinds(data: RolloutData) -> list[str]:
    return [reason.kind for reason in judge_rollout(data).reasons]


def test_skin_through_much_of_the_cloth_counts_in_every_frame() -> None:
    assert judge_rollout(worn(np.zeros(COUNT), 9)).sound
    assert judge_rollout(worn(np.full(COUNT, 0.004), 9)).sound  # still outside
    (reason,) = judge_rollout(worn(np.where(np.arange(COUNT) > 10, 0.0055, 0.0), 20)).reasons
    assert (reason.kind, reason.limit, reason.unit) == ("skin_through_cloth", 0.01, "share of the cloth's triangles")
    assert reason.frames[0][0] > 10
    assert reason.value is not None
    assert 0.01 < reason.value < 0.1


@pytest.mark.parametrize(("size", "sound"), [(14, True), (20, False)])
def test_one_frame_of_much_skin_counts_between_measured_ones(size: int, sound: bool) -> None:
    """Every fifth frame was measured, one of them beside the frame that the skin comes through in; 2% of the triangles and more
    are seen in one frame, less is not."""
    data = worn(np.where(np.arange(COUNT) == 9, 0.0055, 0.0), size)
    data.cloth_pos[10] = worn(np.full(COUNT, 0.0055), 5).cloth_pos[10]
    whole = surface_metrics(data, meshes_of(data))
    every_fifth = {name: np.where(np.arange(COUNT) % 5 == 0, values, np.nan) for name, values in whole.items()}
    data.step_metrics.update(every_fifth)
    shown = surface_metrics(data, meshes_of(data))["cut_face_share"]
    assert np.isfinite(shown[6:15]).all()
    assert np.isnan(shown[1:5]).all()
    verdict = judge_rollout(data)
    assert verdict.sound is sound
    if not sound:
        (reason,) = verdict.reasons
        assert (reason.kind, reason.frame) == ("skin_through_cloth", 9)


@pytest.mark.parametrize(("dent", "sound"), [(0.025, True), (0.045, False)])
def test_a_limb_through_the_cloth_is_seen_in_one_frame_of_a_long_rollout(dent: float, sound: bool) -> None:
    """20 mm and 40 mm, in one frame of sixty, all of which were measured."""
    once = np.arange(60) == 40
    data, short = worn(np.where(once, dent, 0.0), 9), worn(np.array([0.0, dent]), 9)
    for name, values in surface_metrics(short, meshes_of(short)).items():
        data.step_metrics[name] = np.where(once, values[1], values[0])
    assert judge_rollout(data).sound is sound


def test_skin_that_sticks_out_far_counts_by_its_height() -> None:
    assert kinds(worn(np.where(np.arange(COUNT) > 10, 0.025, 0.0), 5)) == ["skin_depth"]
    (reason,) = judge_rollout(worn(np.where(np.arange(COUNT) > 10, 0.025, 0.0), 5)).reasons
    assert reason.value == pytest.approx(0.02, abs=3e-3)


def test_low_spots_of_skin_count_where_they_stay() -> None:
    assert judge_rollout(worn(np.where(np.arange(COUNT) > 13, 0.0115, 0.0), 5)).sound
    (reason,) = judge_rollout(worn(np.full(COUNT, 0.0115), 5)).reasons
    assert "spots of skin stick out by more than 1.5 mm, and stay" in reason.sentence
    assert judge_rollout(worn(np.full(COUNT, 0.006), 5)).sound  # 1 mm


def test_larger_spots_count_where_they_last_less_long() -> None:
    sometimes = np.where(np.arange(COUNT) > 10, 0.0115, 0.0)
    assert judge_rollout(worn(sometimes, 3)).sound  # 0.3% of the triangles
    (reason,) = judge_rollout(worn(sometimes, 6)).reasons  # 0.6%
    assert (reason.kind, reason.frames) == ("skin_depth", ((11, 15),))
    assert judge_rollout(worn(np.where(np.arange(COUNT) > 12, 0.0115, 0.0), 6)).sound  # three of sixteen frames


def test_a_corner_between_the_vertices_of_the_cloth_is_no_spot() -> None:
    """8 mm of a cube's corner, of a ball, and of a toe that turns as sharply but has no flat sides, in every frame."""
    flat, faces = sheet((0.003, 0.5, 0.007), 1, 0.6, 30)
    cube = trimesh.creation.box((0.2, 0.2, 0.2)).subdivide().subdivide().subdivide()
    upwards = Rotation.align_vectors([[0, 1, 0]], [[1, 1, 1]])[0].as_matrix()
    ball = trimesh.creation.icosphere(3, 0.04)
    toe = trimesh.convex.convex_hull(np.concatenate([np.eye(3), -np.eye(3)]) * [0.06, 0.05, 0.06])
    shapes = [(cube.vertices @ upwards.T, cube.faces, True)]
    shapes += [(shape.vertices, shape.faces, False) for shape in (ball, toe)]
    for pos, triangles, sound in shapes:
        body = np.array(pos) + [0, 0.508 - pos[:, 1].max(), 0]
        data = stored(COUNT, {"strain_p99": frames(COUNT)}, cloth=flat, faces=faces, body=body,
                      body_faces=triangles.astype(np.int32), config={"worn": False})  # fmt: skip
        assert 0.002 < surface_metrics(data, meshes_of(data))["cut_face_share"][0] < 0.01
        assert judge_rollout(data).sound is sound


def test_a_body_that_goes_through_a_sheet_counts_by_how_far() -> None:
    """Its tip is farther from the cloth than skin that is looked for."""
    flat, faces = sheet((0.0, 0.5, 0.0), 1, 0.6, 30)
    spear, spear_faces = tube(0.012, 0.2, 0.9, 12, 60)
    data = stored(COUNT, {"strain_p99": frames(COUNT)}, cloth=flat, faces=faces, body=spear,
                  body_faces=spear_faces.astype(np.int32), config={"worn": False})  # fmt: skip
    assert "skin_depth" in kinds(data)
    cut = crossings(flat, faces, spear, spear_faces)
    assert way_through(flat, faces, spear, spear_faces, cut) == pytest.approx(0.3, abs=0.02)
    below = crossings(flat, faces, spear - [0, 0.5, 0], spear_faces)
    assert way_through(flat, faces, spear - [0, 0.5, 0], spear_faces, below) == 0.0


def test_a_limb_that_a_hem_cuts_all_around_has_not_gone_through() -> None:
    cuff, faces = tube(0.105, 0.3, 0.7, 96, 40)
    cuff[cuff[:, 1] > 0.695] *= [0.94, 1.0, 0.94]  # 1 mm in the skin
    cut = crossings(cuff, faces, POST, POST_FACES)
    assert len(np.unique(cut.second_edges[:, :2])) > 90
    assert way_through(cuff, faces, POST, POST_FACES, cut) == 0.0
    plate, plate_faces = sheet((0.003, 0.503, 0.007), 1, 0.24, 1)  # its edge is near, but all of it is outside
    cut = crossings(plate, plate_faces, POST, POST_FACES)
    assert way_through(plate, plate_faces, POST, POST_FACES, cut) == pytest.approx(0.5, abs=0.02)


def test_folds_of_the_skin_are_told_and_do_not_count() -> None:
    """Two posts in one place: cloth cannot be outside both."""
    doubled = np.concatenate([POST, POST @ Rotation.from_euler("y", 1.9, degrees=True).as_matrix()])
    faces = np.concatenate([POST_FACES, POST_FACES + len(POST)]).astype(np.int32)
    data = worn(np.full(COUNT, 0.0055), 20)
    folded = stored(COUNT, {"strain_p99": frames(COUNT)}, cloth=data.cloth_pos, faces=SLEEVE_FACES, body=doubled,
                    body_faces=faces)  # fmt: skip
    verdict = judge_rollout(folded)
    assert verdict.sound
    assert any("where it passes through itself" in note for note in verdict.notes)


def measured(**metrics: np.ndarray) -> RolloutData:
    """A rollout that has measured its surface: nothing, but for what is given."""
    names = ("cut_face_share", "cut_edge_share", "skin_depth", "self_crossings", "garment_crossings", "cut_in_folds")
    return stored(COUNT, {"strain_p99": frames(COUNT), **{name: frames(COUNT, 0.0) for name in names}, **metrics})


def test_cloth_inside_the_body_cuts_nothing_and_counts() -> None:
    (reason,) = judge_rollout(measured(penetration_share=frames(COUNT, 0.3))).reasons
    assert reason.kind == "inside_body"


def test_cloth_through_cloth_counts_for_every_stepper() -> None:
    """Measured here from the positions alone: the file has no metrics of the surface."""
    apart, faces = crossed(0.5)
    through, _ = crossed()
    cloth = np.repeat(apart[None], COUNT, axis=0)
    assert judge_rollout(stored(COUNT, cloth=cloth, faces=faces)).sound
    cloth[10:] = through
    data = stored(COUNT, {"strain_p99": frames(COUNT)}, cloth=cloth, faces=faces)
    (reason,) = judge_rollout(data).reasons
    assert reason.kind == "cloth_through_cloth"
    assert reason.unit == "pairs of triangles"
    pieces = {"piece": np.repeat([0, 1], len(apart) // 2)}
    (reason,) = judge_rollout(stored(COUNT, {"strain_p99": frames(COUNT)}, cloth=cloth, faces=faces, still=pieces)).reasons
    assert reason.kind == "garments_through_each_other"


def test_a_few_pairs_of_the_start_are_doubtful_and_many_are_wrong() -> None:
    through, faces = crossed()
    (reason,) = judge_rollout(stored(COUNT, {"strain_p99": frames(COUNT)}, cloth=through, faces=faces)).reasons
    assert "pass through each other (frame 0 has " in reason.sentence
    few = through.copy()
    few[len(few) // 2 :] += [0.0, 0.36, 0.0]  # an edge alone
    verdict = judge_rollout(stored(COUNT, {"strain_p99": frames(COUNT)}, cloth=few, faces=faces))
    assert verdict.sound
    (doubt,) = verdict.doubts
    assert (doubt["kind"], doubt["frames"], doubt["unit"]) == ("garment", [0], "pairs of triangles")


def test_what_no_viewer_sees_is_told_and_does_not_count() -> None:
    """The crossing sheets are inside a closed room."""
    apart, faces = crossed(0.25)
    through, _ = crossed()
    walls, wall_faces = room()
    cloth = np.repeat(apart[None], COUNT, axis=0)
    cloth[10:] = through
    hidden = stored(COUNT, {"strain_p99": frames(COUNT)}, cloth=cloth, faces=faces, body=walls,
                    body_faces=wall_faces.astype(np.int32), config={"worn": False})  # fmt: skip
    verdict = judge_rollout(hidden)
    assert verdict.sound
    assert any("of which no viewer sees more than 0" in note for note in verdict.notes)
    seen = stored(COUNT, {"strain_p99": frames(COUNT)}, cloth=cloth, faces=faces, body=walls + 3.0,
                  body_faces=wall_faces.astype(np.int32), config={"worn": False})  # fmt: skip
    assert judge_rollout(seen).sound is False


def room() -> tuple[np.ndarray, np.ndarray]:
    """A box of a metre around the sheets."""
    parts = [sheet(tuple(np.array([0.0, 1.0, 0.0]) + 0.5 * way * np.eye(3)[axis]), axis, 1.0)  # type: ignore[arg-type]
             for axis in range(3) for way in (-1, 1)]  # fmt: skip
    count = len(parts[0][0])
    return np.concatenate([pos for pos, _ in parts]), np.concatenate(
        [part[1] + count * number for number, part in enumerate(parts)]
    )


def test_metrics_of_the_rollout_come_before_own_ones() -> None:
    data = measured(cut_face_share=np.where(np.arange(COUNT) % 5 == 0, 0.002, np.nan))
    assert surface_metrics(data, meshes_of(data))["cut_face_share"][5] == 0.002


def test_places_are_seen_where_nothing_lies_before_them() -> None:
    body, faces = tube(0.2, 0.0, 1.0)
    places = np.array([[0.0, 0.5, 0.201], [0.0, 0.5, 0.0], [0.19, 0.5, 0.0], [0.0, 3.0, 0.0]])
    lids = [sheet((0.0, y, 0.0), 1, 0.5) for y in (0.0, 1.0)]
    assert visible(places, [(body, faces), *lids]).tolist() == [True, False, True, True]
    below_the_rim = np.array([[0.0, 0.95, 0.0]])
    assert visible(below_the_rim, [(body, faces)]).all()  # from above, through the open end
    assert not visible(below_the_rim, [(body, faces), *lids]).any()
    assert visible(np.zeros((0, 3)), [(body, faces)]).shape == (0,)


def test_surfaces_are_sampled_without_holes() -> None:
    pos, faces = sheet((0.0, 0.0, 0.0), 2, 0.1, 1)
    points = sampled(pos, faces)
    grid = np.stack(np.meshgrid(np.linspace(-0.049, 0.049, 40), np.linspace(-0.049, 0.049, 40)), axis=-1).reshape(-1, 2)
    gap = np.sqrt(((grid[:, None] - points[None, :, :2]) ** 2).sum(axis=2)).min(axis=1)
    assert gap.max() < 0.006
    assert points[:, 2] == pytest.approx(0.0)
