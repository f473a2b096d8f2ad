"""``plan=FILE``: the settings of a rollout that ``hood plan`` found to be enough, read back from its file."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from hood.assets.atomic import write_atomically
from hood.assets.unpickle import check_size
from hood.config import ConfigError, load_config

FORMAT = "hood-plan/1"
_LIMIT = 1 << 20
#: Keys that change nothing about the steps, so they may be given beside a plan.
_FREE = (
    "output", "num_frames", "guard", "seed", "allow_unsound", "resume", "metrics", "surface_stride", "export", "colour",
    "thin_body", "video", "video_stride", "sheet",
)  # fmt: skip


def rollout_config(overrides: Sequence[str]) -> DictConfig:
    """The config of ``hood rollout`` with these words, those of a ``plan=FILE`` among them.

    Raises:
        ConfigError: unknown keys or values, a file that is no plan, or a word that the plan was not made for.
    """
    config = load_config("rollout", overrides)
    if config.plan is None:
        return config
    path = Path(str(config.plan)).expanduser()
    words = _read_words(path)
    for word in overrides:
        key, _, value = word.partition("=")
        if key in ("plan", *_FREE) or word in words:
            continue
        made = next((known for known in words if known.partition("=")[0] == key), f"the default of {key}")
        raise ConfigError(f"{key}={value}: {path} was made for {made}; drop {key}=…, or make a plan with hood plan {word}")
    given = {word.partition("=")[0] for word in overrides}
    return load_config("rollout", [*(word for word in words if word.partition("=")[0] not in given), *overrides])


def write_plan(path: Path, plan: Mapping[str, Any]) -> None:
    """Write a plan: ``words`` of the rollout it was made for, ``chosen`` further ones, and what else is known."""
    write_atomically(path, json.dumps({"format": FORMAT, **plan}, indent=1, allow_nan=False).encode())


def _read_words(path: Path) -> list[str]:
    if not path.is_file():
        raise ConfigError(f"plan={path}: no such file; hood plan … output=FOLDER writes FOLDER/plan.json")
    check_size(path, _LIMIT)
    try:
        plan = json.loads(path.read_text(encoding="utf-8"))
        known = isinstance(plan, dict) and plan.get("format") == FORMAT
    except (ValueError, RecursionError):
        known = False
    if not known:
        raise ConfigError(f"plan={path}: not a plan ({FORMAT}); hood plan … output=FOLDER writes FOLDER/plan.json")
    words = [plan.get(key) for key in ("words", "chosen")]
    if not all(isinstance(part, list) and all(isinstance(word, str) for word in part) for part in words):
        raise ConfigError(f"plan={path}: 'words' and 'chosen' must be lists of key=value; make the plan again")
    if any(word.partition("=")[0] == "plan" for part in words for word in part):
        raise ConfigError(f"plan={path}: names another plan; make the plan again")
    return [word for part in words for word in part]
