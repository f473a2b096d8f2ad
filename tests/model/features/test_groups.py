"""Widths, order and values of the feature sets, on two triangles by hand."""

from dataclasses import replace

import pytest
import torch

from hood.assets.material import RANGES, Material
from hood.cloth.cloth import build_cloth, concatenate_cloths
from hood.cloth.state import Obstacle, State, StepInput, concatenate_obstacles, concatenate_states
from hood.contact.contact import Contact
from hood.model.features import feature_set, groups, local, physical
from hood.model.features.inputs import Inputs
from hood.model.graph.builder import build_graph, build_static
from hood.model.graph.hierarchy import Hierarchy, concatenate_hierarchies
from hood.testing import assert_feature_group_contract, concatenate_contacts

DT = 1 / 30
REST = torch.tensor([[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1.0]], dtype=torch.float64)
FABRIC = Material(
    lame_mu=RANGES["lame_mu"][1], lame_lambda=RANGES["lame_lambda"][0], bending_stiffness=RANGES["bending_stiffness"][1]
)


def make_inputs(base: bool = True, shift: float = 0.0, dt: float = DT) -> Inputs:
    """Two triangles in a square of 1 m, vertex 3 pinned, vertex 0 raised by 0.1 m and 2 cm above body vertex 1."""
    cloth = build_cloth(REST.numpy(), [[0, 2, 1], [0, 3, 2]], FABRIC, torch.arange(4) == 3, dtype=torch.float64)
    pos = REST.clone()
    pos[0, 1] = 0.1
    vel = torch.zeros(4, 3, dtype=torch.float64)
    vel[1, 2] = 3.0
    body = torch.tensor([[9, 9, 9], [0, 0.08, 0], [0, 0.08, 1], [1, 0.08, 0.0]], dtype=torch.float64)
    zero = torch.zeros(4, dtype=torch.int64)
    obstacle = Obstacle(
        body + shift, body + shift + 0.01, body + shift - 0.02, torch.tensor([[1, 2, 3]]), zero, zero[:1], zero.bool()
    )
    dist = torch.tensor([0.02, 1, 1, 1], dtype=torch.float64)
    up = torch.tensor([0.0, 1, 0], dtype=torch.float64).expand(4, 3)
    point = pos + shift - dist.unsqueeze(1) * up
    contact = Contact(
        vertex=torch.tensor([1, 0, 0, 0]), vertex_dist=dist, face=zero, bary=up, dist=dist, valid=dist < 0.1,
        point=point, normal=up, next_point=point + 0.01, next_normal=up, curvature=torch.zeros(4, dtype=torch.float64),
    )  # fmt: skip
    step = StepInput(torch.tensor([dt], dtype=torch.float64), obstacle)
    state = State(pos + shift, vel, torch.zeros(1, 3, dtype=torch.float64))
    hierarchy = Hierarchy((torch.tensor([[0, 2]]),), torch.tensor([1, 0, 1, 0]))
    graph = build_graph(build_static(cloth, hierarchy, ("mesh", "coarse0")), step, contact.nearest)
    return Inputs(cloth, state, step, contact, graph, pos + shift + 0.05 if base else None)


def test_widths_are_the_papers():
    assert (feature_set.paper(3).node_width, feature_set.paper(1).node_width) == (24, 20)
    assert feature_set.paper().edge_widths == {"mesh": 12, "coarse": 12, "body": 9}
    normalizers = (
        feature_set.paper().node_normalizer,
        feature_set.paper().edge_normalizer,
        feature_set.paper().body_edge_normalizer,
    )
    assert [n.width for n in normalizers] == [21, 9, 9]
    embeddings = sum(p.numel() for p in feature_set.paper(3).parameters())
    assert embeddings == 9 * 9 + 3 * 4


@pytest.mark.parametrize("make", [feature_set.paper, physical.physical])
def test_features_have_the_widths_they_promise(make):
    features, inputs = make(2).double(), make_inputs()
    nodes, edges = features(inputs)
    assert nodes.shape == (5, features.node_width)
    widths = features.edge_widths
    for name, table in edges.items():
        width = widths["coarse" if name.startswith("coarse") else name]
        assert table.shape == (inputs.graph.edge_sets[name].num_edges, width)
    for group in (*features.node, *features.edge, *features.body_edge):
        assert group(inputs).shape[1] == group.width
    assert all(torch.isfinite(t).all() for t in (nodes, *edges.values()))


def test_node_features_of_the_paper_by_hand():
    features, inputs = feature_set.paper(2).double().eval(), make_inputs()
    nodes, _ = features(inputs)  # identity normaliser: no statistics yet
    types, levels = features.node[1].table.weight, features.node[2].table.weight
    assert nodes[1, :3].tolist() == pytest.approx([0, 0, 0.1])
    assert nodes[4, :3].tolist() == pytest.approx([0.02] * 3)  # body: now − before
    for node, kind in enumerate([0, 0, 0, 3, 1]):
        assert torch.equal(nodes[node, 3:12], types[kind])
    for node, level in enumerate([1, 0, 1, 0, 0]):
        assert torch.equal(nodes[node, 12:16], levels[level])
    assert nodes[4, 16:19].tolist() == pytest.approx([0, 1, 0])
    assert nodes[:, 19].tolist() == pytest.approx([DT] * 5)
    mass = 0.20022 / 6
    log_mass = torch.tensor([2 * mass, mass, 2 * mass, mass]).log().tolist()
    assert nodes[:, 20].tolist() == pytest.approx([*log_mass, -1], rel=1e-6)
    assert nodes[0, 21:].tolist() == pytest.approx([1, 1, 0])  # bending, μ at their upper ends, λ at its lower end
    assert nodes[4, 21:].tolist() == [-1, -1, -1]


def test_body_velocity_can_be_the_next_displacement():
    nodes, _ = feature_set.paper(1, body_velocity="next").double().eval()(make_inputs())
    assert nodes[4, :3].tolist() == pytest.approx([0.01] * 3)
    with pytest.raises(ValueError, match="'previous' or 'next'"):
        feature_set.paper(body_velocity="later")


def test_edge_features_of_the_paper_by_hand():
    inputs = make_inputs()
    _, edges = feature_set.paper(2).double().eval()(inputs)
    mesh = inputs.graph.edge_sets["mesh"]
    row = next(i for i in range(mesh.num_edges) if (mesh.senders[i], mesh.receivers[i]) == (1, 0))
    norm = (1 + 0.1**2) ** 0.5
    assert edges["mesh"][row].tolist() == pytest.approx([1, -0.1, 0, norm, 1, 0, 0, 1, DT, 1, 1, 0])
    back = edges["mesh"][mesh.reverse[row]]
    assert back[:3].tolist() == pytest.approx([-1, 0.1, 0])
    assert edges["coarse0"][0, 4:8].tolist() == pytest.approx([1, 0, 1, 2**0.5])
    to_cloth, to_body = edges["body"]  # rows sorted by receiver: cloth vertex 0 first
    current, following = [0, -0.02, 0, 0.02], [0.01, -0.01, 0.01, 3**0.5 * 0.01]
    assert to_cloth.tolist() == pytest.approx([*current, *following, DT])
    assert to_body[:3].tolist() == pytest.approx([0, 0.02, 0])


def test_relaxing_step_is_told_by_the_timestep_feature_alone():
    inputs = replace(make_inputs(), timestep=torch.tensor([1 / 3], dtype=torch.float64))
    nodes, edges = feature_set.paper(2).double().eval()(inputs)
    assert nodes[1, 2].item() == pytest.approx(0.1)  # displacement of the true dt
    assert nodes[:, 19].tolist() == pytest.approx([1 / 3] * 5)
    assert edges["mesh"][:, 8].unique().item() == pytest.approx(1 / 3)


def test_physical_features_by_hand():
    inputs = make_inputs()
    nodes, edges = physical.physical(2)(inputs)
    expected = torch.asinh(torch.tensor([-5.0, -5.0, 5.0]))  # (0, 0, 0.1) − 0.05 over 1 cm
    assert nodes[1, :3].tolist() == pytest.approx(expected.tolist())
    assert nodes[4, :3].tolist() == pytest.approx(torch.asinh(torch.tensor([-1.0] * 3)).tolist())
    assert nodes[0, 14:18].tolist() == pytest.approx([2.5, 0, 1, 0])  # 0.06 m, clamped to 0.05
    assert nodes[1, 14:18].tolist() == pytest.approx([2.5, 0, 0, 0])  # out of reach
    assert nodes[0, 19:22].tolist() == pytest.approx([1, 1, -1])
    mesh = inputs.graph.edge_sets["mesh"]
    row = next(i for i in range(mesh.num_edges) if (mesh.senders[i], mesh.receivers[i]) == (1, 0))
    mean = (4 + 2**0.5) / 5
    strain = torch.asinh(torch.tensor(100 * ((1 + 0.1**2) ** 0.5 - 1))).item()
    assert edges["mesh"][row, :4].tolist() == pytest.approx([1 / mean, -0.1 / mean, 0, (1.01**0.5) / mean])
    assert edges["mesh"][row, 8:10].tolist() == pytest.approx([strain, strain])
    assert edges["body"][0, :3].tolist() == pytest.approx([-4, -6, -4])


def test_physical_features_need_a_base():
    with pytest.raises(ValueError, match="base_pos"):
        physical.physical(2)(make_inputs(base=False))


@pytest.mark.parametrize("features", [feature_set.paper(2).double().eval(), physical.physical(2)])
def test_features_do_not_depend_on_where_the_scene_is(features):
    here, there = features(make_inputs()), features(make_inputs(shift=3.0))
    torch.testing.assert_close(there[0], here[0], atol=1e-10, rtol=0)
    for name in here[1]:
        torch.testing.assert_close(there[1][name], here[1][name], atol=1e-10, rtol=0)


@pytest.mark.parametrize("features", [feature_set.paper(2).double().eval(), physical.physical(2)])
def test_batch_equals_singles(features):
    single, other = make_inputs(), make_inputs(shift=1.0, dt=1 / 60)
    items = [single, other]
    cloth = concatenate_cloths([i.cloth for i in items])
    obstacle = concatenate_obstacles([i.step.obstacle for i in items])
    contact = concatenate_contacts([i.contact for i in items])
    contact = replace(contact, vertex=contact.vertex + 4 * (torch.arange(8) // 4))
    hierarchy = Hierarchy((torch.tensor([[0, 2]]),), torch.tensor([1, 0, 1, 0]))
    step = StepInput(torch.cat([i.step.dt for i in items]), obstacle)
    static = build_static(cloth, concatenate_hierarchies([hierarchy] * 2, [4, 4]), ("mesh", "coarse0"))
    graph = build_graph(static, step, contact.nearest)
    state = concatenate_states([i.state for i in items])
    nodes, edges = features(Inputs(cloth, state, step, contact, graph, torch.cat([i.base_pos for i in items])))
    alone = [features(i) for i in items]
    expected = torch.cat([n[:4] for n, _ in alone] + [n[4:] for n, _ in alone])
    torch.testing.assert_close(nodes, expected)
    torch.testing.assert_close(edges["mesh"], torch.cat([e["mesh"] for _, e in alone]))
    torch.testing.assert_close(edges["coarse0"], torch.cat([e["coarse0"] for _, e in alone]))


def test_massless_and_unbending_cloth_has_finite_features():
    inputs = make_inputs()
    fabric = inputs.cloth.vertex_fabric.clone()
    fabric[:, 2] = 0.0
    mass = inputs.cloth.mass.clone()
    mass[1] = 0.0
    inputs = replace(inputs, cloth=replace(inputs.cloth, vertex_fabric=fabric, edge_fabric=fabric[[0] * 5], mass=mass))
    for features in (feature_set.paper(2).double(), physical.physical(2)):
        nodes, edges = features(inputs)
        assert all(torch.isfinite(t).all() for t in (nodes, *edges.values()))


def test_unnormalised_groups_come_last():
    with pytest.raises(ValueError, match="move the latter to the end"):
        feature_set.FeatureSet([groups.NodeMaterial(), groups.Normal()], [groups.EdgeTimestep()], [groups.BodyTimestep()])


EVERY_GROUP = [
    group
    for features in (feature_set.paper(2, layers=True), physical.physical(2, layers=True), local.local(2, together=True))
    for rows in (features.node, features.edge, features.body_edge, features.layer_edge)
    for group in rows
]


@pytest.mark.parametrize("group", EVERY_GROUP, ids=lambda group: type(group).__name__)
def test_every_group_meets_the_contract(group):
    assert_feature_group_contract(group)


def test_the_contract_notices_what_a_group_promises_and_does_not_keep():
    class Place(groups.NodeGroup):
        width = 3

        def cloth(self, inputs):
            return inputs.state.pos

        def body(self, inputs):
            return inputs.body(inputs.obstacle.pos)

    with pytest.raises(AssertionError, match="Place: differs by 3 "):
        assert_feature_group_contract(Place())
    Place.width = 2
    with pytest.raises(AssertionError, match="Place: .* instead of"):
        assert_feature_group_contract(Place())


def test_rest_lengths_are_those_of_the_flat_pattern() -> None:
    plain = make_inputs()
    edges = plain.edges
    faces = plain.cloth.faces.numpy()
    same, longer = (size * REST.numpy()[faces][..., [0, 2]] for size in (1.0, 1.25))
    lengths = {}
    for name, flat in (("none", None), ("same", same), ("longer", longer)):
        cloth = build_cloth(REST.numpy(), faces, FABRIC, torch.arange(4) == 3, dtype=torch.float64, flat=flat)
        inputs = replace(plain, cloth=cloth)
        strain = physical.Strain(gain=1.0)
        lengths[name] = groups.RestRelative()(inputs), strain(inputs)[:, 0], local._strain(inputs, "mesh"), inputs.rest
    assert torch.equal(lengths["none"][3], REST[edges.senders] - REST[edges.receivers])
    for one, other in zip(lengths["none"], lengths["same"], strict=True):
        assert torch.allclose(one, other)
    mesh = plain.graph.edge_sets["mesh"].num_edges
    grown, before = lengths["longer"], lengths["none"]
    factor = torch.where(torch.arange(len(edges.senders)) < mesh, 1.25, 1.0).unsqueeze(1)  # coarse edges are no threads
    assert mesh < len(edges.senders)
    assert torch.allclose(grown[0], factor * before[0])
    assert torch.allclose(torch.sinh(grown[1]) + 1.0, (torch.sinh(before[1]) + 1.0) / factor[:, 0])
    assert torch.allclose((torch.sinh(grown[2]) / 100.0 + 1.0) * 1.25, torch.sinh(before[2]) / 100.0 + 1.0)
