"""The conditions of an evaluation in words: its command, the machine, how the models were trained."""

from __future__ import annotations

import platform
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from omegaconf import DictConfig

from hood.config import plain
from hood.dynamics.checkpoint import read_header
from hood.dynamics.reference import SUFFIXES
from hood.evaluation.table_one import TableConditions

#: Arguments that change nothing about the figures.
_ASIDE = ("output", "resume", "max_rollouts", "contact_sheets")


def conditions(
    config: DictConfig,
    overrides: Sequence[str],
    motions: Sequence[str],
    vertices: Mapping[str, int],
    training: Mapping[str, str],
) -> TableConditions:
    """Of an evaluation with ``config``: ``vertices`` by garment, ``training`` in words by model."""
    return TableConditions(
        command=command_line("evaluate", overrides),
        machine=machine_name(str(config.device)),
        body=f"{Path(str(config.body)).stem} (embedded)" if str(config.body) == "default" else Path(str(config.body)).name,
        motions=[Path(name).stem for name in motions],
        num_shapes=len(plain(config.shapes)),
        num_frames=int(config.num_frames),
        fps=float(config.fps),
        vertices=dict(vertices),
        training=dict(training),
    )


def command_line(command: str, overrides: Sequence[str]) -> str:
    """The command that gives the same figures: what says where files go is left out."""
    kept = [text for text in overrides if text.split("=", 1)[0].strip("+~") not in _ASIDE]
    return shlex.join(["hood", command, *kept])


def machine_name(device: str) -> str:
    """:func:`device_name`, threads of a processor, torch version."""
    threads = "" if device.startswith("cuda") else f"{torch.get_num_threads()} thread(s), "
    return f"{device_name(device)}, {threads}torch {torch.__version__}"


def device_name(device: str) -> str:
    """What the processor or the graphics card calls itself."""
    if device.startswith("cuda"):
        return torch.cuda.get_device_name(device)
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8", errors="replace").splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name") and ":" in line]
    return names[0] if names else platform.processor() or platform.machine()


def training_note(path: Path) -> str:
    """What a model file says about its training; empty where it says nothing."""
    if path.suffix.lower() in SUFFIXES:
        return "published weights"
    header = {key: value for key, value in read_header(path).items() if key not in ("format", "model", "ranges", "validation")}
    iteration = header.pop("iteration", None)
    notes = [] if iteration is None else [f"{int(iteration):,} updates"]
    return ", ".join([*notes, *(f"{key} {value}" for key, value in sorted(header.items()))])
