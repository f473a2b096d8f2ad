"""Resume checkpoints: atomic, and never a vehicle for code."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest
import torch

from hood.training.checkpoint import load_checkpoint, save_checkpoint

STATE = {
    "iteration": 3, "seed": 0, "skipped": 0, "simulator": {"a": torch.arange(4.0)}, "average": {}, "optimizer": {},
    "slots": {0: {"live": True}}, "rng": torch.get_rng_state(), "model": {"latent_dim": 8},
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
    with pytest.raises(FileNotFoundError):
        load_checkpoint(tmp_path / "none.pt")
