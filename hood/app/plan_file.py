"""``plan=FILE``: the settings of a rollout that ``hood plan`` found to be enough, read back from its file.

What a plan was made for: its words and the content of the files that they name, as one number.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import shlex
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from hood import plugins
from hood.app.settings.compose import ConfigError, load_config, named_today, plain
from hood.app.settings.rollout_settings import RolloutSettings, refinement
from hood.assets.files.atomic import write_atomically
from hood.assets.files.guarded import check_size
from hood.assets.files.library import locate
from hood.rollouts.verdict.frames import name_frames
from hood.steppers.watched import PLAN_METRICS

#: Words of these keys name files whose content decides.
_FILES = ("garment", "sequence", "body", "checkpoint", "pins")
#: Of larger files [bytes] the size alone is looked at.
_LARGE = 1 << 26


def content_digest(words: Sequence[str]) -> str:
    """Of the words of a rollout, and of the files in them.

    Raises:
        ConfigError: words that are none.
    """
    said = hashlib.sha256("\0".join(sorted(words)).encode())
    config = load_config("rollout", words)
    for key, value in [*((key, config[key]) for key in _FILES), ("refine", refinement(config).table)]:
        for name in _names_in(plain(value)):
            said.update(f"\0{key}".encode())
            for part in _content_of(key, name):
                said.update(part)
    return said.hexdigest()


def _names_in(value: Any) -> Iterator[str]:
    """What may name files in a value, in lists and tables as well."""
    if isinstance(value, (list, Mapping)):
        for one in value.values() if isinstance(value, Mapping) else value:
            yield from _names_in(one)
    else:
        yield str(value)


def _content_of(key: str, name: str) -> Iterator[bytes]:
    """Of the files that a value names; nothing where it is something else."""
    path = Path(name).expanduser()
    if path.is_dir():
        for file in sorted(Path(folder) / name for folder, _, files in os.walk(path) for name in files):
            yield str(file.relative_to(path)).encode()
            yield _content(file)
        return
    kind = {"garment": "garments", "sequence": "motions", "body": "body", "checkpoint": "weights"}.get(key)
    try:
        found = path if path.is_file() else None if kind is None else locate(kind, name)
    except (ValueError, FileNotFoundError):
        return
    if found is not None:
        yield _content(found)


def _content(path: Path) -> bytes:
    size = path.stat().st_size
    return path.read_bytes() if size <= _LARGE else str(size).encode()


FORMAT = "hood-plan/1"
_LIMIT = 1 << 20
#: Keys that say nothing about the model, so they may be given beside a plan.
FREE = (
    "output", "num_frames", "guard", "fail_on", "resume", "metrics", "colour", "picture",
    "video", "sheet", "output_fps", "refine_mesh", "formats", "texture",
)  # fmt: skip


#: Values of ``plan`` that name no file; null, as older records have it, is the first.
_MODES = ("auto", "full")
#: An accuracy that ``plan`` asks for: a γ, or a length.
_ACCURACY = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)? ?([mc]?m)?")


def plan_path(config: Mapping[Any, Any]) -> Path | None:
    """The file that ``plan`` names; None for ``auto``, ``full`` and an accuracy."""
    asked = config.get("plan")
    return None if asked is None or str(asked) in _MODES or _is_accuracy(asked) else Path(str(asked)).expanduser()


def plan_accuracy(config: Mapping[Any, Any]) -> str | None:
    """The accuracy that ``plan`` asks for; None where it asks for none."""
    return str(config["plan"]) if _is_accuracy(config.get("plan")) else None


def _is_accuracy(asked: Any) -> bool:
    return asked is not None and _ACCURACY.fullmatch(str(asked)) is not None


def plan_mode(config: Mapping[Any, Any]) -> str:
    """``auto``, ``full`` or ``file``."""
    if plan_path(config) is not None:
        return "file"
    return "full" if config.get("plan") is not None and str(config["plan"]) == "full" else "auto"


def key_of(word: str) -> str:
    """The key of a word ``key=value``, without the signs that add or remove it."""
    return word.partition("=")[0].lstrip("+~")


def without_accuracy(overrides: Sequence[str]) -> list[str]:
    """The words of the full model of a rollout that may plan first, by today's keys."""
    return [word for word in named_today(overrides) if key_of(word) != "plan" or not _is_accuracy(word.partition("=")[2])]


def planned(overrides: Sequence[str]) -> list[str]:
    """The words of a rollout; where ``plan`` is an accuracy its plan stands in them, see
    :func:`hood.studies.plan.plan.planned`."""
    overrides = list(named_today(overrides))
    if len(without_accuracy(overrides)) == len(overrides):
        return overrides
    words: list[str] = plugins.find("planners", "accuracy")(overrides)
    return words


def rollout_config(overrides: Sequence[str]) -> RolloutSettings:
    """The config of ``hood rollout`` with these words, those of a ``plan=FILE`` among them.

    Raises:
        ConfigError: unknown keys or values, a file that is no plan, or a word that the plan was not made for.
    """
    overrides = named_today(overrides)
    config = RolloutSettings.from_words(overrides)
    path = plan_path(config)
    if path is None:
        return config
    words = _checked_words(path)
    said = {word.partition("=")[0]: word for word in words}  # what was chosen stands for what was asked for
    for word in overrides:
        key, _, value = word.partition("=")
        if key in ("plan", *FREE) or said.get(key) == word:
            continue
        made = said.get(key, f"the default of {key}")
        raise ConfigError(f"{key}={value}: {path} was made for {made}; drop {key}=…, or make a plan with hood plan {word}")
    given = {word.partition("=")[0] for word in overrides}
    try:
        return RolloutSettings.from_words([*(word for key, word in said.items() if key not in given), *overrides])
    except ConfigError as error:  # what stands beside the plan has been read before
        raise ConfigError(f"plan={path}: {error}; make the plan again") from error


@dataclass(frozen=True)
class _Watch:
    """When energies that a plan leaves out come back: see :class:`hood.steppers.watched.WatchedStepper`.

    Args:
        words: of the full model.
    """

    words: list[str]
    limit: float
    hold: int


def read_watch(path: Path) -> _Watch | None:
    """The watch of a plan; None where it leaves out no energy.

    Raises:
        ConfigError: its numbers are none.
    """
    plan = read_plan(path)
    given = plan.get("watch")
    if given is None:
        return None
    values = [given.get(key) for key in ("limit", "hold")] if isinstance(given, dict) else []
    numbers = [float(value) for value in values if isinstance(value, (int, float)) and 0.0 < value < float("inf")]
    if len(numbers) != 2:
        raise ConfigError(f"plan={path}: 'watch' must hold limit and hold, both above 0; make the plan again")
    return _Watch(_with_stepper(plan["words"]), numbers[0], max(int(numbers[1]), 1))


def write_plan(path: Path, plan: Mapping[str, Any]) -> None:
    """Write a plan: ``words`` of the rollout it was made for, ``chosen`` further ones, and what else is known."""
    write_atomically(path, json.dumps({"format": FORMAT, **plan}, indent=1, allow_nan=False).encode())


def _checked_words(path: Path) -> list[str]:
    """All words of a plan. A warning says where these, or files that they name, are not those that it was made for.

    Raises:
        ConfigError: words that are none, and those of :func:`read_plan`.
    """
    plan = read_plan(path)
    try:
        content = content_digest(plan["words"])
    except ConfigError as error:
        raise ConfigError(f"plan={path}: {error}; make the plan again") from error
    if plan.get("content", content) != content:
        warnings.warn(
            f"plan={path}: its words, or the files that they name, are not those that it was made for; make it again: "
            f"{shlex.join(['hood', 'plan', *_with_stepper(plan['words']), 'output=…'])}",
            stacklevel=2,
        )
    return list(named_today([*_with_stepper(plan["words"]), *plan["chosen"]]))


def _with_stepper(words: Sequence[str]) -> list[str]:
    """The words of a plan. One that names no stepper is of the time when the network was the default."""
    named = any(word.partition("=")[0] == "stepper" for word in words)
    return [*([] if named else ["stepper=network"]), *words]


def read_plan(path: Path) -> dict[str, Any]:
    """What a plan holds.

    Raises:
        ConfigError: there is no such file, or it is no plan.
    """
    if not path.is_file():
        raise ConfigError(f"plan={path}: no such file; hood plan … output=FOLDER writes FOLDER/plan.json")
    check_size(path, _LIMIT)
    plan: Any = None
    with contextlib.suppress(ValueError, RecursionError):
        plan = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(plan, dict) or plan.get("format") != FORMAT:
        raise ConfigError(f"plan={path}: not a plan ({FORMAT}); hood plan … output=FOLDER writes FOLDER/plan.json")
    words = [plan.get(key) for key in ("words", "chosen")]
    if not all(isinstance(part, list) and all(isinstance(word, str) for word in part) for part in words):
        raise ConfigError(f"plan={path}: 'words' and 'chosen' must be lists of key=value; make the plan again")
    if any(word.partition("=")[0] == "plan" for part in words for word in part or []):
        raise ConfigError(f"plan={path}: names another plan; make the plan again")
    return dict(plan)


def summarise_plan(path: Path, config: Mapping[Any, Any]) -> dict[str, Any]:
    """What ``summary.json`` says of a rollout's plan, and of what was left out where that was watched."""
    file_of = plan_path(config)
    found: dict[str, Any] = {"mode": plan_mode(config)} | ({} if file_of is None else {"file": str(file_of)})
    missed = None if file_of is None or not file_of.is_file() else _missed_budget(read_plan(file_of))
    return {"plan": found | ({} if missed is None else {"missed_budget_ms": missed}) | _watched(path)}


def _missed_budget(plan: Mapping[str, Any]) -> float | None:
    """The time [ms] that a plan was asked for and found nothing for; None where it did."""
    found = plan.get("combination")
    missed = isinstance(found, dict) and found.get("fits") is False
    return float(plan["budget_ms"]) if missed and isinstance(plan.get("budget_ms"), (int, float)) else None


def _watched(path: Path) -> dict[str, Any]:
    with h5py.File(path, "r") as file:
        if f"metrics/{PLAN_METRICS[0]}" not in file:
            return {}
        price, full = (np.nan_to_num(np.asarray(file[f"metrics/{name}"])) for name in PLAN_METRICS)
        limit = json.loads(file.attrs["model"])["plan_limit"]
    frames = [int(frame) for frame in np.flatnonzero(full > 0)]
    return {"limit": limit, "price_max": float(price.max(initial=0.0)), "frames_by_full_model": frames}


def plan_sentences(summary: Mapping[str, Any]) -> list[str]:
    """A line on where the full model came back; nothing without a watch."""
    found = summary.get("plan")
    if not found:
        return []
    lines = _watch_sentences(found) if "limit" in found else []
    if "missed_budget_ms" in found:
        missed = f"{found['missed_budget_ms']:g} ms a frame"
        lines.insert(0, f"plan: it was asked for {missed}, and nothing that was measured took as little; this is the nearest")
    return lines


def _watch_sentences(found: Mapping[str, Any]) -> list[str]:
    if not found["frames_by_full_model"]:
        worst = f"{found['price_max']:.2g} of γ at most, {found['limit']:.2g} was accepted"
        return [f"plan: what was left out was worth {worst}"]
    chosen = np.zeros(1 + max(found["frames_by_full_model"]), dtype=bool)
    chosen[found["frames_by_full_model"]] = True
    return [f"plan: the full model took {int(chosen.sum())} steps, where what is left out matters: {name_frames(chosen)}"]
