"""Batches of one garment each: every window once, an order by seed and epoch, few files and chunks at a time, workers."""

from __future__ import annotations

import json
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from test_compact import FACES
from torch.utils.data import DataLoader

import hood
from hood.rollouts.file.batches import RolloutBatches
from hood.rollouts.file.compact import BOTH, PositionTable, make_compact
from hood.rollouts.file.dataset import RolloutDataset
from hood.rollouts.file.recorder import RolloutWriter

#: Frames of every rollout.
LENGTH = 40


def write(path: Path, faces: np.ndarray, value: float) -> None:
    path.parent.mkdir(parents=True)
    with RolloutWriter(path, LENGTH, np.eye(4, 3), faces, FACES[:1], 3, (), 0.1, {"garment": "rag"}) as target:
        for t in range(LENGTH):
            target.append(np.full((4, 3), value + 1e-3 * t), np.zeros((3, 3)), {})
    make_compact(path, BOTH, None)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Twelve rollouts of three garments; two of these have the same faces."""
    lines = []
    for index in range(12):
        garment, name = "abb"[index % 3], f"{'abc'[index % 3]}/{index}"
        write(tmp_path / name / "rollout.h5", FACES if garment == "a" else FACES[:1], float(index))
        settings = {"garment": "abc"[index % 3], "sequence": f"walk{index}", "seed": str(index), "size": "1.1"}
        line = {"row": name, "verdict": "sound", "stored_frames": LENGTH, "settings": settings}
        lines.append(json.dumps(line | {"inputs": {"garment": garment * 64}}))
    (tmp_path / "manifest.jsonl").write_text("\n".join(lines) + "\n")
    return tmp_path


def rollouts_of(data: RolloutDataset, batch: list[int]) -> set[int]:
    return {next(n for n in range(len(data.names)) if index in data.windows(n)) for index in batch}


@pytest.mark.parametrize("settings", [{}, {"workers": 3}, {"shuffle": False}, {"files": 1}, {"batch_size": 1000}])
def test_every_window_comes_once_and_a_batch_is_of_one_mesh(folder: Path, settings: dict[str, Any]) -> None:
    data = RolloutDataset(folder, window=3)
    batches = RolloutBatches(data, **{"batch_size": 7, **settings})
    found = list(batches)
    assert sorted(chain.from_iterable(found)) == list(range(len(data)))
    assert len(found) == len(batches)
    for batch in found:
        assert len({data.graphs[number] for number in rollouts_of(data, batch)}) == 1
    assert {*data.graphs} == {0, 1}  # the second and the third garment have the same faces


def test_settings_of_rows_spare_files(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data, opened = RolloutDataset(folder), []
    monkeypatch.setattr(data, "_open", lambda number, real=data._open: opened.append(number) or real(number))
    assert data.graphs == [0, 1, 1] * 4
    assert opened == [0, 1, 2]
    listed = RolloutDataset([folder / name for name in data.names])
    assert listed.graphs == data.graphs


def test_the_order_is_of_seed_and_epoch(folder: Path) -> None:
    data = RolloutDataset(folder, window=3)
    first, second, other = RolloutBatches(data, 7, seed=5), RolloutBatches(data, 7, seed=5), RolloutBatches(data, 7, seed=6)
    assert list(first) == list(second) == list(first)
    second.set_epoch(1)
    assert list(first) != list(second)
    assert list(first) != list(other)
    assert len(list(second)) == len(second)
    kept = list(RolloutBatches(data, 7, shuffle=False))
    assert kept[0] == [*range(7)]
    assert {len(batch) for batch in RolloutBatches(data, 7, drop_last=True)} == {7}


def test_windows_of_files_are_mixed_and_few_files_are_read_at_a_time(folder: Path) -> None:
    data = RolloutDataset(folder, window=2, rows=["b/*", "c/*"])
    batches = [rollouts_of(data, batch) for batch in RolloutBatches(data, 16, files=3)]
    places = {number: [place for place, batch in enumerate(batches) if number in batch] for number in range(8)}
    at_a_time = [sum(min(own) <= place <= max(own) for own in places.values()) for place in range(len(batches))]
    assert max(at_a_time) <= 2 * 3  # where a group ends, what is left of it goes into the next one's first batch
    assert max(at_a_time) < len(data.names)
    assert np.mean([len(batch) for batch in batches]) > 2
    jumps = [abs(b - a) for batch in RolloutBatches(data, 16, files=3) for a, b in pairwise(batch)]
    assert np.mean(np.array(jumps) == 1) < 0.2


@pytest.mark.parametrize("workers", [0, 2])
def test_a_worker_unpacks_a_chunk_once(folder: Path, workers: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """With as many streams as workers, whose batches come in turn, as a loader gives them out."""
    data, reads = RolloutDataset(folder, window=2), list[tuple[str, int]]()
    read = PositionTable.read

    def counted(self: PositionTable, start: int = 0, stop: int | None = None) -> np.ndarray:
        reads.append((self._table.file.filename, start))
        return read(self, start, stop)

    monkeypatch.setattr(PositionTable, "read", counted)
    batches = list(RolloutBatches(data, 5, workers=workers))
    for worker in range(max(workers, 1)):
        data.__setstate__(data.__getstate__())  # nothing is open or kept
        for index in chain.from_iterable(batches[worker :: max(workers, 1)][:30]):
            data[index]
    assert len(reads) == len({*reads}) > 0


def test_items_may_be_changed(folder: Path) -> None:
    data = RolloutDataset(folder)
    before = data[3]["cloth_pos"].clone()
    data[3]["cloth_pos"].zero_()
    assert torch.equal(data[3]["cloth_pos"], before)
    assert before.abs().max() > 0


@pytest.mark.filterwarnings("ignore:This DataLoader will create")  # where the tests have one processor
def test_a_loader_with_workers_reads_the_same(folder: Path) -> None:
    data = RolloutDataset(folder, window=2)
    batches = hood.RolloutBatches(data, 9, workers=2)
    loaded = DataLoader(data, batch_sampler=batches, num_workers=2)
    for batch, indices in zip(loaded, batches, strict=True):
        assert torch.equal(batch["cloth_pos"], torch.stack([data[index]["cloth_pos"] for index in indices]))


@pytest.mark.parametrize("given", [{"batch_size": 0}, {"files": 1.5}, {"workers": -1}, {"seed": True}])
def test_wrong_arguments_are_named(folder: Path, given: dict[str, Any]) -> None:
    (name, value) = next(iter(given.items()))
    with pytest.raises(ValueError, match=f"{name}={value!r}: give a whole number from"):
        RolloutBatches(RolloutDataset(folder), **{"batch_size": 4, **given})
