"""Resume checkpoints: atomic, and never a vehicle for code."""

from __future__ import annotations

import errno
import os
import pickle
import random
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from hood.training.checkpoint import load_checkpoint, load_last_good, previous, save_checkpoint, set_aside

STATE = {
    "iteration": 3, "seed": 0, "skipped": 0, "skipped_in_row": 0, "rollbacks": [0, 0, -1], "best": 0.5,
    "simulator": {"a": torch.arange(4.0)}, "average": {}, "optimizer": {}, "slots": {0: {"live": True}},
    "window": [[]], "rng": [{"cpu": torch.get_rng_state()}], "earlier": 0, "model": {"latent_dim": 8},
}  # fmt: skip


def test_round_trip(tmp_path: Path) -> None:
    save_checkpoint(tmp_path / "c.pt", STATE)
    state = load_checkpoint(tmp_path / "c.pt")
    assert torch.equal(state["simulator"]["a"], STATE["simulator"]["a"])
    assert state["slots"] == STATE["slots"]
    assert [path.name for path in tmp_path.iterdir()] == ["c.pt"]


class Unwritable:
    def __reduce__(self) -> tuple:
        raise RuntimeError("cannot be written")


def test_a_failed_write_keeps_the_old_file(tmp_path: Path) -> None:
    save_checkpoint(tmp_path / "c.pt", STATE)
    with pytest.raises(RuntimeError, match="cannot be written"):
        save_checkpoint(tmp_path / "c.pt", {**STATE, "iteration": 4, "bad": Unwritable()})
    assert load_checkpoint(tmp_path / "c.pt")["iteration"] == 3
    assert [path.name for path in tmp_path.iterdir()] == ["c.pt"]


class Payload:
    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple:
        return (Path.touch, (self.path,))


@pytest.mark.filterwarnings("ignore:Detected pickle protocol")
def test_pickled_classes_are_refused_and_not_run(tmp_path: Path) -> None:
    torch.save({"iteration": 1, "payload": Payload(tmp_path / "ran")}, tmp_path / "c.pt")
    (tmp_path / "plain.pt").write_bytes(pickle.dumps(Payload(tmp_path / "ran")))
    for name in ("c.pt", "plain.pt"):
        with pytest.raises(ValueError, match=f"{name}: not a readable training checkpoint"):
            load_checkpoint(tmp_path / name)
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("share", [0.0, 0.3, 0.95])
def test_truncated_files_are_refused(tmp_path: Path, share: float) -> None:
    save_checkpoint(tmp_path / "c.pt", STATE)
    content = (tmp_path / "c.pt").read_bytes()
    (tmp_path / "c.pt").write_bytes(content[: int(share * len(content))])
    with pytest.raises(ValueError, match=r"c\.pt: not a readable training checkpoint") as error:
        load_checkpoint(tmp_path / "c.pt")
    assert "\n" not in str(error.value)


def test_other_torch_files_are_refused(tmp_path: Path) -> None:
    torch.save({"iteration": 1, "weight": torch.ones(2)}, tmp_path / "model.pt")
    with pytest.raises(ValueError, match=r"model\.pt: not a training checkpoint; give the checkpoint\.pt"):
        load_checkpoint(tmp_path / "model.pt")
    torch.save(torch.ones(2), tmp_path / "tensor.pt")
    with pytest.raises(ValueError, match="not a training checkpoint"):
        load_checkpoint(tmp_path / "tensor.pt")


def test_missing_file(tmp_path: Path) -> None:
    for load in (load_checkpoint, load_last_good):
        with pytest.raises(FileNotFoundError):
            load(tmp_path / "none.pt")


def test_flipped_bits_are_no_weights(tmp_path: Path) -> None:
    save_checkpoint(tmp_path / "c.pt", {**STATE, "simulator": {"a": torch.full((512,), 1.25)}})
    content = bytearray((tmp_path / "c.pt").read_bytes())
    place = content.find(torch.full((8,), 1.25).numpy().tobytes())
    assert place > 0
    content[place + 2] ^= 1
    (tmp_path / "c.pt").write_bytes(content)
    with pytest.raises(ValueError, match=r"c\.pt: not a readable training checkpoint \(checksum"):
        load_checkpoint(tmp_path / "c.pt")


def test_the_last_two_checkpoints_are_kept(tmp_path: Path) -> None:
    for iteration in (1, 2, 3):
        save_checkpoint(tmp_path / "c.pt", {**STATE, "iteration": iteration})
    assert sorted(path.name for path in tmp_path.iterdir()) == ["c.previous.pt", "c.pt"]
    assert load_checkpoint(tmp_path / "c.pt")["iteration"] == 3
    assert load_checkpoint(previous(tmp_path / "c.pt"))["iteration"] == 2
    assert load_last_good(tmp_path / "c.pt")[1] is None


@pytest.mark.parametrize("damage", ["truncated", "missing"])
def test_a_damaged_checkpoint_gives_way_to_the_previous_one(damage: str, tmp_path: Path) -> None:
    path = tmp_path / "c.pt"
    for iteration in (1, 2):
        save_checkpoint(path, {**STATE, "iteration": iteration})
    if damage == "missing":
        path.unlink()
    else:
        path.write_bytes(path.read_bytes()[:900])
    state, note = load_last_good(path)
    assert state["iteration"] == 1
    assert note is not None
    assert "c.pt: " in note
    assert "c.previous.pt, iteration 1" in note
    # The next checkpoint must not push the good one out for the damaged one.
    set_aside(path)
    save_checkpoint(path, {**STATE, "iteration": 5})
    assert load_checkpoint(path)["iteration"] == 5
    assert load_checkpoint(previous(path))["iteration"] == 1
    path.write_bytes(b"")
    previous(path).write_bytes(b"")
    with pytest.raises(ValueError, match=r"c\.pt: not a readable .* and .*c\.previous\.pt: not a readable"):
        load_last_good(path)


def test_a_writer_stopped_between_its_two_renames_costs_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "c.pt"
    for iteration in (1, 2):
        save_checkpoint(path, {**STATE, "iteration": iteration})
    real = os.replace

    def stopped(source: Path, target: Path) -> None:
        if target == path:
            raise KeyboardInterrupt
        real(source, target)

    monkeypatch.setattr("os.replace", stopped)
    with pytest.raises(KeyboardInterrupt):
        save_checkpoint(path, {**STATE, "iteration": 3})
    monkeypatch.undo()
    assert load_checkpoint(path)["iteration"] == 2
    for iteration in (4, 5):
        save_checkpoint(path, {**STATE, "iteration": iteration})
        assert load_checkpoint(path)["iteration"] == iteration
    assert load_checkpoint(previous(path))["iteration"] == 4
    assert sorted(item.name for item in tmp_path.iterdir()) == ["c.previous.pt", "c.pt"]


def test_without_hard_links(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*args: object) -> None:
        raise OSError(errno.EPERM, "no links here")

    monkeypatch.setattr("os.link", refuse)
    for iteration in (1, 2):
        save_checkpoint(tmp_path / "c.pt", {**STATE, "iteration": iteration})
    assert load_checkpoint(tmp_path / "c.pt")["iteration"] == 2
    assert load_checkpoint(previous(tmp_path / "c.pt"))["iteration"] == 1


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
def test_a_full_disk_is_named_and_costs_nothing(tmp_path: Path) -> None:
    path = tmp_path / "c.pt"
    for iteration in (1, 2):
        save_checkpoint(path, {**STATE, "iteration": iteration})
    (tmp_path / "c.pt.partial").symlink_to("/dev/full")
    with pytest.raises(OSError, match="No space left") as error:
        save_checkpoint(path, {**STATE, "iteration": 3})
    assert (error.value.errno, error.value.filename) == (errno.ENOSPC, str(path))
    assert load_checkpoint(path)["iteration"] == 2
    assert load_checkpoint(previous(path))["iteration"] == 1
    assert sorted(item.name for item in tmp_path.iterdir()) == ["c.previous.pt", "c.pt"]


_WRITER = """
import sys, torch
from pathlib import Path
from hood.training.checkpoint import save_checkpoint
state = torch.load(sys.argv[1], weights_only=True)
for iteration in range(int(sys.argv[3]), 10**9):
    state["iteration"] = iteration
    state["simulator"]["a"] = torch.full((400_000,), float(iteration))
    save_checkpoint(Path(sys.argv[2]), state)
    print(iteration, flush=True)
"""


@pytest.mark.slow
def test_twenty_kills_of_a_process_that_does_nothing_but_write(tmp_path: Path) -> None:
    """At any moment there is a readable checkpoint, no older than the last one that was finished."""
    torch.save(STATE, tmp_path / "state.pt")
    path, rng, last = tmp_path / "run" / "c.pt", random.Random(4), 0
    path.parent.mkdir()
    for _ in range(20):
        arguments = [str(tmp_path / "state.pt"), str(path), str(last + 1)]
        writer = subprocess.Popen([sys.executable, "-c", _WRITER, *arguments], stdout=subprocess.PIPE, text=True)
        assert writer.stdout is not None
        told = int(writer.stdout.readline())
        time.sleep(rng.uniform(0.0, 0.15))
        writer.kill()
        finished = [told, *map(int, writer.stdout.read().split())][-1]
        writer.wait()
        state, note = load_last_good(path)
        assert note is None
        assert finished <= state["iteration"] <= finished + 1
        assert bool((state["simulator"]["a"] == state["iteration"]).all())
        assert load_checkpoint(previous(path))["iteration"] in (state["iteration"] - 1, state["iteration"])
        last = state["iteration"]
    assert last > 40
