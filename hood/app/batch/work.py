"""Work on the rows of a data set: a process takes one that nobody has, makes it and writes its line, until none is left.

A row is made in a temporary folder below the output folder and takes its place when it is whole. Who works on a row says so
in a file; where that process is gone, another one takes the row. Two that make the same row lose time, and nothing else.
"""

from __future__ import annotations

import errno
import gc
import hashlib
import json
import os
import platform
import re
import shutil
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import h5py
import torch

from hood.app.batch.manifest import DOUBTFUL, FAILED, OWN_LINE, SOUND, UNJUDGED, UNSOUND, Line, Manifest, inputs_of, own_line
from hood.app.batch.rows import DataRow
from hood.app.notices import Item
from hood.app.rollout import roll_out_into
from hood.app.settings.compose import plain
from hood.app.settings.overrides import parse
from hood.app.settings.rollout_settings import RolloutSettings
from hood.app.setup import check_config, make_stepper

#: The folder for what is not done, below the output folder.
_WORK = ".work"
#: A disk in this state refuses the next row too.
_HOPELESS = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)
#: Seconds after which the process that works on a row is taken for gone, of another machine; and between its signs of life.
_SILENCE, _SIGN = 600.0, 60.0
#: Seconds that a file of a claim may be empty, between its making and its writing.
_WRITING = 10.0
#: Keys of a rollout that every row has of its own.
_OWN = ("seed", "sequence")
#: Keys of a rollout that change nothing in it.
_FREE = ("output", "root", "resume", "fail_on")


@dataclass(frozen=True)
class Call:
    """What all processes of a call know.

    Args:
        folder: the output folder.
        words: ``key=value`` of ``hood rollout`` that all rows have.
        attempts: how often a row is begun.
        since: the place [bytes] in the manifest where this call began.
    """

    folder: Path
    words: tuple[str, ...]
    attempts: int
    since: int


class HopelessError(Exception):
    """No further row can be written; the cause is an OSError."""


def pull(call: Call, rows: Sequence[DataRow], first: int = 0) -> None:
    """Make rows that are not done and that nobody works on, from the place ``first`` on round to it again, until there are
    none.

    Raises:
        HopelessError: the disk refuses.
    """
    torch.set_num_threads(1)
    gc.freeze()
    manifest, done = Manifest(call.folder, call.since), set[str]()
    while True:
        made = 0
        for row in [*rows[first:], *rows[:first]]:
            done |= {line["row"] for line in manifest.new()}
            if row.name not in done:
                made += make_row(call, row)
        if not made:
            return


def make_row(call: Call, row: DataRow, claimed: bool = True) -> bool:
    """Make a row and write its line; False where another process works on it, or has just done it.

    Args:
        claimed: whether processes tell each other; False where something else sees to it that none has another's row.
    """
    manifest = Manifest(call.folder, call.since)
    with _claim(call, row) if claimed else _alone() as attempt:
        if attempt is None or _has_line(manifest, row):
            return False
        if attempt > call.attempts:
            sentence = f"the process that made it was killed {call.attempts} times, as where memory is short"
            lose(call, row, sentence)
            return True
        try:
            line = _made(call, row, attempt)
            if claimed or not _has_line(manifest, row):  # a process that a lost cluster has left behind makes the same
                _append(call, line)
        except OSError as error:
            raise HopelessError from error
        gc.collect()  # tables of large meshes, in few objects
        return True


def _has_line(manifest: Manifest, row: DataRow) -> bool:
    """Whether the row has got a line since the last look, or since the call began."""
    return any(line["row"] == row.name for line in manifest.new())


def lose(call: Call, row: DataRow, sentence: str) -> None:
    """Write that a row failed."""
    _append(call, _line(row, {}) | _failure(sentence) | {"attempts": call.attempts})


def _append(call: Call, line: Line) -> None:
    Manifest(call.folder).append(line)


def _made(call: Call, row: DataRow, attempt: int) -> Line:
    """The line of a row that has been made, or has failed. Raises OSError where the disk refuses."""
    began, spent, place = time.perf_counter(), time.process_time(), call.folder / row.name
    temporary = call.folder / _WORK / f"{_code(row)}.{os.getpid()}"
    line = _line(row, inputs_of(row)) | {"attempts": attempt}
    try:
        shutil.rmtree(temporary, ignore_errors=True)
        config = settings_of(call.words, row).with_values(output=str(place))
        check_config(config)
        stepper, weights = make_stepper(config)
        summary = roll_out_into(config, stepper, weights, silently, temporary)
        line |= _result(config, summary, weights) | _times(began, spent)
        with h5py.File(temporary / "rollout.h5", "r") as file:
            line["stored_frames"] = len(file["time"])
        line["bytes"] = sum(file.stat().st_size for file in temporary.rglob("*") if file.is_file())
        (temporary / OWN_LINE).write_text(json.dumps(line), encoding="utf-8")
        _put(temporary, place)
    except Exception as error:  # whatever is wrong with a row costs that row
        shutil.rmtree(temporary, ignore_errors=True)
        refused = _refusal(error)
        if refused is not None:
            raise OSError(refused, os.strerror(refused), str(call.folder)) from error
        known = isinstance(error, (ValueError, OSError, ImportError, MemoryError))
        text = " ".join(str(error).split()) or type(error).__name__
        sentence = text if known else f"{type(error).__name__}: {text}"
        return line | _failure(sentence) | _times(began, spent)
    return line


def settings_of(words: Sequence[str], row: DataRow) -> RolloutSettings:
    """The settings of a row, with the ``words`` that all have; those of its garment, body and fabric are read once.

    Raises:
        ConfigError: a word that cannot be used.
    """
    own = {key: parse(word).value() for word in row.words if (key := word.partition("=")[0]) in _OWN}
    alike = (word for word in row.words if word.partition("=")[0] not in _OWN)
    return _settings((*words, *alike)).with_values(**own)


@lru_cache(maxsize=64)
def _settings(words: tuple[str, ...]) -> RolloutSettings:
    return RolloutSettings.from_words(words)


def _refusal(error: BaseException | None) -> int | None:
    """The number of the system's error where the disk has refused; HDF5 says it in a text, or on the way to another error."""
    while error is not None:
        told = re.search(r"\berrno = (\d+)", str(error))
        number = error.errno if isinstance(error, OSError) and error.errno else int(told[1]) if told else 0
        if number in _HOPELESS:
            return number
        error = error.__cause__ or error.__context__
    return None


def _times(began: float, spent: float) -> Line:
    """Seconds since a row was begun, by the clock and of the processor."""
    return {"seconds": time.perf_counter() - began, "cpu_seconds": time.process_time() - spent}


def silently(items: Iterable[Item], total: int, what: str) -> Iterable[Item]:
    """A :class:`hood.app.notices.Bar` that shows nothing."""
    return items


def _line(row: DataRow, inputs: Mapping[str, str]) -> Line:
    """What a line says in any case."""
    ended = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    return {"row": row.name, "verdict": FAILED, "settings": row.keys, "inputs": inputs, "host": platform.node(), "time": ended}


def _failure(sentence: str) -> Line:
    """What a line says of a failure."""
    return {"verdict": FAILED, "error": sentence, "cause": cause_of(sentence), "frames": 0, "bytes": 0}


def cause_of(sentence: str) -> str:
    """A sentence without names of files and numbers, which many rows have in common."""
    return re.sub(r"(?<![\w…])[-+]?\d[\d.,]*(e[-+]?\d+)?", "…", re.sub(r"\S*/\S*", "…", sentence))


def _result(config: RolloutSettings, summary: Mapping[str, Any], weights: str) -> Line:
    settings = {key: value for key, value in plain(config).items() if key not in _FREE}
    worst = next((dict(reason) for reason in summary["reasons"]), None) or summary["worst_frames"].get("strain_p99", {})
    return {
        "verdict": verdict_of(summary),
        "doubts": [{"kind": doubt["kind"], "sentence": doubt["sentence"]} for doubt in summary["doubts"]],
        "reasons": list(summary["unsound_reasons"]),
        "settings_sha256": hashlib.sha256(json.dumps(settings, sort_keys=True, default=str).encode()).hexdigest(),
        "weights_sha256": weights,
        "worst": {"value": worst.get("value"), "frame": int(worst.get("frame") or 0)},
        "frames": int(summary["num_frames"]),
        "vertices": int(summary["num_vertices"]),
    }


def verdict_of(summary: Mapping[str, Any]) -> str:
    """One word for a summary."""
    if summary["sound"] is False or (summary.get("guard") or {}).get("stopped") is not None:
        return UNSOUND
    if summary["sound"] is None:
        return UNJUDGED
    return DOUBTFUL if summary["doubts"] else SOUND


def _put(temporary: Path, place: Path) -> None:
    """Give a whole row its place, where an earlier one makes way; all of it is on the disk before."""
    for file in [*temporary.rglob("*"), temporary]:
        descriptor = os.open(file, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    place.parent.mkdir(parents=True, exist_ok=True)
    before = temporary.with_name(temporary.name + ".before")
    if place.exists():
        os.rename(place, before)
    os.rename(temporary, place)
    shutil.rmtree(before, ignore_errors=True)


def _code(row: DataRow) -> str:
    """A file name for a row."""
    return hashlib.sha256(row.name.encode()).hexdigest()[:20]


# ---- who works on what -----------------------------------------------------------------------------------------------


@contextmanager
def _alone() -> Iterator[int]:
    yield 1


@contextmanager
def _claim(call: Call, row: DataRow) -> Iterator[int | None]:
    """Hold a row: yields which attempt this is, from 1 on; None where another process holds it.

    The file of a process that was killed stays, and counts.
    """
    path = _claims(call.folder) / _code(row)
    attempt = _take(path)
    if attempt is None:
        yield None
        return
    ended = threading.Event()
    signs = threading.Thread(target=_give_signs, args=(path, ended), daemon=True)
    signs.start()
    try:
        yield attempt
    finally:
        ended.set()
        path.unlink(missing_ok=True)


def _claims(folder: Path) -> Path:
    return folder / _WORK / "claims"


def _take(path: Path) -> int | None:
    """Make the file of a claim, over that of a process that is gone."""
    begun = 0
    if path.exists():
        owner = _owner(path)
        if owner is None or is_alive(owner, path):
            return None
        aside = path.with_name(f"{path.name}.{os.getpid()}.gone")
        try:
            os.rename(path, aside)
        except FileNotFoundError:  # somebody else took it
            return None
        begun = int(owner["attempt"])
        if _owner(aside) != owner:  # somebody else took it, and has it now
            os.rename(aside, path)
            return None
        aside.unlink()
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
    except FileExistsError:
        return None
    with os.fdopen(descriptor, "w") as file:
        file.write(json.dumps(_me() | {"attempt": begun + 1}))
    return begun + 1


def _owner(path: Path) -> dict[str, Any] | None:
    """Who holds a claim; None where that is being written."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        return found if isinstance(found, dict) else None
    except FileNotFoundError:
        return None
    except ValueError:
        return None if time.time() - path.stat().st_mtime < _WRITING else {"machine": "", "pid": 0, "began": "", "attempt": 1}


def _me() -> dict[str, Any]:
    return {"machine": _machine(), "pid": os.getpid(), "began": _began(os.getpid())}


def _machine() -> str:
    """This machine since it was started."""
    try:
        booted = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        booted = ""
    return f"{platform.node()} {booted}"


def _began(pid: int) -> str:
    """When a process began, which tells it from a later one of the same number; empty where that cannot be known."""
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()[19]
    except (OSError, IndexError):
        return ""


def is_alive(owner: Mapping[str, Any], path: Path) -> bool:
    """Whether the process that holds a claim is there; one of another machine by the last sign of life in the file."""
    if owner["machine"] == _machine():
        try:
            os.kill(int(owner["pid"]), 0)
        except ProcessLookupError:
            return False
        except PermissionError:
            pass
        return not _is_zombie(int(owner["pid"])) and _began(int(owner["pid"])) == owner["began"]
    try:
        return time.time() - path.stat().st_mtime < _SILENCE
    except FileNotFoundError:
        return False


def _is_zombie(pid: int) -> bool:
    """Whether a process has ended and its parent has not noticed yet."""
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()[0] == "Z"
    except (OSError, IndexError):
        return False


def _give_signs(path: Path, ended: threading.Event) -> None:
    while not ended.wait(_SIGN):
        try:
            os.utime(path)
        except OSError:
            return


def is_held(folder: Path, row: DataRow) -> bool:
    """Whether a process works on a row."""
    path = _claims(folder) / _code(row)
    owner = _owner(path) if path.exists() else None
    return path.exists() and (owner is None or is_alive(owner, path))


def clear(folder: Path) -> None:
    """Take away what processes that are gone have left behind; their rows are begun afresh."""
    claims, work = _claims(folder), folder / _WORK
    for path in claims.glob("*") if claims.is_dir() else ():
        owner = _owner(path)
        if owner is not None and not is_alive(owner, path):
            path.unlink(missing_ok=True)
    held = {path.name for path in claims.glob("*")} if claims.is_dir() else set()
    for path in work.glob("*.*") if work.is_dir() else ():
        if path.name.split(".")[0] not in held:
            _restore(folder, path)
    for path in (claims, work):
        try:
            path.rmdir()
        except OSError:  # not empty, or not there
            pass


def _restore(folder: Path, path: Path) -> None:
    """Remove a folder of a row that was not finished; an earlier row that had made way goes back to its place."""
    line = own_line(path) if path.name.endswith(".before") else None
    if line is not None and not (folder / line["row"]).exists():
        os.rename(path, folder / line["row"])
    shutil.rmtree(path, ignore_errors=True)
