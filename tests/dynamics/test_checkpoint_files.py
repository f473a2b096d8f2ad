"""Checkpoints on disk: what is read is what was written, and other files are refused in one sentence."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from small_simulators import KINDS, make, take

from hood.dynamics.checkpoint import load_simulator, save_simulator
from hood.scene.scene import Scene


@pytest.mark.parametrize("kind", KINDS)
def test_round_trip_through_a_file(kind: str, tmp_path: Path, tank_scene: Scene) -> None:
    simulator = make(kind)
    simulator.train()
    take(simulator, tank_scene)  # statistics are part of the model
    simulator.eval()
    save_simulator(tmp_path / "m.safetensors", simulator, {"iteration": "7"})
    loaded = load_simulator(tmp_path / "m.safetensors")
    assert loaded.config == simulator.config
    assert not loaded.training
    assert torch.equal(take(loaded, tank_scene)[1].pos, take(simulator, tank_scene)[1].pos)
    assert [path.name for path in tmp_path.iterdir()] == ["m.safetensors"]


def test_half_precision_file(tmp_path: Path, tank_scene: Scene) -> None:
    simulator = make("physical")
    save_simulator(tmp_path / "full.safetensors", simulator)
    save_simulator(tmp_path / "half.safetensors", simulator, half=True)
    sizes = [(tmp_path / f"{name}.safetensors").stat().st_size for name in ("half", "full")]
    assert sizes[0] < 0.75 * sizes[1]
    loaded = load_simulator(tmp_path / "half.safetensors")
    assert {p.dtype for p in loaded.parameters()} == {torch.float32}
    assert float((take(loaded, tank_scene)[1].pos - take(simulator, tank_scene)[1].pos).abs().max()) < 1e-4


def damaged(path: Path, case: str) -> Path:
    simulator = make("physical")
    save_simulator(path, simulator)
    content = path.read_bytes()
    header = {"format": "hood-1", "model": json.dumps(simulator.config)}
    weights = {name: value.clone() for name, value in simulator.state_dict().items()}
    if case == "cut":
        path.write_bytes(content[: len(content) // 2])
    elif case == "empty":
        path.write_bytes(b"")
    elif case == "text":
        path.write_text("hello")
    elif case == "foreign":
        save_file({"weight": torch.zeros(3)}, path)
    elif case == "missing weight":
        save_file(dict(list(weights.items())[1:]), path, header)
    elif case == "wrong shape":
        name = next(iter(weights))
        save_file({**weights, name: torch.zeros(1)}, path, header)
    elif case == "unknown option":
        save_file(weights, path, {**header, "model": json.dumps({**simulator.config, "heads": 4})})
    elif case == "no model":
        save_file(weights, path, {"format": "hood-1"})
    elif case == "model is no JSON":
        save_file(weights, path, {**header, "model": "small"})
    return path


@pytest.mark.parametrize(
    "case",
    [
        "cut", "empty", "text", "foreign", "missing weight", "wrong shape", "unknown option", "no model",
        "model is no JSON",
    ],
)  # fmt: skip
def test_damaged_and_foreign_files_are_refused_in_one_sentence(tmp_path: Path, case: str) -> None:
    path = damaged(tmp_path / "m.safetensors", case)
    with pytest.raises(ValueError, match=r"m\.safetensors: ") as error:
        load_simulator(path)
    assert "\n" not in str(error.value)


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "m.safetensors"
    save_simulator(path, make("physical"))
    before = path.read_bytes()
    with pytest.raises(TypeError):
        save_simulator(path, make("physical", seed=1), {"iteration": 3})  # type: ignore[dict-item]
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["m.safetensors"]
