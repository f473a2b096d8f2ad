"""The notebooks run from top to bottom, as a reader runs them, and stay small."""

from __future__ import annotations

import ast
import json
import re
from pathlib import Path

import pytest
from pages import ROOT

NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
#: Cells of code of a notebook, and bytes of its file with what it printed and drew.
MOST_CELLS, MOST_BYTES = 8, 400_000


def cells(path: Path) -> list[dict[str, object]]:
    found = json.loads(path.read_text(encoding="utf-8"))["cells"]
    assert isinstance(found, list)
    return found


def code_of(path: Path) -> list[str]:
    return ["".join(cell["source"]) for cell in cells(path) if cell["cell_type"] == "code"]  # type: ignore[arg-type]


def run(code: str, name: str, known: dict[str, object]) -> object:
    """The value of a cell's last expression, as a notebook shows it."""
    tree = ast.parse(code)
    last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    exec(compile(tree, name, "exec"), known)
    return None if last is None else eval(compile(ast.Expression(last.value), name, "eval"), known)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    known: dict[str, object] = {"__name__": "__main__"}
    for number, code in enumerate(code_of(path)):
        shown = run(code, f"{path.name}, cell {number}", known)
        if hasattr(shown, "_repr_html_"):
            assert shown._repr_html_()


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_short_and_says_what_it_shows(path: Path) -> None:
    first = cells(path)[0]
    assert first["cell_type"] == "markdown"
    assert "".join(first["source"]).startswith("# ")  # type: ignore[arg-type]
    assert len(code_of(path)) <= MOST_CELLS
    assert path.stat().st_size <= MOST_BYTES


def test_the_list_names_every_notebook() -> None:
    text = (ROOT / "notebooks" / "README.md").read_text(encoding="utf-8")
    assert [path.name for path in NOTEBOOKS if f"({path.name})" not in text] == []
    assert [name for name in re.findall(r"\((\w+\.ipynb)\)", text) if not (ROOT / "notebooks" / name).is_file()] == []
