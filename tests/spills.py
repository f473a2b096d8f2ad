"""Triton kernels compiled for a GPU that is not there: how many bytes a thread keeps in memory."""

import os
import re
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

#: Bytes a thread may keep in memory because there are no registers for them.
LEAST = 256
#: Generations of GPUs: Ampere, Hopper, Blackwell.
CAPABILITIES = [pytest.param(80, marks=pytest.mark.slow), 90, pytest.param(120, marks=pytest.mark.slow)]


def spilled(
    kernel: Any,
    types: Mapping[str, str],
    constants: Mapping[str, Any],
    options: Mapping[str, Any],
    capability: int,
    tmp_path: Path,
) -> int:
    """Bytes a thread of the kernel stores for want of registers.

    Args:
        types: of the arguments that are no constants, by name.
        constants: by name; those that the kernel does not have are passed over.
    """
    import triton
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    given = {key: value for key, value in constants.items() if key in kernel.arg_names}
    signature = {key: "constexpr" if key in given else types[key] for key in kernel.arg_names}
    places = {(kernel.arg_names.index(key),): value for key, value in given.items()}
    made = triton.compile(
        ASTSource(kernel, signature, constexprs=places), target=GPUTarget("cuda", capability, 32), options=dict(options)
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
