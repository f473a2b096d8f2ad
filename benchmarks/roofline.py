"""What a function asks of a device: its kernels, the bytes that they move and their floating-point operations, without running
it there. From this follows how long it takes at least, see :class:`Device`."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from hood.steppers.static_shapes.cuda_graph import VIEWS

#: Operations that read rows of a table: what they do not read of it costs nothing.
_GATHERS = ("index_select", "index", "gather", "embedding", "take")
#: Operations that make an array without writing to it.
_ALLOCATIONS = ("empty", "empty_like", "empty_strided", "new_empty")


@dataclass(frozen=True)
class Kernel:
    """One operation on the device."""

    name: str
    bytes_moved: int
    flops: int
    kind: str  # ``matmul`` or ``other``


@dataclass(frozen=True)
class Device:
    """What a device is capable of. Times that follow from it are computed, not measured.

    Args:
        bandwidth: of its memory [B/s].
        matmul: operations a second of matrix products, by the precision of the network.
        arithmetic: operations a second of everything else.
        launch: seconds from one kernel to the next at least, each started by the host.
        replay: the same within a CUDA graph.
    """

    name: str
    bandwidth: float
    matmul: dict[str, float]
    arithmetic: float
    launch: float = 6.5e-6
    replay: float = 2.5e-6

    def seconds(self, work: Work, precision: str = "fp32", captured: bool = True) -> float:
        """Sum over the kernels of the longest of: the gap between kernels, the bytes, the operations."""
        least, rates = self.replay if captured else self.launch, {"matmul": self.matmul[precision], "other": self.arithmetic}
        return sum(max(least, k.bytes_moved / self.bandwidth, k.flops / rates[k.kind]) for k in work.kernels)


@dataclass
class Work:
    """The kernels of a function, one after the other."""

    kernels: list[Kernel] = field(default_factory=list)

    @property
    def bytes_moved(self) -> int:
        """Read and written by all of them, as if nothing stayed in a cache in between."""
        return sum(kernel.bytes_moved for kernel in self.kernels)

    @property
    def flops(self) -> int:
        """Floating-point operations, those of matrix products and one for every other number that is computed."""
        return sum(kernel.flops for kernel in self.kernels)


class WorkCounter(TorchDispatchMode):
    """Counts the work of what is computed inside; values play no role, so it works with tensors that have none."""

    def __init__(self) -> None:
        super().__init__()
        self.work = Work()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        name = func._opname.rstrip("_") if hasattr(func, "_opname") else ""
        if name and func.namespace == "aten" and func._opname not in VIEWS and name not in _ALLOCATIONS:
            given = [value for value in tree_leaves((args, kwargs)) if isinstance(value, Tensor)]
            made = [value for value in tree_leaves(result) if isinstance(value, Tensor)]
            self.work.kernels.append(_kernel(name, given, made))
        return result


def _kernel(name: str, given: list[Tensor], made: list[Tensor]) -> Kernel:
    written, read = sum(map(_size, made)), sum(map(_size, given))
    if name in _GATHERS and given:
        read = written + sum(map(_size, given[1:]))
    if name in ("mm", "addmm", "bmm", "baddbmm"):
        left = given[1] if name in ("addmm", "baddbmm") else given[0]
        return Kernel(name, read + written, 2 * made[0].numel() * left.shape[-1], "matmul")
    return Kernel(name, read + written, sum(value.numel() for value in made if value.is_floating_point()), "other")


def _size(value: Tensor) -> int:
    # What is broadcast is read once.
    shape = [1 if stride == 0 else size for size, stride in zip(value.shape, value.stride(), strict=True)]
    return math.prod(shape) * value.element_size()


#: Data sheets (SXM boards, dense products): B/s, and operations a second.
DATA_SHEETS = {
    "a100": Device("A100 80 GB", 2.04e12, {"fp32": 19.5e12, "tf32": 156e12, "bf16": 312e12}, 19.5e12),
    "h100": Device("H100", 3.35e12, {"fp32": 67e12, "tf32": 494e12, "bf16": 989e12}, 67e12),
    "h200": Device("H200", 4.8e12, {"fp32": 67e12, "tf32": 494e12, "bf16": 989e12}, 67e12),
}
