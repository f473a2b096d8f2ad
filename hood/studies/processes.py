"""Runs commands of ``hood`` in processes of their own, several side by side, each with a log file."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TypeVar

#: What runs before the arguments of ``hood``; nothing is imported from the working folder.
PROGRAM = (sys.executable, "-P", "-m", "hood.cli.main")
#: How the line begins that a command fails with.
_ERROR = "hood: error: "
#: Seconds that an ended process has to go.
_PATIENCE = 20.0

Key = TypeVar("Key")


@dataclass(frozen=True)
class Ended:
    """How a command ended."""

    exit_code: int  # negative: the signal that ended it
    error: str  # the one line that it ended with; empty without, or where there was a traceback
    seconds: float


@dataclass
class _Running:
    process: subprocess.Popen[bytes]
    log: IO[bytes]
    path: Path
    begin: float


def run_beside(
    commands: Iterable[tuple[Key, Sequence[str], Path]], jobs: int, timeout: float, program: Sequence[str] = PROGRAM
) -> Iterator[tuple[Key, Ended]]:
    """Run ``commands`` (key, arguments, folder for log.txt), ``jobs`` of them side by side; yields them as they end.

    A command that takes longer than ``timeout`` [s] is ended. An interruption ends all that run.
    """
    waiting, running = iter(commands), dict[Key, _Running]()
    more = True
    try:
        while more or running:
            while more and len(running) < jobs:
                found = next(waiting, None)
                more = found is not None
                if found is not None:
                    key, arguments, folder = found
                    running[key] = _start(arguments, folder, program)
            for key, item in list(running.items()):
                late = time.monotonic() - item.begin > timeout
                if late and item.process.poll() is None:
                    item.process.kill()
                    item.process.wait()
                if item.process.poll() is not None:
                    del running[key]
                    yield key, _ended(item, f"not done after {timeout:g} s" if late else "")
            time.sleep(0.05)
    finally:
        end([item.process for item in running.values()])


def end(processes: Sequence[subprocess.Popen[bytes]]) -> None:
    """End them: ask first, since processes started in the background ignore SIGINT, then kill."""
    for process in processes:
        process.terminate()
    for process in processes:
        try:
            process.wait(_PATIENCE)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


@contextmanager
def interruptible() -> Iterator[None]:
    """SIGTERM interrupts the block like Ctrl-C: the processes it started do not outlive it."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _start(arguments: Sequence[str], folder: Path, program: Sequence[str]) -> _Running:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "log.txt"
    log = open(path, "wb")  # closed when the process has ended
    process = subprocess.Popen([*program, *arguments], stdout=log, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL)
    return _Running(process, log, path, time.monotonic())


def _ended(item: _Running, error: str) -> Ended:
    item.log.close()
    lines = item.path.read_text(encoding="utf-8", errors="replace").splitlines()
    told = [line.removeprefix(_ERROR) for line in lines if line.startswith(_ERROR)]
    traceback = any(line.startswith("Traceback (most recent call last)") for line in lines)
    if not error and told and not traceback and item.process.returncode == 2:
        error = told[-1]
    return Ended(item.process.returncode, error, time.monotonic() - item.begin)
