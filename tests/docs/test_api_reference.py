"""The reference names every class that a user meets, and each says what it holds.

From the public names, and from what the pages tell readers to import, the annotations are followed: what functions take and
give, fields, properties and methods of classes, and so on. Every class of hood on the way has an entry in docs/api.md.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import re
import sys
import textwrap
import typing
from collections.abc import Callable, Iterator
from dataclasses import is_dataclass
from functools import cache, cached_property
from typing import Any

import pytest
from pages import PAGES, ROOT, blocks, prose_of, text_of

import hood

#: Beginnings of the paths of classes that an annotation shows and no user handles, with the reason.
INNER = {
    "hood.app.setup.": "hood.simulate makes it of its keys",
    "hood.contact.self_contact.": "tables of a search of the solver: cloth near cloth",
    "hood.energies.term.ContactRows": "compiled passes of hood's own terms",
    "hood.mesh.closest_point.": "tables of a search of the network",
    "hood.model.": "the inside of networks; a page names what a package of one's own takes the place of",
    "hood.rollouts.checks.": "what the key guard makes",
    "hood.rollouts.gradients.Simulated": "hood.Simulation is one",
    "hood.scene.following.Ride": "a table of what pins follow",
    "hood.steppers.network.NetworkInputs": "what a network is shown inside a step",
    "hood.steppers.network.Prepared": "what a network computes once per cloth",
    "hood.steppers.protocol.FrameRules": "conventions of earlier weights, which their files hold",
    "hood.steppers.ranges.": "what weights were trained for, which their files hold",
    "hood.tensors.": "the inside of networks and solvers",
    "hood.training.callbacks.ValidationWatch": "what a training keeps of its validations",
    "hood.training.settings.": "keys of hood train, which its help describes",
}
ENTRIES = set(re.findall(r"^::: (hood\.[\w.]+)$", text_of(ROOT / "docs" / "api.md"), re.MULTILINE))


def resolve(path: str) -> Any:
    """The object behind a dotted path; None where there is none."""
    home, _, name = path.rpartition(".")
    try:
        return getattr(importlib.import_module(home), name, None)
    except ImportError:
        return None


def path_of(item: Any) -> str:
    public = item.__name__ in hood.__all__ and getattr(hood, item.__name__) is item
    return f"hood.{item.__name__}" if public else f"{item.__module__}.{item.__qualname__}"


def named_by_pages() -> dict[Any, str]:
    """Classes and functions that the pages import or write with their path, and the page."""
    found: dict[Any, str] = {}
    for page in PAGES:
        code = [node for block in blocks(page) if block.language == "python" for node in ast.walk(ast.parse(block.text))]
        taken = [node for node in code if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("hood.")]
        paths = [f"{node.module}.{alias.name}" for node in taken for alias in node.names]
        for path in [*paths, *re.findall(r"`(hood\.[\w.]+)`", prose_of(page))]:
            item = resolve(path)
            if inspect.isclass(item) or inspect.isfunction(item):
                found[item] = page.name
    return found


def names_of(module: Any) -> dict[str, Any]:
    """The names of a module as type checkers see them, those that it imports for annotations alone included."""
    names = dict(vars(module))
    for node in ast.walk(ast.parse(inspect.getsource(module))):
        if isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
            exec(compile(ast.Module(node.body, []), "types", "exec"), names)
    return names


@cache
def cached_names(module: str) -> dict[str, Any]:
    return names_of(sys.modules[module])


def classes_in(hint: Any) -> Iterator[type]:
    """The classes of hood in a type."""
    origin = typing.get_origin(hint)
    for one in (hint, origin):
        if inspect.isclass(one) and one.__module__.split(".")[0] == "hood":
            yield one
    for part in typing.get_args(hint):
        for one in part if isinstance(part, list) else [part]:
            yield from classes_in(one)


def attributes_of(kind: type) -> Iterator[Any]:
    """Types of the attributes that ``__init__`` declares."""
    if "__init__" not in vars(kind) or is_dataclass(kind):
        return
    tree = ast.parse(textwrap.dedent(inspect.getsource(vars(kind)["__init__"])))
    for node in ast.walk(tree):
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Attribute) and node.target.attr[0] != "_":
            yield eval(ast.unparse(node.annotation), cached_names(kind.__module__))


def functions_of(kind: type) -> dict[str, Callable[..., Any]]:
    """Public functions and properties of a class, and those that Python calls, by name; those of hood alone."""
    found = {}
    for name, member in inspect.getmembers_static(kind):
        if name.startswith("_") and name not in ("__init__", "__iter__", "__next__", "__getitem__", "__call__"):
            continue
        member = getattr(member, "__func__", member)
        member = member.func if isinstance(member, cached_property) else getattr(member, "fget", None) or member
        if inspect.isfunction(member) and member.__module__.split(".")[0] == "hood":
            found[name] = member
    return found


def types_of(item: Any) -> Iterator[Any]:
    """The annotations of a function, or of a class and those of hood that it inherits from."""
    for owner in item.__mro__ if inspect.isclass(item) else [item]:
        of_hood = owner.__module__.split(".")[0] == "hood"
        for name, hint in (vars(owner).get("__annotations__", {}) if inspect.isclass(item) else item.__annotations__).items():
            if of_hood and not name.startswith("_"):
                yield eval(hint, cached_names(owner.__module__)) if isinstance(hint, str) else hint


def met_by(item: Any) -> Iterator[type]:
    """Classes that somebody who uses a class or a function meets."""
    parts = [item, *functions_of(item).values()] if inspect.isclass(item) else [item]
    hints = [hint for part in parts for hint in types_of(part)]
    hints += attributes_of(item) if inspect.isclass(item) else ()
    for hint in hints:
        yield from classes_in(hint)


def is_inner(path: str) -> bool:
    return any(path.startswith(start) for start in INNER) or path.rpartition(".")[2].startswith("_")


@cache
def met() -> dict[Any, str]:
    """Everything that users meet, and where they meet it first."""
    todo = {getattr(hood, name): "hood" for name in hood.__all__ if name != "__version__"} | named_by_pages()
    found: dict[Any, str] = {}
    while todo:
        item = next(iter(todo))
        found[item] = todo.pop(item)
        for one in met_by(item):
            if one not in found and one not in todo and not is_inner(path_of(one)):
                todo[one] = path_of(item)
    return found


def test_every_class_that_a_user_meets_has_an_entry() -> None:
    missing = {path_of(item): where for item, where in met().items() if path_of(item) not in ENTRIES}
    assert not missing


def test_what_is_inner_is_met_and_has_no_entry() -> None:
    shown = {path_of(one) for item in met() for one in met_by(item)}
    assert [start for start in INNER if not any(path.startswith(start) for path in shown)] == []


def test_entries_lead_somewhere() -> None:
    assert [path for path in sorted(ENTRIES) if resolve(path) is None] == []


def told_fields(kind: type) -> set[str]:
    """Fields whose meaning stands in the docstring of the class, in the comment behind them or in that above them."""
    lines = inspect.getsource(kind).splitlines()
    said = set(re.findall(r"^ *([\w, ]+): ", inspect.getdoc(kind) or "", re.MULTILINE))
    found = {name for names in said for name in names.split(", ")}
    for number, line in enumerate(lines):
        field = re.match(r"    (\w+)\b.*?(?:  # (?!type: ignore\[\w+\]$).+)?$", line)
        if field and (re.search(r"  # (?!type: ignore\[[\w-]+\]$)", line) or lines[number - 1].startswith("    #: ")):
            found.add(field[1])
    return found


@pytest.mark.parametrize("path", sorted(ENTRIES))
def test_an_entry_says_what_it_is(path: str) -> None:
    item = resolve(path)
    assert inspect.getdoc(item)
    if inspect.isclass(item):
        own = {name: one for name, one in functions_of(item).items() if not name.startswith("_")}
        silent = [name for name, one in own.items() if not one.__doc__]
        fields = [*vars(item).get("__annotations__", {}), *getattr(item, "__members__", ())]
        told = told_fields(item)
        assert silent + [name for name in fields if not name.startswith("_") and name not in told] == []
