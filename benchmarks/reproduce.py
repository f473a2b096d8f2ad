"""Points of a chart measured again: does the command that stands beside a point give its figures?

    python benchmarks/reproduce.py outputs/tradeoff --points 6

Points are taken evenly from ``points.json``; each one's command runs as it is printed, one after another with one thread, into
a folder of its own. Printed is whether median γ, its 95th percentile and the median time fall into the chart's confidence
intervals. Run it where the chart was made, if models were given by relative paths. γ of the same machine and version should be
the same number; times say how far the machine can be trusted.
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

FIGURES = ("gap", "gap_p95", "ms")


def chosen(rows: Sequence[Mapping[str, Any]], count: int) -> list[Mapping[str, Any]]:
    """``count`` of the rows, evenly."""
    measured = [row for row in rows if row["gap"] is not None]
    count = min(count, len(measured))
    return [measured[round(i * (len(measured) - 1) / max(count - 1, 1))] for i in range(count)]


def measured_again(row: Mapping[str, Any], folder: Path) -> Mapping[str, Any]:
    """The row over all garments of the table that the point's command writes."""
    words = shlex.split(row["command"])
    command = [sys.executable, "-m", "hood.cli", *words[1:], f"output={folder}"]
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
    inside = dict.fromkeys(FIGURES, 0)
    rows = chosen(json.loads((arguments.chart / "points.json").read_text()), arguments.points)
    for row in rows:
        with tempfile.TemporaryDirectory() as folder:
            again = measured_again(row, Path(folder) / "again")
        text = []
        for name in FIGURES:
            low, high = row[f"{name}_low"], row[f"{name}_high"]
            within = None not in (low, high) and low <= again[name] <= high
            inside[name] += within
            ends = " to ".join("?" if end is None else f"{end:.3g}" for end in (low, high))
            text.append(f"{name} {row[name]:.3g} ({ends}) now {again[name]:.3g}{'' if within else ' OUTSIDE'}")
        print(f"{row['size']:>4} {row['setting']:<28} {'; '.join(text)}", flush=True)
    print(", ".join(f"{name}: {count} of {len(rows)} inside" for name, count in inside.items()))


if __name__ == "__main__":
    main()
