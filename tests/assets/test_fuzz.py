"""Damaged and harmful files: every reader answers with one clear error, in time and in little memory, and runs nothing."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

_WORKER = Path(__file__).with_name("fuzz_worker.py")


def fuzz(folder: Path, count: int, seed: int, timeout: float) -> None:
    command = [sys.executable, str(_WORKER), str(count), str(seed), str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    report = json.loads(done.stdout.splitlines()[-1])
    assert report["tried"] == count
    assert report["failures"] == []


def test_a_hundred_damaged_files(tmp_path: Path) -> None:
    fuzz(tmp_path, 112, seed=0, timeout=600)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_thousands_of_damaged_files(tmp_path: Path, seed: int) -> None:
    fuzz(tmp_path, 560, seed=100 + seed, timeout=600)
