"""How near coarser meshes of a garment stay to it, and how much time they save: ``hood plan accuracy=5mm`` of many scenes.

    python benchmarks/levels.py                                    # 14 garments, three motions: about twenty minutes
    python benchmarks/levels.py --garments tank_4k skirt_12k --sequences plie
    python benchmarks/levels.py --output outputs/levels.json       # the rows as a file too

Every garment begins at rest on the still body of two windows of the motion, its start and its fastest moment, and takes 30
steps with the solver; so does each coarser mesh of it, and the garment itself at half the time step. A line per mesh: median
and 95th percentile [mm] of the distances from the garment at the end of the worse window, at the points that both have;
milliseconds of the processor of a frame of the garment and of the mesh, and how many times faster that is. ``60 fps`` is what
the length of a step changes, which no mesh can be asked to be nearer than. At the end, how many are within the accuracy.
"""

from __future__ import annotations

import argparse
import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from hood.app.settings.compose import load_config
from hood.studies.plan.choices import levels_of
from hood.studies.plan.plan import make_plan

STEMS = "tank tshirt longsleeve shorts trousers skirt dress".split()
GARMENTS = [f"{stem}_{size}" for size in ("4k", "12k") for stem in STEMS]
SEQUENCES = ["plie", "walk_proud", "dance_mixed"]
#: Half the time step of a motion at 30 frames a second, as ``hood plan`` names it.
SHORTER = "60 fps"


def rows_of(garment: str, sequence: str, accuracy: str, frames: int) -> list[dict[str, Any]]:
    """A row per coarser mesh and one of the shorter step: what it is, distances [mm], and milliseconds of a frame."""
    coarser = list(levels_of(garment))
    coarser = coarser[: coarser.index(garment)]
    parts = ",".join([*(f"mesh {name}" for name in coarser), SHORTER])
    own = load_config("plan", [f"accuracy={accuracy}", f"frames={frames}", f"parts=[{parts}]"])
    plan, _ = make_plan([f"garment={garment}", f"sequence={sequence}", "stepper=newton"], own)
    found = []
    for row in plan["rows"]:
        kept = {key: row[key] for key in ("part", "mm_p50", "mm", "ms", "saved")}
        found.append({"garment": garment, "sequence": sequence, **kept, "full_ms": row["ms"] / (1.0 - row["saved"])})
    return found


def line(row: dict[str, Any]) -> str:
    """A row as text."""
    numbers = row["mm_p50"], row["mm"], row["full_ms"], row["ms"], row["full_ms"] / row["ms"]
    return f"{row['garment']:16}{row['sequence']:14}{row['part']:18}" + "".join(f"{number:>9.1f}" for number in numbers)


def totals(rows: list[dict[str, Any]], limit: float) -> str:
    """How many meshes are within ``limit`` [mm], and how much faster those are."""
    meshes = [row for row in rows if row["part"] != SHORTER]
    within = [row for row in meshes if row["mm"] <= limit]
    half = sum(row["mm_p50"] <= limit for row in meshes)
    text = f"within {limit:g} mm: {len(within)} of {len(meshes)} meshes by the 95th percentile, {half} by the median"
    if not within:
        return text
    times = [row["full_ms"] / row["ms"] for row in within]
    return f"{text}; those {np.median(times):.1f} times as fast (median), least {min(times):.1f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--garments", nargs="+", default=GARMENTS, choices=GARMENTS, metavar="GARMENT")
    parser.add_argument("--sequences", nargs="+", default=SEQUENCES)
    parser.add_argument("--accuracy", type=float, default=5.0, help="mm")
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--output", type=Path, help="JSON file of the rows")
    arguments = parser.parse_args()
    print(f"{'garment':16}{'sequence':14}{'instead':18}{'mm p50':>9}{'p95':>9}{'full ms':>9}{'ms':>9}{'times':>9}")
    rows: list[dict[str, Any]] = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what scenes say of themselves
        for garment in arguments.garments:
            for sequence in arguments.sequences:
                found = rows_of(garment, sequence, f"{arguments.accuracy:g}mm", arguments.frames)
                rows += found
                print("\n".join(line(row) for row in found), flush=True)
    print(totals(rows, arguments.accuracy))
    if arguments.output is not None:
        arguments.output.parent.mkdir(parents=True, exist_ok=True)
        arguments.output.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
