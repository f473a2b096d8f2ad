"""The Triton kernels compiled for three generations of GPUs, without one: how many bytes a thread keeps in memory."""

import os
import re
import subprocess
import warnings
from pathlib import Path
from typing import Any

import pytest
import torch

from hood.model.kernels import triton_step

triton = pytest.importorskip("triton", reason="Triton is built for Linux only")

#: Bytes a thread may keep in memory because there are no registers for them.
LEAST = 256
ARGUMENTS = {
    **dict.fromkeys(("count", "tiles", "stride", "column", "stride_1"), "i32"),
    **dict.fromkeys(("receivers", "senders", "local_receivers", "chosen", "offsets"), "*i64"),
    **dict.fromkeys(("borders", "nodes", "updated", "weight_1", "weight_2", "weight_3"), "*fp32"),
    **dict.fromkeys(("bias_1", "bias_2", "bias_3", "scale", "shift", "residual"), "*fp32"),
    "eps": "fp32",
}
KERNELS = ("edges_pass", "border_pass", "nodes_pass", "tail_pass")


def spilled(name: str, width: int, dtype: torch.dtype, capability: int, tmp_path: Path) -> int:
    """Bytes a thread of the kernel stores for want of registers."""
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    from hood.model.kernels import triton_kernels

    kernel: Any = getattr(triton_kernels, name)
    options = triton_step.options_of(width, torch.empty(0), "tf32x3")
    constants: dict[str, Any] = {"WIDTH": width, "PADDED": width, "TILE": triton_step.tile_of(width, dtype), "CHUNK": 32}
    constants |= {"SOME": True, "SETS": 4, "ADD": True, "WIDEN": False, "PRECISION": options["PRECISION"]}
    constants = {key: value for key, value in constants.items() if key in kernel.arg_names}
    latents = {torch.float32: "*fp32", torch.bfloat16: "*bf16"}[dtype]
    types = {key: "constexpr" if key in constants else ARGUMENTS.get(key, latents) for key in kernel.arg_names}
    places = {(kernel.arg_names.index(key),): value for key, value in constants.items()}
    made = triton.compile(
        ASTSource(kernel, types, constexprs=places),
        target=GPUTarget("cuda", capability, 32),
        options={"num_warps": options["num_warps"], "num_stages": options["num_stages"]},
    )
    source = tmp_path / "kernel.ptx"
    source.write_text(made.asm["ptx"])
    machine = re.search(r"\.target (\w+)", made.asm["ptx"])
    assert machine is not None
    tools = Path(triton.__file__).parent / "backends" / "nvidia" / "bin"
    assembler = next(path for path in (tools / "ptxas-blackwell", tools / "ptxas") if path.exists())
    command = [str(assembler), "-v", f"-arch={machine[1]}", str(source), "-o", os.devnull]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stderr
    found = re.search(r"(\d+) bytes spill stores", said)
    assert found is not None, said
    return int(found[1])


@pytest.mark.parametrize("capability", [80, 90, 120])
@pytest.mark.parametrize("width, dtype", [(64, torch.float32), (64, torch.bfloat16), (128, torch.bfloat16)], ids=str)
def test_registers_suffice(width, dtype, capability, tmp_path, monkeypatch):
    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path / "cache"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = {name: spilled(name, width, dtype, capability, tmp_path) for name in KERNELS}
    assert max(found.values()) <= LEAST, found
