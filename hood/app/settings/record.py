"""Settings that a run leaves in its folder, written and read back."""

from __future__ import annotations

import inspect
import json
import platform
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from hydra.utils import get_object
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from hood.app.settings.compose import _REASON, ConfigError, one_line, plain, shown
from hood.app.settings.old_names import put_todays_keys, rename_targets
from hood.assets.files.atomic import write_atomically
from hood.assets.files.guarded import check_size

#: Bytes of a record at most, and levels of its nesting.
_RECORD_LIMIT, _DEEPEST = 1 << 20, 32


def read_record(path: Path) -> dict[str, Any]:
    """The settings that a run left in its ``config.yaml``, as dicts, lists and scalars; nothing in them is resolved.

    Raises:
        FileNotFoundError: no such file.
        ConfigError: not such a record.
    """
    check_size(path, _RECORD_LIMIT)
    content = path.read_bytes()
    try:
        text = content.decode("utf-8")
        _require_plain(text)
        record = OmegaConf.to_container(OmegaConf.create(text), resolve=False)
    except (ValueError, yaml.YAMLError, OmegaConfBaseException, RecursionError) as error:
        reason = one_line(error)[:_REASON]
        raise ConfigError(f"{path}: not the record of a run ({reason}); use another output") from error
    if not isinstance(record, dict):
        raise ConfigError(f"{path}: not the record of a run (it holds no keys); use another output")
    rename_targets(record)
    named = {str(key): value for key, value in record.items()}
    put_todays_keys(named)
    return named


def read_words(path: Path) -> dict[str, str]:
    """The words of a sweep's run, which Hydra left in ``.hydra/overrides.yaml``: values by keys.

    Raises:
        FileNotFoundError: no such file.
        ConfigError: not such a list.
    """
    check_size(path, _RECORD_LIMIT)
    try:
        text = path.read_text(encoding="utf-8")
        _require_plain(text)
        words = yaml.safe_load(text)
    except (ValueError, yaml.YAMLError, RecursionError) as error:
        raise ConfigError(f"{path}: not the words of a run ({one_line(error)[:_REASON]}); remove it") from error
    if not isinstance(words, list) or not all(isinstance(word, str) for word in words):
        raise ConfigError(f"{path}: not the words of a run (no list of words); remove it")
    return {word.partition("=")[0]: word.partition("=")[2] for word in words}


def read_settings(text: str) -> dict[str, Any]:
    """The settings of a rollout as its file keeps them, by today's keys.

    Raises:
        ValueError: the text is no JSON, or holds none.
    """
    settings = json.loads(text)
    if not isinstance(settings, dict):
        raise ValueError("not the settings of a rollout")
    put_todays_keys(settings)
    return settings


def _require_plain(text: str) -> None:
    """Refuse YAML that takes long to build: references to references multiply, and deep nesting costs its square."""
    depth = 0
    for event in yaml.parse(text, yaml.SafeLoader):
        if isinstance(event, yaml.AliasEvent):
            raise ConfigError("it holds references")
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > _DEEPEST:
            raise ConfigError(f"it is nested more than {_DEEPEST} deep")


def save_run_record(folder: Path, config: Mapping[Any, Any], seed: int) -> None:
    """Write ``config.yaml`` (resolved) and ``versions.json`` (packages, platform, seed) into a run folder."""
    from importlib.metadata import version

    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / "config.yaml", OmegaConf.to_yaml(OmegaConf.create(plain(config))).encode())
    packages = {name: version(name) for name in ("torch", "numpy", "scipy", "h5py", "hydra-core", "safetensors")}
    from hood import __version__

    record = {
        "hood": __version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        **packages,
        "seed": seed,
    }
    write_atomically(folder / "versions.json", json.dumps(record, indent=1).encode())


def require_same_config(config: Mapping[Any, Any], folder: Path, free: Sequence[str], free_below: Sequence[str] = ()) -> None:
    """Raise ConfigError where the run in ``folder`` was started with other settings.

    Keys in ``free`` may differ, and so may keys in ``free_below`` of the groups.
    """
    record = folder / "config.yaml"
    if not record.exists():
        return
    before = read_record(record)

    for key in map(str, config):
        if key in free:
            continue
        there, here = plain(before.get(key)), plain(config[key])
        if isinstance(there, dict) and isinstance(here, dict):
            here = _as_known(there, here)
            # A key that is newer than the record is null where nobody asks for anything.
            there, here = (
                {name: item for name, item in side.items() if name not in free_below and item is not None}
                for side in (there, here)
            )
        if there != here:
            name, there, here = _difference(key, there, here)
            raise ConfigError(
                f"{record}: {name} is {shown(there)} there, {shown(here)} in this command; resume with the same settings or "
                "use another output"
            )


def _as_known(there: dict[str, Any], here: dict[str, Any]) -> dict[str, Any]:
    """``here`` without the keys that are newer than the record and ask for nothing: off, or what their class does anyway."""
    parameters = inspect.signature(get_object(here["_target_"])).parameters if "_target_" in here else {}
    kept = {}
    for key, value in here.items():
        if key in there:
            kept[key] = _as_known(there[key], value) if isinstance(value, dict) and isinstance(there[key], dict) else value
        elif value is not None and value != (parameters[key].default if key in parameters else type(value)()):
            kept[key] = value
    return kept


def _difference(name: str, there: Any, here: Any) -> tuple[str, Any, Any]:
    """The first place in two values of a config that is not the same in both: its name, and what is there."""
    if isinstance(there, dict) and isinstance(here, dict):
        for key in dict.fromkeys([*there, *here]):
            if there.get(key) != here.get(key):
                return _difference(f"{name}.{key}", there.get(key), here.get(key))
    return name, there, here
