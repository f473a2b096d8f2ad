"""What a test module computes by Triton's interpreter, as a script of its own; Triton decides at its import."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch


def interpret(script: str, what: str, tmp_path: Path, seconds: int) -> Any:
    """What ``python script what PATH`` has written with ``torch.save``."""
    pytest.importorskip("triton", reason="Triton is built for Linux only")
    path, root = tmp_path / "results.pt", str(Path(__file__).parents[1])
    search = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = {**os.environ, "TRITON_INTERPRET": "1", "PYTHONPATH": search}
    subprocess.run([sys.executable, script, what, str(path)], check=True, env=environment, timeout=seconds)
    return torch.load(path)
