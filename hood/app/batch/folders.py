"""The folder of each of many motions, and whether another motion is in it already.

``resume=true``: which rollouts are finished, which are made again and why, and with what the others go on.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py

from hood.app.common import output_folder
from hood.app.notices import say
from hood.app.output.summary import summarise
from hood.app.settings.compose import ConfigError, brief, load_config, options, plain
from hood.app.settings.record import read_settings
from hood.app.settings.rollout_settings import RolloutSettings
from hood.app.stepping.automatic import AUTO
from hood.app.stepping.steppers import GROUP, with_stepper
from hood.assets.files.library import locate, names
from hood.rollouts.file.reader import read_rollout

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
    return sequence if sequence in names("motions") else os.path.realpath(Path(sequence).expanduser())


def motion_digest(file: str) -> str:
    """SHA-256 of a motion's file or of an embedded one; :data:`NO_FILE` where there is no such file."""
    try:
        return hashlib.sha256(locate("motions", file).read_bytes()).hexdigest()
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
    """With ``resume=true stepper=auto`` the config with the stepper of the first rollout that is finished with all its other
    settings: what was begun with one stepper, or when another was the default, goes on with that.

    Args:
        motions: of each the motion and the folder.
    """
    if not bool(config.resume) or str(config.stepper) != AUTO:
        return config
    for sequence, folder in motions:
        attributes = _complete(folder)
        if attributes is None or str(attributes["stepper"]) not in options(GROUP):  # of a plugin that is gone
            continue
        same = with_stepper(config, str(attributes["stepper"]))
        if not _other_settings(same.with_values(sequence=sequence), attributes):
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
    if attributes is None or attributes["checkpoint_sha256"] != digest or _other_settings(config, attributes):
        return None
    return summary if {"sound", "doubts"} <= set(summary) else summarise(read_rollout(folder / "rollout.h5"))


def made_otherwise(config: RolloutSettings, folder: Path) -> str | None:
    """A sentence where the folder has a whole rollout of the motion with another setting; None where it has none."""
    attributes = _complete(folder)
    found = {} if attributes is None else _other_settings(config, attributes)
    for key, there in found.items():
        here = f"{key} is {brief(there)} there, {brief(config[key])} in this command"
        return f"resume=true: {folder} was made with other settings and is made again ({here})"
    return None


def _complete(folder: Path) -> dict[str, Any] | None:
    """Attributes of the whole rollout in a folder; None where there is none."""
    attributes = attributes_of(folder)
    known = attributes is not None and {"asked", "complete", "checkpoint_sha256", "stepper"} <= {*attributes}
    return attributes if attributes is not None and known and bool(attributes["complete"]) else None


def _other_settings(config: Any, attributes: dict[str, Any]) -> dict[str, Any]:
    """What a rollout was made with where that is not what ``config`` says, by key."""
    try:
        before = read_settings(attributes["asked"])
    except ValueError:
        return {"asked": None}
    now = plain(config)
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
