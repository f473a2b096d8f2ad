"""Where kernels in Triton run."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib.util import find_spec

import torch

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
