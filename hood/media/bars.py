"""Bar charts: few figures side by side."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hood.assets.files.atomic import write_atomically

#: Of the series, in their order; far apart in lightness too.
COLOURS = ("#345c8e", "#d6843e", "#609668", "#a05478", "#78787e", "#debe60")

#: Values by category and series.
Panel = Mapping[str, Mapping[str, float]]


def write_bars(panels: Mapping[str, Panel], path: Path) -> None:
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


def write_png(figure: Any, path: Path, dpi: int = 150) -> None:
    """Write the figure as a picture; the file appears when it is complete."""
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=dpi, metadata={"Software": None})
    write_atomically(path, content.getvalue())
