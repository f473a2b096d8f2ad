"""Callbacks: called in order, they may end a training, and a resumed training ends where an uninterrupted one does."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from test_watch import SETTINGS, Scripted, lines, tiny

from hood.energies.potential import default_potential
from hood.training.callbacks import Callback, EarlyStopping
from hood.training.log import Csv
from hood.training.scenes import SceneSampler
from hood.training.settings import TrainerSettings
from hood.training.trainer import Trainer

SCORES = {2: 3.0, 4: 1.0, 6: 2.0, 8: 1.5, 10: 0.5, 12: 0.4}
LONG = replace(SETTINGS, iterations=12, checkpoint_every=4)


class Diary(Callback):
    """What was called, with its iteration."""

    def __init__(self) -> None:
        self.entries: list[tuple[str, int]] = []

    def begin(self, trainer: Trainer) -> None:
        self.entries.append(("begin", trainer.iteration))

    def after_update(self, trainer: Trainer, iteration: int, report: Mapping[str, float]) -> None:
        assert report["loss"] > 0
        self.entries.append(("update", iteration))

    def after_log(self, trainer: Trainer, iteration: int, record: Mapping[str, float]) -> None:
        assert record["iterations_per_second"] > 0
        self.entries.append(("log", iteration))

    def after_validation(self, trainer: Trainer, iteration: int, record: Mapping[str, float]) -> None:
        assert record == {"validation_score": SCORES[iteration]}
        self.entries.append(("validation", iteration))

    def after_checkpoint(self, trainer: Trainer, iteration: int) -> None:
        assert torch.load(trainer.checkpoint_path, weights_only=True)["iteration"] == iteration
        self.entries.append(("checkpoint", iteration))

    def end(self, trainer: Trainer) -> None:
        self.entries.append(("end", trainer.iteration))


class Unkept(Callback):
    """Its state is nothing that a checkpoint can hold."""

    def state_dict(self) -> dict[str, Any]:
        return {"path": Path("somewhere")}


def make(
    folder: Path, sampler: SceneSampler, *callbacks: Callback, settings: TrainerSettings = LONG, watched: bool = True
) -> Trainer:
    watch = Scripted(SCORES) if watched else None
    return Trainer(tiny(), default_potential(), sampler, settings, folder, 0, watch, 0, [Csv()], callbacks)  # type: ignore[arg-type]


def test_hooks_are_called_in_order(tmp_path: Path, sampler: SceneSampler) -> None:
    diary = Diary()
    assert make(tmp_path, sampler, diary, settings=replace(LONG, iterations=3, checkpoint_every=2, log_every=2)).run()
    assert diary.entries == [
        ("begin", 0), ("checkpoint", 0), ("update", 1), ("update", 2), ("log", 2), ("validation", 2), ("checkpoint", 2),
        ("update", 3), ("log", 3), ("checkpoint", 3), ("end", 3),
    ]  # fmt: skip


def test_early_stopping_counts_validations(tmp_path: Path, sampler: SceneSampler) -> None:
    trainer = make(tmp_path, sampler, EarlyStopping(patience=2))
    assert trainer.run()
    assert trainer.iteration == 8  # 2.0 and 1.5 are not below 1.0
    assert trainer.stopped == "validation_score has not become better than 1 in 2 records"
    assert torch.load(tmp_path / "checkpoint.pt", weights_only=True)["iteration"] == 8


@pytest.mark.parametrize("options", [{"least_change": 1.9}, {"larger_is_better": True}])
def test_what_is_better(options: dict[str, Any], tmp_path: Path, sampler: SceneSampler) -> None:
    """3, 1, 2: with 1.9 the second is better by 2, with larger ones none is after the first."""
    trainer = make(tmp_path, sampler, EarlyStopping(patience=2, **options))
    assert trainer.run()
    assert trainer.iteration == (8 if "least_change" in options else 6)


def test_a_resumed_training_ends_where_an_uninterrupted_one_does(tmp_path: Path, sampler: SceneSampler) -> None:
    first = make(tmp_path, sampler, EarlyStopping(patience=2))
    assert not first.run(should_stop=lambda: first.iteration >= 7)  # one validation was not better
    second = make(tmp_path, sampler, Diary(), EarlyStopping(patience=2))
    second.resume(second.checkpoint_path)
    assert second.run()
    assert second.iteration == 8
    again = make(tmp_path, sampler, EarlyStopping(patience=2))
    again.resume(again.checkpoint_path)
    assert again.run()
    assert (again.iteration, bool(again.stopped)) == (8, True)
    without = make(tmp_path, sampler)
    without.resume(without.checkpoint_path)
    assert without.run()
    assert without.iteration == 12
    assert [line["iteration"] for line in lines(tmp_path) if "loss" in line] == [*range(1, 13)]
    rows = (tmp_path / "metrics.csv").read_text().splitlines()
    assert len(rows) == 1 + len(lines(tmp_path))


def test_what_cannot_be_kept_is_refused_before_the_first_update(tmp_path: Path, sampler: SceneSampler) -> None:
    trainer = make(tmp_path, sampler, Unkept())
    with pytest.raises(ValueError, match=r"^callbacks: state_dict\(\) holds what no checkpoint can"):
        trainer.run()
    assert trainer.iteration == 0
    assert not trainer.checkpoint_path.exists()


def test_what_early_stopping_cannot_read_is_refused(tmp_path: Path, sampler: SceneSampler) -> None:
    for stopping, watched, words in (
        (EarlyStopping(), False, "trainer.validate_every is 0"),
        (EarlyStopping("lose"), True, "did you mean 'loss'"),
        (EarlyStopping("validation_scores"), True, None),
    ):
        settings = LONG if watched else replace(LONG, validate_every=0)
        if words is None:
            with pytest.raises(ValueError, match="did you mean 'validation_score'"):
                make(tmp_path / "run", sampler, stopping, settings=settings).run()
            continue
        with pytest.raises(ValueError, match=words):
            make(tmp_path / "none", sampler, stopping, settings=settings, watched=watched)
    assert not (tmp_path / "none").exists()
    for options in ({"patience": 0}, {"patience": "3"}, {"least_change": -1.0}):
        with pytest.raises(ValueError, match="EarlyStopping has patience="):
            EarlyStopping(**options)


def test_a_loss_is_read_from_the_log(tmp_path: Path, sampler: SceneSampler) -> None:
    trainer = make(tmp_path, sampler, EarlyStopping("loss", patience=1))
    assert trainer.run()
    losses = [json.loads(line)["loss"] for line in (tmp_path / "metrics.jsonl").read_text().splitlines() if '"loss"' in line]
    assert trainer.iteration == len(losses) < 12
    assert losses[-1] >= min(losses[:-1])
    assert all(later < earlier for earlier, later in zip(losses[:-2], losses[1:-1], strict=True))
