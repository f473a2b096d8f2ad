"""Runs the points of a chart in processes of their own, several side by side; finished ones are not run again."""

from __future__ import annotations

import hashlib
import json
import math
import os
import shlex
import subprocess
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from hood.app.common import UNTRAINED
from hood.app.stepping.steppers import find_option
from hood.assets.files.atomic import write_atomically
from hood.assets.files.library import locate
from hood.studies.processes import PROGRAM, end, interruptible
from hood.studies.tradeoff.grid import Point, quoted_word
from hood.studies.tradeoff.results import read_measured

#: Written by ``hood evaluate`` when all its rollouts are done.
_TABLE = "table.json"
#: By which command and weights a point was begun, and the times of its turns.
_TURNS = "turns.json"


@dataclass(frozen=True)
class Failure:
    """A point that gave no result, why, and where more is said."""

    point: Point
    reason: str
    log: Path


@dataclass
class _Running:
    point: Point
    process: subprocess.Popen[bytes]
    begin: float
    load: float
    rollouts: int  # that were there before
    cpu_seconds: float | None = None  # of the process; known when it has ended

    def ended(self) -> bool:
        """Whether the process has ended."""
        if not hasattr(os, "wait4"):
            return self.process.poll() is not None
        found, status, usage = os.wait4(self.process.pid, os.WNOHANG)
        if found:
            self.process.returncode = os.waitstatus_to_exitcode(status)
            self.cpu_seconds = usage.ru_utime + usage.ru_stime
        return bool(found)


class Points:
    """The points of a chart on disk: one folder each below ``folder``.

    A machine shared with others is faster at some hours than at others. So a point's rollouts are measured in several turns and
    the points of a size take turns: what one of them meets, all meet, and it shows in the spread over rollouts.

    Args:
        jobs: points side by side, one thread each.
        device: its name, written down with every point.
        turns: in which a point's rollouts are measured.
        program: what stands for ``hood``.
    """

    def __init__(self, folder: Path, jobs: int, device: str, turns: int = 1, program: Sequence[str] = PROGRAM) -> None:
        self.folder, self.jobs, self.device, self.turns, self.program = folder, jobs, device, turns, tuple(program)

    def folder_of(self, point: Point) -> Path:
        return self.folder / point.folder

    def log_of(self, point: Point) -> Path:
        return self.folder_of(point) / "log.txt"

    def is_done(self, point: Point) -> bool:
        """Whether it was measured to the end by this very command and with the weights that have that name today."""
        record = read_measured(self.folder_of(point))
        return record.get("command") == point.command and record.get("weights") == weights_digest(point)

    def measure(self, points: Sequence[Point]) -> list[Failure]:
        """Measure those that are not done; returns those that failed.

        An interruption ends the processes; the rollouts they had finished are not done again.
        """
        todo = [point for point in points if not self.is_done(point)]
        for point in todo:
            self._clear(point)
        failures: list[Failure] = []
        with (
            tqdm(total=len(points), initial=len(points) - len(todo), desc="trade-off", unit="point") as bar,
            interruptible(),
        ):
            for size in dict.fromkeys(point.size for point in todo):
                failures += self._take_turns([point for point in todo if point.size == size], bar)
        return failures

    def _take_turns(self, points: Sequence[Point], bar: tqdm[Any]) -> list[Failure]:
        waiting, running, failures = deque(points), list[_Running](), list[Failure]()
        try:
            while waiting or running:
                while waiting and len(running) < self.jobs:
                    running.append(self._start(waiting.popleft()))
                text = ", ".join(self._progress(item.point) for item in running)
                if text != bar.postfix:
                    bar.set_postfix_str(text)
                time.sleep(0.1)
                for item in [item for item in running if item.ended()]:
                    running.remove(item)
                    self._note_turn(item)
                    unfinished = not (self.folder_of(item.point) / _TABLE).exists()
                    if item.process.returncode == 0 and unfinished and self._count(item.point) > item.rollouts:
                        waiting.append(item.point)
                        continue
                    failures += self._finish(item)
                    bar.update()
        finally:
            end([item.process for item in running])
        return failures

    def _clear(self, point: Point) -> None:
        """Take away what says that the point is done, and all of it that other weights or another command gave."""
        folder, begun = self.folder_of(point), {"command": point.command, "weights": weights_digest(point)}
        for name in (_TABLE, "point.json"):  # the table's presence says that all rollouts are there
            (folder / name).unlink(missing_ok=True)
        before = read_measured(folder, _TURNS)
        if {key: before.get(key) for key in begun} != begun:
            for path in folder.glob("rollouts.*.jsonl"):
                path.unlink(missing_ok=True)
            folder.mkdir(parents=True, exist_ok=True)
            write_atomically(folder / _TURNS, json.dumps({**begun, "turns": []}).encode())

    def _start(self, point: Point) -> _Running:
        folder = self.folder_of(point)
        folder.mkdir(parents=True, exist_ok=True)
        count = self._count(point)
        arguments = [
            *self.program,
            "evaluate",
            *point.settings,
            f"output={quoted_word(str(folder))}",
            f"resume={str(count > 0).lower()}",
            f"max_rollouts={math.ceil(point.rollouts / self.turns)}",
        ]
        load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
        with open(self.log_of(point), "ab") as sink:
            sink.write(f"\n$ {shlex.join(arguments)}\n".encode())
            sink.flush()
            process = subprocess.Popen(
                arguments, stdin=subprocess.DEVNULL, stdout=sink, stderr=sink, env=os.environ | {"OMP_NUM_THREADS": "1"}
            )
        return _Running(point, process, time.monotonic(), load, count)

    def _note_turn(self, item: _Running) -> None:
        turn = {"seconds": time.monotonic() - item.begin, "cpu_seconds": item.cpu_seconds, "load_at_start": item.load}
        folder = self.folder_of(item.point)
        record = read_measured(folder, _TURNS)
        write_atomically(folder / _TURNS, json.dumps({**record, "turns": [*record["turns"], turn]}).encode())

    def _finish(self, item: _Running) -> list[Failure]:
        if item.process.returncode:
            return [Failure(item.point, self._complaint(item), self.log_of(item.point))]
        if not (self.folder_of(item.point) / _TABLE).exists():
            return [Failure(item.point, "a turn added no rollout and wrote no table", self.log_of(item.point))]
        turns = read_measured(self.folder_of(item.point), _TURNS)["turns"]
        seconds = sum(turn["seconds"] for turn in turns)
        spent = [turn["cpu_seconds"] for turn in turns]
        record: dict[str, Any] = {
            "command": item.point.command,
            "weights": weights_digest(item.point),
            "device": self.device,
            "jobs": self.jobs,
            "turns": len(turns),
            "load_at_start": max(turn["load_at_start"] for turn in turns),
            "seconds": seconds,
            # A process alone on its processor has all of its time.
            "cpu_share": None if None in spent else sum(spent) / seconds,
        }
        write_atomically(self.folder_of(item.point) / "point.json", json.dumps(record, indent=1).encode())
        return []

    def _complaint(self, item: _Running) -> str:
        """How it ended, and the last error that it told: the log keeps earlier attempts as well."""
        said = self.log_of(item.point).read_text(encoding="utf-8", errors="replace").rpartition("\n$ ")[2]
        errors = [line.strip() for line in said.splitlines()[1:] if "error" in line.lower()]
        code = item.process.returncode
        ending = f"exit code {code}" if code > 0 else f"ended by signal {-code}"
        return f"{ending}: {errors[-1] if errors else 'no error was told'}"

    def _progress(self, point: Point) -> str:
        return f"{point.size} {point.label}: {self._count(point)} rollouts"

    def _count(self, point: Point) -> int:
        """Rollouts written down."""
        return sum(path.read_bytes().count(b'"unit"') for path in self.folder_of(point).glob("rollouts.*.jsonl"))


def weights_digest(point: Point) -> str:
    """SHA-256 of the file of weights: a point measured with others of the same name is not done.

    Raises:
        FileNotFoundError: there is no such file.
    """
    if point.alone or point.model.startswith(UNTRAINED + ":") or find_option(point.model) is not None:
        return "none"
    return hashlib.sha256(locate("weights", point.model).read_bytes()).hexdigest()
