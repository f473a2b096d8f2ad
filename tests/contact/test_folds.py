"""Contact on both sides of folds of the body."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from hood.assets.material import Material
from hood.assets.motion.load import load_sequence
from hood.cloth.cloth import build_cloth
from hood.cloth.state import Obstacle, concatenate_obstacles
from hood.contact.contact import Contact, find_contact, find_second_contact, find_static_second_contact
from hood.energies.contact import Collision
from hood.energies.potential import default_potential, keeps_both_sides, reference_potential
from hood.energies.problem import StepProblem
from hood.energies.self_contact import for_networks
from hood.mesh.closest_point import tree
from hood.mesh.closest_point.search import build_incidence
from hood.mesh.closest_point.tree import library
from hood.scene.body_motion.motion import body_motion
from hood.solver.newton import NewtonSettings, minimize
from hood.solver.system.iterate import in_single
from hood.solver.vertex.compiled import local_terms
from hood.steppers.static_shapes.problem import with_fixed_contact
from hood.tensors.batch import to_device
from hood.testing import grid, make_problem, sphere

F64 = torch.float64


def obstacle(pos: np.ndarray, faces: np.ndarray, later: np.ndarray | None = None) -> Obstacle:
    now, after = torch.as_tensor(pos), torch.as_tensor(pos if later is None else later)
    return Obstacle(now, after, now, torch.as_tensor(faces), torch.zeros(len(pos)).long(), torch.zeros(len(faces)).long())


def limbs(gap: float, angle: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """The sides of two limbs that face each other across a gap [m] along z, the upper one turned by an angle about y."""
    side, faces = grid(9, 9, 0.4)
    lower = side[:, [0, 2, 1]] * [1, 1, 0] - [0.1, 0.2, gap / 2]
    turn = np.array([[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]])
    upper = (lower + [0, 0, gap / 2]) @ turn.T + [0, 0, gap / 2]
    up, down = faces[:, ::-1], faces
    return np.concatenate([lower, upper]), np.concatenate([up, down + len(side)])


def contact_at(points: list[list[float]], body: Obstacle) -> tuple[Tensor, Tensor, Contact]:
    pos = torch.tensor(points, dtype=F64)
    scene = torch.zeros(len(pos)).long()
    return pos, scene, find_contact(pos, scene, body)


def fold_at(points: list[list[float]], body: Obstacle) -> Contact | None:
    pos, scene, contact = contact_at(points, body)
    return find_second_contact(pos, scene, body, contact).contact


def test_between_two_limbs_the_other_one_is_found() -> None:
    body = obstacle(*limbs(0.01))
    fold = fold_at([[0.1, 0.0, 0.002], [0.1, 0.1, -0.002], [0.1, 0.0, 0.2]], body)
    assert fold is not None
    assert fold.valid.tolist() == [True, True, False]
    torch.testing.assert_close(fold.dist[:2], torch.full((2,), 7e-3, dtype=F64))
    torch.testing.assert_close(fold.normal[:2, 2], torch.tensor([1.0, -1.0], dtype=F64))
    assert float(fold.point[0, 2]) == pytest.approx(-0.005)


def test_cloth_that_is_already_in_the_other_limb_is_seen() -> None:
    body = obstacle(*limbs(0.004))
    pos, scene, contact = contact_at([[0.1, 0.0, 0.003]], body)
    fold = find_second_contact(pos, scene, body, contact).contact
    assert fold is not None
    assert bool(fold.valid[0])
    assert float(contact.dist[0]) == pytest.approx(-1e-3)
    assert float(fold.dist[0]) == pytest.approx(5e-3)


@pytest.mark.parametrize("gap", [0.04, 0.2])
def test_limbs_far_apart_have_no_other_side(gap: float) -> None:
    assert fold_at([[0.1, 0.0, -gap / 2 + 0.003]], obstacle(*limbs(gap))) is None


def test_a_bulge_and_a_thin_plate_are_no_folds() -> None:
    round_body, faces = sphere(3, 0.02)
    around = np.random.default_rng(0).normal(size=(200, 3))
    around *= 0.023 / np.linalg.norm(around, axis=1, keepdims=True)
    assert fold_at(around.tolist(), obstacle(round_body, faces)) is None
    block = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.3, 0.3) for z in (-0.003, 0.003)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    plate = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    beside = [[x, y, z] for x in (0.0, 0.098, 0.103) for y in (0.0, 0.303) for z in (-0.008, 0.002, 0.008)]
    assert fold_at(beside, obstacle(block, plate)) is None


def test_a_batch_finds_what_each_scene_does() -> None:
    narrow, wide = obstacle(*limbs(0.01)), obstacle(*limbs(0.02))
    points = [[0.1, 0.05 * i, 0.001 * i] for i in range(4)]
    pos = torch.tensor(points + points, dtype=F64)
    both, scene = concatenate_obstacles([narrow, wide]), torch.arange(8) // 4
    together = find_second_contact(pos, scene, both, find_contact(pos, scene, both)).contact
    assert together is not None
    for index, body in enumerate((narrow, wide)):
        alone = fold_at(points, body)
        assert alone is not None
        for name in ("valid", "dist", "point", "normal", "next_point", "next_normal", "curvature"):
            found = getattr(together, name)[4 * index : 4 * index + 4]
            torch.testing.assert_close(found, getattr(alone, name), rtol=0, atol=1e-12)


def test_the_form_of_fixed_shapes_finds_the_same() -> None:
    body = obstacle(*limbs(0.012, 0.1))
    points = [[0.02 * i, 0.03 * j, 1e-3 * (i - j)] for i in range(1, 6) for j in range(4)] + [[0.1, 0.0, 2.0]]
    pos, scene, contact = contact_at(points, body)
    plain = find_second_contact(pos, scene, body, contact).contact
    incidence = build_incidence(body.faces, len(body.pos))
    fixed = find_static_second_contact(pos, scene, contact, body, incidence, 1, len(body.faces)).contact
    assert plain is not None
    assert fixed is not None
    assert 10 <= int(plain.valid.sum()) < len(points)
    assert torch.equal(plain.valid, fixed.valid)
    for name in ("dist", "point", "normal", "next_point", "next_normal", "curvature"):
        torch.testing.assert_close(getattr(plain, name)[plain.valid], getattr(fixed, name)[plain.valid], rtol=1e-9, atol=1e-12)


def test_fixed_shapes_do_not_depend_on_what_is_found() -> None:
    for gap, found in ((0.01, True), (1.0, False)):
        problem = between(gap)
        body = problem.step.obstacle
        assert body is not None
        fixed, _ = with_fixed_contact(problem, build_incidence(body.faces, len(body.pos)), len(body.faces), folds=True)
        assert fixed.second_contact is not None
        assert fixed.second_contact.contact is not None
        assert bool(fixed.second_contact.contact.valid.any()) is found
        assert len(fixed.second_contact.contact.valid) == len(problem.state.pos)


@pytest.mark.skipif(library() is None, reason="without a compiler every search begins anew")
def test_searches_again_see_a_body_that_was_changed_in_place() -> None:
    body = obstacle(*limbs(0.01))
    before = contact_at([[0.1, 0.0, -0.002]], body)[2]
    body.pos.add_(torch.tensor([0.0, 0.0, 1e-3], dtype=F64))
    after = contact_at([[0.1, 0.0, -0.002]], body)[2]
    assert float(before.dist[0] - after.dist[0]) == pytest.approx(1e-3)


def between(gap: float, speed: float = 0.0) -> StepProblem:
    """A small sheet between two limbs, nearer to the lower one, that flies towards the upper one."""
    pos, faces = grid(4, 4, 0.06)
    cloth = build_cloth(pos + [0.07, 0.0, 0.0], faces, Material(), dtype=F64)
    start = cloth.rest_pos[:, [0, 2, 1]]  # from the plane y = 0 to z = 0
    start = start - torch.tensor([0.0, 0.03, gap / 8], dtype=F64)
    problem = make_problem(cloth, start, np.tile([0.0, 0.0, speed], (len(pos), 1)))
    return replace(problem, step=replace(problem.step, obstacle=obstacle(*limbs(gap))), contact=None)


def test_the_energy_is_that_of_either_side() -> None:
    problem = Collision().prepare(between(0.006))
    assert problem.second_contact is not None
    assert problem.second_contact.contact is not None
    middle = problem.state.pos * torch.tensor([1.0, 1.0, 0.0], dtype=F64)
    deep = [(2e-3 - 3e-3 + shift) for shift in (0.0015, -0.0015)]
    energy = Collision(reach="constant")(problem, middle + torch.tensor([0.0, 0.0, 0.0015], dtype=F64), middle)
    assert float(energy) == pytest.approx(len(middle) * 5e5 * sum(max(d, 0.0) ** 3 for d in deep), rel=1e-6)
    one = Collision(reach="constant", sides="nearest")(problem, middle + torch.tensor([0.0, 0.0, 0.0015], dtype=F64), middle)
    assert float(one) == 0.0  # the lower limb is nearest, and the sheet has left it


def test_cloth_between_two_limbs_does_not_pass_from_one_into_the_other() -> None:
    """A sheet flies 20 mm in a step, 10 mm before the limb that is not the nearest one."""
    deep = {}
    for sides in ("nearest", "both"):
        potential = default_potential(sides=sides)
        problem = potential.prepare(between(0.016, 0.6))
        pos, report = minimize(potential, problem, settings=NewtonSettings(target_rg=1e-3))
        assert bool(report.converged.all())
        deep[sides] = float((pos[:, 2] - 0.008).max())
    assert deep["both"] < 0.0
    assert deep["nearest"] > 8e-3


def test_networks_are_shown_both_sides() -> None:
    """What a vertex alone would do at the end of its flight: the limb ahead turns it back, as the solver's energy has it."""
    assert keeps_both_sides(for_networks(default_potential()))
    assert not keeps_both_sides(reference_potential())
    views = {}
    for sides in ("nearest", "both"):
        shown = for_networks(default_potential(sides=sides))
        exact = between(0.016, 0.6)
        problem = shown.prepare(in_single(exact, to_device(exact.cloth, dtype=torch.float32)))
        ahead = problem.state.pos + problem.vertex_dt * problem.state.vel
        for compiled in (False, True):
            views[sides, compiled] = local_terms(shown, problem, compiled)(ahead)
    for compiled in (False, True):
        assert float(views["both", compiled].force[:, 2].max()) < 0.0
        assert float(views["nearest", compiled].force[:, 2].abs().max()) < 0.1 * float(
            views["both", compiled].force[:, 2].abs().min()
        )
    torch.testing.assert_close(views["both", True].force, views["both", False].force, rtol=1e-3, atol=1e-6)
    torch.testing.assert_close(views["both", True].step, views["both", False].step, rtol=1e-3, atol=1e-7)


@pytest.mark.skipif(library() is None, reason="compares the compiled search with that of torch")
def test_the_compiled_search_finds_what_torch_does(body, monkeypatch: pytest.MonkeyPatch) -> None:
    """Around a body whose arms are bent: elbows, armpits, fingers."""
    motion = body_motion(body, load_sequence("dance_mixed", 30.0).window(38, 40), np.zeros(10), dtype=F64)
    surface = motion.obstacle(0, motion.translation[0])
    generator = torch.Generator().manual_seed(0)
    rows = torch.randint(len(surface.pos), (3000,), generator=generator)
    pos = surface.pos[rows] + 0.01 * torch.randn(3000, 3, generator=generator, dtype=F64)
    scene = torch.zeros(len(pos)).long()
    contact = find_contact(pos, scene, surface)
    compiled = find_second_contact(pos, scene, surface, contact).contact
    monkeypatch.setattr(tree, "search_folds", lambda *given: None)
    plain = find_second_contact(pos, scene, surface, contact).contact
    assert compiled is not None
    assert plain is not None
    assert int(plain.valid.sum()) > 50
    assert torch.equal(compiled.valid, plain.valid)
    for name in ("dist", "point", "normal", "next_point", "next_normal", "curvature"):
        one, other = (getattr(fold, name)[plain.valid] for fold in (compiled, plain))
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-12)


def test_nothing_folds_without_a_surface_or_without_cloth() -> None:
    body = obstacle(*limbs(0.01))
    pos, scene, contact = contact_at([[0.1, 0.0, 0.002]], body)
    empty = Obstacle(body.pos, body.pos, body.pos, body.faces[:0], body.vertex_scene, body.face_scene[:0])
    assert find_second_contact(pos, scene, empty, contact).contact is None
    assert find_second_contact(pos[:0], scene[:0], body, contact).contact is None
