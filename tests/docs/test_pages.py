"""README and docs: short where they promise to be, their links lead somewhere, their commands have keys that exist."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from hood.cli import COMMANDS
from hood.config import load_config

ROOT = Path(__file__).resolve().parents[2]
README = ROOT / "README.md"
PAGES = [README, *sorted((ROOT / "docs").glob("*.md"))]
#: Commands with a config of their own; others take files.
CONFIGURED = {path.stem for path in (ROOT / "configs").glob("*.yaml")} & set(COMMANDS)
#: The page of options that a reader makes; test_extending.py runs its commands.
EXTENDING = "extending.md"


def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def commands() -> list[tuple[str, str]]:
    """Page and line of every command in a block of code."""
    found = []
    for page in PAGES:
        fenced = re.findall(r"^ *```(\w*)\n(.*?)^ *```$", text_of(page), re.DOTALL | re.MULTILINE)
        for block in (body for language, body in fenced if language in {"", "bash", "sh"}):
            lines = block.replace("\\\n", " ").splitlines()
            found += [(page.name, line.strip()) for line in lines if re.match(r"\s*hood \w", line)]
    return found


def test_the_readme_is_short_and_has_a_picture_first() -> None:
    text = text_of(README)
    assert len(text.splitlines()) <= 120
    assert len(text.split()) <= 900
    picture = re.search(r"!\[[^]]+\]\(([^)]+)\)", "\n".join(text.splitlines()[:20]))
    assert picture is not None
    assert (ROOT / picture[1]).stat().st_size <= 2 * 2**20


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_to_what_is_there(page: Path) -> None:
    for link in re.findall(r"\]\((?!https?:)([^)#]+)(?:#[^)]*)?\)", text_of(page)):
        assert (page.parent / link).exists(), link


def test_every_page_is_reached_from_the_readme() -> None:
    seen, left = set(), [README]
    while left:
        page = left.pop()
        if page not in seen:
            seen.add(page)
            left += [(page.parent / link).resolve() for link in re.findall(r"\]\(((?!https?:)[^)#]+\.md)", text_of(page))]
    assert set(PAGES) <= seen


def test_there_are_commands_to_check() -> None:
    assert len(commands()) > 30
    assert {page for page, _ in commands()} >= {"README.md", "rollout.md", "files.md", "train.md", "evaluation.md"}


@pytest.mark.parametrize(("page", "line"), commands())
def test_commands_have_keys_that_exist(page: str, line: str) -> None:
    words = shlex.split(line, comments=True)[1:]
    assert words[0] in COMMANDS, line
    if words[0] == "plan":
        own = set(load_config("plan"))
        load_config("plan", [word for word in words[1:] if word.partition("=")[0] in own])
        load_config("rollout", [word for word in words[1:] if word.partition("=")[0] not in own])
    elif words[0] in CONFIGURED and "…" not in line and page != EXTENDING:
        load_config(words[0], [word for word in words[1:] if "=" in word])


def test_the_python_of_the_readme_runs(capsys: pytest.CaptureFixture[str]) -> None:
    blocks = re.findall(r"^```python\n(.*?)^```$", text_of(README), re.DOTALL | re.MULTILINE)
    assert blocks
    for block in blocks:
        exec(compile(block.replace("num_frames=60", "num_frames=2"), "README.md", "exec"), {})
    assert capsys.readouterr().out.splitlines()[-1].startswith("1 torch.Size([")
