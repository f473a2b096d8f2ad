"""Charts of time against accuracy, drawn by matplotlib: as PNG, and as SVG to stand inside a page."""

from __future__ import annotations

import io
import re
from collections.abc import Collection, Sequence
from typing import Any

from hood.evaluation.table import NEWTON
from hood.studies.tradeoff.comparison import RESOLUTION, pareto_front
from hood.studies.tradeoff.grid import Point
from hood.studies.tradeoff.results import FRAME_PARTS, Reached

#: Gaps below are not drawn in their place: a logarithm has none for γ ≤ 0, and minima are not known that exactly.
FLOOR = RESOLUTION
#: Below, γ says little: minimisations from different starts end that far apart.
_BLUR = 1e-2
_COLOURS = ("#2a6fbb", "#c8503c", "#3f8f4f", "#8c5bb0", "#c98a1b", "#2b9aa0", "#8a5a44", "#c2558f")
_SOLVER = "#222222"
_PART_COLOURS = {"search": "#8fb8de", "features": "#f2c078", "network": "#2a6fbb", "refine": "#c8503c", "rest": "#bbbbbb"}
#: Of matplotlib; versions differ in how they type its keys.
_STYLE: Any = {
    "font.size": 9.0, "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True, "grid.color": "#e6e6e6",
    "axes.axisbelow": True, "svg.hashsalt": "hood", "legend.frameon": False, "axes.titlesize": 10.0, "axes.titleweight": "bold",
}  # fmt: skip
_STAMPED = {"Date": None, "Creator": None}  # the same points give the same file


def below_floor(reached: Sequence[Reached], quantity: str = "gap") -> list[Reached]:
    """Points whose γ has no place in the chart."""
    return [item for item in reached if item.charted and getattr(item, quantity).value < FLOOR]


def series_colours(reached: Sequence[Reached]) -> dict[str, str]:
    """A colour for every model, the same at all sizes; the solver's is black."""
    models = dict.fromkeys(item.point.model for item in reached if not item.point.alone)
    return {model: _COLOURS[index % len(_COLOURS)] for index, model in enumerate(models)}


def front_chart(reached: Sequence[Reached], rejected: Collection[Point], colours: dict[str, str], title: str) -> Any:
    """Figure of one size: milliseconds a frame against γ, median and 95th percentile, log–log, with confidence intervals.

    One line per model and precision; the numbers at it are iterations. Hollow: ``rejected``. The staircase is the Pareto front
    of the medians. Points below :data:`FLOOR` stand at the lower edge as triangles.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(_STYLE):
        figure = Figure(figsize=(11.5, 5.6), layout="constrained")
        panels = figure.subplots(1, 2, sharex=True, sharey=True)
        figure.suptitle(title, fontsize=11, fontweight="bold")
        for axes, quantity, name in zip(panels, ("gap", "gap_p95"), ("median", "95th percentile"), strict=True):
            _panel(axes, [item for item in reached if item.charted], rejected, colours, quantity)
            axes.set_title(f"γ, {name} over states")
            axes.set_xlabel("milliseconds per frame (median; search and features included)")
            axes.tick_params(labelleft=True)
        panels[0].set_ylabel("γ: energy above the exact step, in e0   (down is better)")
        if any(item.point in rejected for item in reached):
            panels[0].plot([], [], "o", color="#555555", markerfacecolor="white", label="overstretched, or broken down")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside right upper", fontsize=8.5)
    return figure


def _panel(axes: Any, reached: Sequence[Reached], rejected: Collection[Point], colours: dict[str, str], quantity: str) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_minor_formatter(NullFormatter())
    for name in dict.fromkeys(item.point.series for item in reached):
        _series(axes, [item for item in reached if item.point.series == name], rejected, colours, quantity)
    if quantity == "gap":
        _staircase(axes, pareto_front(reached, rejected))
    _limits(axes, reached, quantity)
    axes.axhspan(FLOOR / 10, _BLUR, color="#f4f4f4", zorder=0)
    # What is both fast and exact: that corner is free.
    note = {"transform": axes.transAxes, "va": "bottom", "fontsize": 7, "color": "#666666"}
    axes.text(0.015, 0.02, f"grey: below {_BLUR:g}, as far apart\nas minima of one and the same step", **note)


def _series(axes: Any, items: list[Reached], rejected: Collection[Point], colours: dict[str, str], quantity: str) -> None:
    """A line from few iterations to many. The converged solver is no further iteration: it stands by itself."""
    point = items[0].point
    style = _line_style(point)
    colour = style["color"] = _SOLVER if point.alone else colours[point.model]
    line = sorted((item for item in items if item.point.model != NEWTON), key=lambda item: item.point.refine)
    shown = [item for item in line if getattr(item, quantity).value >= FLOOR]
    if line:
        places = [item.ms.value for item in shown], [getattr(item, quantity).value for item in shown]
        axes.plot(*places, **(style | {"marker": ""}), alpha=0.6)
        axes.plot([], [], **style, markersize=5, label=point.series)
    named = line if len(line) < 5 else [line[0], line[-1]]
    for item in items:
        if getattr(item, quantity).value < FLOOR:
            _at_the_edge(axes, item, colour)
            continue
        face = "white" if item.point in rejected else colour
        _marker(axes, item, getattr(item, quantity), style | {"markerfacecolor": face}, item in named)


def _line_style(point: Point) -> dict[str, Any]:
    marker, line = ("s", "--") if point.precision != "fp32" else ("o", "-")
    if point.method == "sweeps":
        marker, line = "D" if marker == "s" else "^", ":"
    return {"linewidth": 1.1, "linestyle": line, "marker": marker}


def _marker(axes: Any, item: Reached, value: Any, style: dict[str, Any], named: bool) -> None:
    converged = item.point.model == NEWTON
    _errors(axes, item, value, style["color"])
    looks = {"marker": "*", "markersize": 11} if converged else {"markersize": 5.5}
    axes.plot([item.ms.value], [value.value], **(style | looks | {"linestyle": "", "zorder": 3}))
    if converged or named:
        text = "converged" if converged else str(item.point.refine)
        place = {"xytext": (5, 4), "textcoords": "offset points"}
        axes.annotate(text, (item.ms.value, value.value), fontsize=7.5, color=style["color"], **place)


def _errors(axes: Any, item: Reached, value: Any, colour: str) -> None:
    """Intervals; an end below the floor is drawn down to the edge of the chart."""
    low = max(value.low, FLOOR / 10)
    across = [[item.ms.value - item.ms.low], [item.ms.high - item.ms.value]]
    up = [[value.value - low], [value.high - value.value]]
    axes.errorbar([item.ms.value], [value.value], xerr=across, yerr=up, color=colour, linewidth=0.8, alpha=0.55, zorder=2)


def _at_the_edge(axes: Any, item: Reached, colour: str) -> None:
    axes.plot(
        [item.ms.value], [0.02], marker="v", color=colour, markersize=7, transform=axes.get_xaxis_transform(), clip_on=False
    )
    name = "converged" if item.point.model == NEWTON else str(item.point.refine)
    axes.annotate(name, (item.ms.value, 0.03), (0, 6), xycoords=axes.get_xaxis_transform(), textcoords="offset points",
                  fontsize=7, color=colour, rotation=90, ha="center", va="bottom")  # fmt: skip


def _staircase(axes: Any, front: Sequence[Reached]) -> None:
    shown = [item for item in front if item.gap.value >= FLOOR]
    if shown:
        style = {"color": "#e0a800", "linewidth": 5, "alpha": 0.3, "zorder": 1, "label": "Pareto front"}
        axes.step([i.ms.value for i in shown], [i.gap.value for i in shown], where="post", **style)


def _limits(axes: Any, reached: Sequence[Reached], quantity: str) -> None:
    times = [end for item in reached for end in (item.ms.low, item.ms.high)]
    axes.set_xlim(min(times) / 1.3, max(times) * 1.5)
    values = [getattr(item, name) for item in reached for name in ("gap", "gap_p95")]
    shown = [value.value for value in values if value.value >= FLOOR]
    lowest = FLOOR if below_floor(reached, quantity) or not shown else min(shown) / 2
    highest = max([value.high for value in values if value.high > 0], default=1.0)
    axes.set_ylim(max(lowest, FLOOR), max(2 * highest, 10 * FLOOR))


def cost_chart(reached: Sequence[Reached], title: str) -> Any:
    """Figure of one size: where the time of a frame goes, with the fewest and the most iterations of every series."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    series: dict[str, list[Reached]] = {}
    for item in (item for item in reached if item.charted):
        series.setdefault("" if item.point.model == NEWTON else item.point.series, []).append(item)
    ends = (sorted(line, key=lambda item: item.point.refine) for line in series.values())
    items = [item for line in ends for item in ([line[0], line[-1]] if len(line) > 1 else line)][::-1]
    with rc_context({**_STYLE, "axes.grid.axis": "x"}):
        figure = Figure(figsize=(9.0, 1.7 + 0.22 * len(items)), layout="constrained")
        axes = figure.subplots()
        left = [0.0] * len(items)
        for name in FRAME_PARTS:
            widths = [item.parts[name] for item in items]
            axes.barh(range(len(items)), widths, left=left, color=_PART_COLOURS[name], label=name, height=0.75)
            left = [before + width for before, width in zip(left, widths, strict=True)]
        axes.set_yticks(range(len(items)), [item.label for item in items], fontsize=8)
        axes.set_ylim(-0.6, len(items) - 0.4)
        axes.set_xlabel("milliseconds per frame (mean)")
        axes.set_title(title, loc="left")
        axes.legend(ncols=len(FRAME_PARTS), loc="lower right", bbox_to_anchor=(1.0, 1.0), fontsize=8)
    return figure


def inline_svg(figure: Any, name: str, label: str) -> str:
    """The figure as an SVG element. Its ids begin with ``name``, so that several may stand in one page; ``label`` is what it
    shows, for those who cannot see it."""
    from matplotlib import rc_context

    content = io.StringIO()
    with rc_context(_STYLE):
        figure.savefig(content, format="svg", metadata=_STAMPED)
    text = content.getvalue()
    text = re.sub(r"<metadata>.*?</metadata>", "", text[text.index("<svg") :], flags=re.S)
    text = re.sub(r'\bid="', f'id="{name}-', text)
    text = re.sub(r'href="#', f'href="#{name}-', text)
    text = text.replace("url(#", f"url(#{name}-")
    # Its size follows the page's width; the view box keeps the proportions.
    text = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", text, count=1)
    text = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", text, count=1)
    return text.replace("<svg", f'<svg role="img" aria-label="{label}"', 1)
