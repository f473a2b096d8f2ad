"""Bar charts: few figures side by side.

The picture of the drape test: the shadow of every sample, with the disc it lies on and the circle it was cut to.

A page in one file: no script, no font, no picture from elsewhere. Written so that it is XML as well as HTML.
"""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from hood.assets.files.atomic import write_atomically
from hood.evaluation.drape import DISC, PIXEL, SAMPLE, DrapedRest

#: Of the series, in their order; far apart in lightness too.
COLOURS = ("#345c8e", "#d6843e", "#609668", "#a05478", "#78787e", "#debe60")

#: Values by category and series.
_Panel = Mapping[str, Mapping[str, float]]


def write_bars(panels: Mapping[str, _Panel], path: Path) -> None:
    """Draw a chart per panel, by its title, one below the other, into a PNG. Bars start at 0; values are not negative."""
    from matplotlib.figure import Figure

    series = list(dict.fromkeys(name for panel in panels.values() for values in panel.values() for name in values))
    longest = max((len(panel) for panel in panels.values()), default=1)
    width = 1.0 + longest * max(0.22 * len(series), 0.9)
    figure = Figure(figsize=(max(width, 4.0), 3.0 * max(len(panels), 1)), layout="constrained")
    rows = figure.subplots(max(len(panels), 1), squeeze=False)[:, 0]
    for axes, (title, panel) in zip(rows, panels.items(), strict=False):
        for index, name in enumerate(series):
            places = [place for place, values in enumerate(panel.values()) if name in values]
            if not places:
                continue
            axes.bar(
                [place + index / (len(series) + 1) for place in places],
                [values[name] for values in panel.values() if name in values],
                0.9 / (len(series) + 1),
                align="edge",
                label=name,
                color=COLOURS[index % len(COLOURS)],
                antialiased=False,
            )
        axes.set_title(title, loc="left", fontsize=10)
        axes.set_xticks([place + 0.5 * len(series) / (len(series) + 1) for place in range(len(panel))], list(panel), fontsize=8)
        axes.set_xlim(-0.1, len(panel))
        axes.legend(fontsize=8, frameon=False)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="y", color="#e6e6e6")
        axes.set_axisbelow(True)
    write_png(figure, path, dpi=100)


def write_course(values: Sequence[float], title: str, across: str, path: Path) -> None:
    """Draw positive values in their order as a line on a logarithmic scale into a PNG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.0, 3.0), layout="constrained")
    axes = figure.subplots()
    axes.semilogy(range(len(values)), [max(value, 1e-9) for value in values], marker="o", markersize=3, color=COLOURS[0])
    if max(values) < 10.0 * min(values):  # no or one power of ten on the axis: numbers between them
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter("{x:g}")
    axes.set_title(title, loc="left", fontsize=10)
    axes.set_xlabel(across, fontsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color="#e6e6e6")
    write_png(figure, path, dpi=100)


def write_png(figure: Any, path: Path, dpi: int = 150) -> None:
    """Write the figure as a picture; the file appears when it is complete."""
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=dpi, metadata={"Software": None})
    write_atomically(path, content.getvalue())


#: Panels in a row at most, and inches of one.
_COLUMNS, _INCHES = 5, 2.2
_CLOTH = "#345c8e"


def write_shadows(states: Mapping[str, DrapedRest], path: Path) -> None:
    """Draw a panel per fabric, by its name, into a PNG."""
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle

    columns = min(len(states), _COLUMNS)
    rows = math.ceil(len(states) / columns)
    figure = Figure(figsize=(_INCHES * columns, (_INCHES + 0.4) * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).reshape(-1)
    for axes in panels:
        axes.set_axis_off()
    for axes, (name, state) in zip(panels, states.items(), strict=False):
        half = 0.5 * PIXEL * len(state.shadow)
        axes.imshow(state.shadow, cmap=ListedColormap(["#ffffff", _CLOTH]), extent=(-half, half, half, -half))
        axes.add_patch(Circle((0, 0), DISC, fill=False, color="#ffffff", linewidth=1.0))
        axes.add_patch(Circle((0, 0), SAMPLE, fill=False, color="#999999", linewidth=0.8, linestyle="--"))
        axes.set_title(f"{name}\n{100 * state.coefficient:.0f}%, {state.folds} folds", fontsize=9)
    write_png(figure, path, dpi=100)


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
