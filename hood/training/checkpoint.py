"""Training checkpoints: everything a run needs to go on exactly, written atomically, read without unpickling classes."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import torch


def save_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write ``state`` (tensors and plain values) to ``path``; the old file stays until the new one is complete."""
    temporary = path.with_name(path.name + ".partial")
    try:
        with open(temporary, "wb") as file:
            torch.save(state, file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def load_checkpoint(path: Path) -> dict[str, Any]:
    """Read a training checkpoint; only tensors and plain values are accepted.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not a training checkpoint.
    """
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise
    except Exception as error:
        raise ValueError(f"{path}: not a readable training checkpoint ({str(error).splitlines()[0]})") from error
    if not isinstance(state, dict) or "iteration" not in state:
        raise ValueError(f"{path}: not a training checkpoint; give the checkpoint.pt of a run folder")
    return state
