"""Functions of tensors that stay in place, recorded as CUDA graphs: all of their kernels are started by one call.

A function of tensors as a flat list of torch's operations, with everything that does not depend on its inputs computed
once.

The list shows that nothing in the function depends on data: tracing works on tensors without values and fails where a value
or a shape that follows from one is asked for.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, fx

from hood.tensors.dense import whole_arrays

Run = Callable[..., tuple[Tensor, ...]]
#: Runs before a capture, in which libraries choose their kernels and take their memory.
_WARM_UP = 3


def has_graphs(device: torch.device) -> bool:
    """Whether the kernels of a function can be recorded there, to be started by one call."""
    return device.type == "cuda"


class InputMemory:
    """Memory of a function's inputs, written only where a value has changed since the last time."""

    def __init__(self, values: Sequence[Tensor]) -> None:
        self.tensors = [value.clone() for value in values]
        self._given: list[tuple[Tensor, float]] = [(value, torch.nan) for value in self.tensors]

    def load(self, values: Sequence[Tensor]) -> list[Tensor]:
        """The memory, holding ``values``."""
        for memory, value, (given, version) in zip(self.tensors, values, self._given, strict=True):
            if value is not given or _version(value) != version:
                memory.copy_(value)
        self._given = [(value, _version(value)) for value in values]
        return self.tensors


class CudaGraph:
    """``function(*inputs)``, recorded once; what it returns is written anew by the next call.

    Args:
        pool: of another graph, whose memory this one may use as well: the two must never run at once, and what the other
            returned stays as it is.
    """

    def __init__(self, function: Run, inputs: Sequence[Tensor], pool: Any = None) -> None:
        # Kept for the memory it holds, which the graph reads without knowing of.
        self._function, self._inputs = function, list(inputs)
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(_WARM_UP):
                function(*self._inputs)
        torch.cuda.current_stream().wait_stream(stream)
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph, pool=pool):
            self._outputs = function(*self._inputs)

    @property
    def pool(self) -> Any:
        """The memory that it computes in."""
        return self._graph.pool()

    def __call__(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        same = all(a is b for a, b in zip(inputs, self._inputs, strict=True))
        assert same, "a CUDA graph reads the memory it was recorded with"
        self._graph.replay()
        return self._outputs


def _version(value: Tensor) -> float:
    """Changes with what the tensor holds; of tensors that keep no count, unequal to itself."""
    return torch.nan if value.is_inference() else value._version


_Function = Callable[..., Any]
#: Operations that give another view of their argument and start nothing on the device.
VIEWS = ("view", "_unsafe_view", "t", "transpose", "permute", "expand", "slice", "select", "split", "split_with_sizes",
          "unsqueeze", "squeeze", "unbind", "alias", "detach", "as_strided")  # fmt: skip


@torch.no_grad()
def trace(function: _Function, inputs: Sequence[Tensor], fold: bool = True) -> fx.GraphModule:
    """``function(*inputs)`` as a module of single operations for inputs of these shapes.

    Tensors that the function holds (weights, the cloth) stay what they are and must not change any more.

    Args:
        fold: compute what does not depend on the inputs now instead of in every call.

    Raises:
        RuntimeError: the function reads a value on the host, or makes an array whose size depends on values.
    """
    from torch._guards import detect_fake_mode  # a second of imports that plain steps are spared
    from torch._subclasses.fake_tensor import FakeTensor, FakeTensorMode
    from torch.fx.experimental.proxy_tensor import make_fx

    # A mode of our own, unless there is one: that of make_fx lets arrays of unknown length pass.
    mode = detect_fake_mode(inputs) or FakeTensorMode(allow_non_fake_inputs=True)
    without_values = [value if isinstance(value, FakeTensor) else mode.from_tensor(value) for value in inputs]
    with whole_arrays(), mode:
        module = make_fx(function)(*without_values)
    return fold_constants(module) if fold else module


def count_operations(module: fx.GraphModule) -> int:
    """Operations of a traced function that work on the device, views not counted: about one kernel each."""
    calls = [node.target for node in module.graph.nodes if node.op == "call_function"]
    return sum(isinstance(target, torch._ops.OpOverload) and target._opname not in VIEWS for target in calls)


@torch.no_grad()
def fold_constants(module: fx.GraphModule) -> fx.GraphModule:
    """The traced module without the operations that depend on its constants alone.

    Arrays that are written to later, themselves or by a view, are made anew in every call.
    """
    written = _written(module.graph)
    values: dict[fx.Node, Any] = {}
    for node in module.graph.nodes:
        if node.op == "get_attr":
            values[node] = operator.attrgetter(str(node.target))(module)
        elif node.op == "call_function" and node not in written and all(arg in values for arg in node.all_input_nodes):
            args, kwargs = fx.node.map_arg((node.args, node.kwargs), values.__getitem__)
            values[node] = node.target(*args, **kwargs)
    return _replace(module, values)


def _replace(module: fx.GraphModule, values: dict[fx.Node, Any]) -> fx.GraphModule:
    for index, (node, value) in enumerate(values.items()):
        if node.op == "get_attr" or all(user in values for user in node.users):
            continue
        name = f"_folded_{index}"
        module.register_buffer(name, value, persistent=False)
        with module.graph.inserting_before(node):
            constant = module.graph.get_attr(name)
        node.replace_all_uses_with(constant, delete_user_cb=lambda user: user not in values)
    for node in reversed(values):
        if not node.users:
            module.graph.erase_node(node)
    module.delete_all_unused_submodules()
    module.recompile()
    return module


def _written(graph: fx.Graph) -> set[fx.Node]:
    """Nodes whose memory some operation writes to."""
    owner: dict[fx.Node, fx.Node] = {}
    dirty: set[fx.Node] = set()
    for node in graph.nodes:
        owner[node] = node
        if node.op != "call_function":
            continue
        if node.target is operator.getitem:
            owner[node] = owner[node.args[0]]
            continue
        for value, writes in _aliased(node):
            owner[node] = owner[value]
            if writes:
                dirty.add(owner[value])
    return {node for node in graph.nodes if owner[node] in dirty}


def _aliased(node: fx.Node) -> list[tuple[fx.Node, bool]]:
    """Arguments whose memory the result of an operation shares, and whether it writes there."""
    schema = node.target._schema  # type: ignore[union-attr]
    shared = []
    for position, argument in enumerate(schema.arguments):
        value = node.args[position] if position < len(node.args) else node.kwargs.get(argument.name)
        if argument.alias_info is not None:
            nodes = value if isinstance(value, (list, tuple)) else [value]
            shared += [(item, bool(argument.alias_info.is_write)) for item in nodes if isinstance(item, fx.Node)]
    return shared
