"""The pages that readers see, their blocks of code and the command lines in them."""

from __future__ import annotations

import re
import shlex
import textwrap
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
README = ROOT / "README.md"
#: Pages that lead a reader on; the changelog is a record.
PAGES = [README, ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
#: Measurements behind the pages.
NOTES = sorted((ROOT / "hood" / "studies" / "notes").glob("*.md"))
#: Pages beside the data of the package, and the notes; they are linked from others, and are no part of the site.
CARDS = [*sorted((ROOT / "hood" / "data").rglob("*.md")), *NOTES]
_FENCE = re.compile(r"^( *)```(\w*)\n(.*?)^\1```$", re.DOTALL | re.MULTILINE)
#: A page whose code is that of a package of the reader's; where it has a test of its own, that runs all of it.
EXTENDING = "extending.md"
EXTENDING_HAS_A_TEST = (ROOT / "tests" / "docs" / "test_extending.py").is_file()
#: What a command line begins with: the tutorial's environment, several processes.
_COMMAND = re.compile(r"(\.venv/bin/)?(hood [a-z]|python (benchmarks|scripts|-m hood)|torchrun |make [a-z])")


class Block(NamedTuple):
    """Code between fences, without the indentation of a list around it."""

    page: str
    language: str
    text: str


def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def blocks(page: Path) -> list[Block]:
    return [Block(page.name, language, textwrap.dedent(body)) for _, language, body in _FENCE.findall(text_of(page))]


def prose_of(page: Path) -> str:
    """The page without its blocks of code."""
    return _FENCE.sub("", text_of(page))


def headings(page: Path) -> set[str]:
    """The #anchors of a page, as GitHub and MkDocs make them: lower case, hyphens for spaces, no punctuation."""
    titles = re.findall(r"^#+ +(.*)$", prose_of(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).strip().replace(" ", "-") for title in titles}


def command_lines() -> list[tuple[str, str]]:
    """Page and line of every command, in blocks and between backticks in a text; those of cards and notes as well."""
    found = []
    for page in [*PAGES, *CARDS]:
        lines = [
            line.strip()
            for block in blocks(page)
            if block.language in {"", "bash", "sh"}
            for line in block.text.replace("\\\n", " ").splitlines()
        ]
        lines += [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", prose_of(page))]
        found += [(page.name, line) for line in lines if _COMMAND.match(line)]
    return sorted(set(found))


def of_hood(line: str) -> bool:
    """Whether the line runs a command of ``hood``, by its name or by a script that does the same."""
    return re.search(r"\bhood [a-z]|-m hood\.cli|scripts/(rollout|train|evaluate)", line) is not None


def words_of(line: str) -> list[str]:
    """The command and its words, without what starts it (python -m hood.cli.main, torchrun …) and what a page leaves open."""
    bare = re.sub(r"^.*?(\bhood |-m hood\.cli |scripts/(?=rollout|train|evaluate))", "", line, count=1)
    words = shlex.split(bare, comments=True)
    return [words[0].removesuffix(".py"), *(word for word in words[1:] if "…" not in word)]


def keys_of(words: list[str]) -> list[str]:
    """The words with a key; of a sweep those of its first run, without what is Hydra's."""
    keys = [word for word in words if "=" in word and not word.startswith(("hydra.", "hydra/"))]
    return [word.split(",")[0] for word in keys] if "-m" in words else keys
