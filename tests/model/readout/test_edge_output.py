"""Edges predicted, positions solved for: zero output is the base, everything turns with the world."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from small_simulators import make
from test_output import ball_problem
from torch import Tensor

from hood.cloth.state import Attachments
from hood.contact.sample_points import chord_error
from hood.energies.problem import StepProblem
from hood.model.graph.builder import MESH, Graph, build_graph, build_static
from hood.model.graph.hierarchy import build_hierarchy
from hood.model.readout.edges import EdgeOutput
from hood.model.readout.network_step import Dirichlet
from hood.scene.scene import Scene
from hood.steppers.checkpoint import load_simulator, save_simulator

STILL, TURN = np.eye(3), Rotation.from_rotvec([0.3, 1.2, -0.4]).as_matrix()


def graph_of(problem: StepProblem) -> Graph:
    cloth = problem.cloth
    hierarchy = build_hierarchy(cloth.num_vertices, cloth.edges.numpy(), cloth.rest_pos.numpy(), 0)
    return build_graph(build_static(cloth, hierarchy, [MESH]), replace(problem.step, obstacle=None))


def positions(problem: StepProblem, raw: Tensor, edge_raw: Tensor) -> Tensor:
    output, cloth = EdgeOutput(), problem.cloth
    held = Dirichlet(cloth.free, problem.state.pos)
    return output.positions(problem, graph_of(problem), output.base(problem), raw, edge_raw, held)


def draw(problem: StepProblem, size: float = 1.0) -> tuple[Tensor, Tensor]:
    num_rows = 2 * len(problem.cloth.edges)
    return size * torch.randn(problem.cloth.num_vertices, 5).double(), size * torch.randn(num_rows, 5).double()


def turned(problem: StepProblem) -> StepProblem:
    """The same step in a world that is turned."""
    contact, turn = problem.contact, torch.as_tensor(TURN)
    assert contact is not None
    fields = {name: getattr(contact, name) @ turn.T for name in ("point", "normal", "next_point", "next_normal")}
    state = replace(problem.state, pos=problem.state.pos @ turn.T, vel=problem.state.vel @ turn.T)
    return replace(problem, state=state, contact=replace(contact, **fields))


def test_zero_output_is_the_base() -> None:
    problem = ball_problem(TURN, np.array([0.01, 0.0, 0.0]))
    raw, edge_raw = draw(problem, 0.0)
    torch.testing.assert_close(positions(problem, raw, edge_raw), EdgeOutput().base(problem), rtol=0, atol=1e-12)


def test_what_is_predicted_turns_with_the_world() -> None:
    problem, turn = ball_problem(STILL, np.array([0.01, 0.0, 0.0])), torch.as_tensor(TURN)
    raw, edge_raw = draw(problem)
    there = positions(problem, raw, edge_raw)
    raw, edge_raw = (torch.cat([part[:, :3] @ turn.T, part[:, 3:]], dim=1) for part in (raw, edge_raw))
    assert float((there - problem.state.pos).norm(dim=1).max()) > 2e-3
    torch.testing.assert_close(positions(turned(problem), raw, edge_raw), there @ turn.T, rtol=0, atol=1e-9)


def vectors(problem: StepProblem, base: Tensor, edge_raw: Tensor) -> tuple[Tensor, Graph]:
    graph = graph_of(problem)
    edges = graph.edge_sets[MESH]
    return EdgeOutput().vectors(problem, graph, base[edges.receivers] - base[edges.senders], edge_raw), graph


def test_an_edge_is_the_same_from_both_ends() -> None:
    problem = ball_problem(STILL, np.zeros(3))
    found, graph = vectors(problem, problem.state.pos, draw(problem)[1])
    torch.testing.assert_close(found, -found[graph.edge_sets[MESH].reverse], rtol=0, atol=1e-12)


def test_lengths_are_shares_of_the_way_to_rest_and_do_not_ask_how_edges_turn() -> None:
    problem = ball_problem(STILL, np.zeros(3))
    edges = graph_of(problem).edge_sets[MESH]
    rest = (problem.cloth.rest_pos[edges.receivers] - problem.cloth.rest_pos[edges.senders]).norm(dim=1)
    raw = draw(problem, 3.0)[1]
    for share, stretch, expected in ((0.0, 0.0, 1.2), (1.0, 0.0, 1.0), (0.5, 0.0, 1.1), (0.0, 2.0, 1.22)):
        raw[:, 3], raw[:, 4] = share, stretch
        found, _ = vectors(problem, 1.2 * problem.state.pos, raw)
        torch.testing.assert_close(found.norm(dim=1), expected * rest, rtol=1e-9, atol=0)


def test_buttons_keep_their_length_and_hold_their_ends_together() -> None:
    """Where their two ends are at rest is a matter of how pieces were laid out."""
    problem = ball_problem(STILL, np.zeros(3))
    ends = torch.tensor([[0, 100]])
    step = replace(problem.step, attachments=Attachments(ends, torch.tensor([True])))
    problem = replace(problem, step=step)
    graph, start = graph_of(problem), 1.1 * problem.state.pos
    edges = graph.edge_sets[MESH]
    raw = torch.zeros(edges.num_edges, 5).double()
    raw[:, 3] = 1.0
    now = start[edges.receivers] - start[edges.senders]
    button = edges.source >= graph.num_mesh_edges
    found = EdgeOutput().vectors(problem, graph, now, raw)
    assert int(button.sum()) == 2
    assert torch.equal(found[button], now[button])
    assert bool((found[~button].norm(dim=1) < now[~button].norm(dim=1)).all())


def test_vertices_near_the_body_are_anchored_and_others_follow_inertia() -> None:
    output = EdgeOutput()
    near, far = ball_problem(STILL, np.zeros(3), gap=2e-3), ball_problem(STILL, np.zeros(3), gap=0.05)
    zero = torch.zeros(near.cloth.num_vertices, 2).double()
    inertia = 0.1 * near.cloth.mass * 30**2
    weight, firm = output.weights(far, far.state.pos, zero + 3.0)
    torch.testing.assert_close(weight, inertia * (far.cloth.mass / near.cloth.mass))
    assert firm is not None
    assert float(firm.weight.abs().max()) == 0
    along, firm = by_default = output.weights(near, near.state.pos, zero)
    assert firm is not None
    assert float(along.min()) > 1.5 > 3 * float(inertia.max())
    torch.testing.assert_close(along - inertia + firm.weight, 4 * (along - inertia))  # cloth slides
    assert firm.normal is near.contact.next_normal
    for column, (of_along, of_sum) in enumerate(((1.0, np.e), (np.e, 1.0))):
        raw = zero.clone()
        raw[:, column] = 1.0
        now, more = output.weights(near, near.state.pos, raw)
        assert more is not None
        torch.testing.assert_close(now - inertia, of_along * (along - inertia))
        torch.testing.assert_close(now - inertia + more.weight, of_sum * (by_default[0] - inertia + firm.weight))
    # Never held less towards the body than along it, and always held.
    for towards, across in ((-100.0, 100.0), (-100.0, -100.0), (100.0, 100.0)):
        now, more = output.weights(near, near.state.pos, torch.stack([zero[:, 0] + towards, zero[:, 1] + across], dim=1))
        assert more is not None
        assert float(now.min()) > 0
        assert float(more.weight.min()) >= 0


def test_the_body_holds_a_fine_mesh_no_tighter_than_a_coarse_one() -> None:
    """An anchor's strength goes with the area that its vertex stands for: a sheet of edges is as stiff in both."""
    found = []
    for rounds in (2, 3, 4):
        problem = ball_problem(STILL, np.zeros(3), gap=2e-3, rounds=rounds)
        output, cloth = EdgeOutput(), problem.cloth
        weight, firm = output.weights(problem, problem.state.pos, torch.zeros(cloth.num_vertices, 2).double())
        assert firm is not None
        held = weight - 0.1 * cloth.mass * 30**2
        found.append([float(part.sum()) for part in (held, firm.weight, output.held_back(problem, problem.state.pos))])
    for coarse, fine in zip(found, found[1:], strict=False):
        assert fine == pytest.approx(coarse, rel=0.05)


def test_cloth_is_taken_out_of_the_body() -> None:
    problem = ball_problem(STILL, np.zeros(3))
    raw, edge_raw = draw(problem, 0.0)
    contact = problem.contact
    assert contact is not None
    raw[:, :3] = -2.0 * contact.next_normal  # a centimetre into it
    found = positions(problem, raw, edge_raw)
    assert float(contact.next_dist(found).min()) > 1.69e-3


@pytest.mark.parametrize(("rounds", "share"), [(1, 1.0), (5, 0.45)])
def test_vertices_of_fine_meshes_are_pressed_less_deep(rounds: int, share: float) -> None:
    """Measured from where contact sets in, which is farther off the body for long edges."""
    problem, output = ball_problem(STILL, np.zeros(3), rounds=rounds), EdgeOutput()
    cloth, contact = problem.cloth, problem.contact
    assert contact is not None
    found = output.outside(problem, 0.9 * problem.state.pos)
    onset = output.clearance + chord_error(cloth, contact, problem.state.pos)
    edge = cloth.edge_length_sq.sqrt().clamp_max(17e-3)
    depth = onset - contact.next_dist(found)
    torch.testing.assert_close(depth, 3e-4 * edge / 17e-3, rtol=1e-6, atol=1e-12)
    assert float(depth.mean()) == pytest.approx(3e-4 * share, rel=0.2)


def test_a_model_file_names_its_output(tmp_path: Path, tank_scene: Scene) -> None:
    simulator = make("edges")
    save_simulator(tmp_path / "model.safetensors", simulator)
    again = load_simulator(tmp_path / "model.safetensors")
    assert again.config["output"] == "edges"
    assert isinstance(again.output, EdgeOutput)
    problem = StepProblem(tank_scene.cloth, tank_scene.start(0), tank_scene.step_input(0, tank_scene.start(0)))
    prepared = simulator.prepare(tank_scene.cloth, tank_scene.garment.rest_pos)
    with torch.no_grad():
        assert torch.equal(again.predict(problem, prepared).next_pos, simulator.predict(problem, prepared).next_pos)
