"""The Triton kernels compiled for three generations of GPUs, without one: how many bytes a thread keeps in memory."""

import warnings
from pathlib import Path
from typing import Any

import pytest
import torch

from hood.model.kernels import triton_step
from tests.spills import CAPABILITIES, LEAST, spilled

pytest.importorskip("triton", reason="Triton is built for Linux only")

ARGUMENTS = {
    **dict.fromkeys(("count", "tiles", "stride", "column", "stride_1", "stride_received"), "i32"),
    **dict.fromkeys(("receivers", "senders", "local_receivers", "chosen", "offsets", "reverse"), "*i64"),
    **dict.fromkeys(("borders", "nodes", "updated", "weight_1", "weight_2", "weight_3"), "*fp32"),
    **dict.fromkeys(("bias_1", "bias_2", "bias_3", "scale", "shift", "residual", "parts", "grad_out"), "*fp32"),
    "eps": "fp32",
}
KERNELS = ("edges_pass", "border_pass", "nodes_pass", "tail_pass")
GRADIENTS = ("edges_back", "ends_back", "tail_back")
#: Of the gradients of latents wider than 64.
LEAST_WIDE = 448


def bytes_of(name: str, width: int, dtype: torch.dtype, capability: int, tmp_path: Path) -> int:
    from hood.model.kernels import triton_gradients, triton_kernels

    kernel: Any = getattr(triton_gradients if name in GRADIENTS else triton_kernels, name)
    options = triton_step.options_of(width, torch.empty(0), "tf32x3")
    constants: dict[str, Any] = {"WIDTH": width, "PADDED": width, "TILE": triton_step.tile_of(width, dtype), "CHUNK": 32}
    constants |= {"SOME": True, "SETS": 4, "ADD": True, "WIDEN": False, "PRECISION": options["PRECISION"]}
    latents = {torch.float32: "*fp32", torch.bfloat16: "*bf16"}[dtype]
    types = {key: ARGUMENTS.get(key, latents) for key in kernel.arg_names}
    types |= {"nodes": "*i64"} if name == "ends_back" else {}
    chosen = {key: options[key] for key in ("num_warps", "num_stages")}
    return spilled(kernel, types, constants, chosen, capability, tmp_path)


@pytest.mark.parametrize("capability", CAPABILITIES)
@pytest.mark.parametrize("width, dtype", [(64, torch.float32), (64, torch.bfloat16), (128, torch.bfloat16)], ids=str)
def test_registers_suffice(width, dtype, capability, tmp_path, monkeypatch):
    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path / "cache"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = {name: bytes_of(name, width, dtype, capability, tmp_path) for name in (*KERNELS, *GRADIENTS)}
    assert max(found[name] for name in KERNELS) <= LEAST, found
    assert max(found[name] for name in GRADIENTS) <= (LEAST if width <= 64 else LEAST_WIDE), found
