"""Does training longer help? γ of own rollouts against updates, along one run of ``trainer=long``, and where that leads.

    hood train model=edges trainer=long trainer.keep_at=[100,200,…] output=runs/edges
    python benchmarks/scaling.py measure edges=runs/edges passes=runs/passes --output outputs/scaling
    python benchmarks/scaling.py report --output outputs/scaling --picture docs/scaling.png

``measure`` runs ``hood evaluate`` on all weights that the runs have kept, at 1,000 and 4,400 vertices, on motions that no
training has seen; what is there already is not done again. CPU seconds are those of ``marks.csv`` (lines ``iteration,seconds``)
in the run's folder, where there is one. ``report`` prints a table, fits log γ against log updates, and says what the
line gives at ``--until`` updates, with the interval in which one further point is to be expected (Student, 95%): that of
the line alone, as if nothing else set a limit.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import t

from hood.evaluation.bootstrap import LEVEL, Estimate, pooled_interval
from hood.evaluation.table import ALL
from hood.media.bars import write_png

#: By resolution: garments, and frames of a rollout.
SIZES = {"1k": ("tshirt,trousers,dress,skirt", 60), "4k": ("dress_4k,skirt_4k", 30)}
MOTIONS = "walk_proud,dance_mixed"
COLOURS = ("#2a6fbb", "#c8503c", "#3f8f4f", "#8c5bb0", "#c98a1b")


@dataclass(frozen=True)
class Mark:
    """Weights that a run has kept."""

    run: str
    updates: int
    weights: Path
    cpu_s: float  # NaN where it is not known


class Line(NamedTuple):
    """log γ = intercept + slope · log updates, and what it gives elsewhere."""

    slope: Estimate
    forecast: Estimate


@dataclass(frozen=True)
class Point:
    """What was measured of a mark at a resolution."""

    run: str
    updates: int
    cpu_s: float
    size: str
    gap: Estimate
    gap_p95: Estimate
    strain_p99: float
    rg: float
    worn: float  # share of the frames
    L_total: float  # [J]
    gradient_norm: float  # [N]
    sound: float  # share of the rollouts
    states: int


def find_marks(name: str, folder: Path) -> list[Mark]:
    """By updates.

    Raises:
        SystemExit: nothing was kept there.
    """
    table = folder / "marks.csv"
    lines = [line.split(",") for line in table.read_text().split()] if table.exists() else []
    seconds = {int(updates): float(cpu_s) for updates, cpu_s in lines}
    paths = sorted((folder / "kept").glob("*.safetensors"))
    if not paths:
        raise SystemExit(f"{folder}: no kept/*.safetensors; train with trainer.keep_at=[100,200,…]")
    return [Mark(name, int(path.stem), path, seconds.get(int(path.stem), math.nan)) for path in paths]


def measure(mark: Mark, size: str, output: Path, kernels: str) -> None:
    """Evaluate the mark, or go on with what was begun."""
    folder = output / mark.run / f"{mark.updates:06d}" / size
    if not (folder / "table.json").exists():
        garments, frames = SIZES[size]
        command = [
            sys.executable,
            "-P",
            "-m",
            "hood.cli.main",
            "evaluate",
            f"models=[{mark.weights}]",
            f"garments=[{garments}]",
        ]
        command += [f"sequences=[{MOTIONS}]", f"num_frames={frames}", "gap_states=4", "gap_iterations=100"]
        command += [f"kernels={kernels}", f"output={folder}", f"resume={str((folder / 'config.yaml').exists()).lower()}"]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    note = {"run": mark.run, "updates": mark.updates, "cpu_s": mark.cpu_s if math.isfinite(mark.cpu_s) else None}
    (folder / "mark.json").write_text(json.dumps(note))


def read_points(output: Path) -> list[Point]:
    """By run, updates and resolution."""
    points = [_point(path.parent) for path in sorted(output.glob("*/*/*/mark.json")) if (path.parent / "table.json").exists()]
    return sorted(points, key=lambda point: (point.run, point.size, point.updates))


def _point(folder: Path) -> Point:
    note = json.loads((folder / "mark.json").read_text())
    lines = [
        json.loads(line) for path in sorted(folder.glob("rollouts.*.jsonl")) for line in path.read_text().splitlines() if line
    ]
    measured = [line["measured"] for line in lines if "measured" in line]
    groups = [[gap["gamma"] for gap in one["gaps"]] for one in measured]
    frames = [frame for one in measured for frame in one["frames"]]
    rows = json.loads((folder / "table.json").read_text())
    means = next((row for row in rows if row["garment"] == ALL), rows[-1])
    return Point(
        run=note["run"],
        updates=note["updates"],
        cpu_s=math.nan if note["cpu_s"] is None else note["cpu_s"],
        size=folder.name,
        gap=_estimate(groups, np.median),
        gap_p95=_estimate(groups, partial(np.quantile, q=0.95)),
        strain_p99=_median(frames, "strain_p99"),
        rg=_median(frames, "relative_gradient"),
        **{key: math.nan if means[key] is None else float(means[key]) for key in ("worn", "L_total", "gradient_norm", "sound")},
        states=sum(map(len, groups)),
    )


def _median(frames: Sequence[dict[str, Any]], key: str) -> float:
    values = [frame[key] for frame in frames if frame.get(key) is not None]
    return float(np.nanmedian(values)) if values else math.nan


def _estimate(groups: Sequence[Sequence[float]], statistic: Any) -> Estimate:
    pooled = np.concatenate([np.asarray(group) for group in groups])
    return Estimate(float(statistic(pooled)), *pooled_interval(groups, statistic))


def fit(updates: Sequence[int], gaps: Sequence[float], until: int) -> Line:
    """Least squares; intervals are NaN for two points, which leave nothing to judge the line by."""
    x, y = np.log(updates), np.log(gaps)
    count, centre = len(x), x.mean()
    spread = float(((x - centre) ** 2).sum())
    slope = float(((x - centre) * (y - y.mean())).sum() / spread)
    at = y.mean() + slope * (math.log(until) - centre)
    if count < 3:
        return Line(Estimate(slope, math.nan, math.nan), Estimate(math.exp(at), math.nan, math.nan))
    left = y - y.mean() - slope * (x - centre)
    error, times = math.sqrt(float((left**2).sum()) / (count - 2)), float(t.ppf((1 + LEVEL) / 2, count - 2))
    steep = times * error / math.sqrt(spread)
    beyond = times * error * math.sqrt(1 + 1 / count + (math.log(until) - centre) ** 2 / spread)
    return Line(
        Estimate(slope, slope - steep, slope + steep), Estimate(math.exp(at), math.exp(at - beyond), math.exp(at + beyond))
    )


def table(points: Sequence[Point]) -> str:
    """A line per run and mark."""
    titles = ("run", "updates", "CPU s", "vertices", "γ median", "γ 95th", "L_total [J]", "gradient norm [N]")
    titles += ("worn", "sound", "strain p99", "rg", "states")
    lines = [f"| {' | '.join(titles)} |", "|" + len(titles) * "---|"]
    for point in points:
        seconds = f"{point.cpu_s:,.0f}" if math.isfinite(point.cpu_s) else ""
        figures = [point.run, f"{point.updates:,}", seconds, point.size, _text(point.gap), _text(point.gap_p95)]
        figures += [f"{point.L_total:.3g}", f"{point.gradient_norm:.2g}", f"{point.worn:.0%}", f"{point.sound:.0%}"]
        lines.append("| " + " | ".join([*figures, f"{point.strain_p99:.1%}", f"{point.rg:.2g}", str(point.states)]) + " |")
    return "\n".join(lines)


def _text(estimate: Estimate) -> str:
    return f"{estimate.value:.2g} ({estimate.low:.2g}–{estimate.high:.2g})"


def forecasts(points: Sequence[Point], until: int) -> str:
    """A sentence per run, resolution and statistic."""
    lines = []
    for run, size in dict.fromkeys((point.run, point.size) for point in points):
        mine = [point for point in points if (point.run, point.size) == (run, size)]
        for name in ("gap", "gap_p95") if len(mine) > 1 else ():
            line = fit([point.updates for point in mine], [getattr(point, name).value for point in mine], until)
            where = f"{run}, {size}, {name}, {len(mine)} points over {mine[-1].updates / mine[0].updates:.0f}×"
            lines.append(f"{where}: updates^{_text(line.slope)}; at {until:,} updates {_text(line.forecast)}")
    return "\n".join(lines)


def draw(points: Sequence[Point], until: int, path: Path) -> None:
    """A panel per resolution: medians with their intervals, 95th percentiles hollow, the fit until the forecast."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    style: Any = {"font.size": 9.0, "axes.spines.top": False, "axes.spines.right": False, "legend.frameon": False}
    runs = list(dict.fromkeys(point.run for point in points))
    sizes = [size for size in SIZES if any(point.size == size for point in points)]
    with rc_context(style):
        figure = Figure(figsize=(5.8 * len(sizes), 4.6), layout="constrained")
        for axes, size in zip(figure.subplots(1, len(sizes), sharey=True, squeeze=False)[0], sizes, strict=True):
            for run, colour in zip(runs, COLOURS, strict=False):
                _draw_run(axes, [point for point in points if (point.run, point.size) == (run, size)], until, colour)
            axes.set(xscale="log", yscale="log", xlabel="updates", title=f"own rollouts, {size} vertices")
            axes.set_ylabel("γ: median ●, 95th percentile ○")
            axes.legend(fontsize=8)
    write_png(figure, path)


def _draw_run(axes: Any, points: Sequence[Point], until: int, colour: str) -> None:
    if not points:
        return
    updates = [point.updates for point in points]
    for name, face in (("gap", colour), ("gap_p95", "none")):
        estimates: list[Estimate] = [getattr(point, name) for point in points]
        label = points[0].run if name == "gap" else None
        axes.plot(updates, [one.value for one in estimates], "o", color=colour, markerfacecolor=face, markersize=5, label=label)
        if name == "gap":
            axes.vlines(updates, [one.low for one in estimates], [one.high for one in estimates], color=colour, alpha=0.5)
        if len(points) > 2:
            _draw_line(axes, updates, [one.value for one in estimates], until, colour, name == "gap")


def _draw_line(axes: Any, updates: Sequence[int], gaps: Sequence[float], until: int, colour: str, shaded: bool) -> None:
    ends = np.geomspace(updates[0], until, 40)
    lines = [fit(updates, gaps, end).forecast for end in ends]
    axes.plot(ends, [line.value for line in lines], color=colour, linewidth=0.9, linestyle="-" if shaded else ":")
    if shaded:
        axes.fill_between(
            ends, [line.low for line in lines], [line.high for line in lines], color=colour, alpha=0.1, linewidth=0
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("measure", "report"))
    parser.add_argument("runs", nargs="*", help="NAME=FOLDER of hood train")
    parser.add_argument("--output", type=Path, default=Path("outputs/scaling"))
    parser.add_argument("--sizes", nargs="+", choices=tuple(SIZES), default=list(SIZES))
    parser.add_argument("--kernels", default="auto")
    parser.add_argument("--until", type=int, default=150_000)
    parser.add_argument("--picture", type=Path)
    arguments = parser.parse_args()
    if arguments.what == "measure":
        for run in arguments.runs:
            name, _, folder = run.partition("=")
            for mark in find_marks(name, Path(folder)):
                for size in arguments.sizes:
                    measure(mark, size, arguments.output, arguments.kernels)
        return
    points = read_points(arguments.output)
    print(table(points))
    print(forecasts(points, arguments.until))
    if arguments.picture is not None:
        draw(points, arguments.until, arguments.picture)


if __name__ == "__main__":
    main()
