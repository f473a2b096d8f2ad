"""A page in one file: no script, no font, no picture from elsewhere. Written so that it is XML as well as HTML."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 1180px; margin: 2em auto; padding: 0 1.2em; }
h1 { font-size: 1.7em; } h2 { font-size: 1.3em; margin-top: 2.2em; border-bottom: 1px solid #ddd; } h3 { font-size: 1.05em; }
p { max-width: 50em; } .lead { font-size: 1.15em; font-weight: 600; background: #f6f3e7; padding: .7em 1em; }
.warning { background: #fbe3de; } .wide { overflow-x: auto; } table { border-collapse: collapse; font-size: 13px; }
th, td { text-align: left; padding: .25em .7em; border-bottom: 1px solid #eee; vertical-align: top; white-space: nowrap; }
th { background: #f7f7f7; } code { font-size: 12px; white-space: pre; user-select: all; }
figure { margin: 1em 0; } figure svg { width: 100%; height: auto; }
figcaption { color: #555; font-size: 13px; max-width: 75em; }
details { margin-top: 1em; } summary { cursor: pointer; font-weight: 600; }
@media (prefers-color-scheme: dark) { html { background: #fff; } }
"""


def whole_page(title: str, body: str, style: str = "") -> str:
    """The document; ``body`` is markup, ``style`` rules of its own."""
    head = f'<meta charset="utf-8"/><meta name="viewport" content="width=device-width"/><title>{escape(title)}</title>'
    return f'<!DOCTYPE html>\n<html lang="en"><head>{head}<style>{_STYLE}{style}</style></head><body>{body}</body></html>\n'


def section(title: str, body: str) -> str:
    """A heading and the markup below it."""
    return f"<section><h2>{escape(title)}</h2>{body}</section>\n"


def paragraph(text: str) -> str:
    """Plain text as a paragraph."""
    return f"<p>{escape(text)}</p>\n"


def table(head: Sequence[str], rows: Sequence[Sequence[str]], raw: int | None = None) -> str:
    """A table that scrolls sideways where it is too wide; the cells are plain text, those of column ``raw`` markup."""
    titles = "".join(f"<th>{escape(title)}</th>" for title in head)
    lines = []
    for row in rows:
        cells = (cell if place == raw else escape(cell) for place, cell in enumerate(row))
        lines.append("<tr>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>")
    return f'<div class="wide"><table><thead><tr>{titles}</tr></thead><tbody>{"".join(lines)}</tbody></table></div>\n'
