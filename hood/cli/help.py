"""``hood COMMAND --help``: keys with their defaults, and every name that can be given.

``--cfg`` and ``--info``: the composed config of a command, and what Hydra says about it.

Help is composed without torch; what needs it is imported by the questions that do.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator, Sequence
from typing import Any

from omegaconf import DictConfig, ListConfig, OmegaConf

from hood.app.settings.compose import (
    CONFIG_FOLDER,
    SWEEP_FLAGS,
    ConfigError,
    load_config,
    notes,
    options,
    plain,
    read_word,
    shown,
)
from hood.assets.files import library

_EXAMPLES = {
    "sizes": [
        "hood sizes garment=tshirt",
        "hood sizes garment=dress 'sizes={S:0.95,L:1.05}' 'shapes=[[],[2]]' sequence=plie output=outputs/dress_sizes",
    ],
    "train": [
        "hood train experiment=quickstart output=runs/quickstart",
        "hood train model=ours trainer=paper data.garments=[dress]",
        "hood train -m seed=0,1,2 model=ours,fine15 output=runs/sweep",
    ],
    "rollout": [
        "hood rollout garment=dress sequence=walk_steady num_frames=200 output=outputs/dress",
        "hood rollout garment=my_shirt.obj sequence=CMU_01_poses.npz material=denim",
    ],
    "dress": [
        "hood dress garments=[dress,tshirt] bodies=[default,{betas:[1.5],name:tall}] motions=[amass/CMU] output=outputs/set",
        "hood dress rows=rows.csv dry_run=true",
        "hood dress motions=[amass] root=amass output=outputs/set engine=slurm workers=40",
    ],
    "fit": [
        "hood fit observed=outputs/dress/rollout.h5 parameters=[fabric,size] garment=dress sequence=walk_steady",
        "hood fit observed=scans points=true garment=dress guess={size:1.1} priors={density:[0.2,0.1]} output=outputs/fit",
    ],
    "plan": [
        "hood plan garment=dress sequence=plie stepper=newton accuracy=0.01",
        "hood plan garment=[tank,skirt] sequence=walk_proud stepper=newton accuracy=5mm frames=30",
        "hood plan garment=dress_4k sequence=dance_mixed stepper=newton budget_ms=15",
        "hood plan experiment=quickstart",
    ],
    "compare": [
        "hood compare outputs/network/rollout.h5 outputs/solver/rollout.h5",
        "hood compare a=outputs/plain b=outputs/refined colour=rg output=outputs/compare",
        "hood compare outputs/plain outputs/refined colour=fabric blind=true seed=7 output=outputs/pair_7",
        "hood compare runs/sweep output=runs.csv",
    ],
    "sew": [
        "hood sew specification.json output=shirt.npz",
        "hood sew skirt.json body=default betas=[1.5] edge=0.012 output=skirt.npz",
        "hood sew design:tshirt design={length:0.3,sleeve:0.5} betas=[1.5] pattern=tshirt.json output=tshirt.npz",
    ],
    "fabric": [
        "hood fabric",
        "hood fabric silk_habotai denim_12oz wool_suiting output=outputs/fabrics",
    ],
    "view": [
        "hood view outputs/dress/rollout.h5 output=dress.html",
        "hood view outputs/network outputs/solver output=both.html",
    ],
    "export": [
        "hood export outputs/dress/rollout.h5 format=usd",
        "hood export outputs/dress format=pc2 up=z output=for_blender",
        "hood export outputs/dress format=glb parts=[cloth] num_frames=120 output=dress.glb",
    ],
    "inspect": [
        "hood inspect my_shirt.obj",
        "hood inspect my_shirt.obj CMU_01_poses.npz --json",
    ],
    "prepare": [
        "hood prepare garment=my_shirt.obj output=my_shirt.npz",
        "hood prepare garment=[shirt.obj,trousers.glb] pins=waistband output=outfit.npz",
        "hood prepare garment=suit.obj pose=CMU_01_poses.npz frame=0 output=suit.npz",
    ],
    "convert": [
        "hood convert checkpoint=postcvpr.pth output=postcvpr.safetensors",
        "hood convert rollout=walk.pkl output=walk.h5",
        "hood convert rollout=outputs/set output=published",
    ],
    "evaluate": [
        "hood evaluate",
        "hood evaluate models=[runs/a/model.safetensors,newton] garments=[dress] sequences=[] gap_states=3",
    ],
    "tradeoff": [
        "hood tradeoff",
        "hood tradeoff models=[runs/a/model.safetensors] precisions=[fp32] garments_4k=[] garments_12k=[] output=outputs/a",
    ],
    "envelope": [
        "hood envelope",
        "hood envelope models=[runs/a/model.safetensors,newton] factors=[dt,spin,teleport] output=outputs/a",
    ],
}
#: Words of a command that are no keys.
_BEFORE_KEYS = {
    **dict.fromkeys(("inspect", "compare", "view", "export"), "FILE ... "),
    "fabric": "[NAME ...] ",
    "sew": "FILE|design:NAME ",
}


#: Keys that take an embedded name of a kind, or a file; a command has one of each, or none.
_NAMED = {
    "garments": ("garment", "garments", "garments_4k", "data.garments"),
    "motions": ("sequence", "sequences", "motions", "data.sequences"),
    "body": ("body", "bodies", "data.body"),
    "weights": ("checkpoint", "models", "weights"),
}
_ABSENT = object()
#: Words of all commands, and of some, that are no keys.
_FLAGS = {
    "": (
        "  --cfg job                       print the config of these words and run nothing; --package KEY: a part of it",
        "  --info                          what Hydra says of it: search path, defaults, plugins; --info defaults-tree: a part",
    ),
    "train": (
        "  -m                              a sweep, one run for each combination: hood train -m seed=0,1,2 model=ours,fine15;",
        "                                  hydra/launcher=joblib: several at a time; --cfg hydra: its keys, hydra.launcher.*",
    ),
}
#: What of Hydra's configuration, and which of Hydra's reports, can be asked for.
_CFG, _INFO = ("job", "hydra", "all"), ("all", "config", "defaults", "defaults-tree", "plugins", "searchpath")
_QUESTIONS = {"--cfg": "--cfg", "-c": "--cfg", "--info": "--info", "-i": "--info", "--package": "--package", "-p": "--package"}
#: Groups whose keys a command's help lists one by one, those of the chosen option.
_LISTED = {"train": {"data": "default", "trainer": "fast"}, "rollout": {"material": "default", "solver": "newton"}}


def describe(name: str) -> str:
    """Help text of the command ``name``."""
    config = load_config(name)
    said, titles = notes(name), _headings(name)
    lines = [f"usage: hood {name} {'[-m] ' if name == 'train' else _BEFORE_KEYS.get(name, '')}[key=value ...]", ""]
    lines += ["In a shell, put words with brackets or braces in quotes: 'key=[1,2]'.", ""]
    lines += [*_FLAGS.get(name, ()), *_FLAGS[""], ""]
    for key in config:
        value = plain(config[key])
        if isinstance(value, dict):
            continue
        if key in titles:
            lines += ["", titles[key]]
        lines.append(_row(str(key), value, said.get(str(key), "")))
    if name == "plan":
        lines += ["", "The keys of hood rollout say the scene and the full model: garment, sequence, stepper, fps, …"]
        lines += ["The keys of hood train say a training; experiment=, trainer= or data.* has to be among them."]
    if name == "fit":
        lines += ["", "All other keys are those of hood rollout and say the scene: garment, body, sequence, pins, fps, …"]
    if name == "dress":
        lines += ["", "All other keys are those of hood rollout, the same for all rows: stepper, num_frames, fps, metrics, …"]
    if name == "fabric":
        lines += ["", textwrap.fill(f"  {'NAME':<14}{' '.join(options('material'))}", 118, subsequent_indent=" " * 16)]
    groups = _groups_of(name)
    if groups:
        lines += ["", f"config groups: one word stands for several keys, such as {groups[0]}={options(groups[0])[-1]}"]
        rows = [f"  {group + '=':<14}{' | '.join(options(group))}" for group in groups]
        lines += [textwrap.fill(row, 118, subsequent_indent=" " * 16) for row in rows]
    for group, option in _LISTED.get(name, {}).items():
        lines += ["", f"keys of {group}={option}, which can be changed one by one"]
        within = notes(f"{group}/{option}")
        lines += [_row(f"{group}.{key}", value, within.get(key, "")) for key, value in _leaves(plain(config[group]))]
    lines += _elsewhere(config, [group for group in groups if group not in _LISTED.get(name, {})])
    if name == "compare":
        lines += ["", "Folders of trainings are compared as a table of their keys and figures; output=runs.csv writes it."]
    if groups or name in ("dress", "tradeoff", "envelope"):
        lines += _names(config)
    lines += ["", "examples:", *(f"  {example}" for example in _EXAMPLES[name])]
    return "\n".join(lines)


def asks(words: Sequence[str]) -> bool:
    """Whether the words of a command ask what it would do."""
    return any(word.partition("=")[0] in _QUESTIONS for word in words)


def answer(name: str, words: Sequence[str]) -> int:
    """Print the config that the words of a command make, or what Hydra says about it; returns the exit code.

    Raises:
        ConfigError: a question that cannot be answered, or words that the command does not take.
    """
    asked, rest = _asked(words)
    hydras = [word for word in rest if word.lstrip("+~").startswith(("hydra.", "hydra/"))]
    rest = [word for word in rest if word not in hydras and not (name == "train" and word in SWEEP_FLAGS)]
    if name in _BEFORE_KEYS:
        from hood.app.common import split_words

        files = split_words(name, rest)[0]
        rest = [word for word in rest if word not in files]
    config, part = _composed(name, rest), asked.get("--package")
    if "--info" in asked or asked["--cfg"] != "job":
        from hood.app.sweep import hydra_of

        own = load_config(name)
        given = [read_word(word, own)[0] for word in rest if word.partition("=")[0].split(".")[0] in (*own, *_groups_of(name))]
        config = hydra_of(name, [*hydras, *given], asked.get("--info"))
        if "--info" in asked:
            return 0
        config = config if asked["--cfg"] == "all" else OmegaConf.create({"hydra": config.hydra})
    value = config if part in (None, "_global_") else OmegaConf.select(config, str(part), default=_ABSENT)
    if value is _ABSENT:
        raise ConfigError(f"--package {part}: no such key; hood {name} --cfg {asked['--cfg']} prints all")
    if not isinstance(value, DictConfig | ListConfig):
        print(shown(value))
        return 0
    print("" if value is config else f"# @package {part}\n", OmegaConf.to_yaml(value), sep="", end="")
    return 0


def _composed(name: str, words: Sequence[str]) -> DictConfig:
    """The config of a command, with that of the command whose keys it takes beside its own."""
    if name not in ("dress", "fit", "plan"):
        return load_config(name, words)
    mine = [word for word in words if word.partition("=")[0] in load_config(name) or word.startswith("-")]
    theirs = [word for word in words if word not in mine]
    training = name == "plan" and any(word.startswith(("experiment=", "trainer", "data.")) for word in theirs)
    return OmegaConf.create({**load_config("train" if training else "rollout", theirs), **load_config(name, mine)})


def _asked(words: Sequence[str]) -> tuple[dict[str, str], list[str]]:
    """The questions among the words, and the others."""
    asked, rest, queue = dict[str, str](), list[str](), list(words)
    while queue:
        word = queue.pop(0)
        flag, _, value = word.partition("=")
        question = _QUESTIONS.get(flag)
        if question is None:
            rest.append(word)
            continue
        if not value and queue and (question == "--package" or queue[0] in (*_CFG, *_INFO)):
            value = queue.pop(0)
        asked[question] = value or {"--info": "all"}.get(question, "")
    for question, known in (("--cfg", _CFG), ("--info", _INFO)):
        if asked.get(question, known[0]) not in known:
            raise ConfigError(f"{question} {asked[question]}".rstrip() + f": give {', '.join(known[:-1])} or {known[-1]}")
    if "--package" in asked and ("--cfg" not in asked or not asked["--package"]):
        raise ConfigError("--package: a key of the config that --cfg job prints, such as --cfg job --package trainer")
    return asked, rest


def _elsewhere(config: DictConfig, groups: list[str]) -> list[str]:
    """Where the keys stand of groups that are not listed."""
    keys = ", ".join(f"{group}.*" for group in groups if isinstance(config.get(group), DictConfig))
    return ["", f"keys of {keys} stand in the files of the options:", f"  {CONFIG_FOLDER}/GROUP/OPTION.yaml"] if keys else []


def _names(config: DictConfig) -> list[str]:
    """The embedded names, each kind with the command's key for it."""
    lines = ["", "embedded names; these keys take files as well"]
    for kind, keys in _NAMED.items():
        for key in [key for key in keys if OmegaConf.select(config, key, default=_ABSENT) is not _ABSENT][:1]:
            lines.append(textwrap.fill(f"  {key + '=':<16}{' '.join(library.names(kind))}", 118, subsequent_indent=" " * 18))
    return lines


def _row(key: str, value: object, note: str) -> str:
    """A key with its default, and behind it what it is."""
    text = f"  {key}={shown(value)}"
    text = f"{text:<34}" if len(text) < 34 else text + "  "
    return textwrap.fill(text + note, 118, subsequent_indent=" " * 34)


def _leaves(node: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Keys and values of a group, ``a.b`` for a key in another, without the names of classes."""
    for key, value in node.items():
        if isinstance(value, dict):
            yield from _leaves(value, f"{prefix}{key}.")
        elif key != "_target_":
            yield f"{prefix}{key}", value


def _groups_of(name: str) -> list[str]:
    text = (CONFIG_FOLDER / f"{name}.yaml").read_text(encoding="utf-8")
    return [match for match in re.findall(r"^\s+- (?:override )?/?(\w+):", text, flags=re.M) if match != "_self_"]


def _headings(name: str) -> dict[str, str]:
    """The lines ``#: …`` of ``configs/<name>.yaml``, by the key that follows each."""
    text = (CONFIG_FOLDER / f"{name}.yaml").read_text(encoding="utf-8")
    return {key: title for title, key in re.findall(r"^#: (.*)\n(\w+):", text, flags=re.MULTILINE)}
