"""A process beside Blender: started, listened to without waiting, ended. What it says goes to a file."""

from __future__ import annotations

import os
import re
import signal
import subprocess
from collections.abc import Sequence
from pathlib import Path

_WINDOWS = os.name == "nt"
_HOW_FAR = re.compile(r"^hood: (.+): (\d+) of (\d+)", re.MULTILINE)
#: As much of the end of a log is read [bytes].
_TAIL = 20_000


class Process:
    """A program that runs.

    Args:
        command: its words.
        folder: where it runs.
        log: file of what it says, errors included.
        threads: that hood may compute on.

    Raises:
        OSError: it cannot be started.
    """

    def __init__(self, command: Sequence[str], folder: Path, log: Path, threads: int = 1) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.log = log
        environment = os.environ | {"PYTHONUNBUFFERED": "1", "PYTHONUTF8": "1", "OMP_NUM_THREADS": str(threads)}
        apart = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP} if _WINDOWS else {"start_new_session": True}
        with open(log, "wb") as said:
            self._process = subprocess.Popen(
                list(command),
                cwd=folder,
                stdin=subprocess.DEVNULL,
                stdout=said,
                stderr=subprocess.STDOUT,
                env=environment,
                **apart,  # type: ignore[call-overload]
            )

    @property
    def code(self) -> int | None:
        """Its exit code; None while it runs."""
        return self._process.poll()

    def said(self) -> str:
        """The end of what it has said."""
        with open(self.log, "rb") as file:
            file.seek(max(0, self.log.stat().st_size - _TAIL))
            return file.read().decode("utf-8", "replace")

    def interrupt(self) -> None:
        """Ask it to end and keep its frames, as Ctrl-C does; on Windows it is ended at once."""
        if self.code is None:
            self._process.terminate() if _WINDOWS else self._process.send_signal(signal.SIGINT)

    def kill(self) -> None:
        """End it at once."""
        if self.code is None:
            self._process.kill()
            self._process.wait()


def how_far(said: str) -> tuple[str, int, int] | None:
    """The last work that hood told of, how much of it is done, and of how much; None where it told nothing."""
    found = _HOW_FAR.findall(said)
    return (found[-1][0], int(found[-1][1]), int(found[-1][2])) if found else None


def time_left(done: int, total: int, seconds: float) -> str:
    """How long the rest takes, in words, where ``done`` of ``total`` took so many ``seconds``; empty where nothing is known."""
    return in_words(seconds / done * (total - done)) if done > 0 and seconds > 0 else ""


def in_words(seconds: float) -> str:
    """A time to be read: 40 s, 3 min, 2 h 5 min."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"
