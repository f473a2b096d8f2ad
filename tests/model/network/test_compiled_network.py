"""Inference in one call per pass against the network by torch's operations in float64."""

import copy

import pytest
import torch
from test_model import SHORT, WIDTHS, Case, make_case, make_graph
from torch import Tensor

from hood.model.kernels import network as compiled_network
from hood.model.kernels.block import check_kernels
from hood.model.network.message_passing import EdgeDecoder, ProcessorStep
from hood.model.network.mlp import MLP
from hood.model.network.model import MeshGraphNet
from hood.native.build import BuildError
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


class HalvedNet(MeshGraphNet):
    """Half of what the network says."""

    def forward(self, *arguments, **named):
        return 0.5 * super().forward(*arguments, **named)


class SlowNet(MeshGraphNet):
    """Latents that change a tenth as much, nodes and edges alike."""

    def _take(self, step, sets, graph, nodes, edges):
        new, changed = super()._take(step, sets, graph, nodes, edges)
        return nodes + 0.1 * (new - nodes), {name: edges[name] + 0.1 * (changed[name] - edges[name]) for name in edges}


class GatedStep(ProcessorStep):
    """The same in the step itself."""

    def forward(self, nodes, edges, subsets, overwrite=False):
        new, changed = super().forward(nodes, edges, subsets, overwrite)
        return nodes + 0.1 * (new - nodes), {name: edges[name] + 0.1 * (changed[name] - edges[name]) for name in edges}


class Loud(MLP):
    """Twice what a perceptron says."""

    def forward(self, x, dtype=None):
        return 2.0 * super().forward(x, dtype)


class OwnDecoder(EdgeDecoder):
    """Edges that say nothing."""

    def forward(self, nodes, latent, edges):
        return 0.0 * super().forward(nodes, latent, edges)


def with_part(place: str, part: torch.nn.Module) -> MeshGraphNet:
    network = make(SHORT, edge_out_width=2)
    network.set_submodule(place, part)
    return network


def hooked() -> MeshGraphNet:
    network = make(SHORT)
    network.decoder.register_forward_hook(lambda module, given, out: 3.0 * out)
    return network


def patched() -> MeshGraphNet:
    network = make(SHORT)
    network.steps[1].node_mlp.tail = lambda hidden, residual=None: residual
    return network


OWN = {
    "HalvedNet": lambda: HalvedNet(5, WIDTHS, 48, SHORT),
    "SlowNet": lambda: SlowNet(5, WIDTHS, 48, SHORT),
    "steps, .*GatedStep": lambda: with_part("steps.2", GatedStep(make(SHORT).steps[2].sets, 48)),
    "node_encoder, .*Loud": lambda: with_part("node_encoder", Loud(5, 48, 48)),
    "edge_encoders, .*Loud": lambda: with_part("edge_encoders.body", Loud(3, 48, 48)),
    "decoder, .*Loud": lambda: with_part("decoder", Loud(48, 48, 3, norm=False)),
    "edge_decoder, .*OwnDecoder": lambda: with_part("edge_decoder", OwnDecoder(48, 2)),
    "decoder, hood.model.network.mlp.MLP": hooked,
    "steps, hood.model.network.mlp.MLP": patched,
}


@needs_compiler
@pytest.mark.parametrize("name", OWN)
def test_networks_with_parts_of_an_own_class_compute_without_a_gradient_what_they_learn_with_one(name):
    network, case = OWN[name](), single(make_case(make_graph(grid(6, 6))))
    arguments = (case.graph, case.nodes, case.edges)
    learned = network(*arguments)
    with pytest.raises(ValueError, match=rf"kernels=fused compute .*{name}.*; use kernels=torch"):
        network.use_kernels("fused")
    forms = ["torch"]
    try:
        check_kernels("compiled", "fp32", 48)
        forms.append("compiled")
    except ValueError:
        pass
    for form in forms:
        network.use_kernels(form)
        with torch.no_grad():
            torch.testing.assert_close(network(*arguments), learned, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(network(*arguments), learned, rtol=1e-4, atol=1e-5)


@needs_compiler
def test_a_part_that_is_replaced_later_is_not_passed_over():
    network, case = make(SHORT), make_case(make_graph(grid(6, 6)))
    assert difference(network, case) < 3e-6
    assert not network.own_part()
    network.decoder = MLP(48, 48, 3, norm=False)
    assert difference(network, case) < 3e-6
    network.decoder = Loud(48, 48, 3, norm=False)
    network.kernels, case = "fused", single(case)
    with torch.no_grad():
        assert compiled_network.weights_for(network, case.nodes) is None
        found = network(case.graph, case.nodes, case.edges)
    torch.testing.assert_close(found, network(case.graph, case.nodes, case.edges), rtol=1e-4, atol=1e-5)


@needs_compiler
def test_passes_and_edge_outputs_are_parts_of_hoods_own_network():
    assert not make(PASSES, look_widths=(5, 1), out_width=5).own_part()
    assert not make(SHORT, edge_out_width=2).own_part()


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

    monkeypatch.setattr(compiled_network, "_library", missing)
    with pytest.raises(ValueError, match=r"kernels=fused: no C\+\+ compiler.* or use kernels=torch"):
        check_kernels("fused", "fp32", 48)
