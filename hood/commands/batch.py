"""Many motions in one command: which files, which folder for each, whose turn."""

from __future__ import annotations

import errno
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from glob import has_magic
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from hood.assets.files.library import locate
from hood.assets.motion.collection import motions_in
from hood.assets.motion.motion_files import find_motions
from hood.commands.batches.overview import refuse_overview, refuse_rollout
from hood.commands.batches.places import place_motions, refuse_others
from hood.config import ConfigError
from hood.training import distributed

#: A disk in this state refuses the next file too.
_HOPELESS = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)


@dataclass(frozen=True)
class Job:
    """One motion and where its files go."""

    sequence: str
    folder: Path

    def of(self, config: DictConfig) -> DictConfig:
        """The config of its rollout, from that of all."""
        one = OmegaConf.merge(config, {"sequence": self.sequence, "output": str(self.folder)})
        assert isinstance(one, DictConfig)
        return one


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


def find_jobs(entry: str, output: Path, root: str | None = None) -> list[Job] | None:
    """The jobs of a folder, a glob or a list of motions, folders below ``output`` named as the files below ``root``, without
    one below what they have in common; None for one motion.

    Raises:
        ConfigError: two motions would share a folder, or another motion is in one; ``root`` does not hold the motions, or
            there is one motion only; one rollout would meet those of many in ``output``.
    """
    plain_file = Path(entry).expanduser().is_file() and Path(entry).suffix not in (".txt", ".json")
    found = [entry] if plain_file else expand_sequences([entry])
    if found == [entry]:
        if root is not None:
            raise ConfigError(f"root={root}: names the folders of many motions, and sequence={entry} is one; drop root")
        refuse_overview(output)
        return None
    refuse_rollout(output)
    folders, start = place_motions(found, output, root)
    for name, folder in zip(found, folders, strict=True):
        refuse_others(folder, name)
    print(f"{len(found)} motions, their folders in {output} are named from {start} (root)")
    return [Job(name, folder) for name, folder in zip(found, folders, strict=True)]


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
