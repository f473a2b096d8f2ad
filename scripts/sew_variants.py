"""Random variants of the own designs, sewn into a folder of garments to train on (``hood train data.patterns=FOLDER``).

    python scripts/sew_variants.py outputs/sewn --count 40
    python scripts/sew_variants.py outputs/dresses --count 10 --designs dress swing shift --seed 1

Designs take turns. Options are drawn between the least and the most that a design allows, those near its default most often.
Variant k of a seed is the same whatever the count; what is not sewn well is left out, and the next one is drawn. A garment that
is there is not sewn anew, so the same command goes on where it was stopped.
"""

from __future__ import annotations

import argparse
import contextlib
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hood.app.settings.compose import shown
from hood.assets.garment.garment import load_garment
from hood.assets.pattern.designs import DESIGNS
from hood.cli.main import main as run_hood

#: Draws for a garment, on the average, before it is given up: more fail only where none can be sewn, as with edges too long.
_DRAWS = 5


def draw_options(design: str, seed: int, number: int) -> dict[str, float | str]:
    """Options of variant ``number`` of a seed."""
    rng = np.random.default_rng([seed, number])
    chosen: dict[str, float | str] = {}
    for key, known in DESIGNS[design].options.items():
        if isinstance(known[0], str):
            chosen[key] = str(rng.choice(known))
        else:
            default, least, most = (float(one) for one in known)
            chosen[key] = round(float(rng.triangular(least, default, most)), 3)
    return chosen


def sew(design: str, options: dict[str, float | str], edge: float, target: Path) -> str:
    """Sew a garment; why it is not there afterwards, nothing where it is."""
    text = io.StringIO()
    words = ["sew", f"design:{design}", f"design={shown(options)}", f"edge={edge:g}", f"output={target}", "sheet=none"]
    with contextlib.redirect_stdout(text), contextlib.redirect_stderr(text):
        run_hood(words)
    target.with_suffix(".unsewn.obj").unlink(missing_ok=True)
    return "" if target.exists() else (text.getvalue().strip().splitlines() or ["not sewn"])[-1]


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="where the garments go")
    parser.add_argument("--count", type=int, default=40, help="garments")
    parser.add_argument("--designs", nargs="+", default=list(DESIGNS), choices=list(DESIGNS), metavar="DESIGN")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--edge", type=float, default=0.035, help="m, length of the mesh's edges: about 1,000 vertices")
    chosen = parser.parse_args(arguments)
    chosen.folder.mkdir(parents=True, exist_ok=True)
    made = 0
    for number in range(_DRAWS * chosen.count):
        if made == chosen.count:
            break
        design = chosen.designs[number % len(chosen.designs)]
        options, target = draw_options(design, chosen.seed, number), chosen.folder / f"{number:03d}_{design}.npz"
        fault = "" if target.exists() else sew(design, options, chosen.edge, target)
        made += not fault
        said = fault or f"{len(load_garment(target).rest_pos):,} vertices"
        print(f"{target.name}: {shown(options)}: {said}", flush=True)
    print(f"{made} of {chosen.count} garments in {chosen.folder}")
    return 0 if made == chosen.count else 1


if __name__ == "__main__":
    raise SystemExit(main())
