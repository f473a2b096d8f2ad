"""``resume=true``: which rollouts are finished, which are made again and why, and with what the others go on."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from hood.commands.automatic import AUTO
from hood.commands.batches.places import attributes_of, is_of
from hood.commands.common import output_folder
from hood.commands.steppers import GROUP, with_stepper
from hood.commands.summary import summarise
from hood.config import brief, load_config, options, plain

#: Keys that change nothing in a rollout; its motion is compared by its file.
_FREE = ("resume", "output", "root", "allow_unsound", "doubts", "sequence")


def as_begun(config: DictConfig, motions: Iterable[tuple[str, Path]]) -> DictConfig:
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
        if not _other_settings(OmegaConf.merge(same, {"sequence": sequence}), attributes):
            print(f"resume=true: stepper={same.stepper}, as in {folder}")
            return same
    return config


def resumed(config: DictConfig, digest: str) -> dict[str, Any] | None:
    """With ``resume=true`` the summary of the rollout that is in its folder; says where one there was made otherwise."""
    if not bool(config.resume):
        return None
    folder = output_folder(config)
    done = finished(config, digest, folder)
    sentence = made_otherwise(config, folder) if done is None else None
    if sentence is not None:
        print(sentence)
    return done


def finished(config: DictConfig, digest: str, folder: Path) -> dict[str, Any] | None:
    """The summary of a rollout that was finished with the same settings and weights; None where there is none."""
    attributes = _complete(folder)
    try:
        summary: dict[str, Any] = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    if attributes is None or attributes["checkpoint_sha256"] != digest or _other_settings(config, attributes):
        return None
    return summary if {"sound", "doubts"} <= set(summary) else summarise(folder / "rollout.h5")


def made_otherwise(config: DictConfig, folder: Path) -> str | None:
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
        before = json.loads(attributes["asked"])
    except ValueError:
        return {"asked": None}
    now = plain(config)
    before["plan"] = before.get("plan") or now["plan"]
    before.setdefault("stepping", now["stepping"])  # rollouts from before there were options are known by their word
    if before.get("stepper") == AUTO != now["stepper"]:  # what it became
        before |= {key: value for key, value in json.loads(attributes["config"]).items() if key in ("stepper", "stepping")}
    # What had no key yet was what its default says now.
    before = {**plain(load_config("rollout")), **before}
    other = {key: before.get(key) for key in now if key not in _FREE and before.get(key) != now[key]}
    if not is_of(attributes, str(config.sequence)):
        other["sequence"] = before.get("sequence")
    return other
