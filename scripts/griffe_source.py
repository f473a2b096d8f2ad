"""Docstrings as the site of ``make docs`` shows them; what is written in the source is written once.

The comment behind a field of a dataclass is its documentation. Roles of Sphinx become names in code type.
"""

from __future__ import annotations

import re
from typing import Any

import griffe

_ROLE = re.compile(r":(?:class|func|meth|mod|data|attr):`~?([^`]+)`")


class Source(griffe.Extension):
    """Reads comments of fields, and the roles in all docstrings."""

    def on_attribute_instance(self, *, attr: griffe.Attribute, **rest: Any) -> None:
        if attr.docstring is None and attr.lineno is not None and attr.endlineno == attr.lineno:
            comment = attr.lines_collection[attr.filepath][attr.lineno - 1].partition("  # ")[2].strip()
            if comment:
                attr.docstring = griffe.Docstring(comment, parent=attr)

    def on_instance(self, *, obj: griffe.Object, **rest: Any) -> None:
        if obj.docstring is not None:
            obj.docstring.value = _ROLE.sub(r"`\1`", obj.docstring.value)
