"""Columns by the compiled library against those of the groups in torch."""

from dataclasses import replace

import pytest
import torch
from test_local_features import make_inputs
from torch import Tensor

from hood.cloth.state import State
from hood.model.features import compiled, feature_set, physical
from hood.model.features.feature_set import FeatureSet
from hood.model.features.inputs import Inputs
from hood.model.features.local import local, look_local
from hood.native import features as native
from hood.scene.scene import Scene

needs_compiler = pytest.mark.skipif(native.library() is None, reason="no C++ compiler")
SCENES = ["band_scene", "tank_scene"]


def moving_inputs(scene: Scene) -> Inputs:
    """The same with velocities and rough positions."""
    inputs = make_inputs(scene)
    wave = torch.sin(40 * inputs.state.pos.flip(1))
    state = State(inputs.state.pos + 2e-3 * wave, wave, inputs.state.origin)
    return replace(inputs, state=state, base_pos=inputs.base + 1e-3 * wave)


def assert_close(found: Tensor, expected: Tensor) -> None:
    """Rounding of float32, on numbers whose differences are taken of positions of half a metre."""
    assert found.shape == expected.shape
    assert found.dtype == expected.dtype
    torch.testing.assert_close(found, expected, rtol=3e-6, atol=3e-5)


@torch.no_grad()
def both(features: FeatureSet, inputs: Inputs) -> None:
    assert compiled.applies(inputs)
    nodes, edges = features(inputs, compiled.COMPILED_COLUMNS)
    expected_nodes, expected_edges = features(inputs)
    assert_close(nodes, expected_nodes)
    assert list(edges) == list(expected_edges)
    for name, expected in expected_edges.items():
        assert_close(edges[name], expected)


@needs_compiler
@pytest.mark.parametrize("name", SCENES)
def test_columns_are_those_of_torch(name: str, request: pytest.FixtureRequest) -> None:
    inputs = moving_inputs(request.getfixturevalue(name))
    both(local(2), inputs)
    both(physical.physical(3), inputs)
    both(feature_set.paper(3).eval(), inputs)  # groups that the library does not know


@needs_compiler
def test_columns_of_a_cloth_are_not_those_of_another(band_scene: Scene, tank_scene: Scene) -> None:
    features = local(2)
    for scene in (band_scene, tank_scene, band_scene):
        both(features, moving_inputs(scene))
    inputs = moving_inputs(band_scene)
    heavier = replace(inputs.cloth, mass=3 * inputs.cloth.mass, pinned=~inputs.cloth.pinned)
    both(features, replace(inputs, cloth=heavier))


@needs_compiler
def test_a_step_without_a_body_and_without_contact(band_scene: Scene) -> None:
    inputs = moving_inputs(band_scene)
    both(local(2), replace(inputs, contact=None))
    free = feature_set.BODY
    empty = {key: value[:0] for key, value in vars(inputs.body_edges).items() if isinstance(value, Tensor)}
    sets = {**inputs.graph.edge_sets, free: replace(inputs.body_edges, **empty)}
    graph = replace(inputs.graph, edge_sets=sets, body_vertex=inputs.graph.body_vertex[:0])
    both(local(2), replace(inputs, graph=graph, contact=None, step=replace(inputs.step, obstacle=None)))


@needs_compiler
def test_another_timestep_is_told(band_scene: Scene) -> None:
    inputs = moving_inputs(band_scene)
    both(local(2), replace(inputs, timestep=torch.tensor([1 / 3])))


@needs_compiler
@pytest.mark.parametrize("name", SCENES)
@torch.no_grad()
def test_what_is_seen_between_passes_is_what_torch_sees(name: str, request: pytest.FixtureRequest) -> None:
    inputs = moving_inputs(request.getfixturevalue(name))
    nodes, edges = compiled.look(inputs, ("mesh", "coarse0"))
    expected_nodes, expected_edges = look_local(inputs, ("mesh", "coarse0"))
    assert_close(nodes, expected_nodes)
    for name, expected in expected_edges.items():
        torch.testing.assert_close(edges[name], expected, rtol=3e-6, atol=3e-4)  # a hundred times the strain


@needs_compiler
@torch.no_grad()
def test_the_same_bits_in_every_run(band_scene: Scene) -> None:
    inputs, features = moving_inputs(band_scene), local(2)
    (first, edges), (second, again) = (features(inputs, compiled.COMPILED_COLUMNS) for _ in range(2))
    assert torch.equal(first, second)
    assert all(torch.equal(edges[name], again[name]) for name in edges)


@needs_compiler
def test_large_and_undefined_numbers_are_what_torch_makes_of_them() -> None:
    values = torch.tensor([0.0, 1e-38, -1e-7, 1e-3, -0.5, 1.0, 30.0, -1e6, 1e18, 1e19, 3e38, torch.inf, -torch.inf, torch.nan])
    values = torch.cat([values, torch.logspace(-12, 12, 500), -torch.logspace(-3, 3, 301)])
    found = torch.empty_like(values)
    native.call("asinh", values, len(values), 1, 1.0, found, 1)
    torch.testing.assert_close(found, torch.asinh(values), rtol=4e-7, atol=0.0, equal_nan=True)


def test_gradients_and_other_numbers_go_to_torch(band_scene: Scene) -> None:
    inputs = moving_inputs(band_scene)
    assert not compiled.applies(inputs)  # a gradient may be asked for
    with torch.no_grad():
        assert compiled.applies(inputs) == (native.library() is not None)
        assert not compiled.applies(replace(inputs, base_pos=inputs.base.double()))
        with native.in_torch():
            assert not compiled.applies(inputs)
        with native.in_torch(False):
            assert compiled.applies(inputs) == (native.library() is not None)
