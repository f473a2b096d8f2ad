"""The rooms of the code: no import circle, a first line for every module, and a list of what is long."""

from __future__ import annotations

import ast
import graphlib
from pathlib import Path

import grimp
import pytest

ROOT = Path(__file__).parents[1]
#: Lines of a module and of a function beyond which the page of the architecture gives a reason.
LONG_MODULE, LONG_FUNCTION = 300, 60
MODULES = sorted(path for folder in ("hood", "tools") for path in (ROOT / folder).rglob("*.py"))


@pytest.fixture(scope="module")
def architecture() -> str:
    return (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")


def dotted(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts)


@pytest.mark.parametrize("package", ["hood", "tools"])
def test_modules_import_each_other_in_one_direction(package: str) -> None:
    """Imports inside functions count, those for type checkers alone do not."""
    graph = grimp.build_graph(package, exclude_type_checking_imports=True, cache_dir=None)
    imported = {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}
    assert len(imported) > 10
    try:
        graphlib.TopologicalSorter(imported).prepare()
    except graphlib.CycleError as error:
        pytest.fail("import circle: " + " → ".join(error.args[1]))


def test_every_module_begins_with_a_sentence_on_what_it_is() -> None:
    for path in MODULES:
        text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8")))
        assert text, dotted(path)
        assert text[0].isupper() or not text[0].isalpha() or text.startswith(("glTF", "hood")), f"{dotted(path)}: {text[:40]}"


def test_long_modules_and_functions_are_listed_with_their_reasons(architecture: str) -> None:
    section = architecture.split("## What is long, and why")[1]
    listed = {word for line in section.splitlines() if line.startswith("| `") for word in line.split("|")[1].split("`")[1::2]}
    long = set()
    for path in MODULES:
        text = path.read_text(encoding="utf-8")
        if len(text.splitlines()) > LONG_MODULE:
            long.add(path.relative_to(ROOT).as_posix())
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef) and (node.end_lineno or 0) - node.lineno + 1 > LONG_FUNCTION:
                long.add(f"{dotted(path)}.{node.name}")
    assert long == listed
