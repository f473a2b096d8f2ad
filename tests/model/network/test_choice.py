"""``kernels=auto``: the fastest form is taken, kept and told; what cannot be kept is not measured."""

import json

import pytest
import torch

from hood.model.graph.builder import BODY, MESH
from hood.model.network import kernel_choice
from hood.model.network.kernel_choice import choose_for, choose_kernels, time_forms
from hood.model.network.model import MeshGraphNet
from hood.native.build import BuildError

CPU = torch.device("cpu")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A cache folder of its own, and a processor on which every form works."""
    monkeypatch.setenv("HOOD_CACHE", str(tmp_path))
    monkeypatch.setattr(kernel_choice, "check_kernels", lambda *arguments: None)
    return tmp_path / "kernels"


def times(monkeypatch, **seconds):
    """Let the forms take so long; returns what was timed."""
    asked = []

    def measured(forms, *arguments):
        asked.append((forms, *arguments))
        return {name: seconds[name] for name in forms}

    monkeypatch.setattr(kernel_choice, "time_forms", measured)
    return asked


def test_the_fastest_form_is_taken_and_kept(folder, monkeypatch):
    asked = times(monkeypatch, torch=0.0035, compiled=0.002, fused=0.001)
    found = choose_kernels("fp32", 64, CPU)
    assert found.kernels == "fused"
    listed = "forward, fp32: fused 1.0, compiled 2.0, torch 3.5"
    assert str(found) == f"kernels=auto: fused (ms of 2 steps at 1,089 vertices, {listed})"
    times(monkeypatch, torch=1.0, compiled=2.0, fused=3.0)
    assert choose_kernels("fp32", 64, CPU) == found  # a busy moment later does not change it
    assert choose_kernels("fp32", 64, CPU, training=True).kernels == "torch"
    assert choose_kernels("bf16", 64, CPU).kernels == "torch"
    assert choose_kernels("fp32", 128, CPU).kernels == "torch"
    assert asked == [(["torch", "compiled", "fused"], "fp32", 64, False)]
    assert len(list(folder.iterdir())) == 4


def test_a_network_with_parts_of_an_own_class_is_computed_by_torch(folder, monkeypatch):
    class Own(MeshGraphNet):
        """A network that somebody has written."""

    times(monkeypatch, torch=3.0, compiled=2.0, fused=1.0)
    known, own = (kind(4, {MESH: 4, BODY: 4}, 16, "1x(mesh)") for kind in (MeshGraphNet, Own))
    assert choose_for(known, "fp32", CPU).kernels == "fused"
    found = choose_for(own, "fp32", CPU)
    assert found.kernels == "torch"
    assert "Own is computed as its class says" in str(found)
    times(monkeypatch, torch=2.0, compiled=1.0)
    assert choose_for(own, "fp32", CPU, training=True).kernels == "compiled"  # the same function, of every part that it knows


def test_gradients_of_the_fused_form_are_those_of_torch(folder, monkeypatch):
    asked = times(monkeypatch, torch=2.0, compiled=1.0)
    assert choose_kernels("bf16", 64, CPU, training=True).kernels == "compiled"
    assert asked == [(["torch", "compiled"], "bf16", 64, True)]


@pytest.mark.parametrize("damage", ["", "{}", '{"kernels": "magic", "reason": ""}', '["fused"]', '{"kernels": null}'])
def test_a_damaged_record_is_made_anew(folder, monkeypatch, damage):
    asked = times(monkeypatch, torch=3.0, compiled=1.0, fused=2.0)
    found = choose_kernels("fp32", 64, CPU)
    (path,) = folder.iterdir()
    path.write_text(damage)
    monkeypatch.undo()
    monkeypatch.setenv("HOOD_CACHE", str(folder.parent))
    monkeypatch.setattr(kernel_choice, "_measure", lambda *arguments: asked.append(arguments) or found)
    assert choose_kernels("fp32", 64, CPU) == found
    assert len(asked) == 2
    assert json.loads(path.read_text())["kernels"] == "compiled"


def test_without_a_compiler_torch_is_taken_and_the_reason_told(folder, monkeypatch):
    def refuse(name, *arguments):
        if name != "torch":
            raise BuildError(f"kernels={name}: no C++ compiler: install g++ or use kernels=torch")

    monkeypatch.setattr(kernel_choice, "check_kernels", refuse)
    asked = times(monkeypatch)
    found = choose_kernels("fp32", 64, CPU)
    assert found.kernels == "torch"
    assert str(found) == "kernels=auto: torch (no C++ compiler: install g++)"
    assert not asked


@pytest.mark.parametrize("device, precision", [("cuda", "fp32"), ("cpu", "tf32")])
def test_elsewhere_there_is_no_choice(folder, monkeypatch, device, precision):
    asked = times(monkeypatch)
    assert choose_kernels(precision, 64, torch.device(device)).kernels == "torch"
    assert not asked


def test_what_cannot_be_kept_is_not_measured(folder, monkeypatch):
    asked = times(monkeypatch, torch=3.0, compiled=1.0, fused=2.0)
    monkeypatch.setenv("HOOD_CACHE", "off")
    found = choose_kernels("fp32", 64, CPU)
    assert (found.kernels, asked) == ("torch", [])
    assert "HOOD_CACHE" in str(found)
    monkeypatch.setenv("HOOD_CACHE", str(folder.parent))
    folder.write_text("in the way")
    found = choose_kernels("fp32", 64, CPU)
    assert found.kernels == "torch"
    assert str(folder.parent) in str(found)


@pytest.mark.parametrize("training", [False, True])
@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_a_timing_is_one_of_every_form_and_draws_no_random_numbers(precision, training):
    before = torch.get_rng_state()
    found = time_forms(["torch"], precision, 16, training)
    assert torch.equal(torch.get_rng_state(), before)
    assert list(found) == ["torch"]
    assert 0 < found["torch"] < float("inf")
