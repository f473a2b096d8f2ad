"""The rooms of the code: no import circle, a first line for every module, and bounds on what makes code hard to find."""

from __future__ import annotations

import ast
import graphlib
import re
from collections import Counter, defaultdict
from pathlib import Path

import grimp
import long_code
import pytest

ROOT = Path(__file__).parents[1]
HOOD = ROOT / "hood"
MODULES = sorted(path for folder in ("hood", "tools") for path in (ROOT / folder).rglob("*.py"))
OWN = sorted(path for path in HOOD.rglob("*.py") if path.name != "__init__.py")
TREES = {path: ast.parse(path.read_text(encoding="utf-8")) for path in MODULES}

#: Modules of the package in all, in one folder, and lines of one.
MOST_MODULES, MOST_IN_A_FOLDER, LONGEST = 320, 20, 450
#: Modules and functions with more lines are listed, with a reason, in long_code.py.
LONG_MODULE, LONG_FUNCTION = 300, 60
#: Rooms in the order of the page: each imports only those before it.
ROOMS = (
    *("native", "tensors", "mesh", "assets", "cloth", "contact", "scene", "energies", "solver", "model", "steppers"),
    *("rollouts", "evaluation", "media", "training", "app", "cli", "studies"),
)


@pytest.fixture(scope="module")
def architecture() -> str:
    return (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def imported() -> dict[str, set[str]]:
    """Modules that each module imports, inside functions too; not for type checkers alone."""
    graph = grimp.build_graph("hood", exclude_type_checking_imports=True, cache_dir=None)
    return {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}


def lines_of(path: Path) -> int:
    return len(path.read_text(encoding="utf-8").splitlines())


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
        text = ast.get_docstring(TREES[path])
        assert text, dotted(path)
        assert text[0].isupper() or not text[0].isalpha() or text.startswith(("glTF", "hood")), f"{dotted(path)}: {text[:40]}"


def test_the_page_has_every_room_with_its_first_sentence(architecture: str) -> None:
    cells = [line.split("|") for line in architecture.splitlines() if re.match(r"\| `hood/\w+/`", line)]
    rows = {cell[1].strip(" `"): cell[2].strip() for cell in cells}
    folders = {path.parent.name for path in HOOD.glob("*/__init__.py")}
    assert [*rows] == [f"hood/{room}/" for room in ROOMS]
    assert folders == set(ROOMS)
    for room in ROOMS:
        text = ast.get_docstring(TREES[HOOD / room / "__init__.py"]) or ""
        assert rows[f"hood/{room}/"] == text.split("\n\n")[0].replace("\n", " ")
        assert "\n\n" in text, f"{room}: say what it never does"


def test_modules_are_few_and_none_is_long() -> None:
    assert len(OWN) <= MOST_MODULES
    folders = Counter(path.parent for path in OWN)
    assert max(folders.values()) <= MOST_IN_A_FOLDER, folders.most_common(1)
    assert not [dotted(path) for path in OWN if lines_of(path) > LONGEST]


def test_long_modules_and_functions_are_listed_with_their_reasons() -> None:
    long = {path.relative_to(ROOT).as_posix() for path in MODULES if lines_of(path) > LONG_MODULE}
    long |= {
        f"{dotted(path)}.{node.name}"
        for path in MODULES
        for node in ast.walk(TREES[path])
        if isinstance(node, ast.FunctionDef) and (node.end_lineno or 0) - node.lineno + 1 > LONG_FUNCTION
    }
    assert long == {*long_code.MODULES, *long_code.FUNCTIONS}


def test_most_modules_need_few_others(imported: dict[str, set[str]]) -> None:
    own = {dotted(path) for path in OWN}
    counts = sorted(len(needed & own) for module, needed in imported.items() if module in own)
    assert counts[int(0.9 * len(counts))] <= 12


def test_few_short_modules_serve_a_single_one(imported: dict[str, set[str]]) -> None:
    importers: dict[str, set[str]] = defaultdict(set)
    for module, needed in imported.items():
        for one in needed:
            importers[one].add(module)
    short = {dotted(path) for path in OWN if lines_of(path) < 70}
    assert len([module for module in short if len(importers[module]) == 1]) <= 8


def test_few_public_names_stand_in_several_modules() -> None:
    places: dict[str, set[str]] = defaultdict(set)
    for path in OWN:
        for node in TREES[path].body:
            named = [node.name] if isinstance(node, ast.FunctionDef | ast.ClassDef) else []
            targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
            for name in [*named, *(target.id for target in targets if isinstance(target, ast.Name))]:
                if not name.startswith("_"):
                    places[name].add(dotted(path))
    several = {name: sorted(modules) for name, modules in places.items() if len(modules) > 1}
    assert len(several) <= 30, several


def test_few_modules_ask_for_the_class_of_an_energy() -> None:
    """Where a term is told by its class, a new energy has to be added: elsewhere than in its own room that is rare."""
    classes = set()
    for path in sorted((HOOD / "energies").glob("*.py")):
        classes |= {node.name for node in TREES[path].body if isinstance(node, ast.ClassDef) and computes_energy(node)}
    found = []
    for path in OWN:
        if path.parent == HOOD / "energies":
            continue
        for node in ast.walk(TREES[path]):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ("isinstance", "issubclass"):
                found += [f"{dotted(path)}:{node.lineno}" for name in ast.walk(node.args[1]) if names_one(name, classes)]
            if isinstance(node, ast.Compare):
                found += [
                    f"{dotted(path)}:{node.lineno}"
                    for one in node.comparators
                    for name in ast.walk(one)
                    if names_one(name, classes)
                ]
    assert len(set(found)) <= 2, sorted(set(found))


def test_the_command_line_alone_prints() -> None:
    """Rooms below say what they have to say (:func:`hood.assets.files.said.say`), and whoever listens prints or keeps it."""
    found = []
    for path in OWN:
        if path.relative_to(HOOD).parts[0] in ("cli", "studies"):
            continue
        for node in ast.walk(TREES[path]):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print":
                found.append(f"{dotted(path)}:{node.lineno}")
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "sys":
                found += [f"{dotted(path)}:{node.lineno}"] if node.attr in ("stdout", "stderr") else []
    assert not found


def computes_energy(node: ast.ClassDef) -> bool:
    """Whether a class computes an energy."""
    return any(isinstance(item, ast.FunctionDef) and item.name == "__call__" for item in node.body)


def names_one(node: ast.AST, classes: set[str]) -> bool:
    return isinstance(node, ast.Name) and node.id in classes
