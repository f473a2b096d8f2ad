"""A run that is killed twenty times, at any moment, ends where the run ends that nobody disturbed."""

from __future__ import annotations

import json
import os
import random
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

from hood.steppers.checkpoint import load_simulator
from hood.training.checkpoint import load_checkpoint, load_last_good, previous

_KILLS = 20
_ITERATIONS = 80
_COMMAND = [
    sys.executable, "-m", "hood.cli.main", "train", "model.latent_dim=16", "model.schedule='1x(mesh)'",
    f"trainer.iterations={_ITERATIONS}", "trainer.batch_size=1", "trainer.log_every=1", "trainer.checkpoint_every=1",
    "trainer.horizon.start=2", "trainer.horizon.maximum=2", "trainer.workers=0", "data.garments=[tank]",
    "data.sequences=[walk_proud]",
]  # fmt: skip


def start(folder: Path, resume: bool) -> subprocess.Popen:
    environment = os.environ | {"OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
    arguments = [*_COMMAND, f"output={folder}", f"resume={str(resume).lower()}"]
    return subprocess.Popen(arguments, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def stamp(path: Path) -> int:
    try:
        return path.stat().st_mtime_ns
    except FileNotFoundError:
        return 0


def wait_for_checkpoints(process: subprocess.Popen, folder: Path, count: int) -> None:
    """Until the run has written ``count`` checkpoints."""
    seen = stamp(folder / "checkpoint.pt")
    while count and process.poll() is None:
        now = stamp(folder / "checkpoint.pt")
        count, seen = count - (now != seen), now
        time.sleep(0.001)


def wait_for_writing(process: subprocess.Popen, folder: Path) -> None:
    """Until the run is in the middle of writing a checkpoint."""
    while process.poll() is None and not (folder / "checkpoint.pt.partial").exists():
        pass


def check_files(folder: Path) -> int:
    """Every file a kill left can be read; returns the iteration that a resume goes on from."""
    path = folder / "checkpoint.pt"
    state, note = load_last_good(path)
    assert note is None, note
    if previous(path).exists():
        assert load_checkpoint(previous(path))["iteration"] in (state["iteration"] - 1, state["iteration"])
    if (folder / "model.safetensors").exists():
        load_simulator(folder / "model.safetensors")
    assert OmegaConf.load(folder / "config.yaml").trainer.iterations == _ITERATIONS
    json.loads((folder / "versions.json").read_text())
    for line in (folder / "metrics.jsonl").read_text().splitlines()[:-1]:
        json.loads(line)
    return int(state["iteration"])


def metrics(folder: Path) -> list[dict]:
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [{key: value for key, value in line.items() if key != "iterations_per_second"} for line in lines]


def tensors(value: object, path: str = "") -> dict[str, torch.Tensor]:
    if isinstance(value, torch.Tensor):
        return {path: value}
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, (list, tuple)) else ()
    return {name: item for key, part in items for name, item in tensors(part, f"{path}/{key}").items()}


@pytest.mark.slow
def test_twenty_kills_change_nothing(tmp_path: Path) -> None:
    rng = random.Random(7)
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    undisturbed = start(whole, False)
    kills, reached = 0, []
    leftovers = 0
    while kills < _KILLS:
        # Before anything is written there is nothing to resume.
        process = start(killed, (killed / "checkpoint.pt").exists())
        if kills % 5 == 4:
            time.sleep(rng.uniform(0.0, 8.0))  # while it starts or resumes, or a little later
        else:
            wait_for_checkpoints(process, killed, rng.randint(1, 3))
            if kills % 2:
                time.sleep(rng.uniform(0.0, 0.2))
            else:
                wait_for_writing(process, killed)
        process.kill()
        assert process.stderr is not None
        message = process.stderr.read()
        assert process.wait() == -9, f"ended by itself after {reached}: {message}"
        kills += 1
        leftovers += (killed / "checkpoint.pt.partial").exists()
        if (killed / "checkpoint.pt").exists():
            reached.append(check_files(killed))
    print(f"iterations reached at the kills: {reached}; {leftovers} kills left a half-written checkpoint behind")
    assert leftovers > 0
    last = start(killed, True)
    assert last.wait(timeout=300) == 0
    assert undisturbed.wait(timeout=300) == 0
    assert reached[-1] > 10
    assert metrics(killed) == metrics(whole)
    states = [tensors(load_checkpoint(folder / "checkpoint.pt")) for folder in (whole, killed)]
    assert states[0].keys() == states[1].keys()
    assert all(torch.equal(value, states[1][name]) for name, value in states[0].items())
    models = [load_simulator(folder / "model.safetensors").state_dict() for folder in (whole, killed)]
    assert all(torch.equal(value, models[1][name]) for name, value in models[0].items())


@pytest.mark.slow
def test_sigterm_ends_a_run_with_a_checkpoint(tmp_path: Path) -> None:
    """Exit code 130, the iterations done are kept, and a line says how to go on."""
    folder = tmp_path / "run"
    environment = os.environ | {"OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
    command = [*_COMMAND, f"output={folder}", "trainer.checkpoint_every=1000", "trainer.iterations=100000"]
    process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    while process.poll() is None and (not (folder / "metrics.jsonl").exists() or not (folder / "metrics.jsonl").read_text()):
        time.sleep(0.01)
    process.terminate()
    assert process.stderr is not None
    message = process.stderr.read()
    assert process.wait() == 130
    iteration = load_checkpoint(folder / "checkpoint.pt")["iteration"]
    assert iteration >= 1
    assert metrics(folder)[-1]["iteration"] == iteration
    assert f"stopped at iteration {iteration}; the same command with resume=true goes on" in message
