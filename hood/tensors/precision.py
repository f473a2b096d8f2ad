"""How a network may compute, and the switch of torch that TensorFloat-32 needs.

Where kernels in Triton run.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib.util import find_spec

import torch

#: Precisions for training and inference, and one for inference on an NVIDIA GPU alone.
PRECISIONS = ("fp32", "bf16")
TF32 = "tf32"


def check_precision(name: str, device: torch.device | None = None) -> None:
    """Raise ValueError unless ``name`` is a precision, and one of ``device`` if that is given."""
    if name not in (*PRECISIONS, TF32):
        raise ValueError(f"precision is {name!r}; choose {', '.join(PRECISIONS)} or {TF32}")
    if name == TF32 and device is not None and device.type != "cuda":
        raise ValueError(f"precision=tf32 needs device=cuda, not {device.type}: a GPU's units for it; use fp32 or bf16")


@contextmanager
def products(name: str) -> Iterator[None]:
    """Inside, products of float32 matrices on a GPU read the upper 19 bits of their factors if ``name`` is ``tf32``; sums
    stay in float32. The switch is torch's own and global, and goes back to what it was."""
    if name != TF32:
        yield
        return
    switch = torch.backends.cuda.matmul
    before = switch.fp32_precision
    switch.fp32_precision = TF32
    try:
        yield
    finally:
        switch.fp32_precision = before


_assumed = False


@contextmanager
def assumed() -> Iterator[None]:
    """Inside, the device counts as one that has these kernels: to count the kernels of a frame, and to run them by Triton's
    interpreter, on a CPU."""
    global _assumed
    before, _assumed = _assumed, True
    try:
        yield
    finally:
        _assumed = before


def has_triton(device: torch.device) -> bool:
    """Whether Triton is here and the device an NVIDIA one with tensor cores for float32 and bfloat16 (Ampere or later).
    ``HOOD_TRITON=off`` in the environment says no."""
    if os.environ.get("HOOD_TRITON", "on") == "off":
        return False
    return _assumed or (device.type == "cuda" and _supported(device))


@cache
def _supported(device: torch.device) -> bool:
    here = find_spec("triton") is not None and torch.version.hip is None
    return here and torch.cuda.get_device_capability(device) >= (8, 0)
