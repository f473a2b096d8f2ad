"""What a step in float32 must not depend on: names of vertices, partners in a batch, the place in the world."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.assets.material import Material
from hood.assets.motion.sequence import PoseSequence
from hood.cloth.cloth import Cloth, build_cloth, concatenate_cloths
from hood.cloth.state import Obstacle, State, StepInput, concatenate_states, concatenate_step_inputs
from hood.contact.contact import find_contact
from hood.energies.problem import StepProblem
from hood.model.graph.builder import build_static
from hood.model.graph.hierarchy import Hierarchy, build_hierarchy
from hood.scene.scene import build_scene
from hood.steppers.network import NetworkStepper, Prepared, build_simulator
from hood.testing import cylinder, grid, sphere, strip

SCHEDULES = ["fine15", "ours"]
Mesh = tuple[np.ndarray, np.ndarray]


def shifted(mesh: Mesh, *shift: float) -> Mesh:
    return mesh[0] + np.array(shift), mesh[1]


# Around a ball of radius 0.3 at the origin, or lying on it.
TUBE = shifted(cylinder(30, 16, 0.31, 0.3), 0.0, -0.15, 0.0)
SHEET = shifted(grid(20, 21, 0.3), -0.15, 0.3, -0.15)
STRIP = shifted(strip(2, 0.1, 0.05), 0.0, 0.31, 0.0)
TRIANGLE = np.array([[0.0, 0.31, 0], [0.05, 0.31, 0], [0, 0.31, 0.05]]), np.array([[0, 2, 1]])


def make(schedule: str) -> NetworkStepper:
    """A network of the paper's width with random weights."""
    torch.manual_seed(0)
    return build_simulator(schedule=schedule).eval()


def make_case(mesh: Mesh, order: np.ndarray | None = None) -> tuple[Cloth, State, StepInput]:
    """A moving, crumpled garment at the ball; ``order`` numbers its vertices anew."""
    pos, faces = mesh
    order = np.arange(len(pos)) if order is None else order
    cloth = build_cloth(pos[order], np.argsort(order)[faces], Material())
    rest = torch.as_tensor(pos)
    moved = rest + 0.005 * torch.sin(40 * rest.flip(1))
    velocity = torch.cos(9 * rest)
    body, body_faces = (torch.as_tensor(x) for x in sphere(3, 0.3))
    index = [torch.zeros(n, dtype=torch.int64) for n in (len(body), len(body_faces))]
    obstacle = Obstacle(body.float(), body.float(), body.float(), body_faces, *index, index[0].bool())
    state = State(moved[order].float(), velocity[order].float(), torch.zeros(1, 3, dtype=torch.float64))
    return cloth, state, StepInput(torch.full((1,), 1 / 30), obstacle)


@torch.no_grad()
def accelerations(simulator: NetworkStepper, cloth: Cloth, prepared: Prepared, state: State, step: StepInput) -> Tensor:
    contact = find_contact(state.pos, cloth.vertex_scene, step.obstacle)
    assert bool((contact.vertex_dist < simulator.body_radius).any()), "no body edge"
    problem = StepProblem(cloth, state, step, contact, simulator.gravity)
    return simulator.predict(problem, prepared).acc.double()


def assert_equal_to_rounding(value: Tensor, reference: Tensor) -> None:
    assert float((value - reference).abs().max() / reference.square().mean().sqrt()) < 1e-5


@pytest.mark.parametrize("schedule", SCHEDULES)
@pytest.mark.parametrize("hierarchy", ["rebuilt", "carried along"])
def test_permuted_vertices_give_permuted_accelerations(schedule: str, hierarchy: str) -> None:
    mesh, simulator = TUBE, make(schedule)
    order = np.random.default_rng(0).permutation(len(mesh[0]))
    cloth, state, step = make_case(mesh)
    prepared = simulator.prepare(cloth, cloth.rest_pos.numpy())
    expected = accelerations(simulator, cloth, prepared, state, step)[torch.as_tensor(order)]
    cloth, state, step = make_case(mesh, order)
    if hierarchy == "rebuilt":
        levels = build_hierarchy(len(order), cloth.edges.numpy(), cloth.rest_pos.numpy(), simulator.num_coarse)
    else:
        new = torch.as_tensor(np.argsort(order))
        old = prepared.hierarchy
        levels = Hierarchy(tuple(new[edges] for edges in old.coarse_edges), old.node_level[torch.as_tensor(order)])
    static = build_static(cloth, levels, simulator.network.edge_set_names)
    assert_equal_to_rounding(accelerations(simulator, cloth, Prepared(levels, static), state, step), expected)


@pytest.mark.parametrize("schedule", SCHEDULES)
@pytest.mark.parametrize("partner", [STRIP, SHEET], ids=["small", "large"])
def test_partners_in_a_batch_change_nothing(schedule: str, partner: Mesh) -> None:
    simulator = make(schedule)
    cases = [make_case(partner), make_case(TUBE), make_case(partner)]
    counts = [cloth.num_vertices for cloth, _, _ in cases]
    prepared = [simulator.prepare(cloth, cloth.rest_pos.numpy()) for cloth, _, _ in cases]
    cloth = concatenate_cloths([c for c, _, _ in cases])
    state, step = concatenate_states([s for _, s, _ in cases]), concatenate_step_inputs([s for _, _, s in cases], counts)
    together = accelerations(simulator, cloth, simulator.concatenate(cloth, prepared, counts), state, step)
    alone = accelerations(simulator, cases[1][0], prepared[1], *cases[1][1:])
    assert_equal_to_rounding(together[counts[0] : counts[0] + counts[1]], alone)


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_ten_kilometres_away_the_step_is_the_same(
    schedule: str, body: Body, garments: dict[str, Garment], walk: PoseSequence
) -> None:
    near, shift = walk.window(60, 63), np.array([1e4, 0.0, -1e4])
    simulator, results = make(schedule), []
    for sequence in (near, replace(near, transl=near.transl + shift)):
        scene = build_scene(garments["tank"], body, sequence)
        state = scene.start(0)
        prepared = simulator.prepare(scene.cloth, scene.garment.rest_pos)
        with torch.no_grad():
            after = simulator.step(scene.cloth, prepared, state, scene.step_input(0, state))
        results.append(after.pos.double() + after.origin)
    moved = results[1] - torch.as_tensor(shift)
    assert float((results[0] - results[0].mean(dim=0)).abs().max()) > 0.1
    assert float((moved - results[0]).abs().max()) < 1e-4


@pytest.mark.parametrize("schedule", ["ours", "1x(mesh) 1x(coarse3+coarse4)", "2x(coarse1)"])
@pytest.mark.parametrize("mesh", [TRIANGLE, STRIP, shifted(grid(3, 3, 0.1), 0.0, 0.31, 0.0)], ids=["1", "2", "8"])
def test_meshes_too_small_for_their_levels(mesh: Mesh, schedule: str) -> None:
    simulator = make(schedule)
    cloth, state, step = make_case(mesh)
    prepared = simulator.prepare(cloth, cloth.rest_pos.numpy())
    assert any(len(edges) == 0 for edges in prepared.hierarchy.coarse_edges)
    assert torch.isfinite(accelerations(simulator, cloth, prepared, state, step)).all()
    problem = StepProblem(cloth, state, step, find_contact(state.pos, cloth.vertex_scene, step.obstacle), simulator.gravity)
    simulator.predict(problem, prepared).acc.sum().backward()
