"""The network in bfloat16: how far it is off, and what stays in float32."""

import copy

import pytest
import torch
from torch import Tensor

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.cloth.state import Obstacle, StepInput
from hood.contact.contact import Contact
from hood.energies.potential import default_potential
from hood.energies.problem import StepProblem
from hood.model.graph.builder import Graph, build_graph, build_static
from hood.model.graph.hierarchy import build_hierarchy
from hood.model.network.mlp import Layers
from hood.model.network.model import MeshGraphNet
from hood.scene.scene import Scene
from hood.steppers.network import build_simulator
from hood.tensors import dense
from hood.testing import grid, plane_contact

WIDTHS = {"mesh": 12, "coarse": 12, "body": 9}


def make(schedule: str, side: int = 24) -> tuple[MeshGraphNet, Graph, Tensor, dict[str, Tensor]]:
    """A network of the paper's width, a sheet of which every second vertex touches a body, random features."""
    torch.manual_seed(0)
    network = MeshGraphNet(20, WIDTHS, 128, schedule)
    cloth = build_cloth(*grid(side, side), Material())
    hierarchy = build_hierarchy(cloth.num_vertices, cloth.edges.numpy(), cloth.rest_pos.numpy(), 2)
    index, body, scene = torch.arange(cloth.num_vertices), torch.zeros(90, 3), torch.zeros(90, dtype=torch.int64)
    obstacle = Obstacle(body, body, body, torch.zeros(0, 3, dtype=torch.int64), scene, scene[:0], scene.bool())
    plane = vars(plane_contact(torch.zeros(len(index), 3)))
    contact = Contact(**{**plane, "vertex": index % 90, "vertex_dist": torch.where(index % 2 == 0, 0.01, 1.0)})
    static = build_static(cloth, hierarchy, network.edge_set_names)
    graph = build_graph(static, StepInput(torch.full((1,), 1 / 30), obstacle), contact)
    edges = {name: torch.randn(s.num_edges, WIDTHS.get(name, 12)) for name, s in graph.edge_sets.items()}
    return network, graph, torch.randn(graph.num_nodes, 20), edges


def relative(value: Tensor, reference: Tensor) -> float:
    return float((value - reference).norm() / reference.norm())


@pytest.mark.parametrize("schedule", ["fine15", "ours"])
def test_accelerations_are_off_by_less_than_three_halves_of_a_percent(schedule):
    network, *inputs = make(schedule)
    with torch.no_grad():
        reference = network(*inputs)
        network.use_precision("bf16")
        low = network(*inputs)
    assert low.dtype == torch.float32
    assert 1e-5 < relative(low, reference) < 0.015


@pytest.mark.parametrize("schedule", ["fine15", "ours"])
def test_gradients_are_float32_and_off_by_less_than_five_percent(schedule):
    network, *inputs = make(schedule, 16)
    gradients = []
    for precision in ("fp32", "bf16"):
        network.use_precision(precision)
        network.zero_grad()
        network(*inputs).square().mean().backward()
        assert all(p.grad is not None and p.grad.dtype == torch.float32 for p in network.parameters())
        gradients.append(torch.cat([p.grad.flatten() for p in network.parameters()]))
    assert 1e-5 < relative(gradients[1], gradients[0]) < 0.05
    assert all(p.dtype == torch.float32 for p in network.parameters())


def test_training_and_inference_agree_in_bf16():
    network, *inputs = make("2x(mesh+coarse0)", 16)
    network.use_precision("bf16")
    with torch.no_grad():
        quiet = network(*inputs)
    torch.testing.assert_close(quiet, network(*inputs), rtol=0, atol=0)


def test_statistics_of_layer_norms_are_float32():
    network, *_ = make("1x(mesh)", 4)
    layers = Layers(torch.bfloat16, 1e-5, network.node_encoder.tail_parameters())
    out, kept = layers.forward(torch.rand(40, 128).bfloat16())
    assert (out.dtype, kept.mean.dtype, kept.rstd.dtype) == (torch.bfloat16, torch.float32, torch.float32)


@pytest.mark.parametrize("precision, tolerance", [("fp32", 1e-5), ("bf16", 0.015)])
def test_the_plain_products_give_the_same(precision, tolerance, monkeypatch):
    """What a CPU without bfloat16 instructions or another torch would compute."""
    network, *inputs = make("3x(mesh+coarse0)", 16)
    with torch.no_grad():
        reference = network(*inputs)
        network.use_precision(precision)
        monkeypatch.setattr(dense, "_kernel", lambda device, dtype: None)
        plain = network(*inputs)
    assert relative(plain, reference) < tolerance


def test_features_positions_and_energies_stay_in_float32(tank_scene: Scene):
    torch.manual_seed(0)
    simulator = build_simulator(schedule="1x(mesh+coarse0)", latent_dim=16).eval()
    state = tank_scene.start(0)
    step, cloth = tank_scene.step_input(0, state), tank_scene.cloth
    prepared = simulator.prepare(cloth, tank_scene.garment.rest_pos)
    problem = default_potential().prepare(StepProblem(cloth, state, step, gravity=simulator.gravity))
    reference = simulator.predict(problem, prepared)
    simulator.network.use_precision("bf16")
    seen: list[Tensor] = []
    simulator.network.register_forward_pre_hook(lambda module, inputs: seen.extend([inputs[1], *inputs[2].values()]))
    prediction = simulator.predict(problem, prepared)
    assert {x.dtype for x in seen} == {torch.float32}
    assert prediction.next_pos.dtype == prediction.acc.dtype == torch.float32
    assert not torch.equal(prediction.next_pos, reference.next_pos)
    gradient, energies = default_potential().gradient(problem, prediction.next_pos.detach(), prediction.acc.detach())
    assert {x.dtype for x in (gradient, *energies.values())} <= {torch.float32, torch.float64}


def test_a_copy_computes_as_its_original():
    simulator = build_simulator(schedule="1x(mesh)", latent_dim=8)
    simulator.network.use_precision("bf16")
    assert simulator.clone().network.precision == "bf16"
    assert copy.deepcopy(simulator).network.precision == "bf16"


def test_unknown_precisions_are_refused():
    with pytest.raises(ValueError, match="precision is 'fp8'; choose fp32, bf16 or tf32"):
        make("1x(mesh)", 4)[0].use_precision("fp8")
