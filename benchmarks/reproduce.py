"""Points of a chart measured again: does the command that stands beside a point give its figures?

    python benchmarks/reproduce.py outputs/tradeoff --points 6

Points are taken evenly from ``points.json``; each one's command runs as it is printed, one after another with one thread, into
a folder of its own. Printed is whether median γ, its 95th percentile and the median time fall into the chart's confidence
intervals. Run it where the chart was made, if models were given by relative paths. γ of the same machine and version should be
the same number.

A machine is not equally fast at all hours. So a setting of the solver alone, the yardstick of its size, is timed before and
after each point, and the point's time is held against the chart as measured and divided by what the yardstick takes now as a
multiple of what it took then (``ms_scaled``).
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

FIGURES = ("gap", "gap_p95", "ms", "ms_scaled")


def chosen(rows: Sequence[Mapping[str, Any]], count: int) -> list[Mapping[str, Any]]:
    """``count`` of the rows, evenly."""
    measured = [row for row in rows if row["gap"] is not None]
    count = min(count, len(measured))
    return [measured[round(i * (len(measured) - 1) / max(count - 1, 1))] for i in range(count)]


def yardstick(rows: Sequence[Mapping[str, Any]], size: str) -> Mapping[str, Any] | None:
    """The solver alone at the middle of its iteration counts; None where the chart has no such point of this size."""
    alone = sorted((row for row in rows if row["size"] == size and row["model"] == "guess"), key=lambda row: row["refine"])
    return alone[len(alone) // 2] if alone else None


def measured_again(row: Mapping[str, Any], *overrides: str) -> Mapping[str, Any]:
    """The row over all garments of the table that the point's command writes; ``overrides`` take the place of its own keys."""
    replaced = {override.split("=")[0] for override in overrides}
    words = [word for word in shlex.split(row["command"])[1:] if word.split("=")[0] not in replaced]
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "again"
        command = [sys.executable, "-P", "-m", "hood.cli.main", *words, *overrides, f"output={folder}"]
        done = subprocess.run(command, env=os.environ | {"OMP_NUM_THREADS": "1"}, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"{row['setting']}: exit code {done.returncode}\n{done.stderr[-2000:]}")
        table = json.loads((folder / "table.json").read_text())
    found: Mapping[str, Any] = next(line for line in table if line["garment"] == "all")
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("chart", type=Path, help="folder that hood tradeoff wrote")
    parser.add_argument("--points", type=int, default=6)
    arguments = parser.parse_args()
    measured = json.loads((arguments.chart / "points.json").read_text())
    rows = chosen(measured, arguments.points)
    verdicts: dict[str, list[bool]] = {name: [] for name in FIGURES}
    for row in rows:
        rule = yardstick(measured, row["size"])
        before = measured_again(rule, "gap_states=0")["ms"] if rule else None
        again = dict(measured_again(row))
        text = []
        if rule:
            slower = 0.5 * (before + measured_again(rule, "gap_states=0")["ms"]) / rule["ms"]
            again["ms_scaled"] = again["ms"] / slower
        for name in [name for name in FIGURES if name in again]:
            key = name.removesuffix("_scaled")
            low, high = row[f"{key}_low"], row[f"{key}_high"]
            within = None not in (low, high) and low <= again[name] <= high
            verdicts[name].append(within)
            ends = " to ".join("?" if end is None else f"{end:.3g}" for end in (low, high))
            text.append(f"{name} {row[key]:.3g} ({ends}) now {again[name]:.3g}{'' if within else ' OUTSIDE'}")
        if rule:
            text.append(f"yardstick {slower:.2f} times as long")
        print(f"{row['size']:>4} {row['setting']:<28} {'; '.join(text)}", flush=True)
    print(", ".join(f"{name}: {sum(inside)} of {len(inside)} inside" for name, inside in verdicts.items()))


if __name__ == "__main__":
    main()
