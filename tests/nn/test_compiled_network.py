"""Inference in one call per pass against the network by torch's operations in float64."""

import copy

import pytest
import torch
from test_model import SHORT, WIDTHS, Case, make_case, make_graph
from torch import Tensor

from hood.native.build import BuildError
from hood.nn import compiled_network
from hood.nn.compiled import check_kernels
from hood.nn.model import MeshGraphNet
from hood.testing import grid


def reason() -> str:
    """Why this machine cannot have it; empty where it can."""
    try:
        check_kernels("fused", "fp32", 48)
    except ValueError as error:
        return str(error)
    return ""


REASON = reason()
needs_compiler = pytest.mark.skipif(bool(REASON), reason=REASON)
PASSES = "1x(mesh+coarse0) | 1x(coarse0+coarse1) 1x(mesh+coarse0) | 1x(mesh)"


def make(schedule: str, width: int = 48, **options) -> MeshGraphNet:
    torch.manual_seed(0)
    network = MeshGraphNet(5, WIDTHS, width, schedule, **options)
    for parameter in network.parameters():
        if parameter.dim() == 1:  # biases, and what the layer norms begin with: 0 and 1
            torch.nn.init.normal_(parameter)
    return network


def single(case: Case) -> Case:
    return Case(case.graph, case.nodes.float(), {name: value.float() for name, value in case.edges.items()})


def looker(case: Case, network: MeshGraphNet):
    """What is seen between passes: sines of what came out."""

    def look(index: int, raw: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        ends = {name: case.graph.edge_sets[name] for name in network.pass_sets(index + 1)}
        edges = {name: raw[e.senders, :1] - raw[e.receivers, 1:2] for name, e in ends.items()}
        return torch.sin(raw), edges

    return look


def evaluate(network: MeshGraphNet, case: Case, compiled: bool) -> Tensor:
    look = looker(case, network) if len(network.passes) > 1 else None
    with torch.no_grad():
        if compiled:
            weights = compiled_network.weights_for(network, case.nodes)
            assert weights is not None
            return compiled_network.infer(network, weights, case.graph, case.nodes, case.edges, look)[0]
        return network(case.graph, case.nodes, case.edges, look)


def difference(network: MeshGraphNet, case: Case) -> float:
    """Largest error of the compiled output over the largest number in it."""
    exact = evaluate(copy.deepcopy(network).double(), case, compiled=False)
    found = evaluate(network, single(case), compiled=True)
    return float((found - exact).abs().max() / exact.abs().max())


@needs_compiler
@pytest.mark.parametrize("width", [16, 32, 48, 64, 80, 128])
def test_outputs_are_those_of_torch_to_rounding(width):
    assert difference(make(SHORT, width), make_case(make_graph(grid(14, 14)))) < 3e-6


@needs_compiler
@pytest.mark.parametrize(
    "schedule, options",
    [
        (PASSES, {"look_widths": (5, 1), "out_width": 5}),
        (SHORT, {"aggregation": "mean"}),
        (SHORT, {"coarse_encoders": 1}),
        ("2x(coarse1)", {}),
    ],
)
def test_every_kind_of_network(schedule, options):
    assert difference(make(schedule, **options), make_case(make_graph(grid(14, 14)))) < 3e-6


@needs_compiler
def test_a_graph_without_body_edges_and_one_with_a_single_body_node():
    free = make_graph(grid(6, 6))
    for name, subset in list(free.body_subsets.items()):
        empty = {key: value[:0] for key, value in vars(subset.edges).items() if isinstance(value, Tensor)}
        edges = type(subset.edges)(**{**empty, "offsets": subset.edges.offsets[:1]})
        free.body_subsets[name] = type(subset)(edges, None)
    free.edge_sets["body"] = free.body_subsets[0].edges
    assert difference(make(SHORT), make_case(free)) < 3e-6
    crowded = make_graph(grid(14, 14), vertex=torch.zeros(14 * 14, dtype=torch.int64))
    assert difference(make(SHORT), make_case(crowded)) < 3e-6


@needs_compiler
def test_the_inputs_stay_what_they_were_and_the_outputs_are_the_same_bits_again():
    network, case = make(PASSES, look_widths=(5, 1), out_width=5), single(make_case(make_graph(grid(14, 14))))
    before = copy.deepcopy((case.nodes, case.edges))
    first, second = (evaluate(network, case, compiled=True) for _ in range(2))
    assert torch.equal(first, second)
    assert torch.equal(case.nodes, before[0])
    assert all(torch.equal(case.edges[name], value) for name, value in before[1].items())


@needs_compiler
def test_weights_that_change_are_read_again():
    network, case = make(SHORT), make_case(make_graph(grid(6, 6)))
    assert difference(network, case) < 3e-6
    with torch.no_grad():
        network.steps[1].node_mlp.third.weight.mul_(-2.0)
    assert difference(network, case) < 3e-6
    network.load_state_dict({name: 0.5 * value for name, value in network.state_dict().items()})
    assert difference(network, case) < 3e-6
    network.steps[0].node_mlp.second.weight = torch.nn.Parameter(torch.randn(48, 48) / 7)
    assert difference(network, case) < 3e-6


@needs_compiler
def test_undefined_numbers_are_not_hidden():
    network, case = make(SHORT), single(make_case(make_graph(grid(6, 6))))
    case.nodes[3] = torch.nan
    assert bool(evaluate(network, case, compiled=True).isnan().any())


@needs_compiler
def test_gradients_and_float64_go_to_torch():
    network, nodes = make(SHORT), torch.zeros(4, 5)
    assert compiled_network.weights_for(network, nodes) is None  # a gradient may be asked for
    with torch.no_grad():
        assert compiled_network.weights_for(network, nodes) is not None
        assert compiled_network.weights_for(network, nodes.double()) is None
        assert compiled_network.weights_for(copy.deepcopy(network).double(), nodes) is None


@needs_compiler
def test_a_network_of_fused_kernels_infers_so_and_learns_by_torch():
    network, case = make(SHORT), single(make_case(make_graph(grid(6, 6))))
    arguments = (case.graph, case.nodes, case.edges)
    plain = network(*arguments)
    network.use_kernels("fused")
    assert torch.equal(network(*arguments), plain)
    with torch.no_grad():
        assert torch.equal(network(*arguments), evaluate(network, case, compiled=True))


@needs_compiler
@pytest.mark.parametrize(
    "precision, width, message",
    [("bf16", 48, "kernels=fused compute in precision=fp32"), ("fp32", 6, "latents of a multiple of")],
)
def test_what_it_cannot_do_is_refused(precision, width, message):
    with pytest.raises(ValueError, match=message):
        check_kernels("fused", precision, width)


def test_without_a_compiler_the_error_names_the_way_out(monkeypatch):
    def missing() -> None:
        raise BuildError("no C++ compiler: install g++ or clang++ (or name one in CXX)")

    monkeypatch.setattr(compiled_network, "library", missing)
    with pytest.raises(ValueError, match=r"kernels=fused: no C\+\+ compiler.* or use kernels=torch"):
        check_kernels("fused", "fp32", 48)
