"""Damaged and harmful files: every reader answers with one clear error, in time and in little memory, and runs nothing."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from hood.app.settings.compose import ConfigError, load_config
from hood.app.settings.record import require_same_config
from hood.assets.identify import identify
from hood.rollouts.file.reader import read_rollout

FUZZ = Path(__file__).parents[2] / "benchmarks" / "fuzz.py"


def fuzz(count: int, seed: int) -> None:
    command = [sys.executable, str(FUZZ), "--count", str(count), "--seed", str(seed)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=FUZZ.parents[1])
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    total = next(line for line in done.stdout.splitlines() if line.startswith("| all |"))
    read, refused, failures = map(int, total.split("|")[3:6])
    assert read + refused == count
    assert failures == 0


def test_some_hundred_damaged_files() -> None:
    fuzz(310, seed=0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_thousands_of_damaged_files(seed: int) -> None:
    fuzz(1000, seed=100 + seed)


def test_a_rollout_whose_tables_lie_in_another_file_is_refused(tmp_path: Path) -> None:
    """Links may name any file of the machine; nothing is read from there, to tell what the file is either."""
    outside = tmp_path / "outside.h5"
    pos, faces = np.eye(3)[None], np.array([[0, 1, 2]])
    with h5py.File(outside, "w") as file:
        file["cloth/pos"] = file["body/pos"] = pos
        file["cloth/faces"] = file["body/faces"] = faces
        file["cloth/rest_pos"], file["time"], file["metrics/strain_p99"] = pos[0], np.zeros(1), np.zeros(1)
        file.attrs.update({"num_frames": 1, "complete": True, "dt": 1 / 30})
    content = outside.read_bytes()
    assert len(read_rollout(outside).metrics) == 1
    for key in ("cloth", "metrics", "cloth/pos", "body/faces", "metrics/strain_p99"):
        path = tmp_path / "linked.h5"
        path.write_bytes(content)
        with h5py.File(path, "r+") as file:
            del file[key]
            file[key] = h5py.ExternalLink(str(outside), key)
        with pytest.raises(ValueError, match=rf"linked\.h5: not a rollout file \({key}.* is a link to another place"):
            read_rollout(path)
        if key == "cloth":
            with pytest.raises(ValueError, match=r"linked\.h5: .*cloth is a link"):
                identify(str(path))


@pytest.mark.parametrize(
    "text", ["a: [", "- 1", "a: &x [1]\nb: *x", "seed: 0\nseed: 1", "[" * 5000, "a: !!python/name:os.system", "\x80"]
)
def test_a_damaged_record_of_a_run_is_one_sentence(tmp_path: Path, text: str) -> None:
    (tmp_path / "config.yaml").write_bytes(text.encode("latin-1"))
    with pytest.raises(ConfigError, match=r"^[^\n]*config\.yaml: not the record of a run[^\n]*another output$"):
        require_same_config(load_config("train"), tmp_path, ())
