"""Docstrings as the site of ``make docs`` shows them; what is written in the source is written once.

The comment behind a field of a dataclass, or above it after ``#:``, is its documentation. Roles of Sphinx become names in code
type, which lead to the entry where there is one.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import griffe

_ROLE = re.compile(r":(?:class|func|meth|mod|data|attr):`~?([^`]+)`")
_PAGE = Path(__file__).resolve().parents[1] / "docs" / "api.md"
_ENTRIES = frozenset(re.findall(r"^::: (\S+)$", _PAGE.read_text(encoding="utf-8"), re.MULTILINE))


def _shown(role: re.Match[str]) -> str:
    return f"[`{role[1]}`][{role[1]}]" if role[1] in _ENTRIES else f"`{role[1]}`"


class Source(griffe.Extension):
    """Reads comments of fields, and the roles in all docstrings."""

    def on_attribute_instance(self, *, attr: griffe.Attribute, **rest: Any) -> None:
        if attr.docstring is None and attr.lineno is not None and attr.endlineno == attr.lineno:
            lines = attr.lines_collection[attr.filepath][: attr.lineno]
            comments = [one.strip() for one in lines.pop().split("  # ")[1:] if not one.startswith("type: ")]
            above: list[str] = []
            while lines and lines[-1].strip().startswith("#: "):
                above.insert(0, lines.pop().strip().removeprefix("#: "))
            text = comments[-1] if comments else " ".join(above)
            if text:
                attr.docstring = griffe.Docstring(_ROLE.sub(_shown, text), parent=attr)

    def on_instance(self, *, obj: griffe.Object, **rest: Any) -> None:
        if obj.docstring is not None:
            obj.docstring.value = _ROLE.sub(_shown, obj.docstring.value)
