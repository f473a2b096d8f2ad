"""The table of limits in hood/studies/notes/verdict.md is that of the code."""

from __future__ import annotations

import ast
import inspect
from importlib import import_module
from pathlib import Path

import pytest

from hood import limits
from hood.limits import Limit, Range

PAGE = Path(__file__).parents[2] / "hood" / "studies" / "notes" / "verdict.md"
BEGIN, END = "<!-- limits: begin -->\n", "<!-- limits: end -->"


def rows() -> list[str]:
    found = []
    for name, one in vars(limits).items():
        if isinstance(one, Limit):
            found.append(f"| {name.lower().replace('_', ' ')} | {one.value:g} {one.unit} | `{one.owner}` | {one.reason} |")
        elif isinstance(one, Range):
            span = f"{one.least:g} to {one.most:g} {one.unit}"
            found.append(f"| {name.lower().replace('_', ' ')} | {span} | `{one.owner}` | {one.reason} |")
    return ["| limit | value | applied by | why |", "|---|---|---|---|", *found]


def test_the_page_has_every_limit() -> None:
    text = PAGE.read_text(encoding="utf-8")
    table = text.split(BEGIN)[1].split(END)[0].strip().splitlines()
    assert table == rows(), "\n".join(rows())
    assert len(table) > 15


NAMED = {name: one for name, one in vars(limits).items() if isinstance(one, (Limit, Range))}


@pytest.mark.parametrize("name", NAMED)
def test_limits_say_whose_they_are(name: str) -> None:
    one = NAMED[name]
    tree = ast.parse(inspect.getsource(import_module(one.owner)))
    assert name in {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}, f"{one.owner} does not use it"
    assert one.unit
    assert one.reason
