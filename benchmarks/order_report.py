"""Runs of the family as a table with intervals over seeds, and as a figure."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from order_scenes import Hanging
from scipy.stats import t

from hood.assets.files.atomic import write_atomically
from hood.evaluation.bootstrap import LEVEL
from hood.media.bars import write_png

NAMES = {"fine15": "Fine15", "ours": "Ours", "fine48": "Fine48"}
COLOURS = {"fine15": "#c8503c", "ours": "#2a6fbb", "fine48": "#3f8f4f"}
#: Least and greatest γ of the figure.
SHOWN = (1e-4, 1e3)
#: What is compared, better where it is lower: titles by column.
QUANTITIES = {"gap": "γ", "loss": "L above the solver's [e0]", "gradient": "gradient [weight of a vertex]"}
#: Not of one sign: own rollouts may lie lower than the solver's. Differences are looked at, of the others ratios.
SIGNED = ("loss",)

Row = Mapping[str, Any]
#: What the solver says about a scene, see ``order.py exact``.
Exact = Mapping[str, Any]


class Mean(NamedTuple):
    """Mean over seeds and the ends of its interval; the ends are NaN for fewer than two seeds."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        value, low, high = (f"{number:.0f}" if abs(number) >= 10 else f"{number:.2g}" for number in self)
        return f"{value} ({low} to {high})" if math.isfinite(self.low) else value


def mean(values: Sequence[float]) -> Mean:
    """With an interval by Student's distribution."""
    middle, count = float(np.mean(values)), len(values)
    if count < 2:
        return Mean(middle, math.nan, math.nan)
    half = float(t.ppf((1 + LEVEL) / 2, count - 1) * np.std(values, ddof=1)) / math.sqrt(count)
    return Mean(middle, middle - half, middle + half)


def geometric_mean(values: Sequence[float]) -> Mean:
    """Of positive values: that of their logarithms."""
    return Mean(*map(math.exp, mean(np.log(values).tolist())))


def summary(quantity: str) -> Callable[[Sequence[float]], Mean]:
    """How values of a quantity are taken together."""
    return mean if quantity in SIGNED else geometric_mean


@dataclass(frozen=True)
class Results:
    """What is there: rows of runs that are done, and what the solver says, by the scene's name."""

    family: Sequence[Hanging]
    schedules: Sequence[str]
    rows: Sequence[Row]
    exact: Mapping[str, Exact]

    def values(self, scene: Hanging, schedule: str, quantity: str) -> dict[int, float]:
        """By seed."""
        mine = [row for row in self.rows if row["scene"] == scene.name and row["schedule"] == schedule]
        return {int(row["seed"]): self._value(row, scene, quantity) for row in mine}

    def _value(self, row: Row, scene: Hanging, quantity: str) -> float:
        exact = self.exact[scene.name]
        if quantity == "loss":
            return float((row["L_total"] - exact["newton"]["L_total"]) / exact["e0"])
        if quantity == "gradient":
            return float(row["gradient_norm"] / exact["vertex_weight"])
        return float(row[quantity])

    def behind(self, scenes: Sequence[Hanging], schedule: str, other: str, quantity: str) -> Mean | None:
        """How many times as much as ``other``, or how much more, seed by seed; None where no seed has both."""
        pairs: list[float] = []
        for scene in scenes:
            mine, theirs = (self.values(scene, name, quantity) for name in (schedule, other))
            both = sorted(mine.keys() & theirs.keys())
            pairs += [mine[seed] - theirs[seed] if quantity in SIGNED else mine[seed] / theirs[seed] for seed in both]
        return summary(quantity)(pairs) if pairs else None


def read_rows(output: Path, updates: int) -> list[Row]:
    """Rows of the runs with so many updates that are done."""
    rows = [json.loads(path.read_text()) for path in sorted(output.glob("*/*/seed*/row.json"))]
    return [row for row in rows if row["updates"] == updates]


def exact_table(results: Results) -> str:
    """A line per scene and radius: what is so without a network."""
    titles = [
        "scene",
        "radius",
        "radius / ℓ",
        "decay / ℓ",
        "γ, pins unfelt beyond",
        "γ, exact within",
        "strain p99, exact within",
    ]
    lines = [[*titles, "of the solver", "γ of the base", "γ of free flight"]]
    for scene in results.family:
        exact = results.exact.get(scene.name, {})
        for radius in (15, 48):
            if f"patch{radius}" in exact:
                floors, patch = exact["floors"], exact[f"patch{radius}"]
                unfelt, base, inertia = (f"{np.median(floors[name]):.2g}" for name in (str(radius), "base", "inertia"))
                reached = f"{patch['gap']:.2g}" if patch["gap"] < SHOWN[1] else "breaks"
                figures = [f"{radius * scene.edge / scene.reach:.2f}", f"{exact['decay'] / scene.reach:.2f}", unfelt]
                strains = [f"{value:.1%}" for value in (patch["strain_p99"], exact["newton"]["strain_p99"])]
                lines.append([scene.title, str(radius), *figures, reached, *strains, base, inertia])
    return _markdown(lines)


def table(results: Results) -> str:
    """A line per scene and schedule."""
    lines = [["scene", "schedule", "radius / ℓ", *QUANTITIES.values(), "strain p99", "CPU s", "failed", "seeds"]]
    for scene in results.family:
        for schedule in results.schedules:
            found = {quantity: results.values(scene, schedule, quantity) for quantity in QUANTITIES}
            if not found["gap"]:
                continue
            rows = [row for row in results.rows if (row["scene"], row["schedule"]) == (scene.name, schedule)]
            cells = [str(summary(quantity)(list(values.values()))) for quantity, values in found.items()]
            strain, seconds, failed = (np.mean([row[name] for row in rows]) for name in ("strain_p99", "cpu_s", "failed"))
            figures = [f"{strain:.1%}", f"{seconds:.0f}", f"{failed:.0%}", str(len(rows))]
            lines.append([scene.title, NAMES[schedule], f"{rows[0]['ratio']:.2f}", *cells, *figures])
    return _markdown(lines)


def _markdown(lines: list[list[str]]) -> str:
    return "\n".join("| " + " | ".join(line) + " |" for line in [lines[0], ["---"] * len(lines[0]), *lines[1:]])


def comparisons(results: Results) -> str:
    """Fine15 and Ours against Fine48: scene by scene, then scenes where the rule has Fine15 fall behind, and the others."""
    groups = {scene.title: [scene] for scene in results.family}
    groups["Fine15 shorter than ℓ"] = [scene for scene in results.family if fine15_ratio(scene) < 1]
    groups["Fine15 longer"] = [scene for scene in results.family if fine15_ratio(scene) >= 1]
    lines = []
    for name, scenes in groups.items():
        for quantity, title in QUANTITIES.items():
            for schedule in ("fine15", "ours"):
                found = results.behind(scenes, schedule, "fine48", quantity)
                if found is not None:
                    sign = "-" if quantity in SIGNED else "/"
                    lines.append(f"{name:22} {title:30} {NAMES[schedule]} {sign} Fine48: {found}")
    return "\n".join(lines)


def fine15_ratio(scene: Hanging) -> float:
    """Radius of Fine15 over ℓ."""
    return 15 * scene.edge / scene.reach


def write_csv(path: Path, results: Results) -> None:
    """Every run with its seed."""
    columns = ["scene", "schedule", "seed", "ratio", "updates", "cpu_s", "gap", "gap_p95", "L_total", "gradient_norm", "rg"]
    columns += ["strain_p99", "unconverged", "failed"]
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, extrasaction="ignore")
    writer.writeheader()
    writer.writerows(results.rows)
    write_atomically(path, text.getvalue().encode())


def draw(results: Results, path: Path) -> None:
    """Four panels: decay, γ against the radius, γ and gradient against Fine48's, losses against Fine48's."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    style: Any = {"font.size": 9.0, "axes.spines.top": False, "axes.spines.right": False, "legend.frameon": False}
    with rc_context(style):
        figure = Figure(figsize=(11.5, 8.0), layout="constrained")
        panels = figure.subplots(2, 2)
        _draw_decay(panels[0, 0], results)
        _draw_gap(panels[0, 1], results)
        _draw_behind(panels[1, 0], results, {"gap": "o", "gradient": "s"})
        panels[1, 0].set(title="γ (●) and gradient (□), times Fine48's with the same seed", yscale="log")
        panels[1, 0].axhline(1.0, color="#222222", linewidth=0.8)
        _draw_behind(panels[1, 1], results, {"loss": "o"})
        panels[1, 1].set(title="loss L_total, above Fine48's with the same seed [e0]")
        panels[1, 1].set_yscale("symlog", linthresh=1.0)
        panels[1, 1].axhline(0.0, color="#222222", linewidth=0.8)
    write_png(figure, path)


def _draw_decay(axes: Any, results: Results) -> None:
    axes.set_title("What an exact step makes of pins that are moved")
    for scene in _known(results):
        exact = results.exact[scene.name]
        distance, share = np.array(exact["distance"]) / scene.reach, np.array(exact["share"])
        order = np.argsort(distance)
        axes.plot(distance[order], share[order], ".", markersize=2.5, label=scene.title)
    line = np.linspace(0.0, 4.0, 50)
    axes.plot(line, np.exp(-line), color="#222222", linewidth=1.0, label="exp(−distance / ℓ)")
    axes.set(xlim=(0.0, 4.0), ylim=(1e-2, 1.3), yscale="log", xlabel="distance from the pins / ℓ")
    axes.set_ylabel("displacement / that of the pins")
    axes.legend(fontsize=7)


def _draw_gap(axes: Any, results: Results) -> None:
    axes.set_title("trained ●   exact within the radius ◇   pins unfelt beyond it –", fontsize=9)
    for scene in _known(results):
        floors = results.exact[scene.name]["floors"]
        radii = sorted(int(name) for name in floors if name.isdigit())
        ratios = [radius * scene.edge / scene.reach for radius in radii]
        axes.plot(ratios, [max(np.median(floors[str(radius)]), 1e-9) for radius in radii], color="#999999", linewidth=0.8)
        for radius in (15, 48):
            patch = results.exact[scene.name].get(f"patch{radius}")
            if patch is not None:
                height = min(max(patch["gap"], SHOWN[0]), SHOWN[1])  # beyond either end: at the edge
                axes.plot([radius * scene.edge / scene.reach], [height], "D", color="#222222", markerfacecolor="none")
        for schedule in results.schedules:
            _point(axes, results, scene, schedule)
    _legend(axes, results.schedules)
    axes.axvline(1.0, color="#222222", linewidth=0.8, linestyle=":")
    ends = (SHOWN[0] / 1.5, SHOWN[1] * 1.5)
    axes.set(xscale="log", yscale="log", ylim=ends, xlabel="radius / ℓ", ylabel="γ (own rollouts, median)")


def _known(results: Results) -> list[Hanging]:
    """Scenes that the solver has something to say about."""
    return [scene for scene in results.family if "floors" in results.exact.get(scene.name, {})]


def _point(axes: Any, results: Results, scene: Hanging, schedule: str) -> None:
    values = list(results.values(scene, schedule, "gap").values())
    if values:
        ratio = next(row["ratio"] for row in results.rows if (row["scene"], row["schedule"]) == (scene.name, schedule))
        _bar(axes, ratio, geometric_mean(values), COLOURS[schedule])


def _draw_behind(axes: Any, results: Results, markers: Mapping[str, str]) -> None:
    for scene in results.family:
        ratio = fine15_ratio(scene)
        for place, (quantity, marker) in enumerate(markers.items()):
            for schedule, shift in (("fine15", 0.95), ("ours", 1.03)):
                found = results.behind([scene], schedule, "fine48", quantity)
                if found is not None:
                    _bar(axes, ratio * (shift + 0.02 * place), found, COLOURS[schedule], marker, hollow=place > 0)
    axes.axvline(1.0, color="#222222", linewidth=0.8, linestyle=":")
    _legend(axes, ("fine15", "ours"))
    axes.set(xscale="log", xlabel="radius of Fine15 / ℓ   (left of 1 the rule has it fall behind)")


def _bar(axes: Any, x: float, found: Mean, colour: str, marker: str = "o", hollow: bool = False) -> None:
    if math.isfinite(found.low):
        axes.plot([x, x], [found.low, found.high], color=colour, linewidth=1.0, alpha=0.6)
    axes.plot([x], [found.value], marker, color=colour, markersize=5, markerfacecolor="none" if hollow else colour)


def _legend(axes: Any, schedules: Sequence[str]) -> None:
    for schedule in schedules:
        axes.plot([], [], "o", color=COLOURS[schedule], label=NAMES[schedule])
    axes.legend(fontsize=8)
