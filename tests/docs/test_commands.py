"""Every command line of the README and the docs: its command, keys, values and names exist. test_commands_run.py runs them."""

from __future__ import annotations

import argparse
import re
import runpy
import shlex
import sys
from typing import Any

import pytest
from omegaconf import DictConfig
from pages import CARDS, EXTENDING, EXTENDING_HAS_A_TEST, PAGES, ROOT, command_lines, keys_of, of_hood, prose_of, words_of

from hood.app.settings.compose import groups, load_config, options, plain
from hood.app.setup import check_config
from hood.assets.files.library import names
from hood.cli.help import _EXAMPLES
from hood.cli.main import COMMANDS
from hood.studies.plan.plan import is_training

#: Commands with a config of their own; others take files.
CONFIGURED = {path.stem for path in (ROOT / "configs").glob("*.yaml")} & set(COMMANDS)
#: Options that a reader makes (docs/extending.md).
OWN = ("losses=windy", "material=felt")
#: Keys that take embedded names, and of what.
NAMED = {"garment": "garments", "sequence": "motions", "checkpoint": "weights", "body": "body"}
LINES = command_lines()
HOOD = [(page, line) for page, line in LINES if of_hood(line)]
PYTHON = [(page, line) for page, line in LINES if line.startswith("python ") and (page, line) not in HOOD]
MAKE = [(page, line) for page, line in LINES if line.startswith("make ")]


def check_names(config: DictConfig) -> None:
    """Names that are no files are embedded ones."""
    for key, kind in NAMED.items():
        value = config.get(key)
        for name in value if isinstance(value, (list, tuple)) or not isinstance(value, (str, type(None))) else [value]:
            if name is not None and not re.search(r"[./*]|^none$|^untrained$|^[A-Z]+$", str(name)):
                assert str(name) in names(kind), f"{key}={name}"


def test_there_are_commands_to_check() -> None:
    assert len(HOOD) > 60
    assert len(PYTHON) > 30
    assert {page for page, _ in HOOD} >= {"README.md", "tutorial.md", "rollout.md", "files.md", "train.md", "evaluation.md"}


def check_command(command: str, keys: list[str]) -> None:
    """The keys and values of a command, and the names among them, exist; those of a plan are its own and a rollout's or a
    training's."""
    if command == "plan":
        own = set(load_config("plan"))
        load_config("plan", [word for word in keys if word.partition("=")[0] in own])
        keys = [word for word in keys if word.partition("=")[0] not in own]
        command = "train" if is_training(keys) else "rollout"
    if command == "dress":
        own = set(load_config("dress"))
        config = load_config("dress", [word for word in keys if word.partition("=")[0] in own and "=[" in word])
        for key, kind in (("garments", "garments"), ("fabrics", "")):
            known = names(kind) if kind else options("material")
            assert {str(name) for name in config[key] if isinstance(name, str)} <= {*known}, key
        command, keys = "rollout", [word for word in keys if word.partition("=")[0] not in own]
    if command == "fit":
        own = set(load_config("fit"))
        load_config("fit", [word for word in keys if word.partition("=")[0] in own])
        command, keys = "rollout", [word for word in keys if word.partition("=")[0] not in own]
    config = load_config(command, keys)
    if command == "rollout":
        check_config(config)
    check_names(config)


@pytest.mark.parametrize(("page", "line"), HOOD)
def test_commands_have_keys_and_values_that_exist(page: str, line: str) -> None:
    command, *words = words_of(line)
    assert command in COMMANDS, line
    keys = keys_of(words)
    if command not in CONFIGURED or set(OWN) & set(keys) or (page == EXTENDING and EXTENDING_HAS_A_TEST):
        return
    check_command(command, keys)


class Parsed(Exception):
    """The arguments of a script were understood."""


@pytest.mark.parametrize(("page", "line"), PYTHON)
def test_scripts_understand_their_arguments(page: str, line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    path, *words = shlex.split(line, comments=True)[1:]
    script = ROOT / path
    assert script.is_file(), line
    if "ArgumentParser" not in script.read_text(encoding="utf-8"):
        assert not words or f"python {path}" in script.read_text(encoding="utf-8"), line
        return
    understood = argparse.ArgumentParser.parse_args

    def parse(self: argparse.ArgumentParser, *given: Any, **named: Any) -> None:
        understood(self, *given, **named)
        raise Parsed

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse)
    monkeypatch.setattr(sys, "argv", [path, *words])
    monkeypatch.setattr(sys, "path", [str(script.parent), *sys.path])
    with pytest.raises(Parsed):
        runpy.run_path(str(script), run_name="__main__")


@pytest.mark.parametrize(("page", "line"), MAKE)
def test_targets_of_make_exist(page: str, line: str) -> None:
    target = shlex.split(line, comments=True)[1]
    assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE), line


def test_every_benchmark_is_listed() -> None:
    listed = (ROOT / "hood" / "studies" / "notes" / "benchmarks.md").read_text(encoding="utf-8")
    runs = [path for path in (ROOT / "benchmarks").glob("*.py") if "__main__" in path.read_text(encoding="utf-8")]
    assert [path.name for path in runs if f"benchmarks/{path.name}" not in listed] == []


def keys_below(node: dict[str, Any], prefix: str = "") -> set[str]:
    """Keys of a config and of what stands in it, ``a.b``."""
    keys = set()
    for key, value in node.items():
        keys.add(prefix + key)
        if isinstance(value, dict):
            keys |= keys_below(value, f"{prefix}{key}.")
    return keys


def known_keys() -> set[str]:
    """Keys of all commands under all options of groups; those of a model, a material or an energy also by the last word."""
    known = set(groups())
    for command in CONFIGURED:
        known |= keys_below(plain(load_config(command)))
    for command, of in (("train", ("model", "trainer", "data")), ("rollout", ("losses", "material", "solver", "stepper"))):
        for group in of:
            for option in options(group):
                known |= keys_below(plain(load_config(command, [f"{group}={option}"])))
    return known | {key.rpartition(".")[2] for key in known if key.startswith(("model.", "material.", "losses.terms."))}


def test_keys_in_the_text_of_pages_exist() -> None:
    known = known_keys()
    seen = 0
    for page in [page for page in [*PAGES, *CARDS] if page.name != EXTENDING]:
        spans = [span for span in re.findall(r"`([^`\n]+)`", prose_of(page)) if not span.startswith("pip ")]
        for span in spans:
            for key, value in re.findall(r"(?<![\w.\[{(,'\"-])([a-z_][\w.]*)=(\w*)", re.sub(r"\(.*\)", "", span)):
                seen += 1
                assert key in known, f"{page.name}: {span}"
                if key in groups() and value:
                    assert value in {*options(key), "…", "null"}, f"{page.name}: {span}"
    assert seen > 300


@pytest.mark.parametrize("command", COMMANDS)
def test_examples_of_the_help_have_keys_and_values_that_exist(command: str) -> None:
    for example in _EXAMPLES[command]:
        name, *words = words_of(example)
        assert name == command
        check_command(name, keys_of(words))


def test_commands_that_messages_name_exist() -> None:
    """``hood WORD`` in the texts of the code is a command."""
    for path in (ROOT / "hood").rglob("*.py"):
        for word in re.findall(r"``hood (\w+)|[:;(] ?hood ([a-z]+) [\w.{]+=", path.read_text(encoding="utf-8")):
            name = word[0] or word[1]
            assert name in {*COMMANDS, "COMMAND"}, f"{path.name}: hood {name}"


@pytest.mark.parametrize(("page", "line"), LINES)
def test_a_shell_leaves_tables_in_commands_as_they_are(page: str, line: str) -> None:
    """Bash makes several words of ``key={a:1,b:2}`` without quotes."""
    bare = re.sub(r"'[^']*'|\"[^\"]*\"", "", line)
    assert not re.search(r"\{[^{}]*,[^{}]*\}", bare), f"{page}: quote the word with braces: {line}"
