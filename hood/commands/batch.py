"""Many motions in one command: which files, which folder for each, whose turn, what is done already."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from glob import has_magic
from pathlib import Path
from typing import Any

import h5py
from omegaconf import DictConfig

from hood.assets.files.library import locate
from hood.assets.motion.collection import motions_in
from hood.assets.motion.motion_files import find_motions
from hood.commands.summary import summarise
from hood.config import ConfigError, load_config, plain
from hood.training import distributed

#: A disk in this state refuses the next file too.
_HOPELESS = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)


@dataclass(frozen=True)
class Job:
    """One motion and where its files go."""

    sequence: str
    folder: Path


@dataclass
class Outcome:
    """What the processes did together."""

    rows: dict[str, dict[str, Any]]  # summaries by motion, or {"error": …}
    interrupted: bool
    hopeless: OSError | None  # the disk refused


def expand_sequences(entries: Sequence[str]) -> list[str]:
    """Names and files that ``entries`` stand for: names, files, globs, lists of them, or folders with all motions below them.

    Raises:
        ValueError: nothing found.
    """
    found: dict[str, None] = {}
    for entry in entries:
        folder = Path(entry).expanduser()
        found.update(dict.fromkeys(map(str, motions_in(folder)) if folder.is_dir() else find_motions([entry])))
    return list(found)


def require_motions(key: str, entries: Sequence[str]) -> None:
    """Refuse names of motions that are not there, before any of them is used; lists and globs are looked through elsewhere.

    Raises:
        FileNotFoundError: names the key, the index and the nearest name.
    """
    for index, entry in enumerate(entries):
        if has_magic(entry) or Path(entry).suffix in (".txt", ".json") or Path(entry).expanduser().is_dir():
            continue
        try:
            locate("motions", entry)
        except FileNotFoundError as error:
            raise FileNotFoundError(f"{key}[{index}]: {error}") from error


def find_jobs(entry: str, output: Path) -> list[Job] | None:
    """The jobs of a folder, a glob or a list of motions, folders below ``output`` named as the files; None for one motion.

    Raises:
        ConfigError: two motions would share a folder.
    """
    plain_file = Path(entry).expanduser().is_file() and Path(entry).suffix not in (".txt", ".json")
    found = [entry] if plain_file else expand_sequences([entry])
    if found == [entry]:
        return None
    files = [name for name in found if Path(name).suffix]
    root = Path(os.path.commonpath([Path(name).absolute().parent for name in files])) if files else Path()
    jobs = [Job(n, output / (Path(n).absolute().relative_to(root).with_suffix("") if n in files else n)) for n in found]
    taken: dict[Path, str] = {}
    for job in jobs:
        if job.folder in taken:
            raise ConfigError(f"{taken[job.folder]} and {job.sequence} would both go to {job.folder}; rename one of them")
        taken[job.folder] = job.sequence
    return jobs


def share(jobs: Sequence[Job], work: Callable[[Job], tuple[dict[str, Any], bool]]) -> Outcome:
    """Do the jobs, each process every n-th; ``work`` returns a summary and whether the user interrupted it.

    A motion that cannot be used gets a row that says why, the others go on; a disk that refuses ends the share.
    """
    rows: dict[str, dict[str, Any]] = {}
    interrupted, hopeless = False, None
    for job in jobs[distributed.rank() :: distributed.world_size()]:
        try:
            rows[job.sequence], interrupted = work(job)
        except (ValueError, OSError) as error:
            if isinstance(error, OSError) and error.errno in _HOPELESS:
                hopeless = error
                break
            rows[job.sequence] = {"error": " ".join(str(error).split())}
        if interrupted:
            break
    parts = distributed.gather(Outcome(rows, interrupted, hopeless))
    known = {name: row for part in parts for name, row in part.rows.items()}
    return Outcome(
        {job.sequence: known[job.sequence] for job in jobs if job.sequence in known},
        any(part.interrupted for part in parts),
        next((part.hopeless for part in parts if part.hopeless is not None), None),
    )


def finished(config: DictConfig, digest: str, folder: Path) -> dict[str, Any] | None:
    """The summary of a rollout that was finished with the same settings and weights; None where there is none."""
    try:
        summary: dict[str, Any] = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
        with h5py.File(folder / "rollout.h5", "r") as file:
            attributes = dict(file.attrs)
        before = json.loads(attributes["asked"])
    except (OSError, ValueError, KeyError):
        return None
    now = plain(config)
    before["plan"] = before.get("plan") or now["plan"]
    before.setdefault("stepping", now["stepping"])  # rollouts from before there were options are known by their word
    # What had no key yet was what its default says now.
    before = {**plain(load_config("rollout")), **before}
    same = all(before.get(key) == now[key] for key in now if key not in ("resume", "output", "allow_unsound", "doubts"))
    if not same or not bool(attributes["complete"]) or attributes["checkpoint_sha256"] != digest:
        return None
    return summary if {"sound", "doubts"} <= set(summary) else summarise(folder / "rollout.h5")
