"""How far off contact holds the cloth: what flat triangles need to stay off a bulge."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth, concatenate_cloths
from hood.cloth.state import Obstacle, concatenate_obstacles
from hood.contact.contact import find_contact, find_fixed_contact
from hood.contact.sample_points import MOST_STRETCHED, chord_error, vertex_reach
from hood.energies.contact import Collision
from hood.energies.friction import Friction
from hood.energies.potential import coded_potential, default_potential, reference_potential
from hood.energies.problem import StepProblem
from hood.mesh.closest_point.search import build_incidence
from hood.mesh.penetration.crossing import crossings
from hood.scene.start import push_out_of_body, settle
from hood.solver.newton import NewtonSettings
from hood.steppers.newton import implicit_euler
from hood.testing import Mesh, cylinder, grid, make_problem, sphere

F64 = torch.float64


def body(mesh: Mesh, shift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Obstacle:
    pos, faces = (torch.as_tensor(part) for part in mesh)
    now = pos + torch.tensor(shift, dtype=F64)
    return Obstacle(now, now, now, faces, torch.zeros(len(pos)).long(), torch.zeros(len(faces)).long())


def sleeve(cells: int = 8, radius: float = 0.062) -> StepProblem:
    """A tube of long edges around a limb 120 mm thick, at rest."""
    cloth = build_cloth(*cylinder(cells, 5, radius, 0.15), Material(), dtype=F64)
    problem = make_problem(cloth)
    return replace(problem, step=replace(problem.step, obstacle=body(limb())))


def limb() -> Mesh:
    """A tube that looks outward, longer than the sleeve on both sides."""
    pos, faces = cylinder(48, 24, 0.06, 0.4)
    axis = int(np.ptp(pos, axis=0).argmax())
    pos[:, axis] -= 0.12
    corners = pos[faces[0]]
    across = np.where(np.arange(3) == axis, 0.0, corners.mean(axis=0))
    outward = np.cross(corners[1] - corners[0], corners[2] - corners[0]) @ across > 0
    return pos, faces if outward else faces[:, ::-1].copy()


def cut(problem: StepProblem, pos: torch.Tensor) -> int:
    obstacle = problem.step.obstacle
    assert obstacle is not None
    return len(crossings(pos.numpy(), problem.cloth.faces.numpy(), obstacle.pos.numpy(), obstacle.faces.numpy()).pairs)


def test_sag_is_that_of_a_chord_with_a_margin() -> None:
    """Edges of length L between points of a circle of radius r chord error by r − √(r² − L²/4)."""
    problem = sleeve().with_contact()
    assert problem.contact is not None
    length_sq, radius = problem.cloth.edge_length_sq, 0.06
    chord = radius - (radius**2 - length_sq / 4.0).sqrt()
    found = chord_error(problem.cloth, problem.contact, problem.state.pos)
    assert float((found / chord).min()) > 1.0
    assert float((found / chord).max()) < 1.7
    assert float(found.max()) <= 8e-3


def test_stretched_cloth_is_held_off_as_its_present_triangles_need() -> None:
    """Edges twice as long as at rest chord error four times as far; what ordinary strain adds is within the margin."""
    problem = sleeve().with_contact()
    contact, cloth = problem.contact, problem.cloth
    assert contact is not None
    at_rest = chord_error(cloth, contact, cloth.rest_pos)
    assert torch.equal(chord_error(cloth, contact, 1.1 * cloth.rest_pos), at_rest)
    assert torch.equal(chord_error(cloth, contact, 0.5 * cloth.rest_pos), at_rest)
    stretched = chord_error(cloth, contact, 1.5 * cloth.rest_pos)
    assert float((stretched / at_rest).min()) > 1.9  # 1.5² less a quarter more of even edges
    assert float((stretched - at_rest).max()) <= MOST_STRETCHED
    alone = cloth.rest_pos.clone()
    alone[0] += 0.05 * torch.tensor([0.0, 1.0, 0.0])  # one vertex is pulled away: its neighbours have one long edge each
    near = torch.unique(cloth.edges[(cloth.edges == 0).any(dim=1)])
    changed = (chord_error(cloth, contact, alone) != at_rest).nonzero().squeeze(1)
    assert set(changed.tolist()) <= set(near.tolist())
    assert len(changed) > 2


def test_constant_reach_is_the_same_everywhere_and_curvature_adds_the_sag() -> None:
    problem = sleeve().with_contact()
    contact, cloth, pos = problem.contact, problem.cloth, problem.state.pos
    assert contact is not None
    even, bent = (vertex_reach(form, 2e-3, cloth, contact, pos) for form in ("constant", "curvature"))
    assert torch.equal(even, torch.full_like(even, 2e-3))
    torch.testing.assert_close(bent - even, chord_error(cloth, contact, pos))
    flat = find_contact(cloth.rest_pos, cloth.vertex_scene, body(grid(5, 5, 2.0), (-1.0, -0.2, -1.0)))
    assert torch.equal(vertex_reach("curvature", 2e-3, cloth, flat, pos), even)


def test_collision_friction_and_walls_read_the_same_reach() -> None:
    potential = default_potential()
    problem = potential.prepare(sleeve())
    contact, collision, friction = problem.contact, potential.terms["collision"], potential.terms["friction"]
    assert contact is not None
    assert isinstance(collision, Collision)
    assert isinstance(friction, Friction)
    depth = collision.reaches(problem, contact) - contact.dist
    assert int((depth > 0).sum()) == problem.cloth.num_vertices  # 2 mm off: outside a constant reach
    torch.testing.assert_close(collision.depth(problem, contact, problem.state.pos)[0], depth, rtol=0, atol=5e-5)
    assert torch.equal(collision.walls(problem, contact).reach, collision.reaches(problem, contact))
    assert float(friction.normal_force(problem, contact).min()) > 0
    for other in (default_potential(reach="constant"), reference_potential(), coded_potential()):
        term = other.terms["collision"]
        assert isinstance(term, Collision)
        assert torch.equal(term.reaches(problem, contact), torch.full_like(contact.dist, 2e-3))
        assert isinstance(term.with_weight(1.0), Collision)
        assert term.with_weight(1.0).reach == "constant"


def test_the_search_of_fixed_shapes_finds_the_same_curvature() -> None:
    problem = sleeve()
    cloth, obstacle = problem.cloth, problem.step.obstacle
    assert obstacle is not None
    incidence = build_incidence(obstacle.faces, len(obstacle.pos))
    fixed, _ = find_fixed_contact(cloth.rest_pos, cloth.vertex_scene, obstacle, incidence, 1, 0)
    torch.testing.assert_close(fixed.curvature, find_contact(cloth.rest_pos, cloth.vertex_scene, obstacle).curvature)


def test_scenes_of_a_batch_keep_their_own() -> None:
    first, second = sleeve(), sleeve(6, 0.065)
    balls = [part.step.obstacle for part in (first, second)]
    cloth = concatenate_cloths([first.cloth, second.cloth])
    both = find_contact(cloth.rest_pos, cloth.vertex_scene, concatenate_obstacles([ball for ball in balls if ball is not None]))
    rests = [problem.cloth.rest_pos for problem in (first, second)]
    alone = [
        chord_error(p.cloth, find_contact(p.cloth.rest_pos, p.cloth.vertex_scene, p.step.obstacle), p.cloth.rest_pos)
        for p in (first, second)
    ]  # type: ignore[arg-type]
    torch.testing.assert_close(chord_error(cloth, both, torch.cat(rests)), torch.cat(alone))


@pytest.mark.parametrize("form", ["curvature", "constant"])
def test_a_tight_sleeve_is_cut_only_with_a_constant_reach(form: str) -> None:
    """Long edges lie across the limb; counted by a check that shares nothing with contact or solver."""
    problem = sleeve(8, 0.060)
    for taken in implicit_euler(default_potential(reach=form), problem, 8, NewtonSettings(target_rg=1e-3)):
        assert taken.report.converged.all()
    pairs = cut(problem, taken.state.pos)
    assert pairs == 0 if form == "curvature" else pairs > 50


def test_a_start_keeps_the_triangles_out_as_well() -> None:
    problem = sleeve(8, 0.055)
    for leave in (push_out_of_body, settle):
        pos = leave(problem.cloth, problem.state.pos, problem.step.obstacle, 2e-3)
        assert cut(problem, pos) == 0


def test_another_reach_is_refused() -> None:
    for kind in (Collision, Friction):
        with pytest.raises(ValueError, match="reach is 'far'; choose curvature, constant"):
            kind(reach="far")


def test_a_ball_is_held_off_by_its_own_curvature() -> None:
    pos, faces = grid(5, 5, 0.16)
    cloth = build_cloth(pos, faces, Material(), dtype=F64)
    ball = body(sphere(4, 0.1), (0.08, -0.1, 0.08))
    contact = find_contact(cloth.rest_pos, cloth.vertex_scene, ball)
    expected = 1.5 / 8.0 * cloth.edge_length_sq / 0.1
    torch.testing.assert_close(chord_error(cloth, contact, cloth.rest_pos), expected, rtol=0.1, atol=0)


def test_a_body_that_has_moved_has_another_curvature() -> None:
    """Also where its positions are written over."""
    pos, faces = sphere(3, 0.1)
    none = torch.zeros(len(pos), dtype=torch.long)
    place = torch.as_tensor(pos).clone()
    own = torch.zeros(len(faces), dtype=torch.long)
    obstacle = Obstacle(place, place, place, torch.as_tensor(faces), none, own, none.bool())
    above = torch.tensor([[0.0, 0.0, 0.25]], dtype=place.dtype)
    scene = torch.zeros(1, dtype=torch.long)
    small = float(find_contact(above, scene, obstacle, cap=1.0).curvature)
    assert float(find_contact(above, scene, obstacle, cap=1.0).curvature) == small
    place.mul_(2.0)
    assert float(find_contact(above, scene, obstacle, cap=1.0).curvature) == pytest.approx(0.5 * small, rel=0.02)
