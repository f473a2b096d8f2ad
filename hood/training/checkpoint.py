"""Training checkpoints: everything a run needs to go on exactly, written atomically, read without unpickling classes.

The checkpoint before the newest stays beside it: a file that a failing disk spoilt costs one interval, not the run.
"""

from __future__ import annotations

import hashlib
import io
import itertools
import os
import pickle
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hood.assets.files.atomic import write_atomically
from hood.assets.garment.garment import Garment
from hood.steppers.checkpoint import read_header
from hood.training.settings import TrainerSettings

#: What a run cannot go on without.
_KEYS = {"iteration", "seed", "skipped", "skipped_in_row", "rollbacks", "best", "simulator", "average", "optimizer", "slots"}
_KEYS |= {"rng", "window", "model", "earlier"}


def previous(path: Path) -> Path:
    """Where the checkpoint before the one at ``path`` is: ``checkpoint.previous.pt`` for ``checkpoint.pt``."""
    return path.with_name(f"{path.stem}.previous{path.suffix}")


def save_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write ``state`` (tensors and plain values) to ``path``; the old file stays as :func:`previous`.

    Raises:
        OSError: no space or no permission; the old files are untouched.
    """
    # Through memory: a full disk is then a plain OSError, not one buried in the archive writer's own.
    buffer = io.BytesIO()
    torch.save(state, buffer)
    write_atomically(path, buffer.getvalue(), keep=previous(path))


def require_plain(key: str, state: Any) -> None:
    """Raise ValueError where a checkpoint could not be read back with ``state``, which is of the class under ``key``."""
    buffer = io.BytesIO()
    try:
        torch.save(state, buffer)
        torch.load(io.BytesIO(buffer.getvalue()), weights_only=True)
    except Exception as error:  # whatever a class of somebody else's raises
        raise ValueError(
            f"{key}: state_dict() holds what no checkpoint can; keep in it numbers, texts, lists, tables and tensors alone"
        ) from error


def load_checkpoint(path: Path) -> dict[str, Any]:
    """Read a training checkpoint; only tensors and plain values are accepted, and checksums must hold.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not a training checkpoint, or a damaged one.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()  # torch.load would take flipped bits for weights
            if damaged is not None:
                raise ValueError(f"checksum of {damaged} does not hold")
        state = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise
    except Exception as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(f"{path}: not a readable training checkpoint ({reason})") from error
    if not isinstance(state, dict) or not _KEYS <= set(state):
        raise ValueError(f"{path}: not a training checkpoint; give the checkpoint.pt of a run folder")
    return state


def set_aside(path: Path) -> None:
    """Rename a damaged checkpoint, so that the next one written does not push the last good one out for it."""
    if path.exists():
        os.replace(path, path.with_name(f"{path.stem}.damaged{path.suffix}"))


def load_last_good(path: Path) -> tuple[dict[str, Any], str | None]:
    """The checkpoint at ``path``, or the previous one where that is missing or damaged, and then a sentence that says so.

    Raises:
        FileNotFoundError: neither exists.
        ValueError: neither can be read.
    """
    try:
        return load_checkpoint(path), None
    except (FileNotFoundError, ValueError) as error:
        older = previous(path)
        if not older.exists():
            raise
        reason = f"{path}: no such file" if isinstance(error, FileNotFoundError) else str(error)
        try:
            state = load_checkpoint(older)
        except ValueError as second:
            raise ValueError(f"{reason}; and {second}") from error
        return state, f"{reason}; going on from {older.name}, iteration {state['iteration']}"


def reached(folder: Path) -> tuple[int, bool]:
    """How many iterations the run in ``folder`` would go on from, 0 where it has no checkpoint, and whether its
    ``model.safetensors`` is of that iteration; no tensor is read."""
    path = folder / "checkpoint.pt"
    for file in (path, previous(path)):
        try:
            state = torch.load(file, map_location="cpu", weights_only=True, mmap=True)
            iteration, behind = int(state["iteration"]), int(state["iteration"]) + int(state["earlier"])
        except (OSError, EOFError, RuntimeError, ValueError, LookupError, TypeError, pickle.UnpicklingError):
            # missing, cut or no checkpoint; resuming says which
            continue
        try:
            return iteration, int(read_header(folder / "model.safetensors")["iteration"]) == behind
        except (OSError, ValueError, KeyError):
            return iteration, False
    return 0, False


def refuse_other(
    path: Path, state: Mapping[str, Any], config: Mapping[str, Any], seed: int, settings: TrainerSettings, num_slots: int
) -> None:
    """Refuse the checkpoint of a run with another model, another seed, another optimiser or other scenes.

    Args:
        config: of this run's model; ``num_slots`` running scenes are its own.

    Raises:
        ValueError: with what to pass.
    """
    if state["model"] != config:
        raise ValueError(f"{path}: trained with model {state['model']}, this run has {config}")
    if state["seed"] != seed:
        raise ValueError(f"{path}: trained with seed {state['seed']}; pass seed={state['seed']} to resume it")
    white = state.get("whitening") is not None
    if white != settings.whitening:
        raise ValueError(
            f"{path}: the optimiser is of a training with trainer.whitening={str(white).lower()}; pass "
            f"trainer.whitening={str(white).lower()} to resume it"
        )
    if len(state["slots"]) != num_slots:
        if settings.max_vertices is None:
            raise ValueError(f"{path}: trained with trainer.batch_size={len(state['slots'])}; pass the same to resume it")
        raise ValueError(
            f"{path}: trained with {len(state['slots'])} running scenes, this run has {num_slots}; pass the "
            "same trainer.batch_size, trainer.max_vertices and data.garments to resume it"
        )


def marks_of(garments: Sequence[Garment]) -> list[str]:
    """Name and checksum of every garment, for a checkpoint: files may change between two parts of a run."""
    marks = []
    for garment in garments:
        content = hashlib.sha256()
        for array in (garment.rest_pos, garment.faces, garment.flat, garment.elastic):
            content.update(b"" if array is None else np.ascontiguousarray(array).tobytes())
        marks.append(f"{garment.name} ({content.hexdigest()[:12]})")
    return marks


def refuse_other_garments(path: Path, state: Mapping[str, Any], garments: Sequence[Garment]) -> None:
    """Refuse the checkpoint of a run on other garments; older ones do not say on which.

    Raises:
        ValueError: with the first garment that is another.
    """
    here = marks_of(garments)
    there = state.get("garments", here)
    for one, other in itertools.zip_longest(there, here, fillvalue="none"):
        if one != other:
            raise ValueError(
                f"{path}: trained on {len(there)} garments, this run has {len(here)}; the first that differs is {one} there, "
                f"{other} here; give back the files of data.garments and data.patterns to resume it"
            )


def generator_states(device: torch.device) -> dict[str, Tensor]:
    """States of torch's random generators, for a checkpoint."""
    states = {"cpu": torch.get_rng_state()}
    return states | ({"cuda": torch.cuda.get_rng_state(device)} if device.type == "cuda" else {})


def set_generator_states(states: Mapping[str, Tensor], device: torch.device) -> None:
    """The inverse of :func:`generator_states`."""
    torch.set_rng_state(states["cpu"])
    if "cuda" in states and device.type == "cuda":
        torch.cuda.set_rng_state(states["cuda"], device)
