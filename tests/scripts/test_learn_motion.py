"""The example that trains a network on rollouts, in small."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).parents[2]


def test_a_network_is_trained_on_rollouts_and_beats_constant_velocity(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    main = runpy.run_path(str(ROOT / "scripts" / "learn_motion.py"))["main"]
    errors = []
    for epochs in ("0", "6"):
        with torch.random.fork_rng():
            main(motions="walk_steady,walk_proud", num_frames="20", epochs=epochs)
        told = re.search(r"walk_proud, one step: network ([\d.]+) mm, constant velocity ([\d.]+) mm", capsys.readouterr().out)
        assert told is not None
        errors.append((float(told[1]), float(told[2])))
    (before, still), (after, same) = errors
    assert still == same > before > after
