"""The compiled kernels against the plain blocks and the formulas, with their gradients; and who is refused them."""

import copy
import os
import subprocess
import sys
from dataclasses import replace

import pytest
import torch
from test_bfloat16 import make, relative
from torch import Tensor, nn

from hood.model.graph.builder import EdgeSet, edge_set
from hood.model.kernels import block
from hood.model.network.message_passing import update_edges
from hood.model.network.mlp import MLP
from hood.model.network.model import MeshGraphNet
from hood.native import build as native_build
from hood.tensors.dense import whole_arrays

WIDTH = 64


def reason(precision: str) -> str:
    """Why this machine cannot have them; empty where it can."""
    try:
        block.check_kernels("compiled", precision, WIDTH)
    except ValueError as error:
        return str(error)
    return ""


REASON, REASON_HALF = reason("fp32"), reason("bf16")
needs_compiler = pytest.mark.skipif(bool(REASON), reason=REASON)
needs_half = pytest.mark.skipif(bool(REASON_HALF), reason=REASON_HALF)
#: Bound on the results and on their gradients; in bfloat16 some units that are nearly zero are on the other side of a ReLU.
BOUNDS = [(torch.float32, 1e-6, 2e-6), pytest.param(torch.bfloat16, 0.01, 0.045, marks=needs_half)]


def hub_and_gaps() -> EdgeSet:
    """1,390 edges, no multiple of a tile, of 120 nodes, the first with over three tiles; between them nodes without any."""
    generator = torch.Generator().manual_seed(0)
    hub = torch.stack([torch.zeros(300, dtype=torch.int64), torch.arange(300) % 119 + 1], dim=1)
    edges = edge_set(torch.cat([hub, torch.randint(1, 120, (395, 2), generator=generator)]))
    offsets = torch.cat([edges.offsets[:1], edges.offsets[1:].repeat_interleave(3)])
    local = {"local_senders": 3 * edges.local_senders, "local_receivers": 3 * edges.local_receivers}
    return replace(edges, nodes=torch.arange(3 * len(edges.nodes)), offsets=offsets, **local)


def perceptron(inputs: int, width: int = WIDTH) -> MLP:
    torch.manual_seed(0)
    mlp = MLP(inputs, width, width)
    assert mlp.norm is not None
    nn.init.normal_(mlp.norm.weight)
    nn.init.normal_(mlp.norm.bias)
    return mlp


def with_gradients(results: tuple[Tensor, ...], weights: tuple[Tensor, ...], leaves: list[Tensor]) -> list[Tensor]:
    total = sum((result.double() * weight).sum() for result, weight in zip(results, weights, strict=True))
    return [*(result.detach().double() for result in results), *torch.autograd.grad(total, leaves)]


def formulas(mlp: MLP, nodes: Tensor, latent: Tensor, edges: EdgeSet) -> tuple[Tensor, Tensor]:
    message = mlp(torch.cat([nodes[edges.local_receivers], nodes[edges.local_senders], latent], dim=1))
    return latent + message, torch.zeros_like(nodes).index_add(0, edges.local_receivers, message)


@pytest.fixture
def no_avx512(monkeypatch):
    """A processor with AVX2, as torch finds it; what was built for it."""
    built = []

    def build(source, flags):
        built.append(flags)
        return native_build.build(source, flags)

    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "AVX2")
    monkeypatch.setattr(block, "build", build)
    block.library.cache_clear()
    yield built
    block.library.cache_clear()


needs_avx2 = pytest.mark.skipif(torch.backends.cpu.get_cpu_capability() not in ("AVX2", "AVX512"), reason="no AVX2 here")


@needs_compiler
@pytest.mark.parametrize("width", [16, 32, 48, WIDTH, 96])
@pytest.mark.parametrize("dtype, bound, bound_gradient", BOUNDS)
def test_an_edge_update_and_its_gradients_are_the_formulas(dtype, bound, bound_gradient, width):
    """Widths have panels of one to four registers; those of a multiple of 32 are by AMX where the processor has it."""
    check_edge_update(dtype, bound, bound_gradient, width)


@needs_compiler
@needs_avx2
@pytest.mark.parametrize("width", [16, 32, 48, WIDTH, 128])
def test_processors_without_avx512_have_the_same_edge_update(no_avx512, width):
    check_edge_update(torch.float32, 1e-6, 2e-6, width)
    assert [flag for flag in no_avx512[0] if flag.startswith(("-mavx", "-mfma"))] == ["-mavx2", "-mfma"]


def check_edge_update(dtype, bound, bound_gradient, width):
    """Results and gradients are the formulas'; nodes without an edge get zeros; without a gradient nothing changes."""
    mlp, edges = perceptron(3 * width, width), hub_and_gaps()
    nodes = torch.randn(len(edges.nodes) + 5, width).to(dtype)
    latent = torch.randn(edges.num_edges, width).to(dtype)
    weights = (torch.randn(latent.shape).to(dtype).double(), torch.randn(nodes.shape).to(dtype).double())
    exact, leaves = copy.deepcopy(mlp).double(), [x.double().requires_grad_() for x in (nodes, latent)]
    expected = with_gradients(formulas(exact, *leaves, edges), weights, [*leaves, *exact.parameters()])
    mlp.compiled = True
    leaves = [x.requires_grad_() for x in (nodes, latent)]
    found = with_gradients(update_edges(mlp, nodes, latent, edges), weights, [*leaves, *mlp.parameters()])
    for index, (value, reference) in enumerate(zip(found, expected, strict=True)):
        assert relative(value.double(), reference) < (bound if index < 2 else bound_gradient)
    degree = edges.offsets.diff()
    assert not found[1][: len(degree)][degree == 0].any()
    assert not found[1][len(degree) :].any()
    with torch.no_grad():
        kept = latent.detach().clone()
        updated, sums = update_edges(mlp, nodes, kept, edges, overwrite=True)
    assert updated.data_ptr() == kept.data_ptr()
    assert torch.equal(updated.double(), found[0])
    assert torch.equal(sums.double(), found[1])


@needs_compiler
@pytest.mark.parametrize("used", [0, 1])
def test_a_result_that_nobody_uses_has_no_gradient(used):
    """The latents of a network's last step lead nowhere; its sums alone do."""
    mlp, edges = perceptron(3 * WIDTH), hub_and_gaps()
    leaves = [torch.randn(len(edges.nodes), WIDTH).requires_grad_(), torch.randn(edges.num_edges, WIDTH).requires_grad_()]
    found = []
    for compiled_form in (False, True):
        mlp.compiled = compiled_form
        result = update_edges(mlp, *leaves, edges)[used]
        found.append(torch.autograd.grad(result.square().sum(), [*leaves, *mlp.parameters()]))
    for value, reference in zip(*found, strict=True):
        assert relative(value, reference) < 1e-5


@needs_compiler
@pytest.mark.parametrize("rows", [1, 95, 96, 205])
@pytest.mark.parametrize("residual", [None, torch.float32])
@pytest.mark.parametrize("dtype, bound, bound_gradient", BOUNDS)
def test_the_layers_behind_the_first_are_the_plain_ones(dtype, bound, bound_gradient, residual, rows):
    """With more rows than a tile and fewer; a node's latent, the residual, is float32 in any case."""
    check_tail(dtype, bound, bound_gradient, residual, rows)


@needs_compiler
@needs_avx2
@pytest.mark.parametrize("rows", [1, 205])
@pytest.mark.parametrize("residual", [None, torch.float32])
def test_processors_without_avx512_have_the_same_layers(no_avx512, residual, rows):
    check_tail(torch.float32, 1e-6, 2e-6, residual, rows)
    assert len(no_avx512) == 1


def check_tail(dtype, bound, bound_gradient, residual, rows):
    """Results and gradients are the plain ones."""
    mlp = perceptron(8)
    hidden, weight = torch.randn(rows, WIDTH).to(dtype), torch.randn(rows, WIDTH).double()
    inputs = [hidden] if residual is None else [hidden, torch.randn(rows, WIDTH, dtype=residual)]
    parameters = [p for name, p in mlp.named_parameters() if not name.startswith("first")]
    exact = copy.deepcopy(mlp).double()
    leaves = [x.double().requires_grad_() for x in inputs]
    own = [p for name, p in exact.named_parameters() if not name.startswith("first")]
    expected = with_gradients((exact.tail(*leaves),), (weight,), [*leaves, *own])
    mlp.compiled = True
    leaves = [x.requires_grad_() for x in inputs]
    out = mlp.tail(*leaves)
    assert out.dtype == (dtype if residual is None else residual)
    found = with_gradients((out,), (weight,), [*leaves, *parameters])
    # A row alone has a gradient that cancels in the layer norm of a few units.
    factor = 1 if rows > 1 else 3
    for index, (value, reference) in enumerate(zip(found, expected, strict=True)):
        assert relative(value.double(), reference) < factor * (bound if index < 1 else bound_gradient)


@needs_compiler
@pytest.mark.parametrize("precision, bound", [("fp32", 1e-5), pytest.param("bf16", 0.015, marks=needs_half)])
def test_a_network_by_compiled_kernels_is_the_plain_network(precision, bound):
    network, *inputs = make("2x(mesh+coarse0)", 16)
    plain = network(*inputs)
    plain.square().sum().backward()
    expected = torch.cat([p.grad.flatten() for p in network.parameters() if p.grad is not None])
    network.use_precision(precision)
    network.use_kernels("compiled")
    gradients = []
    for checkpointing in (False, True):
        network.zero_grad()
        network.use_checkpointing(checkpointing)
        out = network(*inputs)
        out.square().sum().backward()
        gradients.append(torch.cat([p.grad.flatten() for p in network.parameters() if p.grad is not None]))
        assert relative(out.detach(), plain.detach()) < bound
    assert relative(gradients[0], expected) < 2 * bound
    assert torch.equal(*gradients)
    with torch.no_grad():
        assert torch.equal(network(*inputs), out)
        assert torch.equal(copy.deepcopy(network)(*inputs), out)
        network.use_kernels("torch")
        assert not torch.equal(network(*inputs), out)


@needs_compiler
def test_double_precision_and_traces_go_the_plain_way():
    mlp = perceptron(8).double()
    x = torch.randn(40, 8).double()
    plain = mlp(x)
    mlp.compiled = True
    assert torch.equal(mlp(x), plain)
    mlp = mlp.float()
    with whole_arrays():
        mlp.compiled = False
        plain = mlp(x.float())
        mlp.compiled = True
        assert torch.equal(mlp(x.float()), plain)


@pytest.fixture
def plain_processor(monkeypatch):
    """One without AMX."""
    monkeypatch.setattr(block, "processor", lambda: "Linux x86_64 flags : avx512f")
    block.library.cache_clear()
    yield
    block.library.cache_clear()


@pytest.fixture
def fresh(tmp_path, monkeypatch):
    """Nothing compiled so far, here or on disk."""
    monkeypatch.setenv("HOOD_CACHE", str(tmp_path))
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "AVX512")
    block.library.cache_clear()
    yield tmp_path
    block.library.cache_clear()


@needs_half
@pytest.mark.parametrize("rows", [1, 33, 205])
def test_processors_without_amx_have_the_same_products_of_bfloat16(plain_processor, rows):
    mlp = perceptron(8)
    hidden, residual = torch.randn(rows, WIDTH).bfloat16(), torch.randn(rows, WIDTH)
    exact = copy.deepcopy(mlp).double()
    expected = exact.tail(hidden.double(), residual.double())
    mlp.compiled = True
    found = mlp.tail(hidden, residual)
    assert relative(found.detach().double(), expected.detach()) < 0.01
    found.sum().backward()
    expected.sum().backward()
    assert relative(mlp.second.weight.grad.double(), exact.second.weight.grad) < (0.045 if rows > 1 else 0.15)
    assert not block.library(WIDTH, True).tiles_are_given()


@needs_compiler
def test_compilers_that_do_not_know_amx_build_the_rest(fresh, monkeypatch):
    built = []

    def build(source, flags):
        built.append(flags)
        if "-mamx-tile" in flags:
            raise native_build.BuildError("unknown flag")

    monkeypatch.setattr(block, "build", build)
    monkeypatch.setattr(block, "processor", lambda: "Linux x86_64 flags : avx512f amx_bf16 amx_tile")
    block.library(WIDTH, True)
    assert ["-mamx-tile" in flags for flags in built] == [True, False]
    block.library(48, True)  # no multiple of 32
    block.library(WIDTH, False)
    assert ["-mamx-tile" in flags for flags in built] == [True, False, False, False]


def test_who_is_refused(fresh, monkeypatch):
    network = MeshGraphNet(3, {"mesh": 2, "body": 2}, WIDTH, "1x(mesh)")
    with pytest.raises(ValueError, match="kernels is 'fast'; choose torch, compiled or fused"):
        network.use_kernels("fast")
    with pytest.raises(ValueError, match="for device=cpu, not cuda; use kernels=torch"):
        block.check_kernels("compiled", "fp32", WIDTH, torch.device("cuda"))
    with pytest.raises(ValueError, match="a multiple of 16 columns, not 40; use kernels=torch"):
        block.check_kernels("compiled", "fp32", 40)
    for missing in ({"CXX": "no-such-compiler"}, {"CXX": "", "PATH": str(fresh)}):
        for name, value in missing.items():
            monkeypatch.setenv(name, value)
        with pytest.raises(ValueError, match=r"kernels=compiled: no C\+\+ compiler: install g\+\+ .* or use kernels=torch"):
            network.use_kernels("compiled")
    assert network.kernels == "torch"
    monkeypatch.setattr(block.platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "AVX2")
    with pytest.raises(ValueError, match="precision=bf16 need a processor with AVX512_BF16; use kernels=torch"):
        block.check_kernels("compiled", "bf16", WIDTH)
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "DEFAULT")
    with pytest.raises(ValueError, match="need a processor with AVX2 or AVX-512; use kernels=torch"):
        network.use_kernels("compiled")
    monkeypatch.setattr(block.platform, "machine", lambda: "aarch64")
    monkeypatch.setattr(block, "build", lambda source, flags: flags)
    assert not [flag for flag in block.library(WIDTH, False) if flag.startswith("-m")]


@needs_compiler
@needs_avx2
def test_torch_says_which_vectors_are_used():
    """A process that is told to find AVX2 alone compiles for it, whatever the processor has."""
    words = "from hood.model.kernels import block; block.build = lambda source, flags: print(*flags); block.library(16, False)"
    environment = {**os.environ, "ATEN_CPU_CAPABILITY": "avx2"}
    said = subprocess.run([sys.executable, "-c", words], env=environment, capture_output=True, text=True, check=True).stdout
    assert "-mavx2 -mfma" in said
    assert "-mavx512f" not in said


def test_a_compiler_that_fails_is_named(fresh, monkeypatch):
    monkeypatch.setenv("CXX", "false")
    with pytest.raises(ValueError, match="false fails .* name another in CXX or use kernels=torch"):
        block.check_kernels("compiled", "fp32", WIDTH)
    assert not list(fresh.rglob("*.so"))


@needs_compiler
def test_what_is_compiled_is_kept(fresh, monkeypatch):
    monkeypatch.setattr(block, "_FLAGS", tuple(flag.replace("-O3", "-O0") for flag in block._FLAGS))
    block.check_kernels("compiled", "fp32", WIDTH)
    assert [path.suffix for path in fresh.rglob("*") if path.is_file()] == [".so"]
    block.library.cache_clear()
    monkeypatch.setattr(native_build, "_compile", lambda *arguments: pytest.fail("compiled again"))
    block.check_kernels("compiled", "fp32", WIDTH)
