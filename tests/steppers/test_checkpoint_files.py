"""Checkpoints on disk: what is read is what was written, and other files are refused in one sentence."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from small_simulators import KINDS, make, take

from hood.energies.potential import default_potential
from hood.scene.scene import Scene
from hood.steppers.checkpoint import load_simulator, read_header, record_ranges, save_simulator
from hood.steppers.ranges import Conditions


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


def test_the_same_weights_are_the_same_bytes(tmp_path: Path) -> None:
    simulator, told = make("physical"), {name: name for name in ("iteration", "seed", "garments", "budget", "commit")}
    files = [tmp_path / f"{number}.safetensors" for number in range(4)]
    for path in files:
        save_simulator(path, simulator, told)
    assert len({path.read_bytes() for path in files}) == 1
    begin = 8 + int.from_bytes(files[0].read_bytes()[:8], "little")
    assert begin % 8 == 0


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
    elif case == "ranges are no ranges":
        save_file(weights, path, {**header, "ranges": "[30, 60]"})
    elif case == "model is no JSON":
        save_file(weights, path, {**header, "model": "small"})
    return path


@pytest.mark.parametrize(
    "case",
    [
        "cut", "empty", "text", "foreign", "missing weight", "wrong shape", "unknown option", "no model",
        "model is no JSON", "ranges are no ranges",
    ],
)  # fmt: skip
def test_damaged_and_foreign_files_are_refused_in_one_sentence(tmp_path: Path, case: str) -> None:
    path = damaged(tmp_path / "m.safetensors", case)
    with pytest.raises(ValueError, match=r"m\.safetensors: ") as error:
        load_simulator(path)
    assert "\n" not in str(error.value)


def test_ranges_travel_with_the_weights(tmp_path: Path) -> None:
    trained_for = Conditions({"fps": (24.0, 30.0)}, default_potential().settings)
    simulator = make("physical")
    assert simulator.trained_for is None
    save_simulator(tmp_path / "old.safetensors", simulator)
    assert load_simulator(tmp_path / "old.safetensors").trained_for is None
    simulator.trained_for = trained_for
    save_simulator(tmp_path / "new.safetensors", simulator.clone(), half=True)
    assert load_simulator(tmp_path / "new.safetensors").trained_for == trained_for


def test_a_caution_travels_with_the_weights_as_one_line(tmp_path: Path) -> None:
    simulator, path = make("paper"), tmp_path / "m.safetensors"
    save_simulator(path, simulator)
    assert load_simulator(path).caution is None
    simulator.caution = "no rollout of it\nis \x1b[31museful yet" + 400 * "!"
    save_simulator(path, simulator.clone(), half=True)
    caution = load_simulator(path).caution
    assert caution is not None
    assert caution.startswith("no rollout of it is [31museful yet!")
    assert len(caution) == 300


@pytest.mark.parametrize("half", [False, True])
def test_ranges_are_recorded_without_touching_the_tensors(half: bool, tmp_path: Path) -> None:
    path, trained_for = tmp_path / "m.safetensors", Conditions({"fps": (24.0, 30.0)}, default_potential().settings)
    save_simulator(path, make("paper"), {"iteration": "7"}, half=half)
    with safe_open(path, "pt") as file:
        before = {name: file.get_tensor(name) for name in file.keys()}
    for ranges in (replace(trained_for, spans={}), trained_for):  # a second time they are replaced
        record_ranges(path, ranges)
    assert load_simulator(path).trained_for == trained_for
    assert read_header(path)["iteration"] == "7"
    with safe_open(path, "pt") as file:
        assert set(file.keys()) == set(before)
        assert all(
            value.dtype == file.get_tensor(n).dtype and torch.equal(value, file.get_tensor(n)) for n, value in before.items()
        )
    assert [file.name for file in tmp_path.iterdir()] == ["m.safetensors"]


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "m.safetensors"
    save_simulator(path, make("physical"))
    before = path.read_bytes()
    with pytest.raises(TypeError):
        save_simulator(path, make("physical", seed=1), {"iteration": 3})  # type: ignore[dict-item]
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["m.safetensors"]
