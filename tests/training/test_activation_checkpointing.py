"""Activation checkpointing: fewer tensors kept for the backward pass, the same update to the last bit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor
from torch.autograd.graph import saved_tensors_hooks

from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.assets.motion.sequence import PoseSequence
from hood.energies.potential import default_potential
from hood.steppers.network import build_simulator
from hood.training.scenes import SceneSampler
from hood.training.settings import TrainerSettings
from hood.training.trainer import Trainer


@pytest.fixture(scope="module")
def sampler(body: Body, garments: dict[str, Garment], walk: PoseSequence) -> SceneSampler:
    return SceneSampler(body, [garments["tank"]], [walk.window(0, 60)])


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_the_same_gradient_from_less_memory(precision: str, tmp_path: Path, sampler: SceneSampler) -> None:
    settings = TrainerSettings(iterations=9, statistics_iterations=0, precision=precision)
    kept, gradients, reports = {}, {}, {}
    for on in (False, True):
        torch.manual_seed(0)
        simulator = build_simulator(schedule="2x(mesh+coarse0) 2x(coarse0)", latent_dim=16)
        on_settings = replace(settings, activation_checkpointing=on)
        trainer = Trainer(simulator, default_potential(), sampler, on_settings, tmp_path, seed=0)
        sizes: dict[int, int] = {}

        def keep(value: Tensor, sizes: dict[int, int] = sizes) -> Tensor:
            sizes[value.untyped_storage().data_ptr()] = value.untyped_storage().nbytes()
            return value

        with saved_tensors_hooks(keep, lambda value: value):
            reports[on] = trainer.update()
        kept[on] = sum(sizes.values())
        gradients[on] = {name: p.grad for name, p in simulator.named_parameters()}
    assert kept[True] < 0.7 * kept[False]
    assert reports[True] == reports[False]
    assert any(bool(grad.any()) for grad in gradients[False].values() if grad is not None)
    for name, grad in gradients[False].items():
        other = gradients[True][name]
        assert (grad is None) == (other is None)
        assert grad is None or torch.equal(grad, other), name
