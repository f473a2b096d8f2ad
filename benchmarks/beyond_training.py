"""A network where it was not trained: on a finer mesh, at rest for long, and under ten times the gravity, beside the solver.

    python benchmarks/beyond_training.py edges              # a name that ships, or model.safetensors of a run
    python benchmarks/beyond_training.py edges small-ours --parts mesh gravity

- ``mesh``: the dress of 12,000 vertices in walk_proud, strain at frame 10. A network that does not let the long waves go leaves
  such a dress hanging in the air, with too little strain.
- ``rest``: the dress of 1,000 vertices on a body that stands still, 1,000 frames: how the strain goes after frame 100.
- ``gravity``: the same dress in walk_proud under 10 g, the median over 60 frames.

Strain is the 99th percentile over the edges (``strain_p99``), in per cent.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch

import hood
from hood.assets.files.library import locate

_PARTS = ("mesh", "rest", "gravity")


def strains(model: str, garment: str, motion: str, frames: int, **keys: Any) -> np.ndarray:
    """Strain [%] of the frames (F,) that ``model``, ``newton`` for the solver, makes."""
    stepper: dict[str, Any] = {"stepper": "newton"} if model == "newton" else {"checkpoint": model, "refine": 0}
    rollout = hood.simulate(
        garment, motion, num_frames=frames, cloth_contact="off", metrics="strain", guard="off", **stepper, **keys
    )
    return 100 * np.array([frame.metrics["strain_p99"] for frame in rollout])


def still(folder: Path, frames: int) -> str:
    """A file of the first pose of walk_proud, held."""
    with np.load(locate("motions", "walk_proud")) as motion:
        values = {name: motion[name] for name in motion.files}
    for name in ("poses", "trans"):
        values[name] = np.repeat(values[name][:1], frames * 4, axis=0)  # to last at any frame rate up to 120
    path = folder / "still.npz"
    np.savez(path, **values)
    return str(path)


def slope(values: np.ndarray, begin: int = 100) -> float:
    """Percentage points per 100 frames of the line through ``values`` (F,) from ``begin`` on."""
    return 100 * float(np.polyfit(np.arange(begin, len(values)), values[begin:], 1)[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="+", help="names or files of models")
    parser.add_argument("--parts", nargs="+", choices=_PARTS, default=_PARTS)
    parser.add_argument("--frames", type=int, default=1000, help="of the rest")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    for model in (*arguments.models, "newton"):
        if "mesh" in arguments.parts:
            values = strains(model, "dress_12k", "walk_proud", 11)
            print(f"{model}: 12,000 vertices, frame 10: {values[10]:.2f}%", flush=True)
        if "gravity" in arguments.parts:
            values = strains(model, "dress", "walk_proud", 60, gravity=98.1)
            print(f"{model}: 10 g: {statistics.median(values):.1f}%, worst frame {values.max():.1f}%", flush=True)
        if "rest" in arguments.parts:
            with tempfile.TemporaryDirectory() as folder:
                values = strains(model, "dress", still(Path(folder), arguments.frames), arguments.frames)
            shown = ", ".join(f"{values[n]:.2f}" for n in (0, 100, 400, len(values) - 1) if n < len(values))
            print(
                f"{model}: at rest: {shown}% (frames 0, 100, 400, last), {slope(values):+.3f} points per 100 frames", flush=True
            )


if __name__ == "__main__":
    main()
