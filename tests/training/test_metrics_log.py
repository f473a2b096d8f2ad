"""Metrics on disk: one line per record, cut back on resume."""

from __future__ import annotations

import csv
import errno
import json
import sys
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from hood.training.log import Csv, Logger, LogWindow, MetricsLog, TensorBoard, Wandb


def read(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


def test_records_are_on_disk_at_once(tmp_path: Path) -> None:
    with MetricsLog(tmp_path, 0) as log:
        log.write(1, {"total": 0.5})
        assert read(tmp_path) == [{"iteration": 1, "total": 0.5}]
        log.write(2, {"total": 0.25, "horizon": 3.0})
    assert read(tmp_path)[1] == {"iteration": 2, "total": 0.25, "horizon": 3.0}


def test_resume_drops_what_lies_ahead(tmp_path: Path) -> None:
    with MetricsLog(tmp_path, 0) as log:
        for iteration in range(1, 9):
            log.write(iteration, {"total": float(iteration)})
    with MetricsLog(tmp_path, 5) as log:
        log.write(6, {"total": 60.0})
    assert [(r["iteration"], r["total"]) for r in read(tmp_path)] == [(i, float(i)) for i in range(1, 6)] + [(6, 60.0)]


def test_going_back_drops_what_lay_ahead(tmp_path: Path) -> None:
    with MetricsLog(tmp_path, 0) as log:
        for iteration in range(1, 5):
            log.write(iteration, {"total": float(iteration)})
        log.cut(2)
        log.write(2, {"rolled_back_from": 4.0})
        log.write(3, {"total": 30.0})
    assert [list(record.values()) for record in read(tmp_path)] == [[1, 1.0], [2, 2.0], [2, 4.0], [3, 30.0]]


def test_what_is_no_number_is_null(tmp_path: Path) -> None:
    with MetricsLog(tmp_path, 0) as log:
        log.write(1, {"total": float("nan"), "score": float("inf"), "loss": 1.0})
    assert read(tmp_path) == [{"iteration": 1, "total": None, "score": None, "loss": 1.0}]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
def test_a_full_disk_is_named(tmp_path: Path) -> None:
    log = MetricsLog(tmp_path, 0)
    log.write(1, {"total": 1.0})
    log._file.close()
    log._file = open("/dev/full", "ab", buffering=0)
    with pytest.raises(OSError) as error:
        log.write(2, {"total": 2.0})
    assert (error.value.errno, error.value.filename) == (errno.ENOSPC, str(tmp_path / "metrics.jsonl"))
    log.__exit__(None, None, None)
    assert read(tmp_path) == [{"iteration": 1, "total": 1.0}]


def test_tensorboard_alone_does_not_end_a_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    class Full:
        def add_scalar(self, *args: object) -> None:
            raise OSError(errno.ENOSPC, "No space left on device")

    with MetricsLog(tmp_path, 0) as log:
        board = TensorBoard()
        board._board = Full()  # type: ignore[attr-defined]
        log._loggers = [board]
        log.write(1, {"total": 1.0, "loss": 2.0})
        log.write(2, {"total": 1.0})
    assert [record["iteration"] for record in read(tmp_path)] == [1, 2]
    assert capsys.readouterr().err.count("no more TensorBoard events") == 1


def test_a_run_without_tensorboard_says_so_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("tensorboard", "torch.utils.tensorboard"):
        monkeypatch.setitem(sys.modules, name, None)  # as where it is not installed
    with MetricsLog(tmp_path, 0) as log:
        log.write(1, {"total": 1.0})
        log.cut(0)
    told = capsys.readouterr().err
    way_out = 'it is not installed (pip install "hood-cloth[tensorboard]"); all numbers are in'
    assert told == f"hood: no TensorBoard events: {way_out} {tmp_path / 'metrics.jsonl'}\n"


def test_a_fresh_run_starts_a_fresh_file(tmp_path: Path) -> None:
    (tmp_path / "metrics.jsonl").write_text('{"iteration": 4, "total": 1.0}\n')
    with MetricsLog(tmp_path, 0):
        pass
    assert read(tmp_path) == []


def test_lines_cut_by_a_kill_are_dropped(tmp_path: Path) -> None:
    (tmp_path / "metrics.jsonl").write_text('{"iteration": 1, "total": 1.0}\n7\n{"total": 2}\n{"iteration": 2, "tot')
    with MetricsLog(tmp_path, 3) as log:
        log.write(4, {"total": 4.0})
    assert [record["iteration"] for record in read(tmp_path)] == [1, 4]


def test_a_window_is_the_mean_of_its_updates() -> None:
    window = LogWindow()
    for value in (1.0, float("nan"), 4.0, 7.0):
        window.add({"loss": value, "horizon": value, "skipped": 2.0})
    copy = LogWindow()
    copy.load_state_dict(window.state_dict())
    assert window.close() == copy.close() == {"loss": 4.0, "horizon": 7.0, "skipped": 2.0}
    window.add({"loss": 3.0})
    assert window.close() == {"loss": 3.0}
    window.add({"loss": float("inf")})
    assert window.close() == {"loss": float("inf")}


def test_a_table_gets_columns_as_they_come_and_is_cut_on_resume(tmp_path: Path) -> None:
    with MetricsLog(tmp_path, 0, [Csv()]) as log:
        log.write(1, {"loss": 0.5})
        log.write(2, {"loss": 0.25})
        log.write(2, {"validation_score": 7.0})
        log.write(3, {"loss": float("nan")})
        log.cut(2)
        log.write(3, {"loss": 0.125})
        log.write(4, {"loss": 0.5})
    with MetricsLog(tmp_path, 3, [Csv()]) as log:  # the run was killed after its checkpoint at 3
        log.write(4, {"loss": 1.0})
    with open(tmp_path / "metrics.csv", newline="") as file:
        rows = list(csv.reader(file))
    assert rows == [
        ["iteration", "loss", "validation_score"],
        ["1", "0.5", ""], ["2", "0.25", ""], ["2", "", "7.0"], ["3", "0.125", ""], ["4", "1.0", ""],
    ]  # fmt: skip


def test_a_table_that_begins_late_has_all_records(tmp_path: Path) -> None:
    with MetricsLog(tmp_path, 0, []) as log:
        log.write(1, {"loss": 0.5})
        log.write(2, {"loss": float("inf")})
    with MetricsLog(tmp_path, 2, [Csv()]):
        pass
    assert (tmp_path / "metrics.csv").read_text() == "iteration,loss\n1,0.5\n2,\n"


def test_a_logger_that_raises_is_dropped_and_the_others_go_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    class Broken(Logger):
        def write(self, iteration: int, values: Any) -> None:
            raise RuntimeError("no\nconnection")

    with MetricsLog(tmp_path, 0, [Broken(), Csv()]) as log:
        log.write(1, {"loss": 0.5})
        log.write(2, {"loss": 0.25})
    told = capsys.readouterr().err
    assert told == f"hood: no more figures for the logger Broken: no connection; all numbers are in {tmp_path}/metrics.jsonl\n"
    assert len((tmp_path / "metrics.csv").read_text().splitlines()) == 3


def test_one_offline_run_holds_each_record_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A stand-in for the package, which writes what it is told into folders as that does."""
    begun: list[dict[str, Any]] = []

    def init(**options: Any) -> SimpleNamespace:
        folder = Path(options["dir"]) / "wandb" / f"offline-run-{len(begun)}"
        folder.mkdir(parents=True)
        begun.append(options)

        def write(values: dict[str, float], step: int) -> None:
            with open(folder / "log", "a") as file:
                file.write(f"{step} {json.dumps(values)}\n")

        return SimpleNamespace(log=write, finish=lambda: (folder / "finished").touch())

    stand_in = ModuleType("wandb")
    stand_in.__spec__ = ModuleSpec("wandb", None)
    stand_in.init, stand_in.Settings = init, dict  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "wandb", stand_in)
    for first, last in ((0, 4), (2, 3)):
        logger = Wandb(project="shirts")
        logger.config = {"seed": 3}
        with MetricsLog(tmp_path, first, [logger]) as log:
            for iteration in range(first + 1, last + 1):
                log.write(iteration, {"loss": 10.0 * last + iteration})
    (folder,) = (tmp_path / "wandb").iterdir()
    assert (folder / "log").read_text() == '1 {"loss": 41.0}\n2 {"loss": 42.0}\n3 {"loss": 33.0}\n'
    assert (folder / "finished").exists()
    assert {(one["mode"], one["project"], one["name"], one["config"]["seed"]) for one in begun} == {
        ("offline", "shirts", tmp_path.name, 3)
    }


def test_a_logger_whose_package_is_missing_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hood.training.log.find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r'wandb is not installed \(pip install "hood-cloth\[wandb\]"\)'):
        Wandb()
