"""The only reader of YAML: Hydra config groups composed, checked and resolved; below it arguments are plain values."""

from __future__ import annotations

import copy
import math
import re
from collections.abc import Mapping, Sequence
from functools import lru_cache, reduce
from operator import getitem
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.override_parser.types import Override, OverrideType
from hydra.errors import HydraException
from hydra.utils import get_object, instantiate
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from hood.app.settings.old_names import rename_targets, todays_words
from hood.app.settings.overrides import decoded, decoded_text, is_coded, loop, parse, readable, require_braces, search_path
from hood.assets.files.library import unknown
from hood.plugins import config_folders, packages, without_options

_PACKAGE = Path(__file__).resolve().parents[2]
#: Installed packages carry the configs inside; a clone has them beside the package.
CONFIG_FOLDER = _PACKAGE / "configs" if (_PACKAGE / "configs").is_dir() else _PACKAGE.parent / "configs"
#: Keys that take one word or number, or a list.
_ONE_OR_MORE = ("garment", "offset", "layers", "size", "blend_in", "video")
#: Keys that take a table of parts, some beside numbers and lists.
TABLES = (
    *"size size_end fabrics pins refine metrics cloth_contact objects guess bounds priors".split(),
    *("trainer.optimizer", "trainer.schedule"),
)
#: Keys in here may be null: an energy that is left out.
_OPTIONAL = "losses.terms."
#: A key that its command checks itself; and those that are "auto", or a value of another kind that their reader checks.
_FOLDER, _OPEN = "output", ("wind", "velocity")
_ABSENT = object()  # of a key that is not there
#: What a value must be, by the type of the default that it replaces.
_KINDS = {bool: "true or false", int: "a whole number", float: "a number", str: "text", ListConfig: "a list in brackets"}
#: Characters that a message repeats at most, of a comment (a longer one is read in --help), a value and a reason.
_SHORT_NOTE, _BRIEF, _REASON = 160, 100, 300
#: Words with dashes that ask for a sweep.
SWEEP_FLAGS = ("-m", "--multirun")
#: Keys of a rollout that say which network takes the steps and how it computes, and how they are refined: who gives one means
#: the network, unless another stepper is named.
NETWORK_KEYS = ("checkpoint", "model", "precision", "kernels")
#: Values of ``step`` that do not ask for steps of fixed shapes.
NOT_FIXED = ("plain", "auto")
#: Keys that people look for under another word.
_OTHER_WORDS = {
    "motion": ("sequence", "sequences"),
    "motions": ("sequences", "sequence"),
    "pose": ("sequence", "sequences"),
    "poses": ("sequence", "sequences"),
    "avatar": ("body",),
    "character": ("body",),
    "cloth": ("garment",),
    "mesh": ("garment",),
    "fabric": ("material",),
    "out": ("output",),
}
#: What configs may name; and classes of plugins (:mod:`hood.plugins`).
_TARGETS = ("hood.", "torch.optim.")


class ConfigError(ValueError):
    """A configuration the user must change; the message names the key, the near miss and the fix."""


def load_config(name: str, overrides: Sequence[str] = ()) -> DictConfig:
    """Config ``configs/<name>.yaml`` with Hydra ``overrides`` (``key=value``, ``group=option``), fully resolved.

    Raises:
        ConfigError: misspelt key, group option or type; Hydra's own complaints in one line.
    """
    folders = tuple(str(folder) for folder in config_folders())
    words = named_today(overrides, name)
    words = with_network(words) if name == "rollout" else words
    return copy.deepcopy(_loaded(CONFIG_FOLDER, folders, name, words))


def named_today(words: Sequence[str], command: str = "rollout") -> tuple[str, ...]:
    """The words of a command by today's keys, see :func:`hood.app.settings.old_names.todays_words`.

    Raises:
        ConfigError: a word contradicts another.
    """
    try:
        return todays_words(words, command)
    except ValueError as error:
        raise ConfigError(str(error)) from error


def with_network(words: Sequence[str]) -> tuple[str, ...]:
    """The words of a rollout; ``stepper=network`` among them where it is left to ``auto`` and one is about a network alone."""
    said = {word.partition("=")[0].lstrip("+"): word.partition("=")[2] for word in words}
    means = said.get("step", "auto") not in NOT_FIXED or any(key.split(".")[0] in (*NETWORK_KEYS, "refine") for key in said)
    return (*words, "stepper=network") if means and said.get("stepper", "auto") == "auto" else tuple(words)


@lru_cache(maxsize=8)
def _loaded(folder: Path, plugins_of: tuple[str, ...], name: str, overrides: tuple[str, ...]) -> DictConfig:
    """A config that is copied and never changed: a command asks for that of its words several times."""
    plugins = [search_path(plugins_of)]
    with initialize_config_dir(str(folder), version_base="1.3"):
        try:
            defaults = _composed(folder, name, tuple(plugins))
            chosen = [_check_override(name, text, defaults) for text in overrides]
            words = _last_of_groups(chosen)
            # The groups may bring keys of their own, so keys are checked against the composition with all groups chosen.
            groups = [text for text, override in chosen if _is_group(override) and text in words]
            known = _composed(folder, name, (*plugins, *groups))
            for _, override in chosen:
                if not _is_group(override):
                    _check_key(override, known)
                    _check_brackets(name, override, known)
            keys = [override for text, override in chosen if text in words and not _is_group(override)]
            config = _with_keys(known, keys)
            if config is None:
                config = compose(name, plugins + words)
            _decode_keys(config, [override for text, override in chosen if is_coded(text)])
            _check_sources(config)
            OmegaConf.resolve(config)
            rename_targets(config)
        except (HydraException, OmegaConfBaseException) as error:
            raise ConfigError(f"configuration: {decoded_text(one_line(error))}") from error
    OmegaConf.set_struct(config, True)
    _check_types(name, known, config, "")
    return config


@lru_cache(maxsize=32)
def _composed(folder: Path, name: str, words: tuple[str, ...]) -> DictConfig:
    """A composition that is read and never changed; several commands in one process need the same ones."""
    return compose(name, list(words))


def _with_keys(known: DictConfig, keys: Sequence[Override]) -> DictConfig | None:
    """A copy of a composition with other values of its keys; None where Hydra has to compose it, or to say what is wrong."""
    config = copy.deepcopy(known)
    try:
        for override in keys:
            if override.type is not OverrideType.CHANGE or override.is_sweep_override() or override.package is not None:
                return None
            key, value = override.key_or_group, override.value()
            part = key == "trainer.schedule" and "_target_" not in str(value)  # of the class that is there
            OmegaConf.update(config, key, value, merge=part or key not in TABLES)
    except OmegaConfBaseException:
        return None
    return config


def build(node: DictConfig | dict[str, Any], **extra: Any) -> Any:
    """Object named by ``node._target_`` with the node's keys as arguments; only ``hood.`` and ``torch.optim.`` targets.

    Raises:
        ConfigError: forbidden target, or arguments the target does not take.
    """
    config = OmegaConf.create(node) if isinstance(node, dict) else node
    if config is not node:
        rename_targets(config)
    _check_targets(config)
    try:
        return instantiate(config, **extra, _convert_="all")
    except HydraException as error:
        cause = error.__cause__ or error
        if isinstance(cause, (ValueError, OSError)):
            raise cause from error
        raise ConfigError(f"configuration: {one_line(cause)}") from error


def plain(node: Any) -> Any:
    """The node as dicts, lists and scalars."""
    if isinstance(node, (DictConfig, ListConfig)):
        return OmegaConf.to_container(node, resolve=True)
    return {key: plain(value) for key, value in node.items()} if isinstance(node, Mapping) else node


def notes(name: str) -> dict[str, str]:
    """The comments behind the keys of ``configs/<name>.yaml`` and of files it takes in (``@_here_``); ``a.b``: b within a."""
    found: dict[str, str] = {}
    path: list[str] = []
    for line in (CONFIG_FOLDER / f"{name}.yaml").read_text(encoding="utf-8").splitlines():
        if taken := re.match(r"  - (\S+)@_here_$", line):
            found |= notes(f"{name.rpartition('/')[0]}/{taken.group(1)}")
        if match := re.match(r"( *)(- )?(\w+):[^#]*(?:#\s*(.*))?$", line):
            group = match.group(2) is not None  # an entry of the list of groups
            path = [] if group else [*path[: len(match.group(1)) // 2], match.group(3)]
            found[match.group(3) if group else ".".join(path)] = match.group(4) or ""
    return {key: note for key, note in found.items() if note}


def shown(value: Any) -> str:
    """A value as it is written behind its key: ``true``, ``null``, ``[a,b]``, ``0.01``."""
    value = plain(value)
    if isinstance(value, (list, tuple)):
        return "[" + ",".join(shown(item) for item in value) + "]"
    if isinstance(value, dict):
        return "{" + ",".join(f"{key}:{shown(item)}" for key, item in value.items()) + "}"
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value)


def brief(value: Any) -> str:
    """A value as :func:`shown`, cut where it is long."""
    text = shown(value)
    return text if len(text) <= _BRIEF else f"{text[:_BRIEF]}…"


def options(group: str) -> list[str]:
    """Names of a config group's options, those of plugins among them."""
    return sorted({path.stem for folder in (CONFIG_FOLDER, *config_folders()) for path in (folder / group).glob("*.yaml")})


def groups() -> list[str]:
    """Names of the config groups."""
    return sorted(path.name for path in CONFIG_FOLDER.iterdir() if path.is_dir())


def require_choice(config: Mapping[Any, Any], key: str, known: Sequence[str]) -> None:
    """Raise ConfigError unless ``config[key]`` is one of ``known``; names the near miss."""
    given = str(reduce(getitem, key.split("."), config))
    if given not in known:
        raise ConfigError(unknown(f"value for {key}", given, known))


def with_words(config: DictConfig, words: Sequence[str]) -> DictConfig:
    """A loaded config with some ``key=value`` more, keys that it has; a hundredth of the time of loading it again.

    Raises:
        ConfigError: a key that it does not have.
    """
    changed = copy.deepcopy(config)
    for word in words:
        _, said = read_word(word, config)
        if OmegaConf.select(config, said.key_or_group, default=_ABSENT) is _ABSENT:
            raise ConfigError(f"{word}: no such key")
        OmegaConf.update(changed, said.key_or_group, decoded(said.value()), merge=False)
    return changed


def _check_override(name: str, text: str, defaults: DictConfig) -> tuple[str, Override]:
    if text.split("=")[0] in SWEEP_FLAGS:
        raise ConfigError(f"{text!r}: only hood train has sweeps; {loop(name)}")
    if text.startswith("-"):
        word = text.lstrip("-") if "=" in text else "key=value"
        raise ConfigError(f"{text!r}: keys have no dashes; write {word}, hood {name} --help lists the keys")
    if "=" not in text and not text.startswith("~"):
        raise ConfigError(f"argument {text!r} is not of the form key=value; keys of {name}: {', '.join(defaults)}")
    given, (text, override) = text, read_word(text, defaults)
    key = override.get_key_element().lstrip("+~").split("@")[0]
    several = _values_of(key, given, override, defaults)
    if several:
        raise ConfigError(f"{given[:_REASON]}: {loop(name, key, several)}")
    if _is_group(override) and override.value() is None and defaults.get(key) is not None:
        raise ConfigError(f"{key}=null: cannot be left out; give one of {', '.join(options(key))}")
    if _is_group(override) and override.value() is not None and str(override.value()) not in options(key):
        lost = without_options()
        raise ConfigError(unknown(key, str(override.value()), options(key)) + (f"; {lost}" if lost else ""))
    return text, override


def read_word(text: str, defaults: DictConfig) -> tuple[str, Override]:
    """A word in the form that Hydra reads, see :func:`hood.app.settings.overrides.readable`, and what it says."""
    try:
        require_braces(text, TABLES)
        text = readable(text, _takes_several(text.partition("=")[0], defaults)) if "=" in text else text
        return text, parse(text)
    except ValueError as error:
        raise ConfigError(str(error)) from error
    except HydraException as error:
        raise ConfigError(f"cannot read {text[:_REASON]!r}: write key=value") from error


def _values_of(key: str, text: str, override: Override, defaults: DictConfig) -> list[str]:
    """The values where a word gives several to a key that takes one: what Hydra calls a sweep. Empty where it gives one."""
    if override.is_sweep_override():
        return ["…"]
    given = str(override.value()).split(",")
    if len(given) < 2 or text.partition("=")[2][:1] in "[{('\"":
        return []
    usual = OmegaConf.select(defaults, key, default=None)
    scalar = isinstance(usual, (bool, int, float))
    options_of_group = _is_group(override) and all(value in options(key) for value in given)
    return given if scalar or options_of_group else []


def _takes_several(key: str, defaults: DictConfig) -> bool:
    """Whether a key may be given a list: what is null may, unless it is where a command writes."""
    try:
        value = OmegaConf.select(defaults, key)
    except OmegaConfBaseException:
        value = None
    return key != _FOLDER and (value is None or key in (*_ONE_OR_MORE, *_OPEN) or isinstance(value, ListConfig))


def _decode_keys(config: DictConfig, chosen: Sequence[Override]) -> None:
    """Give tables the keys that :func:`hood.app.settings.overrides.coded` wrote otherwise."""
    for override in chosen:
        value = OmegaConf.select(config, override.key_or_group)
        if isinstance(value, (DictConfig, ListConfig)):
            OmegaConf.update(config, override.key_or_group, decoded(OmegaConf.to_container(value)), merge=False)


def _check_brackets(name: str, override: Override, known: DictConfig) -> None:
    """Refuse a table where a list is wanted; Hydra would not say so."""
    key, value = override.key_or_group, override.value()
    before = OmegaConf.select(known, key, default=None)
    if isinstance(before, ListConfig) and isinstance(value, dict) and key not in TABLES:
        raise ConfigError(_wrong_kind(name, key, before, decoded(value)))


def _last_of_groups(chosen: Sequence[tuple[str, Override]]) -> list[str]:
    """The words, of several options of one group the last, as of several values of one key."""
    last = {override.key_or_group: place for place, (_, override) in enumerate(chosen) if _is_group(override)}
    return [
        text for place, (text, override) in enumerate(chosen) if not _is_group(override) or last[override.key_or_group] == place
    ]


def _is_group(override: Override) -> bool:
    key = override.key_or_group
    return (CONFIG_FOLDER / key).is_dir() and not isinstance(override.value(), dict)


def _check_key(override: Override, known: DictConfig) -> None:
    if override.is_add() or override.is_delete():
        raise ConfigError(f"override {override.input_line!r}: keys are fixed; write key=value without '+' or '~'")
    key = override.key_or_group
    if OmegaConf.select(known, key, default=OmegaConf) is OmegaConf:
        siblings, words = _siblings(known, key), (key, *_OTHER_WORDS.get(key, ()))
        groups = {name: node for name, node in known.items() if isinstance(node, DictConfig)}
        deeper = [f"{name}.{word}" for word in words for name, node in groups.items() if word in node]
        meant = next(iter([word for word in words if word in siblings] + deeper), None)
        raise ConfigError(unknown("key", key, siblings, meant))


def _siblings(known: DictConfig, key: str) -> list[str]:
    """Keys that stand where ``key`` was looked for: below the deepest part of its path that exists."""
    parts = key.split(".")[:-1]
    for depth in range(len(parts), -1, -1):
        prefix = ".".join(parts[:depth])
        node = OmegaConf.select(known, prefix) if prefix else known
        if isinstance(node, DictConfig):
            return [f"{prefix}.{name}" if prefix else str(name) for name in node if name != "_target_"]
    return []


def _check_types(name: str, known: DictConfig, config: DictConfig, prefix: str) -> None:
    """A value must have the kind of the default it replaces, and be finite as it is; a None default takes anything.

    Plain keys come before those below them, which may take their values from them.
    """
    for key in sorted(map(str, config), key=lambda key: isinstance(config[key], DictConfig)):
        before, after = known.get(key), config[key]
        if isinstance(after, DictConfig) and isinstance(before, DictConfig):
            _check_types(name, before, after, f"{prefix}{key}.")
        elif key in _ONE_OR_MORE and isinstance(after, ListConfig):
            continue
        elif f"{prefix}{key}" in TABLES and (isinstance(after, DictConfig) or (key == "optimizer" and isinstance(after, str))):
            continue
        elif key in _OPEN or (after is None and (prefix == _OPTIONAL or key == _FOLDER)):
            continue
        elif before is not None and not _same_kind(before, after):
            raise ConfigError(_wrong_kind(name, f"{prefix}{key}", before, after))
        elif isinstance(before, (int, float)) and math.isfinite(before) and not math.isfinite(after):
            raise ConfigError(f"{prefix}{key}={after}: must be finite; {shown(before)} is the default")


def _wrong_kind(name: str, key: str, before: Any, after: Any) -> str:
    """The sentence for a value of another kind than the default's: what the key takes, and where to read more."""
    kind = _KINDS.get(type(before), "keys and values in braces")
    if key in _ONE_OR_MORE:
        kind += " or a list in brackets"
    elif isinstance(before, str) and isinstance(after, ListConfig):
        kind = "one text, not a list"
    usual = f"such as {key}={shown(before)}" if shown(before) not in ("", "[]") else f"the default is {key}={shown(before)}"
    note = notes(name).get(key, "")
    note = f"hood {name} --help says of {key}: {note}" if 0 < len(note) <= _SHORT_NOTE else f"see hood {name} --help"
    return f"{key}={brief(after)}: give {kind}, {usual}; {note}"


def _check_sources(config: DictConfig) -> None:
    """Raise ConfigError where an energy is left out from which another one takes values."""
    terms = OmegaConf.to_container(config, resolve=False).get("losses", {}).get("terms", {})  # type: ignore[union-attr]
    for holder, values in terms.items():
        sources = re.findall(rf"\$\{{{re.escape(_OPTIONAL)}(\w+)\.", str(values))
        source = next((source for source in sources if terms.get(source) is None), None)
        if source is not None:
            # A training takes the weight of contact from its own keys.
            ramp = "trainer.collision.start=0 trainer.collision.end=0"
            no_weight = ramp if "trainer" in config else f"{_OPTIONAL}{source}.weight=0"
            raise ConfigError(
                f"{_OPTIONAL}{source}=null: {_OPTIONAL}{holder} takes values from it; add {_OPTIONAL}{holder}=null as well, "
                f"or give {no_weight} instead"
            )


def _same_kind(before: Any, after: Any) -> bool:
    if isinstance(before, bool) or isinstance(after, bool):
        return isinstance(before, bool) and isinstance(after, bool)
    if isinstance(before, float):
        return isinstance(after, (int, float))
    if isinstance(before, str):
        # Names may look like numbers (garment=12): taken as text.
        return isinstance(after, (str, int, float))
    if isinstance(before, ListConfig):
        return isinstance(after, ListConfig)
    return isinstance(after, type(before))


def _check_targets(node: Any) -> None:
    if isinstance(node, DictConfig):
        target = node.get("_target_")
        if target is not None and not _is_own(str(target)):
            raise ConfigError(
                f"_target_ {target!r} is not allowed: only {' and '.join(_allowed())} classes are built; a package of your own "
                f"registers as a plugin (docs/extending.md)"
            )
        for key in node:
            _check_targets(node[key])
    elif isinstance(node, ListConfig):
        for item in node:
            _check_targets(item)


def _is_own(target: str) -> bool:
    """Whether the object is defined in an allowed package: ``hood.cli.main.sys.exit`` is reached through one, but is not."""
    if not target.startswith(_allowed()):
        return False
    try:
        found = get_object(target)
    except Exception:  # whatever importing it raises; instantiate() says it better
        return True
    return str(getattr(found, "__module__", "") + ".").startswith(_allowed())


def _allowed() -> tuple[str, ...]:
    """Beginnings of the names of classes that configs may name."""
    return (*_TARGETS, *(f"{name}." for name in packages()))


def one_line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
