"""The processor step in Triton against the plain one: by Triton's interpreter on any machine, compiled where there is a GPU.

Triton decides at its import whether it interprets, so the kernels run in a process of their own: this file as a script
computes all cases and writes what came out.
"""

import collections
import contextlib
import functools
import statistics
import sys
from dataclasses import replace
from types import SimpleNamespace
from typing import NamedTuple

import pytest
import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode

from hood.model.graph.builder import EdgeSet, Subset, edge_set
from hood.model.kernels import triton_step
from hood.model.network.message_passing import ProcessorStep
from hood.model.network.mlp import MLP
from hood.steppers.static_shapes.cuda_graph import VIEWS
from hood.tensors import dense as triton_device
from hood.tensors.dense import assumed, products, whole_arrays
from tests.interpreted import interpret

TILE = 32  # of the widest tiles
BOUND = {torch.float32: 2e-6, torch.bfloat16: 0.015}
DTYPES = {"fp32": torch.float32, "bf16": torch.bfloat16}
GRAPHS = ("ring", "hub", "gaps", "star", "full tiles", "one edge", "none")
CASES = [(graph, 64, dtype) for graph in GRAPHS for dtype in DTYPES]
CASES += [("ring", 16, "fp32"), ("ring", 48, "fp32"), ("ring", 48, "bf16"), ("ring", 96, "bf16"), ("ring", 128, "bf16")]
WIDTHS = {name: triton_step.WIDEST[kind] // 16 for name, kind in DTYPES.items()}
RANDOM = [(f"random {seed}", 16 * (1 + seed % WIDTHS[dtype]), dtype) for seed in range(250) for dtype in DTYPES]
EXTRA = 5  # nodes without any edge
TAILS = [(16, "fp32"), (48, "fp32"), (48, "bf16"), (128, "bf16")]


class Case(NamedTuple):
    """A step with its inputs, the same for everyone who asks."""

    step: ProcessorStep
    nodes: Tensor
    latents: dict[str, Tensor]
    subsets: dict[str, Subset]

    def expected(self) -> tuple[Tensor, dict[str, Tensor]]:
        latents = {name: latent.float() for name, latent in self.latents.items()}
        nodes, edges = self.step(self.nodes, latents, self.subsets)
        return nodes, edges

    def fused(self, overwrite: bool = False) -> tuple[Tensor, dict[str, Tensor]]:
        return triton_step.take(self.step, self.nodes, self.latents, self.subsets, overwrite)


def pairs(graph: str) -> Tensor:
    """Undirected edges (E, 2)."""
    ring = torch.stack([torch.arange(41), (torch.arange(41) + 1) % 41], dim=1)
    if graph in ("ring", "gaps"):  # gaps: see below
        return torch.cat([ring, ring + torch.tensor([0, 3])])
    if graph == "hub":  # a node in the middle with edges in many tiles
        spokes = torch.arange(41, 61 + 3 * TILE)
        return torch.cat([ring, torch.stack([torch.full_like(spokes, 40), spokes], dim=1)])
    if graph == "star":  # the first node fills tiles, the last tiles hold many nodes
        return torch.stack([torch.zeros(TILE * 2, dtype=torch.int64), torch.arange(1, TILE * 2 + 1)], dim=1)
    if graph == "full tiles":  # two nodes, one tile each
        return torch.stack([torch.zeros(TILE, dtype=torch.int64), torch.ones(TILE, dtype=torch.int64)], dim=1)
    if graph == "one edge":
        return torch.tensor([[0, 1]])
    if graph == "none":
        return torch.zeros(0, 2, dtype=torch.int64)
    size = int(torch.randint(2, 90, ()))
    ends = torch.randint(0, size, (int(torch.randint(1, 5 * size, ())), 2))
    ends[: len(ends) // 3, 0] = 0  # a hub
    return ends[ends[:, 0] != ends[:, 1]]


def with_gaps(edges: EdgeSet) -> EdgeSet:
    """The same edges between the even ones of twice as many nodes; the odd ones have none."""
    senders, receivers = 2 * edges.senders, 2 * edges.receivers
    return replace(edges, senders=senders, receivers=receivers, nodes=2 * edges.nodes)


def make(graph: str, width: int, dtype: str, device: str = "cpu") -> Case:
    """A step on two sets: one of the graph, and the rows of another that take part."""
    torch.manual_seed(width + 1000 * sum(graph.encode()) if graph.startswith("random") else width)
    step = ProcessorStep(("mesh", "body"), width).requires_grad_(False)
    for norm in (part for part in step.modules() if isinstance(part, nn.LayerNorm)):
        norm.weight.normal_()
        norm.bias.normal_()
    whole, ring = edge_set(pairs(graph)), edge_set(pairs("ring"))
    whole = with_gaps(whole) if graph == "gaps" else whole
    subsets = {"mesh": Subset(whole, None), "body": Subset(ring, 7 + 2 * torch.arange(ring.num_edges))}
    count = 1 + max(int(part.edges.senders.max()) for part in subsets.values() if part.edges.num_edges) + EXTRA
    nodes, kind = torch.randn(count, width), DTYPES[dtype]
    latents = {
        "mesh": torch.randn(whole.num_edges, width).to(kind),
        "body": torch.randn(2 * ring.num_edges + 9, width).to(kind),
    }
    subsets = {name: Subset(_on(device, part.edges), _there(part.rows, device)) for name, part in subsets.items()}
    return Case(step.to(device), nodes.to(device), {name: x.to(device) for name, x in latents.items()}, subsets)


def _on(device: str, edges: EdgeSet) -> EdgeSet:
    return EdgeSet(**{name: value.to(device) for name, value in vars(edges).items() if isinstance(value, Tensor)})


def _there(rows: Tensor | None, device: str) -> Tensor | None:
    return None if rows is None else rows.to(device)


def gradients(case: Case, taken: tuple[Tensor, dict[str, Tensor]], inputs: dict[str, Tensor]) -> dict[str, Tensor]:
    """Of a sum of all results with random weights, by the nodes, the sets and the parameters; zeros where there is none."""
    draw = torch.Generator().manual_seed(5)
    results = [taken[0], *taken[1].values()]
    weighted = [(x.float() * torch.randn(x.shape, generator=draw).to(x.device)).sum() for x in results]
    wanted = inputs | dict(case.step.named_parameters())
    found = torch.autograd.grad(sum(weighted[1:], weighted[0]), list(wanted.values()), allow_unused=True)
    return {
        name: torch.zeros_like(x).float() if grad is None else grad.float()
        for (name, x), grad in zip(wanted.items(), found, strict=True)
    }


def gradients_of(case: Case, fused: bool, dtype: torch.dtype | None = None) -> dict[str, Tensor]:
    """Of the kernels or of the plain path, with the latents in ``dtype`` if given."""
    case.step.requires_grad_(True)
    with torch.enable_grad():
        nodes = case.nodes.clone().requires_grad_(True)
        latents = {name: x.to(dtype or x.dtype).clone().requires_grad_(True) for name, x in case.latents.items()}
        take = functools.partial(triton_step.take, case.step) if fused else case.step
        return gradients(case, take(nodes, latents, case.subsets), {"nodes": nodes, **latents})


def apart(found: dict[str, Tensor], reference: dict[str, Tensor]) -> float:
    """Distance of two gradients as a whole, relative to the second."""
    off, whole = (
        torch.cat([x.flatten() for x in one])
        for one in ([found[name] - reference[name] for name in reference], list(reference.values()))
    )
    return float(off.norm() / whole.norm())


def assert_equal_gradients(found: dict[str, Tensor], case: Case) -> None:
    """In float32 those of the plain path, each of them; in bfloat16, where a rounding opens other ReLUs, as a whole."""
    reference = gradients_of(case, False, torch.float32)
    if case.latents["mesh"].dtype == torch.bfloat16:
        assert apart(found, reference) < 0.15
        return
    assert apart(found, reference) < 1e-6
    floor = 0.01 * max(float(x.norm()) for x in reference.values())
    for name, value in reference.items():
        assert float((found[name] - value).norm()) <= 1e-6 * max(float(value.norm()), floor), name


def assert_equal_step(result: tuple[Tensor, dict[str, Tensor]], case: Case) -> None:
    """Latents within the bound of the RMS of the plain path's in float32; rows that take no part are as they were."""
    bound = BOUND[case.latents["mesh"].dtype]
    with torch.no_grad():
        nodes, edges = case.expected()
    assert result[0].dtype == torch.float32
    assert float((result[0] - nodes).norm() / nodes.norm()) < bound
    for name, reference in edges.items():
        value = result[1][name]
        assert value.dtype == case.latents[name].dtype
        assert value.shape == reference.shape
        assert float((value.float() - reference).norm()) <= bound * float(reference.norm())
    rest = torch.ones(len(edges["body"]), dtype=torch.bool, device=nodes.device)
    rows = case.subsets["body"].rows
    assert rows is not None
    rest[rows] = False
    assert torch.equal(result[1]["body"][rest], case.latents["body"][rest])


def tail_of(width: int, dtype: str) -> tuple[MLP, Tensor, Tensor]:
    """A network, its first layer's output (77, width), and what is added to its result, in float32."""
    torch.manual_seed(width)
    mlp = MLP(9, width, width).requires_grad_(False)
    assert mlp.norm is not None
    mlp.norm.weight.normal_()
    return mlp, torch.randn(77, width).to(DTYPES[dtype]), torch.randn(77, width)


def tail_gradients(mlp: MLP, hidden: Tensor, residual: Tensor) -> dict[str, Tensor]:
    """Of a network's weighted result by its input, what is added, and its parameters."""
    mlp.requires_grad_(True)
    with torch.enable_grad():
        hidden, residual = (x.clone().requires_grad_(True) for x in (hidden, residual))
        wanted = {"hidden": hidden, "residual": residual} | dict(
            zip("2 b2 3 b3 scale shift".split(), mlp.tail_parameters(), strict=True)
        )
        weights = torch.randn(hidden.shape, generator=torch.Generator().manual_seed(5))
        found = torch.autograd.grad((mlp.tail(hidden, residual) * weights).sum(), list(wanted.values()))
    return {name: grad.float() for name, grad in zip(wanted, found, strict=True)}


@pytest.mark.parametrize("width, dtype", TAILS)
def test_their_gradients_as_well(interpreted, width, dtype):
    mlp, hidden, residual = tail_of(width, dtype)
    found, reference = interpreted["tail gradients", width, dtype], tail_gradients(mlp, hidden.float(), residual)
    most = 1e-6 if dtype == "fp32" else 2 * apart(tail_gradients(mlp, hidden, residual), reference)
    assert apart(found, reference) < most


@pytest.mark.parametrize("width, dtype", TAILS)
def test_networks_beside_the_steps_are_those_of_the_plain_path(interpreted, width, dtype):
    mlp, hidden, residual = tail_of(width, dtype)
    bound = BOUND[hidden.dtype]
    with torch.no_grad():
        plain, added = mlp.tail(hidden.float()), mlp.tail(hidden.float(), residual)
    for result, reference, kind in zip(
        interpreted["tail", width, dtype], (plain, added), (hidden.dtype, torch.float32), strict=True
    ):
        assert result.dtype == kind
        assert float((result.float() - reference).norm() / reference.norm()) < bound


@pytest.fixture(scope="module")
def interpreted(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[str, int, str], tuple[Tensor, dict[str, Tensor]]]:
    return interpret(__file__, "CASES", tmp_path_factory.mktemp("triton"), 300)


@pytest.mark.parametrize("graph, width, dtype", CASES)
def test_latents_are_those_of_the_plain_path(interpreted, graph, width, dtype):
    assert_equal_step(interpreted[graph, width, dtype], make(graph, width, dtype))


@pytest.mark.parametrize("graph, width, dtype", CASES)
def test_gradients_are_those_of_the_plain_path(interpreted, graph, width, dtype):
    assert_equal_gradients(interpreted["gradients", graph, width, dtype], make(graph, width, dtype))


@pytest.mark.slow
def test_latents_and_gradients_of_five_hundred_random_steps(tmp_path):
    results = interpret(__file__, "RANDOM", tmp_path, 3600)
    assert len(results) >= 2 * 500
    shares = []  # how far the kernels' gradients in bfloat16 are from those of float32, by how far the plain path's are
    for key, result in results.items():
        if key[0] != "gradients":
            assert_equal_step(result, make(*key))
            continue
        case = make(*key[1:])
        assert_equal_gradients(result, case)
        if key[3] == "bf16":
            reference = gradients_of(case, False, torch.float32)
            shares.append(apart(result, reference) / apart(gradients_of(case, False), reference))
    assert statistics.median(shares) < 1.1


def test_the_graphs_cover_every_kind_of_border():
    sets = {graph: make(graph, 16, "fp32").subsets["mesh"].edges for graph in GRAPHS}
    degree = {graph: int(edges.offsets.diff().max()) for graph, edges in sets.items() if edges.num_edges}
    assert degree["hub"] > 3 * TILE  # more than two whole tiles of one node
    assert degree["full tiles"] == TILE
    assert sets["full tiles"].num_edges == 2 * TILE
    assert all(sets[graph].num_edges % TILE for graph in ("ring", "hub", "gaps", "one edge"))
    assert not torch.equal(sets["gaps"].receivers, sets["gaps"].local_receivers)


def test_only_a_cuda_device_takes_it(monkeypatch):
    cuda, cpu = torch.device("cuda"), torch.device("cpu")
    monkeypatch.setattr(triton_device, "_supported", lambda device: True)
    assert triton_step.applies(64, torch.float32, cuda)
    with torch.no_grad():
        assert triton_step.applies(64, torch.float32, cuda)
        assert triton_step.applies(64, torch.bfloat16, cuda)
        assert not triton_step.applies(64, torch.float32, cpu)
        assert not triton_step.applies(64, torch.float64, cuda)
        assert not triton_step.applies(40, torch.float32, cuda)
        assert not triton_step.applies(128, torch.float32, cuda)
        assert triton_step.applies(128, torch.bfloat16, cuda)
        assert not triton_step.applies(256, torch.bfloat16, cuda)
        with assumed():
            assert triton_step.applies(64, torch.float32, cpu)
            monkeypatch.setenv("HOOD_TRITON", "off")
            assert not triton_step.applies(64, torch.float32, cpu)


def test_a_network_of_an_own_class_is_asked_itself(monkeypatch):
    """Its function is not known to the kernels."""

    class Doubled(MLP):
        def tail(self, hidden: Tensor, residual: Tensor | None = None) -> Tensor:
            return 2 * super().tail(hidden, residual)

    def never(*arguments: object) -> None:
        raise AssertionError("the kernels were asked")

    case = make("ring", 16, "fp32")
    monkeypatch.setattr(triton_step, "take", never)
    case.step.node_mlp.__class__ = Doubled
    with assumed(), torch.no_grad():
        case.expected()


class Launches(TorchDispatchMode):
    """Counts operations that start something on a device; those of our own operators are counted where they start kernels."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        allocates = ("empty", "empty_like", "new_empty", "lift_fresh")
        self.count += func.namespace != "hood" and func._opname not in (*VIEWS, *allocates)
        return func(*args, **(kwargs or {}))

    def kernels(self) -> SimpleNamespace:
        """In the place of the modules of the kernels: counts those that are started."""

        def launch(*arguments: object, **options: object) -> None:
            self.count += 1

        names = ("edges_pass", "border_pass", "nodes_pass", "tail_pass", "edges_back", "ends_back", "tail_back")
        return SimpleNamespace(**{name: collections.defaultdict(lambda: launch) for name in names})


@pytest.mark.parametrize(("sets", "limit"), [(("mesh",), 42), (("mesh", "coarse0"), 51), (("mesh", "coarse0", "coarse1"), 60)])
def test_an_update_starts_a_quarter_of_the_kernels(sets, limit, monkeypatch):
    """Forward and backward through a step. The limits may fall, not rise."""
    case, names = make("ring", 64, "fp32"), (*sets, "body")
    step, which = ProcessorStep(names, 64), {name: "body" if name == "body" else "mesh" for name in names}
    found = []
    for device in (contextlib.nullcontext(), assumed()):
        with device, whole_arrays(), Launches() as launches:
            for kernels in ("_kernels", "_gradient_kernels"):
                monkeypatch.setattr(triton_step, kernels, launches.kernels)
            latents = {name: case.latents[kind].clone().requires_grad_(True) for name, kind in which.items()}
            began = launches.count
            nodes, edges = step(case.nodes, latents, {name: case.subsets[kind] for name, kind in which.items()})
            results = [nodes, *edges.values()]
            torch.autograd.grad(results, [*step.parameters(), *latents.values()], list(map(torch.zeros_like, results)))
            found.append(launches.count - began - len(results))  # without the zeros
    plain, fused = found
    assert fused <= limit
    assert fused <= plain / 4


def test_products_are_as_exact_as_torchs():
    assert triton_step.input_precision() == "tf32x3"
    with products("tf32"):
        assert triton_step.input_precision() == "tf32"


def test_unknown_precisions_are_refused():
    case = make("one edge", 16, "fp32")
    with pytest.raises(ValueError, match="precision is 'tf16'; choose ieee or tf32x3 or tf32"):
        triton_step.take(case.step, case.nodes, case.latents, case.subsets, precision="tf16")


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("graph, width, dtype", CASES)
def test_compiled_on_a_gpu(graph, width, dtype):
    case = make(graph, width, dtype, "cuda")
    with torch.no_grad():
        result = case.fused()
        again = case.fused()
    assert torch.equal(result[0], again[0])  # to the last bit
    assert all(torch.equal(result[1][name], again[1][name]) for name in result[1])
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOOD_TRITON", "off")
        assert_equal_step(result, case)
        first, second = gradients_of(case, True), gradients_of(case, True)
        assert all(torch.equal(first[name], second[name]) for name in first)
        assert_equal_gradients(first, case)


def main(cases: list[tuple[str, int, str]], path: str) -> None:
    torch.set_num_threads(1)
    results = {}
    for key in cases:
        case = make(*key)
        results[key] = case.fused(overwrite=key[0] == "hub")
        assert (results[key][1]["mesh"] is case.latents["mesh"]) == (key[0] in ("hub", "none"))
        results["gradients", *key] = gradients_of(make(*key), True)
    if cases is CASES:
        for key in TAILS:
            mlp, hidden, residual = tail_of(*key)
            with assumed():
                results["tail", *key] = (mlp.tail(hidden), mlp.tail(hidden, residual))
                results["tail gradients", *key] = tail_gradients(mlp, hidden, residual)
    torch.save(results, path)


if __name__ == "__main__":
    with torch.no_grad():
        main({"CASES": CASES, "RANDOM": RANDOM}[sys.argv[1]], sys.argv[2])
