"""Lists of motion files from folders, globs and split lists."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from pathlib import Path

from hood.assets.files.library import locate
from hood.assets.files.text import read_text
from hood.assets.motion.layouts.content import ARRAYS, TENSORS
from hood.assets.motion.motion_files import find_motions
from hood.assets.motion.recording import motion_suffixes

#: What lies beside the motions in AMASS folders: subjects' shapes, stages of the fit.
_BESIDES = ("shape", "neutral_stagei", "female_stagei", "male_stagei")
_OFTEN_OTHERS = (*ARRAYS, *TENSORS)
#: Columns of a table that may name the motion.
_NAME_COLUMNS = ("id", "file", "path", "sequence", "name")


def expand_sequences(patterns: str | Path | Iterable[str | Path], part: str = "train") -> list[Path]:
    """Motion files that ``patterns`` stand for: in their order, folders and globs sorted, nothing twice.

    A pattern is the name of an embedded motion; a file; a folder, with its motions as in :func:`motions_in`; a glob
    (``amass/**/*_poses.npz``); a list, see :func:`hood.assets.motion.motion_files.find_motions`; or a ``.csv`` table with a
    column ``id`` (or file, path, sequence, name; else its first), whose entries start from its folder, with or without suffix.

    Args:
        part: of a JSON split, "train" or "validation".

    Raises:
        FileNotFoundError: an unknown name, a missing file or list.
        ValueError: nothing found for a pattern, or an unreadable list; names it.
    """
    found: dict[Path, None] = {}
    for pattern in [patterns] if isinstance(patterns, (str, Path)) else patterns:
        path = Path(pattern).expanduser()
        if path.is_dir():
            files = motions_in(path)
        elif path.suffix.lower() == ".csv":
            files = _in_table(path)
        else:
            files = [locate("motions", name) for name in find_motions([str(pattern)], part)]
        found.update(dict.fromkeys(files))
    return list(found)


def motions_in(folder: Path) -> list[Path]:
    """Motion files in a folder and below, sorted: archives, pickles and what plugins read, without the shapes and stages of the
    fit that AMASS keeps beside them; where there are none, arrays and files of torch.

    Raises:
        ValueError: there are none.
    """
    suffixes = motion_suffixes()
    files = (path for path in folder.rglob("*") if path.suffix.lower() in suffixes and path.is_file())
    every = sorted(path for path in files if path.stem not in _BESIDES and not path.name.startswith("."))
    # Arrays and files of torch are motions in few folders, and lie beside them in many: statistics, weights.
    found = [path for path in every if path.suffix.lower() not in _OFTEN_OTHERS] or every
    if not found:
        raise ValueError(f"{folder}: no motions ({', '.join(suffixes)}) in it or below; give a folder that holds such files")
    return found


def _in_table(path: Path) -> list[Path]:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        rows = list(csv.DictReader(io.StringIO(read_text(path), newline="")))
    except csv.Error as error:
        raise ValueError(f"{path}: not readable as a table of comma-separated values ({error})") from error
    if not rows:
        raise ValueError(f"{path}: an empty table; give one row per motion below a row of column names")
    column = next((name for name in _NAME_COLUMNS if name in rows[0]), next(iter(rows[0])))
    names = [row[column] for row in rows]
    if any(not name for name in names):
        raise ValueError(f"{path}: row {next(i for i, name in enumerate(names) if not name) + 2} names no motion in {column!r}")
    return [_beside(path, row, str(name)) for row, name in enumerate(names, start=2)]


def _beside(table: Path, row: int, name: str) -> Path:
    """File of a table's entry: beside the table, with or without its suffix, or an embedded motion."""
    for suffix in ("", *motion_suffixes()):
        file = table.parent / (name + suffix)
        if file.is_file():
            return file
    try:
        return locate("motions", name)
    except (ValueError, OSError) as error:
        kind = FileNotFoundError if isinstance(error, FileNotFoundError) else ValueError
        raise kind(f"{table}, row {row}: {error}") from error
