"""How a network may compute, and the switch of torch that TensorFloat-32 needs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

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
