"""Functions of tensors that stay in place, recorded as CUDA graphs: all of their kernels are started by one call."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

Run = Callable[..., tuple[Tensor, ...]]
#: Runs before a capture, in which libraries choose their kernels and take their memory.
_WARM_UP = 3


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
    """``function(*inputs)``, recorded once; what it returns is written anew by the next call."""

    def __init__(self, function: Run, inputs: Sequence[Tensor]) -> None:
        # Kept for the memory it holds, which the graph reads without knowing of.
        self._function, self._inputs = function, list(inputs)
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(_WARM_UP):
                function(*self._inputs)
        torch.cuda.current_stream().wait_stream(stream)
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph):
            self._outputs = function(*self._inputs)

    def __call__(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        same = all(a is b for a, b in zip(inputs, self._inputs, strict=True))
        assert same, "a CUDA graph reads the memory it was recorded with"
        self._graph.replay()
        return self._outputs


def _version(value: Tensor) -> float:
    """Changes with what the tensor holds; of tensors that keep no count, unequal to itself."""
    return torch.nan if value.is_inference() else value._version
