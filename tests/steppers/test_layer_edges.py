"""Models with edges between layers of cloth: without near layers they are models without, and near layers feel each other."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import Cloth, build_cloth, concatenate_cloths
from hood.energies.problem import StepProblem
from hood.evaluation.table import measured_radius
from hood.model.graph.builder import LAYERS
from hood.model.kernels.block import check_kernels
from hood.steppers.checkpoint import load_simulator, save_simulator
from hood.steppers.network import NetworkStepper, Prepared, build_simulator
from hood.steppers.static_shapes.simulator import CapturedSimulator
from hood.tensors.batch import to_device
from hood.testing import grid, make_problem

RADIUS = 0.03
KINDS = {
    "paper": {"features": "paper", "output": "acceleration", "schedule": "1x(mesh+coarse0) 1x(coarse0)"},
    "physical": {"features": "physical", "output": "velocity_base", "schedule": "1x(mesh+coarse0) 1x(coarse0)"},
    "local": {"features": "local", "output": "local_steps", "schedule": "1x(mesh+coarse0) | 1x(mesh)"},
}


def make(kind: str, layer_radius: float | None = RADIUS, width: int = 16) -> NetworkStepper:
    torch.manual_seed(0)
    return build_simulator(**KINDS[kind], latent_dim=width, output_init=0.5, layer_radius=layer_radius).eval()


def without(simulator: NetworkStepper) -> NetworkStepper:
    """The same weights in a model that knows no layers."""
    config = {name: value for name, value in simulator.config.items() if name != "layer_radius"}
    other = build_simulator(**config).eval()
    weights = simulator.state_dict()
    width = simulator.network.latent_dim
    for name, value in other.state_dict().items():
        known = weights[name]
        if known.shape != value.shape:  # the node networks' columns for what comes from layers are the last
            assert known.shape[1] == value.shape[1] + width
            known = known[:, : value.shape[1]]
        value.copy_(known)
    return other


def sheets(gap: float = 0.01, n: int = 9, seed: int = 0, dtype: torch.dtype = torch.float32) -> StepProblem:
    """A sheet over another one."""
    pos, faces = grid(n, n, 0.2)
    both = np.concatenate([faces, faces + len(pos)])
    cloth = build_cloth(np.concatenate([pos, pos]), both, Material(), dtype=dtype)
    noise = 1e-3 * np.random.default_rng(seed).normal(size=cloth.rest_pos.shape)
    return make_problem(cloth, np.concatenate([pos, pos + [0.005, gap, 0.003]]) + noise, vel=30 * noise)


def step(simulator: NetworkStepper, problem: StepProblem) -> torch.Tensor:
    """Next positions (V, 3)."""
    prepared = simulator.prepare(problem.cloth, problem.cloth.rest_pos.cpu().numpy())
    with torch.no_grad():
        return simulator.predict(problem, prepared).next_pos


def num_layer_edges(simulator: NetworkStepper, problem: StepProblem) -> int:
    """Pairs of vertices of two layers that a step has edges between."""
    pairs = simulator.near_cloth(problem)
    assert pairs is not None
    return len(pairs)


@pytest.mark.parametrize("kernels", ["torch", "compiled", "fused"])
@pytest.mark.parametrize("kind", KINDS)
def test_without_layers_near_each_other_a_step_is_that_of_a_model_without(kind: str, kernels: str) -> None:
    with_layers, apart, near = make(kind), sheets(gap=0.05), sheets()
    plain = without(with_layers)
    try:
        check_kernels(kernels, "fp32", 16)
    except ValueError as error:
        pytest.skip(str(error))
    for simulator in (with_layers, plain):
        simulator.network.use_kernels(kernels)
    assert num_layer_edges(with_layers, apart) == 0
    assert torch.equal(step(with_layers, apart), step(plain, apart))
    assert num_layer_edges(with_layers, near) > 100
    assert not torch.allclose(step(with_layers, near), step(plain, near), atol=1e-6)


@pytest.mark.parametrize("kernels", ["compiled", "fused"])
def test_kernels_compute_the_same_function(kernels: str) -> None:
    simulator, problem = make("local", width=32), sheets()
    by_torch = step(simulator, problem)
    try:
        simulator.network.use_kernels(kernels)
    except ValueError as error:
        pytest.skip(str(error))
    torch.testing.assert_close(step(simulator, problem), by_torch, rtol=0, atol=2e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_layers_feel_each_other(kind: str) -> None:
    """What lies on one sheet changes the other, which shares no edge with it."""
    simulator, problem = make(kind), sheets()
    moved = problem.state.pos.clone()
    moved[100, 1] += 0.004
    other = replace(problem, state=replace(problem.state, pos=moved))
    with_layers = (step(simulator, other) - step(simulator, problem))[:81].abs().max()
    plain = without(simulator)
    assert float(with_layers) > 1e-6
    assert float((step(plain, other) - step(plain, problem))[:81].abs().max()) == 0


@pytest.mark.parametrize("kind", KINDS)
def test_a_shift_of_the_scene_shifts_the_step(kind: str) -> None:
    simulator, problem = make(kind).double(), sheets(dtype=torch.float64)
    shift = torch.tensor([0.3, -0.2, 0.7], dtype=torch.float64)
    there = replace(problem, state=replace(problem.state, pos=problem.state.pos + shift))
    torch.testing.assert_close(step(simulator, there), step(simulator, problem) + shift, rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_names_of_vertices_do_not_matter(kind: str) -> None:
    simulator, problem = make(kind).double(), sheets(dtype=torch.float64)
    cloth = problem.cloth
    order = torch.randperm(cloth.num_vertices, generator=torch.Generator().manual_seed(3))
    number = torch.argsort(order)
    other = build_cloth(cloth.rest_pos[order].numpy(), number[cloth.faces].numpy(), Material(), dtype=torch.float64)
    renamed = make_problem(other, problem.state.pos[order], problem.state.vel[order])
    torch.testing.assert_close(step(simulator, renamed), step(simulator, problem)[order], rtol=0, atol=1e-9)


def together(simulator: NetworkStepper, problems: list[StepProblem]) -> tuple[StepProblem, Prepared]:
    cloths = [problem.cloth for problem in problems]
    batch: Cloth = concatenate_cloths(cloths)
    prepared = [simulator.prepare(cloth, cloth.rest_pos.numpy()) for cloth in cloths]
    joined = make_problem(
        batch,
        torch.cat([problem.state.pos for problem in problems]),
        torch.cat([problem.state.vel for problem in problems]),
    )
    return joined, simulator.concatenate(batch, prepared, [cloth.num_vertices for cloth in cloths])


@pytest.mark.parametrize("kind", KINDS)
def test_a_batch_is_its_scenes(kind: str) -> None:
    simulator = make(kind).double()
    problems = [sheets(0.01, seed=1, dtype=torch.float64), sheets(0.05, 7, 2, torch.float64), sheets(0.02, 6, 3, torch.float64)]
    joined, prepared = together(simulator, problems)
    with torch.no_grad():
        batch = simulator.predict(joined, prepared).next_pos
    alone = torch.cat([step(simulator, problem) for problem in problems])
    torch.testing.assert_close(batch, alone, rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_reach_the_weights_of_layers(kind: str) -> None:
    simulator, problem = make(kind).train(), sheets()
    prepared = simulator.prepare(problem.cloth, problem.cloth.rest_pos.numpy())
    for _ in range(2):  # statistics first
        prediction = simulator.predict(problem, prepared)
    (prediction.next_pos.square().sum() + sum(pos.square().sum() for pos, _ in prediction.early)).backward()
    named = [value for name, value in simulator.network.named_parameters() if f".{LAYERS}." in name]
    assert len(named) >= 10
    reached = [value.grad is not None and float(value.grad.abs().max()) > 0 for value in named]
    assert sum(reached) > 0.8 * len(reached)


def test_weights_are_kept_and_models_without_say_nothing_of_it(tmp_path: Path) -> None:
    simulator, problem = make("local"), sheets()
    save_simulator(tmp_path / "model.safetensors", simulator)
    again = load_simulator(tmp_path / "model.safetensors")
    assert again.layer_radius == RADIUS
    assert torch.equal(step(again, problem), step(simulator, problem))
    assert torch.equal(step(simulator.clone().eval(), problem), step(simulator, problem))
    plain = make("local", None)
    assert "layer_radius" not in plain.config
    assert not any(LAYERS in name for name in plain.state_dict())
    with pytest.raises(ValueError, match="layer_radius"):
        make("local", 0.0)


def test_steps_of_fixed_shapes_refuse_it() -> None:
    with pytest.raises(ValueError, match=r"edges between layers of cloth \(model.layer_radius=0.03\).*use step=plain"):
        CapturedSimulator(make("physical"), "fixed")


def test_the_radius_of_propagation_is_that_of_the_mesh() -> None:
    assert measured_radius(make("physical")) == measured_radius(make("physical", None))


@pytest.mark.gpu
@pytest.mark.parametrize("kind", KINDS)
def test_the_same_on_a_gpu(kind: str) -> None:
    simulator, problem = make(kind).double(), sheets(dtype=torch.float64)
    here = step(simulator, problem)
    there = replace(
        problem, cloth=to_device(problem.cloth, "cuda"), state=to_device(problem.state, "cuda"),
        step=to_device(problem.step, "cuda"), gravity=problem.gravity.cuda(),
    )  # fmt: skip
    torch.testing.assert_close(step(simulator.cuda(), there).cpu(), here, rtol=0, atol=1e-8)
