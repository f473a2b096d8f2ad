"""Many motions in one command: which files, which folder for each, whose turn.

``summary.json`` over many motions: the rows of every call that wrote into the folder.

``stepper=auto`` over many motions: chosen once, so that what is made in one folder is made in one way.

The folder of each of many motions, and whether another motion is in it already.

``resume=true``: which rollouts are finished, which are made again and why, and with what the others go on.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from glob import has_magic
from pathlib import Path
from typing import Any

import h5py

from hood.app.common import output_folder
from hood.app.notices import say
from hood.app.output.summary import summarise_file
from hood.app.settings.compose import ConfigError, brief, load_config, options, plain
from hood.app.settings.record import read_settings
from hood.app.settings.rollout_settings import RolloutSettings
from hood.app.setup import make_scene, make_stepper
from hood.app.stepping.automatic import AUTO, choose, decided
from hood.app.stepping.steppers import GROUP, with_air, with_stepper
from hood.assets.files.atomic import occupy, write_atomically
from hood.assets.motion.motion_files import LISTS, file_named, find_motions, is_embedded
from hood.training import distributed

_NAME = "summary.json"
#: Beside a rollout that is not whole: where it was stopped (:mod:`hood.app.progress`).
STATE = "rollout.state"
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
            file_named(entry)
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


#: Instead of a digest: the motion is in no file that can be read.
NO_FILE = "none"


def place_motions(found: Sequence[str], output: Path, root: str | None) -> tuple[list[Path], Path]:
    """Folders below ``output`` for motions, and the folder from which they are named.

    A file's folder has its path below ``root``, without the suffix, an embedded motion's its name. Without a ``root`` it is
    what the paths of all files have in common: then the names depend on which motions there are.

    Raises:
        ConfigError: ``root`` is no folder, or a motion is not below it; two motions would share a folder.
    """
    files = [name for name in found if Path(name).suffix]
    start = _stated(root, files) if root is not None else _common([Path(name).absolute().parent for name in files])
    folders: dict[Path, str] = {}
    for name in found:
        folder = output / (_below(start, name).with_suffix("") if name in files else name)
        if folder in folders:
            raise ConfigError(f"{folders[folder]} and {name} would both go to {folder}; rename one of them")
        folders[folder] = name
    return list(folders), start


def refuse_others(folder: Path, sequence: str) -> None:
    """Raise ConfigError where ``folder`` holds the rollout of another motion than ``sequence``; it would be lost."""
    attributes = attributes_of(folder)
    if attributes is None or is_of(attributes, sequence):
        return
    there, here = str(attributes.get("motion_file") or _asked(attributes)), motion_file(sequence)
    way_out = "choose another output"
    if os.path.isabs(there) and os.path.isabs(here):
        way_out = (
            f"name the folders from one that holds both, root={_common([Path(there).parent, Path(here).parent])}, or {way_out}"
        )
    raise ConfigError(f"{folder}: holds the rollout of {there}, which that of {here} would replace; {way_out}")


def is_of(attributes: Mapping[str, Any], sequence: str) -> bool:
    """Whether the attributes of a rollout file are those of a rollout of this motion, wherever its file lies now.

    Files of earlier versions know their motion as it was written in the command alone.
    """
    there, here = attributes.get("motion_file"), motion_file(sequence)
    if there is not None:
        return there == here or attributes.get("motion_sha256") == motion_digest(here) != NO_FILE
    before = _asked(attributes)
    return before == sequence or motion_file(before) == here


def motion_attributes(sequence: str) -> dict[str, str]:
    """What a rollout file keeps of its motion's file: where it is, and its content."""
    return {"motion_file": motion_file(sequence), "motion_sha256": motion_digest(motion_file(sequence))}


def motion_file(sequence: str) -> str:
    """The whole path of a motion's file, the name of an embedded one."""
    return sequence if is_embedded(sequence) else os.path.realpath(Path(sequence).expanduser())


def motion_digest(file: str) -> str:
    """SHA-256 of a motion's file or of an embedded one; :data:`NO_FILE` where there is no such file."""
    try:
        return hashlib.sha256(file_named(file).read_bytes()).hexdigest()
    except (OSError, ValueError):
        return NO_FILE


def _stated(root: str, files: Sequence[str]) -> Path:
    start = Path(root).expanduser().absolute()
    if not start.is_dir():
        raise ConfigError(f"root={root}: no such folder; give one that holds all the motions")
    for name in files:
        if start not in Path(name).absolute().parents and start.resolve() not in Path(name).resolve().parents:
            raise ConfigError(f"root={root}: {name} is not below it; give a folder that holds all the motions")
    return start


def _below(start: Path, name: str) -> Path:
    """The path of a motion's file from the folder ``start`` above it, links followed only where they have to be."""
    file = Path(name).absolute()
    return file.relative_to(start) if start in file.parents else file.resolve().relative_to(start.resolve())


def _common(folders: Sequence[Path]) -> Path:
    return Path(os.path.commonpath(folders)) if folders else Path()


def attributes_of(folder: Path) -> dict[str, Any] | None:
    """Attributes of the rollout in a folder; None where there is none that can be read."""
    try:
        with h5py.File(folder / "rollout.h5", "r") as file:
            return dict(file.attrs)
    except OSError:
        return None


def _asked(attributes: Mapping[str, Any]) -> str:
    """The motion of a rollout as its command named it."""
    try:
        return str(json.loads(attributes["asked"])["sequence"])
    except (KeyError, ValueError, TypeError):
        return str(attributes.get("sequence", "an unknown motion"))


#: Keys that change nothing in a rollout; its motion is compared by its file.
_FREE = ("resume", "output", "root", "fail_on", "sequence")


def as_begun(config: RolloutSettings, motions: Iterable[tuple[str, Path]]) -> RolloutSettings:
    """With ``resume=true stepper=auto`` the config with the stepper of the first rollout that is finished, or was stopped, with
    all its other settings: what was begun with one stepper, or when another was the default, goes on with that.

    Args:
        motions: of each the motion and the folder.
    """
    if not bool(config.resume) or str(config.stepper) != AUTO:
        return config
    for sequence, folder in motions:
        attributes = _complete(folder, or_stopped=True)
        if attributes is None or str(attributes["stepper"]) not in options(GROUP):  # of a plugin that is gone
            continue
        same = with_stepper(config, str(attributes["stepper"]))
        if not other_settings(same.with_values(sequence=sequence), attributes):
            say(f"resume=true: stepper={same.stepper}, as in {folder}")
            return same
    return config


def resumed(config: RolloutSettings, digest: str) -> dict[str, Any] | None:
    """With ``resume=true`` the summary of the rollout that is in its folder; says where one there was made otherwise."""
    if not bool(config.resume):
        return None
    folder = output_folder(config)
    done = finished(config, digest, folder)
    sentence = made_otherwise(config, folder) if done is None else None
    if sentence is not None:
        say(sentence)
    return done


def finished(config: RolloutSettings, digest: str, folder: Path) -> dict[str, Any] | None:
    """The summary of a rollout that was finished with the same settings and weights; None where there is none."""
    attributes = _complete(folder)
    try:
        summary: dict[str, Any] = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    if attributes is None or attributes["checkpoint_sha256"] != digest or other_settings(config, attributes):
        return None
    return summary if {"sound", "doubts"} <= set(summary) else summarise_file(folder / "rollout.h5")


def made_otherwise(config: RolloutSettings, folder: Path) -> str | None:
    """A sentence where the folder has a whole rollout of the motion with another setting; None where it has none."""
    attributes = _complete(folder)
    found = {} if attributes is None else other_settings(config, attributes)
    for key, there in found.items():
        here = f"{key} is {brief(there)} there, {brief(config[key])} in this command"
        return f"resume=true: {folder} was made with other settings and is made again ({here})"
    return None


def _complete(folder: Path, or_stopped: bool = False) -> dict[str, Any] | None:
    """Attributes of the whole rollout in a folder, ``or_stopped`` also of one that can go on; None where there is none."""
    attributes = attributes_of(folder)
    if attributes is None or not {"asked", "complete", "checkpoint_sha256", "stepper"} <= {*attributes}:
        return None
    goes_on = or_stopped and (folder / STATE).is_file()
    return attributes if bool(attributes["complete"]) or goes_on else None


def other_settings(config: Any, attributes: dict[str, Any]) -> dict[str, Any]:
    """What a rollout was made with where that is not what ``config`` says, by key."""
    try:
        before = read_settings(attributes["asked"])
    except ValueError:
        return {"asked": None}
    now = plain(with_air(config)[0])
    if before.get("wind") == AUTO:
        before |= {key: value for key, value in read_settings(attributes["config"]).items() if key in ("wind", "losses")}
    before["plan"] = before.get("plan") or now["plan"]
    before.setdefault("stepping", now["stepping"])  # rollouts from before there were options are known by their word
    if before.get("stepper") == AUTO != now["stepper"]:  # what it became
        before |= {key: value for key, value in read_settings(attributes["config"]).items() if key in ("stepper", "stepping")}
    # What had no key yet was what its default says now.
    before = {**plain(load_config("rollout")), **before}
    other = {key: before.get(key) for key in now if key not in _FREE and before.get(key) != now[key]}
    if not is_of(attributes, str(config.sequence)):
        other["sequence"] = before.get("sequence")
    return other
