"""Many motions in one command: which files, which folder for each, whose turn.

``summary.json`` over many motions: the rows of every call that wrote into the folder.

``stepper=auto`` over many motions: chosen once, so that what is made in one folder is made in one way.
"""

from __future__ import annotations

import errno
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from glob import has_magic
from pathlib import Path
from typing import Any

from hood.app.batch.folders import as_begun, place_motions, refuse_others
from hood.app.notices import say
from hood.app.settings.compose import ConfigError
from hood.app.settings.rollout_settings import RolloutSettings
from hood.app.setup import make_scene, make_stepper
from hood.app.stepping.automatic import AUTO, choose, decided
from hood.app.stepping.steppers import with_stepper
from hood.assets.files.atomic import occupy, write_atomically
from hood.assets.files.library import locate
from hood.assets.motion.motion_files import LISTS, find_motions
from hood.training import distributed

_NAME = "summary.json"
#: Seconds to wait for another call that writes its rows at this moment.
_PATIENCE = 20.0


def write_overview(output: Path, rows: Mapping[str, dict[str, Any]], folders: Mapping[str, Path]) -> Path:
    """Write the rows of this call, by motion, beside those of others that are still there; returns the file.

    Args:
        rows: summaries, or ``{"error": …}``.
        folders: of all motions of this call, in its order; those without a row yet keep the one that they had.
    """
    path = output / _NAME
    places = {name: folder.relative_to(output).as_posix() for name, folder in folders.items()}
    with occupy(output, _PATIENCE):
        before, their_places = _read(path)
        replaced = {places[name] for name in rows}
        kept = {
            name: row
            for name, row in before.items()
            if name not in rows and their_places.get(name) not in replaced and _is_there(output, their_places.get(name), row)
        }
        known = {name: place for name, place in their_places.items() if name in kept} | places
        order = [*(name for name in kept if name not in places), *places]
        shown = {name: row for name in order if (row := rows.get(name, kept.get(name))) is not None}
        content = {
            "num_motions": len(order),
            "motions": shown,
            "folders": {name: known[name] for name in order if name in known},
        }
        write_atomically(path, json.dumps(content, indent=1).encode())
    return path


def refuse_overview(folder: Path) -> None:
    """Raise ConfigError where one rollout would write into the folder of many, and replace the summary over all of them."""
    count = len(_read(folder / _NAME)[0])
    if count:
        raise ConfigError(f"output={folder}: holds the rollouts of {count} motions and their summary; give a folder of its own")


def refuse_rollout(folder: Path) -> None:
    """Raise ConfigError where the folder for many motions holds one rollout: its summary would be replaced."""
    if (folder / "rollout.h5").exists():
        raise ConfigError(
            f"output={folder}: holds one rollout, whose summary that of many would replace; choose another output"
        )


def _is_there(output: Path, place: str | None, row: Mapping[str, Any]) -> bool:
    """Whether a row of another call still says what lies in the folder; earlier versions do not say in which."""
    return place is None or "error" in row or (output / place / "rollout.h5").exists()


def _read(path: Path) -> tuple[dict[str, dict[str, Any]], dict[str, str]]:
    """Rows and folders by motion that a file holds; nothing where it is none of many motions."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        motions, folders = content["motions"], content.get("folders", {})
    except (OSError, ValueError, KeyError, TypeError):
        return {}, {}
    ours = isinstance(motions, dict) and isinstance(folders, dict) and all(isinstance(row, dict) for row in motions.values())
    return (motions, folders) if ours else ({}, {})


#: A disk in this state refuses the next file too.
_HOPELESS = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)


@dataclass(frozen=True)
class Job:
    """One motion and where its files go."""

    sequence: str
    folder: Path

    def of(self, config: RolloutSettings) -> RolloutSettings:
        """The config of its rollout, from that of all."""
        return config.with_values(sequence=self.sequence, output=str(self.folder))


@dataclass
class Outcome:
    """What the processes did together."""

    rows: dict[str, dict[str, Any]]  # summaries by motion, or {"error": …}
    interrupted: bool
    hopeless: OSError | None  # the disk refused


def require_motions(key: str, entries: Sequence[str]) -> None:
    """Refuse names of motions that are not there, before any of them is used; lists and globs are looked through elsewhere.

    Raises:
        FileNotFoundError: names the key, the index and the nearest name.
    """
    for index, entry in enumerate(entries):
        if has_magic(entry) or Path(entry).suffix.lower() in LISTS or Path(entry).expanduser().is_dir():
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
    plain_file = Path(entry).expanduser().is_file() and Path(entry).suffix.lower() not in LISTS
    found = [entry] if plain_file else find_motions([entry])
    if found == [entry]:
        if root is not None:
            raise ConfigError(f"root={root}: names the folders of many motions, and sequence={entry} is one; drop root")
        refuse_overview(output)
        return None
    refuse_rollout(output)
    folders, start = place_motions(found, output, root)
    for name, folder in zip(found, folders, strict=True):
        refuse_others(folder, name)
    say(f"{len(found)} motions, their folders in {output} are named from {start} (root)")
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


def with_one_stepper(config: RolloutSettings, jobs: Sequence[Job]) -> RolloutSettings:
    """The config without ``stepper=auto``, and a line that says why.

    It is the stepper of the rollouts that are finished already where ``resume=true``, else what is chosen for the first motion.
    """
    config = as_begun(config, [(job.sequence, job.folder) for job in jobs])
    settled, why = decided(config)
    if str(settled.stepper) == AUTO:
        first = jobs[0].of(config)
        choice = choose(first, make_stepper(first)[0], make_scene(first))
        settled, why = with_stepper(config, choice.stepper), choice.why
    for sentence in why:
        say(sentence)
    return settled
