"""Training checkpoints: everything a run needs to go on exactly, written atomically, read without unpickling classes."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import torch

#: What a run cannot go on without.
_KEYS = {"iteration", "seed", "skipped", "simulator", "average", "optimizer", "slots", "rng", "model"}


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
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(f"{path}: not a readable training checkpoint ({reason})") from error
    if not isinstance(state, dict) or not _KEYS <= set(state):
        raise ValueError(f"{path}: not a training checkpoint; give the checkpoint.pt of a run folder")
    return state
