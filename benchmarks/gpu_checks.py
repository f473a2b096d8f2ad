"""What must hold on a GPU, shown by hood's commands: the CPU's positions, the same bits twice, contact of layers, trainings.

    python benchmarks/gpu_checks.py --minutes 5 --csv gpu_checks.csv

Every check is one or more commands in processes of their own. What fails or does not end in its time is a line like any other;
lines come in the order of their importance, each printed and written to the CSV file at once. Columns: what was found, the
bound that it is held to (none: it is measured only), whether it holds, and the seconds that the commands took.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch

from hood.rollouts.file.reader import read_rollout

#: How a command of hood begins, and the device that is checked.
COMMAND = (sys.executable, "-P", "-m", "hood.cli.main")
DEVICE = "cuda"
SHORT = ("num_frames=10", "video=none", "sheet=false", "settle=paper", "fail_on=nothing")
#: One frame: a network's errors of rounding grow tenfold a frame while cloth falls into place.
ONE = (*SHORT, "num_frames=2")
NETWORK = ("rollout", "garment=tshirt", "checkpoint=quickstart", "refine=0", "kernels=torch", *ONE)
#: To where both devices find the same minimum: by default a step ends some micrometres from it.
SOLVER = ("rollout", "garment=tshirt", "stepper=newton", "solver.target_rg=1e-5", *SHORT)
REFINED = ("rollout", "garment=tshirt", "checkpoint=quickstart", "refine=2", "kernels=torch", *ONE)
OUTFIT = ("rollout", "garment=[tank,skirt]", "sequence=plie", "stepper=newton", *SHORT, "num_frames=4")
TRAINING = ("train", "trainer.statistics_iterations=10", "trainer.iterations=60", "trainer.log_every=10")
PAPER = (*TRAINING, "experiment=paper_fast", "trainer.schedule.every=60", "trainer.horizon.every=20",
         "trainer.collision.begin_iteration=20", "trainer.collision.end_iteration=40")  # fmt: skip
QUICK = (*TRAINING, "experiment=quickstart")
EVALUATION = (
    "evaluate",
    "models=[quickstart,newton]",
    "garments=[tshirt]",
    "num_frames=10",
    "gap_states=2",
    "gap_iterations=20",
)


class Failed(Exception):
    """A command did not end well; says how."""


@dataclass(frozen=True)
class Line:
    """A check and what came of it."""

    check: str
    found: str
    bound: str
    holds: str  # yes, no, or nothing
    seconds: float


class Commands:
    """Runs commands, each into a folder of its own, and keeps what they wrote: no command runs twice under a name."""

    def __init__(self, folder: Path, until: float, limit: float) -> None:
        self._folder, self._until, self._limit, self._done = folder, until, limit, set[str]()

    def run(self, name: str, *words: str) -> Path:
        """The folder that a command wrote to.

        Raises:
            Failed: it could not be begun or ended in time, or its exit code is not 0.
        """
        place = self._folder / name.replace(" ", "_")
        if name in self._done:
            return place
        left = min(self._limit, self._until - time.monotonic())
        if left < 1:
            raise Failed("no time left")
        try:
            done = subprocess.run(
                [*COMMAND, *words, f"output={place}"], capture_output=True, text=True, timeout=left, check=False
            )
        except subprocess.TimeoutExpired:
            raise Failed(f"not done after {left:.0f} s") from None
        if done.returncode:
            raise Failed(f"exit code {done.returncode}: {(done.stderr.strip().splitlines() or ['nothing said'])[-1][:200]}")
        self._done.add(name)
        return place


def apart(first: Path, second: Path) -> float:
    """Greatest distance [m] of vertices of two rollouts; NaN where one is not finite."""
    a, b = (read_rollout(folder / "rollout.h5").cloth_pos for folder in (first, second))
    return float(np.abs(np.asarray(a, np.float64) - np.asarray(b, np.float64)).max())


def rate(folder: Path) -> float:
    """Updates a second in the second half of a training: without its statistics, its search for kernels and its graphs."""
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    half, last = lines[len(lines) // 2 - 1], lines[-1]
    spent = [line["iteration"] / line["iterations_per_second"] for line in (half, last)]
    return (last["iteration"] - half["iteration"]) / (spent[1] - spent[0])


Check = tuple[str, float | None, str, Callable[[Commands], float]]


def same_as_cpu(words: Sequence[str], name: str, step: str = "step=plain") -> Callable[[Commands], float]:
    def check(commands: Commands) -> float:
        # A CPU has no graphs: there the same shapes are taken operation by operation.
        on_cpu = step.replace("captured", "fixed")
        # The compiled solver takes other steps of its linear systems, on the way to other minima where there are several.
        engine = ["solver.engine=torch"] if "stepper=newton" in words and on_cpu == "step=plain" else []
        there = commands.run(f"{name} {step}", *words, step, f"device={DEVICE}")
        return apart(commands.run(f"{name} {on_cpu} cpu", *words, on_cpu, *engine, "device=cpu"), there)

    return check


def same_twice(words: Sequence[str], name: str, step: str = "step=plain") -> Callable[[Commands], float]:
    def check(commands: Commands) -> float:
        places = [commands.run(f"{name} {step}{again}", *words, step, f"device={DEVICE}") for again in ("", " again")]
        return apart(*places)

    return check


def layers_as_on_cpu(commands: Commands) -> float:
    """Relative difference of the number of contacts of cloth with cloth: from the last bit on, such cloth goes other ways."""
    both = []
    for device in ("cpu", DEVICE):
        place = commands.run(f"outfit {device}", *OUTFIT, f"device={device}")
        told = json.loads((place / "summary.json").read_text())["cloth_contact"]
        if told["used"] != "on" or told["crossed_pairs_max"]:
            raise Failed(f"contact of layers on {device}: {told}")
        both.append(told["contacts_max"])
    return abs(both[1] - both[0]) / both[0]


def trained(words: Sequence[str], name: str, *more: str) -> Callable[[Commands], float]:
    return lambda commands: rate(commands.run(f"{name} {' '.join(more)}", *words, *more, f"device={DEVICE}"))


def learned_alike(words: Sequence[str], name: str) -> Callable[[Commands], float]:
    """Greatest relative difference of the total energy in the first ten updates that change weights."""

    def check(commands: Commands) -> float:
        both = []
        for step in ("plain", "captured"):
            place = commands.run(f"{name} trainer.step={step}", *words, f"trainer.step={step}", f"device={DEVICE}")
            both.append(json.loads((place / "metrics.jsonl").read_text().splitlines()[1])["total"])
        return abs(both[1] - both[0]) / abs(both[0])

    return check


def evaluated(commands: Commands) -> float:
    began = time.monotonic()
    commands.run("evaluation", *EVALUATION, f"device={DEVICE}")
    return time.monotonic() - began


#: Name, bound, unit, and what finds the number.
CHECKS: list[Check] = [
    ("network, from the CPU's", 1e-5, "m", same_as_cpu(NETWORK, "network")),
    ("network captured, from the CPU's", 1e-5, "m", same_as_cpu(NETWORK, "network", "step=captured")),
    ("paper's network, updates", None, "1/s", trained(PAPER, "paper", "trainer.step=plain")),
    ("paper's network, captured updates", None, "1/s", trained(PAPER, "paper", "trainer.step=captured")),
    ("paper's network, captured from plain", 1e-2, "of the energy", learned_alike(PAPER, "paper")),
    ("solver, from the CPU's", 1e-6, "m", same_as_cpu(SOLVER, "solver")),
    ("contacts of the layers of an outfit, from the CPU's", 0.05, "of them", layers_as_on_cpu),
    ("network captured, twice", 0.0, "m", same_twice(NETWORK, "network", "step=captured")),
    ("solver, twice", 0.0, "m", same_twice(SOLVER, "solver")),
    ("evaluation", None, "s", evaluated),
    ("quickstart, updates of four scenes", None, "1/s", trained(QUICK, "quick", "trainer.step=plain")),
    ("quickstart, captured updates", None, "1/s", trained(QUICK, "quick", "trainer.step=captured")),
    ("paper's network in bf16, updates", None, "1/s", trained(PAPER, "paper", "trainer.step=plain", "trainer.precision=bf16")),
    ("paper's network in bf16, captured updates", None, "1/s",
     trained(PAPER, "paper", "trainer.step=captured", "trainer.precision=bf16")),
    ("solver captured, from the CPU's", 1e-6, "m",
     same_as_cpu((*SOLVER, "metrics=none", "guard=off"), "solver", "step=captured")),
    ("refinement captured, from the CPU's", 1e-5, "m",
     same_as_cpu((*REFINED, "metrics=none", "guard=off"), "refinement", "step=captured")),
]  # fmt: skip


def run(minutes: float, limit: float, path: Path | None, checks: Sequence[Check] = CHECKS) -> list[Line]:
    """All checks that the time allows, at most ``limit`` seconds a command."""
    lines: list[Line] = []
    print("| check | found | bound | holds | s |\n|---|---|---|---|---|", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        commands = Commands(Path(folder), time.monotonic() + 60 * minutes, limit)
        for name, bound, unit, check in checks:
            began = time.monotonic()
            try:
                value = check(commands)
                found = f"{value:.3g} {unit}"
                holds = "" if bound is None else "yes" if value <= bound else "no"
            except (Failed, OSError, ValueError, KeyError, IndexError) as error:
                found, holds = str(error).replace("|", "/") or type(error).__name__, "" if bound is None else "no"
            shown = "" if bound is None else f"{bound:g} {unit}"
            lines.append(Line(name, found, shown, holds, round(time.monotonic() - began, 1)))
            print(f"| {' | '.join(str(value) for value in asdict(lines[-1]).values())} |", flush=True)
            if path is not None:
                temporary = path.with_name(path.name + ".partial")
                with temporary.open("w", newline="", encoding="utf-8") as file:
                    writer = csv.DictWriter(file, list(asdict(lines[0])))
                    writer.writeheader()
                    writer.writerows(map(asdict, lines))
                os.replace(temporary, path)
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--limit", type=float, default=90.0, help="seconds of one command")
    parser.add_argument("--csv", type=Path, default=None)
    args = parser.parse_args()
    if not torch.cuda.is_available():
        raise SystemExit("gpu_checks.py needs a GPU that torch sees; benchmarks/gpu.py computes times without one")
    run(args.minutes, args.limit, args.csv)


if __name__ == "__main__":
    main()
