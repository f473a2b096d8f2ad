"""``manifest.jsonl`` of a data set: a line a row, appended when the row is done, and what the lines say at the next call.

The last line of a row counts. A line that was cut off by a kill is passed over; the folder of its row holds it as well.
"""

from __future__ import annotations

import errno
import hashlib
import importlib
import importlib.util
import io
import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

from hood.app.batch.rows import DataRow
from hood.app.settings.compose import ConfigError, brief
from hood.assets.files.atomic import write_atomically
from hood.assets.files.library import locate
from hood.assets.files.said import install

Line = dict[str, Any]
#: A row's own line, in its folder.
OWN_LINE = "row.json"
#: Verdicts of rows: those of results, and that of a row without one.
VERDICTS = SOUND, DOUBTFUL, UNSOUND, UNJUDGED, FAILED = "sound", "doubtful", "unsound", "unjudged", "failed"
#: Keys of a row that name files, and what they name among assets.
_FILES = {"garment": "garments", "body": "body", "sequence": "motions"}


class Manifest:
    """The lines of an output folder; several processes append, on one machine or on many.

    Args:
        folder: the output folder.
        start: the place [bytes] in the file where :meth:`new` begins.
    """

    def __init__(self, folder: Path, start: int = 0) -> None:
        self.path, self._read = folder / "manifest.jsonl", start

    def size(self) -> int:
        """Bytes that are there."""
        return self.path.stat().st_size if self.path.exists() else 0

    def new(self) -> list[Line]:
        """The whole lines that have come since the last call."""
        if self.size() <= self._read:
            return []
        with open(self.path, "rb") as file:
            file.seek(self._read)
            whole, newline, _ = file.read().rpartition(b"\n")
        self._read += len(whole) + len(newline)
        return [line for text in whole.split(b"\n") if (line := _line_of(text)) is not None]

    def append(self, line: Mapping[str, Any]) -> None:
        """Write a line in one piece, and have it on the disk before this returns; a half line before it stays alone.

        Raises:
            OSError: it cannot be written; names the file.
        """
        text = json.dumps(line).encode() + b"\n"
        try:
            descriptor = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
            try:
                size = os.fstat(descriptor).st_size
                if size and os.pread(descriptor, 1, size - 1) != b"\n":
                    text = b"\n" + text
                if os.write(descriptor, text) < len(text):
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self.path)) from error


def _line_of(text: bytes) -> Line | None:
    """A line of the file; None for what is none."""
    try:
        found = json.loads(text)
    except ValueError:
        return None
    return found if isinstance(found, dict) and {"row", "verdict", "settings"} <= {*found} else None


def read_manifest(folder: Path) -> dict[str, Line]:
    """The last line of every row in an output folder; empty where there is no manifest."""
    return {line["row"]: line for line in Manifest(folder).new()}


def check_parquet(wanted: bool) -> None:
    """Raise ConfigError where ``manifest.parquet`` is ``wanted`` and the package that writes it is not there."""
    if wanted and importlib.util.find_spec("pyarrow") is None:
        raise ConfigError(f"parquet=true needs the package pyarrow: {install('parquet')}")


def parquet_columns(lines: Iterable[Line]) -> dict[str, list[Any]]:
    """A column a key of any line, None where a line lacks it: of tables one a key, ``settings.garment``; lists are JSON."""
    rows = []
    for line in lines:
        tables = {key: value for key, value in line.items() if isinstance(value, dict)}
        flat = {key: value for key, value in line.items() if key not in tables}
        flat |= {f"{key}.{name}": value for key, table in tables.items() for name, value in table.items()}
        rows.append({key: json.dumps(value) if isinstance(value, (list, dict)) else value for key, value in flat.items()})
    return {key: [row.get(key) for row in rows] for key in dict.fromkeys(key for row in rows for key in row)}


def write_parquet(folder: Path) -> None:
    """Write the last line of every row of an output folder as ``manifest.parquet``."""
    content = io.BytesIO()
    table = importlib.import_module("pyarrow").table(parquet_columns(read_manifest(folder).values()))
    importlib.import_module("pyarrow.parquet").write_table(table, content)
    write_atomically(folder / "manifest.parquet", content.getvalue())


def own_line(folder: Path) -> Line | None:
    """The line that the folder of a row holds; None where there is none."""
    try:
        return _line_of((folder / OWN_LINE).read_bytes())
    except OSError:
        return None


def mend_manifest(folder: Path, rows: Iterable[DataRow]) -> int:
    """Append the lines of rows whose folders are in place, and which the manifest has lost by a kill or a full disk; returns
    how many there were."""
    known, count = read_manifest(folder), 0
    for row in rows:
        line = own_line(folder / row.name) if row.name not in known else None
        if line is not None and line["row"] == row.name:
            Manifest(folder).append(line)
            count += 1
    return count


def require_same_rows(folder: Path, rows: Iterable[DataRow], known: Mapping[str, Line]) -> None:
    """Raise ConfigError where a row of the manifest was made with other settings than it would be now; names key and row.

    A file that has another place but the same content is the same.
    """
    for row in rows:
        line = known.get(row.name)
        if line is None or line["settings"] == row.keys:
            continue
        there, here = line["settings"], row.keys
        for key in dict.fromkeys([*there, *here]):
            if there.get(key) != here.get(key) and not _is_same_file(line, key, here.get(key)):
                raise ConfigError(
                    f"{Manifest(folder).path}: {key} of row {row.name} is {brief(there.get(key))} there, "
                    f"{brief(here.get(key))} in this command; give the same settings or use another output"
                )


def _is_same_file(line: Line, key: str, name: str | None) -> bool:
    before = line.get("inputs", {}).get(key)
    return key in _FILES and name is not None and before is not None and before == input_digest(key, name)


def open_rows(folder: Path, rows: Sequence[DataRow], known: Mapping[str, Line], retry: str) -> tuple[list[DataRow], list[str]]:
    """The rows that are to be made, and sentences on those of them that were made before.

    Args:
        retry: ``none``, ``failed`` or ``unsound``, which means both.
    """
    again = {"none": (), "failed": (FAILED,), "unsound": (FAILED, UNSOUND)}[retry]
    left, changed, lost = list[DataRow](), 0, 0
    for row in rows:
        line = known.get(row.name)
        if line is None or line["verdict"] in again:
            left.append(row)
        elif line["verdict"] == FAILED:
            continue
        elif not (folder / row.name / "rollout.h5").exists():
            left.append(row)
            lost += 1
        elif any(before != input_digest(key, row.keys.get(key, "")) for key, before in line.get("inputs", {}).items()):
            left.append(row)
            changed += 1
    said = [f"{changed} rows are made again: their files have other content now"] if changed else []
    return left, [*said, f"{lost} rows are made again: their folders are gone"] if lost else said


def inputs_of(row: DataRow) -> dict[str, str]:
    """SHA-256 of what stands behind the names of garment, body and motion; of an outfit one for all."""
    return {key: input_digest(key, row.keys[key]) for key in _FILES if key in row.keys}


def input_digest(key: str, value: str) -> str:
    """SHA-256 of the file or folder, or files, that a word names; ``none`` where there is none that can be read."""
    found = hashlib.sha256()
    for name in value.strip("[]").split(",") if value.startswith("[") else [value]:
        content = _content(_FILES[key], name.strip("'\""))
        if content is None:
            return "none"
        found.update(content.encode())
    return found.hexdigest()


def _content(kind: str, name: str) -> str | None:
    """Of one name."""
    try:
        path = locate(kind, name, folders=True)
        files = [file for file in _files_of(path)]
        return _hashed(tuple((str(file), file.stat().st_size, file.stat().st_mtime_ns) for file in files))
    except (OSError, ValueError):
        return None


def _files_of(path: Path) -> Iterator[Path]:
    if not path.is_dir():
        yield path
        return
    yield from sorted(file for file in path.rglob("*") if file.is_file())


@lru_cache(maxsize=4096)
def _hashed(files: tuple[tuple[str, int, int], ...]) -> str:
    """Of files by name, size and time of change: what has not changed is read once a process."""
    found = hashlib.sha256()
    for name, _, _ in files:
        with open(name, "rb") as file:
            found.update(hashlib.file_digest(file, "sha256").digest())
    return found.hexdigest()
