"""``device=cuda`` before anything is computed: a GPU for every process, or one sentence."""

from __future__ import annotations

import pytest
import torch

from hood.app.common import require_device
from hood.app.settings.compose import ConfigError, load_config


@pytest.fixture
def taken(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """GPUs that processes have taken, on a machine that seems to have two."""
    found: list[int] = []
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "set_device", found.append)
    return found


@pytest.mark.parametrize("rank", [0, 1])
def test_every_process_takes_the_gpu_of_its_rank(monkeypatch: pytest.MonkeyPatch, taken: list[int], rank: int) -> None:
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "2")
    monkeypatch.setenv("LOCAL_RANK", str(rank))
    require_device(load_config("rollout", ["device=cuda"]))
    assert taken == [rank]


def test_more_processes_than_gpus_are_refused(monkeypatch: pytest.MonkeyPatch, taken: list[int]) -> None:
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "4")
    with pytest.raises(ConfigError, match="4 processes and 2 GPUs here; --nproc-per-node 2"):
        require_device(load_config("train", ["device=cuda"]))
    assert not taken


def test_a_cpu_takes_no_gpu(taken: list[int]) -> None:
    require_device(load_config("rollout", ["device=cpu"]))
    assert not taken


def test_no_gpu_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ConfigError, match="no CUDA device is available; use device=cpu"):
        require_device(load_config("rollout", ["device=cuda"]))
