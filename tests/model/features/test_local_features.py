"""What models that correct themselves see of the potential."""

from dataclasses import replace

import pytest
import torch

from hood.contact.contact import find_contact
from hood.model.features.inputs import Inputs
from hood.model.features.local import GLOBAL_LOOK_WIDTHS, LOOK_WIDTHS, local, look_local
from hood.model.graph.builder import build_graph, build_static
from hood.model.graph.hierarchy import build_hierarchy
from hood.scene.scene import Scene


def make_inputs(scene: Scene) -> Inputs:
    """A garment at the body with made-up views of the potential."""
    state = scene.start(2)
    step, cloth = scene.step_input(2, state), scene.cloth
    contact = find_contact(state.pos, cloth.vertex_scene, step.obstacle)
    hierarchy = build_hierarchy(cloth.num_vertices, cloth.edges.numpy(), scene.garment.rest_pos, 1)
    graph = build_graph(build_static(cloth, hierarchy, ("mesh", "coarse0")), step, contact.nearest)
    torch.manual_seed(0)
    residual, wide = torch.randn_like(state.pos), torch.randn(len(state.pos), 6)
    base = state.pos + 1e-3
    return Inputs(cloth, state, step, contact, graph, base, residual, 1e-4 * torch.randn_like(base), wide)


def test_widths_are_those_promised(band_scene: Scene) -> None:
    inputs, features = make_inputs(band_scene), local(2)
    nodes, _ = features(inputs)
    assert nodes.shape[1] == features.node_width
    for group in features.node:
        assert group(inputs).shape[1] == group.width
    nodes, edges = look_local(inputs, ("mesh",))
    assert nodes.shape == (inputs.num_cloth, LOOK_WIDTHS[0])
    assert list(edges) == ["mesh"]
    assert edges["mesh"].shape == (inputs.graph.edge_sets["mesh"].num_edges, LOOK_WIDTHS[1])


def test_global_steps_are_seen_where_there_are_any(band_scene: Scene) -> None:
    inputs, features = make_inputs(band_scene), local(2, together=True)
    step = 1e-3 * torch.randn_like(inputs.base)
    seen = replace(inputs, global_step=step)
    nodes, _ = look_local(seen, ())
    plain, _ = look_local(inputs, ())
    assert nodes.shape[1] == GLOBAL_LOOK_WIDTHS[0]
    assert torch.equal(nodes[:, : LOOK_WIDTHS[0]], plain)
    assert torch.allclose(nodes[:, LOOK_WIDTHS[0] : -1], (step / 1e-3).asinh())
    assert torch.allclose(nodes[:, -1], (step.norm(dim=1) / 1e-3).asinh())
    assert features(seen)[0].shape[1] == features.node_width
    with pytest.raises(ValueError, match="global_step"):
        features(inputs)


def test_strain_is_read_at_the_prediction(band_scene: Scene) -> None:
    inputs = make_inputs(band_scene)
    stretched = replace(inputs, base_pos=1.1 * inputs.cloth.rest_pos)
    assert torch.allclose(look_local(stretched, ("mesh", "coarse0"))[1]["coarse0"], torch.tensor(10.0).asinh(), atol=1e-3)
    assert torch.allclose(look_local(stretched, ("mesh",))[1]["mesh"], torch.tensor(10.0).asinh(), atol=1e-3)


def test_views_that_are_missing_are_asked_for(band_scene: Scene) -> None:
    inputs = replace(make_inputs(band_scene), local_step=None)
    with pytest.raises(ValueError, match="local_step"):
        look_local(inputs, ("mesh",))
