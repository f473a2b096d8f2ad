"""The loop around the step: a cheating network must replay a trajectory; starts, metrics, attachments."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.assets.motion.sequence import PoseSequence
from hood.cloth.state import Attachments
from hood.contact import contact
from hood.energies.potential import default_potential
from hood.model.graph.builder import MESH, Graph
from hood.rollouts.file.reader import read_rollout
from hood.rollouts.frame import METRIC_CHOICES, Frame, metric_names
from hood.rollouts.loop import simulate, start_state
from hood.scene.scene import Scene, build_scene
from hood.steppers.network import NetworkStepper, build_simulator
from tests.verdict.table.scene import run
from tests.verdict.table.scenes import SECOND

POTENTIAL = default_potential()
DT = 1 / 30


class Cheat(nn.Module):
    """Stands in for the network: raw output of step k is ``answer(k)``; the graphs it is shown are kept."""

    def __init__(self, network: nn.Module, answer: Callable[[int, Graph], Tensor]) -> None:
        super().__init__()
        self.schedule, self.edge_set_names = network.schedule, network.edge_set_names
        self.answer, self.graphs = answer, []

    def forward(self, graph: Graph, nodes: Tensor, edges: Mapping[str, Tensor]) -> Tensor:
        self.graphs.append(graph)
        return self.answer(len(self.graphs) - 1, graph).to(nodes)


def cheating(answer: Callable[[int, Graph], Tensor], dtype: torch.dtype = torch.float32) -> NetworkStepper:
    """The paper's features and output; without statistics its raw output is the displacement per frame² [m]."""
    simulator = build_simulator("paper", "acceleration", "1x(mesh)", latent_dim=4).to(dtype).eval()
    simulator.network = Cheat(simulator.network, answer)
    return simulator


def zeros(step: int, graph: Graph) -> Tensor:
    return torch.zeros(graph.num_cloth, 3)


def small(seed: int = 0) -> NetworkStepper:
    torch.manual_seed(seed)
    return build_simulator("physical", "velocity_base", "1x(mesh+coarse0)", latent_dim=8, output_init=0.1).eval()


@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, 2e-5), (torch.float64, 1e-10)])
def test_true_accelerations_replay_the_trajectory(
    dtype: torch.dtype, tolerance: float, garments: dict[str, Garment], body: Body, walk: PoseSequence
) -> None:
    """A trajectory that walks 6 m away, so that the local frame moves with it."""
    scene = build_scene(garments["tank"], body, walk.window(60, 72), dtype=dtype)
    start = start_state(cheating(zeros, dtype), scene, POTENTIAL, relaxing_steps=0)
    world = [start.pos.double() + start.origin]
    wave = torch.sin(40 * world[0][:, [1, 2, 0]])
    for frame in range(1, 12):
        drift = torch.tensor([0.5 * frame, 0.02 * frame, -0.03 * frame**2]).double()
        world.append(world[0] + drift + 0.01 * np.sin(frame) * wave)
    vel = [start.vel.double()] + [(after - before) / DT for before, after in zip(world, world[1:], strict=False)]
    true = [world[k + 1] - world[k] - DT * vel[k] for k in range(11)]
    simulator = cheating(lambda step, graph: true[step], dtype)
    frames = list(simulate(simulator, scene, POTENTIAL, relaxing_steps=0))
    assert len(frames) == 12
    for frame in frames:
        assert float((frame.world_pos - world[frame.index]).abs().max()) < tolerance
        assert float(frame.state.pos.abs().max()) < 2.0
    assert float(frames[-1].state.origin.norm()) > 5.0


def test_zero_output_moves_on_with_the_start_velocity(tank_scene: Scene) -> None:
    frames = list(simulate(cheating(zeros), tank_scene, POTENTIAL, 6, relaxing_steps=0))
    velocity = tank_scene.start_velocity(0).double()
    for frame in frames:
        expected = frames[0].world_pos + frame.index * DT * velocity
        torch.testing.assert_close(frame.world_pos, expected, rtol=0, atol=1e-6)


def test_gravity_as_output_is_free_fall(tank_scene: Scene) -> None:
    """Implicit Euler: after n steps the cloth has fallen g dt² n (n + 1) / 2."""
    fall = torch.tensor([0.0, -9.81 * DT**2, 0.0])
    simulator = cheating(lambda step, graph: fall.expand(graph.num_cloth, 3))
    frames = list(simulate(simulator, tank_scene, POTENTIAL, 5, relaxing_steps=0))
    velocity = tank_scene.start_velocity(0).double()
    for n, frame in enumerate(frames):
        expected = frames[0].world_pos + n * DT * velocity + fall.double() * n * (n + 1) / 2
        torch.testing.assert_close(frame.world_pos, expected, rtol=0, atol=1e-5)


def test_frame_zero_is_fit_to_start_from(garments: dict[str, Garment], body: Body, walk: PoseSequence) -> None:
    """Whatever the network says: the relaxing step is kept only where it helps."""
    wild = cheating(lambda step, graph: 0.3 * torch.sin(torch.arange(3 * graph.num_cloth)).reshape(-1, 3))
    for name in ("tshirt", "trousers"):
        scene = build_scene(garments[name], body, walk.window(0, 3))
        first = next(simulate(wild, scene, POTENTIAL))
        assert first.index == 0
        assert first.metrics["penetration_count"] == 0
        assert first.metrics["strain_p99"] <= 0.15


def test_relaxing_lowers_the_potential_of_its_problem(tank_scene: Scene) -> None:
    """Half the way down the residual is a good answer and must be taken."""
    simulator = small()
    settled = start_state(simulator, tank_scene, POTENTIAL, 0)
    chord_error = torch.tensor([0.0, -2e-4, 0.0])
    helpful = cheating(lambda step, graph: chord_error.expand(graph.num_cloth, 3))
    relaxed = start_state(helpful, tank_scene, POTENTIAL, 1)
    assert not torch.equal(relaxed.pos, settled.pos)
    torch.testing.assert_close(relaxed.vel, settled.vel)


def test_relaxing_takes_no_cloth_through_a_thin_plate(tmp_path: Path) -> None:
    """A free sheet 5 cm above a plate of 3 mm would fall by a metre in the relaxing step, between its vertices."""
    scene = SECOND["blade_through_sheet"]
    assert run(replace(scene, frames=1), tmp_path)[1] in (0, 3)
    data = read_rollout(tmp_path / "rollout.h5")
    assert data.cloth_pos[0][:, 1].min() > data.body_pos[0][:, 1].max()


@pytest.fixture(scope="module")
def rollout(skirt_scene: Scene) -> list[Frame]:
    return list(simulate(small(), skirt_scene, POTENTIAL, 8))


def test_metrics_are_finite_and_named(rollout: list[Frame]) -> None:
    assert [frame.index for frame in rollout] == list(range(8))
    for frame in rollout:
        assert set(frame.metrics) <= set(metric_names(POTENTIAL, small()))
        assert all(np.isfinite(value) for value in frame.metrics.values())
        assert frame.world_pos.dtype == frame.body_pos.dtype == torch.float64
    assert "energy_total" not in rollout[0].metrics
    last = rollout[-1].metrics
    assert last["energy_total"] == pytest.approx(sum(last.get(f"energy_{name}", 0.0) for name in POTENTIAL.terms))
    assert last["e0"] > 0
    assert last["relative_gradient"] > 0


@pytest.fixture
def surface_searches(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Number of points of every search for contact with the body's surface so far."""
    calls: list[int] = []
    search = contact.match_surface

    def counted(points: Tensor, *rest: object, **named: object) -> object:
        calls.append(len(points))
        return search(points, *rest, **named)

    monkeypatch.setattr(contact, "match_surface", counted)
    return calls


def of_paper() -> NetworkStepper:
    torch.manual_seed(0)
    return build_simulator("paper", "acceleration", "1x(mesh)", latent_dim=4, output_init=0.01).eval()


@pytest.mark.parametrize(
    "metrics, make, expected",
    [("none", of_paper, 0), ("strain", of_paper, 0), ("all", of_paper, 3), ("none", small, 2), ("all", small, 3)],
)
def test_the_surface_is_searched_where_somebody_asks_for_it_and_once_a_step(
    metrics: str, make: Callable[[], NetworkStepper], expected: int, tank_scene: Scene, surface_searches: list[int]
) -> None:
    """After frame 0: metrics of contact ask at frames 1, 2, 3, a model that needs it at the two that a step follows."""
    frames = simulate(make(), tank_scene, POTENTIAL, 4, relaxing_steps=0, metrics=metrics)
    positions = [next(frames).world_pos]
    surface_searches.clear()
    positions += [frame.world_pos for frame in frames]
    assert len(surface_searches) == expected
    reference = [frame.world_pos for frame in simulate(make(), tank_scene, POTENTIAL, 4, relaxing_steps=0)]
    assert all(torch.equal(*pair) for pair in zip(positions, reference, strict=True))


@pytest.mark.parametrize("metrics", METRIC_CHOICES)
def test_frames_hold_the_metrics_asked_for(metrics: str, tank_scene: Scene) -> None:
    simulator = of_paper()
    last = list(simulate(simulator, tank_scene, POTENTIAL, 3, metrics=metrics))[-1].metrics
    assert set(last) <= set(metric_names(POTENTIAL, simulator, metrics))
    assert ("strain_p50" in last) == (metrics != "none")
    assert ("penetration_depth" in last) == ("energy_total" in last) == (metrics == "all")
    parts = sum(last[f"ms_{part}"] for part in ("search", "features", "network", "rest"))
    assert last["ms_total"] == pytest.approx(parts)
    assert last["ms_metrics"] >= 0


def test_unknown_metrics_are_refused(tank_scene: Scene) -> None:
    with pytest.raises(ValueError, match="metrics is 'some'; choose all, strain, none"):
        list(simulate(of_paper(), tank_scene, POTENTIAL, 2, metrics="some"))


def test_pins_follow_the_body_over_the_rollout(rollout: list[Frame], skirt_scene: Scene) -> None:
    pinned = skirt_scene.cloth.pinned
    for frame in rollout[1:]:
        origin = np.zeros(3)
        skinned = skirt_scene.motion.skinned(skirt_scene.garment, frame.index, origin).double()
        assert float((frame.world_pos - skinned)[pinned].abs().max()) < 1e-6


def test_body_positions_are_the_motions(rollout: list[Frame], skirt_scene: Scene) -> None:
    motion = skirt_scene.motion
    for frame in rollout[::3]:
        expected = motion.local_surface(frame.index).double() + torch.as_tensor(motion.translation[frame.index])
        assert float((frame.body_pos - expected).abs().max()) < 1e-6


def test_the_motions_end_is_the_rollouts(tank_scene: Scene) -> None:
    assert len(list(simulate(cheating(zeros), tank_scene, POTENTIAL, 100))) == tank_scene.num_frames
    late = list(simulate(cheating(zeros), tank_scene, POTENTIAL, start_frame=9))
    assert [frame.index for frame in late] == [0, 1, 2]
    torch.testing.assert_close(
        late[-1].body_pos.mean(dim=0),
        tank_scene.motion.local_surface(11).double().mean(dim=0) + torch.as_tensor(tank_scene.motion.translation[11]),
        rtol=0,
        atol=1e-6,
    )


def test_the_same_rollout_twice(skirt_scene: Scene, rollout: list[Frame]) -> None:
    again = list(simulate(small(), skirt_scene, POTENTIAL, 4))
    for first, second in zip(rollout, again, strict=False):
        assert torch.equal(first.world_pos, second.world_pos)


def test_attachments_reach_the_graph_while_they_are_closed(tank_scene: Scene) -> None:
    simulator = cheating(zeros)
    last = tank_scene.cloth.num_vertices - 1
    button = torch.tensor([[0, last]])

    def schedule(index: int) -> Attachments:
        return Attachments(button, torch.tensor([index != 1]))

    list(simulate(simulator, tank_scene, POTENTIAL, 4, relaxing_steps=0, attachments=schedule))
    rows = [graph.edge_sets[MESH].num_edges for graph in simulator.network.graphs]
    plain = 2 * len(tank_scene.cloth.edges)
    assert rows == [plain + 2, plain, plain + 2]
    edges = simulator.network.graphs[0].edge_sets[MESH]
    assert bool(((edges.senders == 0) & (edges.receivers == last)).any())


def test_attachments_pull_in_the_potential(tank_scene: Scene) -> None:
    button = Attachments(torch.tensor([[0, tank_scene.cloth.num_vertices - 1]]), torch.tensor([True]))
    plain, closed = (
        list(simulate(cheating(zeros), tank_scene, POTENTIAL, 2, attachments=lambda index, a=a: a))[1].metrics
        for a in (None, button)
    )
    assert plain.get("energy_attachment", 0.0) == 0.0
    assert closed["energy_attachment"] > 0.0


def test_a_rollout_goes_on_over_broken_frames(tank_scene: Scene) -> None:
    def broken(step: int, graph: Graph) -> Tensor:
        return torch.full((graph.num_cloth, 3), float("nan") if step == 1 else 0.0)

    frames = list(simulate(cheating(broken), tank_scene, POTENTIAL, 5, relaxing_steps=0))
    assert [bool(torch.isfinite(f.world_pos).all()) for f in frames] == [True, True, False, False, False]
    assert all(bool(torch.isfinite(f.body_pos).all()) for f in frames)
    assert np.isnan(frames[2].metrics["strain_p99"])
