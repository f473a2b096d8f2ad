"""γ of models on one dress in five resolutions, of 300 to 48,000 vertices.

    python benchmarks/resolution.py edges quickstart                  # 300, 1k, 4k and 12k
    python benchmarks/resolution.py edges --sizes 300 48k --output outputs/resolution

The dress of 300 vertices is that of 1,000, triangulated anew; in that of 48,000 every face of the one of 12,000 is four. Each
is evaluated by ``hood evaluate`` in walk_proud and dance_mixed, 24 frames and four states each, on states of the model's own
rollouts.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from hood.assets.garment.garment import load_garment, save_garment
from hood.studies.envelope.extreme_garments import FAULTS

#: What a size is made of: a garment, and what is done to it.
SIZES = {
    "300": ("dress", "remesh", 300.0),
    "1k": ("dress", None, 0.0),
    "4k": ("dress_4k", None, 0.0),
    "12k": ("dress_12k", None, 0.0),
    "48k": ("dress_12k", "subdivide", 1.0),
}


def garment_of(size: str, folder: Path) -> str:
    """Name or file of the dress of a size."""
    name, fault, amount = SIZES[size]
    if fault is None:
        return name
    path = folder / f"dress_{size}.npz"
    if not path.exists():
        save_garment(path, FAULTS[fault](load_garment(name), amount, np.random.default_rng(0)))
    return str(path)


def evaluate(models: list[str], size: str, folder: Path) -> list[dict[str, Any]]:
    """Rows of ``hood evaluate``, one for each model."""
    settings = {
        "models": f"[{','.join(models)}]",
        "garments": f"[{garment_of(size, folder)}]",
        "sequences": "[walk_proud,dance_mixed]",
        "num_frames": 24,
        "gap_states": 4,
        "gap_iterations": 100,
        "output": folder / size,
    }
    command = [sys.executable, "-c", "from hood.cli.main import entry; entry()", "evaluate"]
    subprocess.run([*command, *(f"{key}={value}" for key, value in settings.items())], check=True, stdout=subprocess.DEVNULL)
    rows = json.loads((folder / size / "table.json").read_text())
    return [row for row in rows if row["garment"] != "all"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="+", help="names or files of models")
    parser.add_argument("--sizes", nargs="+", choices=list(SIZES), default=["300", "1k", "4k", "12k"])
    parser.add_argument("--output", type=Path, default=Path("outputs/resolution"))
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    print(f"{'model':24}{'size':>6}{'γ median':>10}{'95th':>8}{'strain p99':>12}{'ms':>8}")
    for size in arguments.sizes:
        for row in evaluate(arguments.models, size, arguments.output):
            gaps = f"{row['gap']:10.3f}{row['gap_p95']:8.3f}"
            print(f"{row['model']:24}{size:>6}{gaps}{100 * row['strain_p99']:11.1f}%{row['ms']:8.0f}", flush=True)


if __name__ == "__main__":
    main()
