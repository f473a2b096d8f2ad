"""Training recipes compared: accuracy of own rollouts against the time the training took.

    python benchmarks/recipes.py baseline --seeds 0 1 2     # the paper's settings beside trainer=fast, in a fifth of their time
    python benchmarks/recipes.py choices                    # trainer=fast with one of its choices taken back at a time
    python benchmarks/recipes.py passes                     # how many times a model looks at what it predicts
    python benchmarks/recipes.py ablations                  # Fine15, Fine48 and Ours with equal updates and with equal time
    python benchmarks/recipes.py levels                     # the small model with one, two and three levels
    python benchmarks/recipes.py shipped                    # both again, told what the potential asks of single vertices
    python benchmarks/recipes.py heads                      # one pass that predicts positions, or edges to solve positions from
    python benchmarks/recipes.py forces                     # forces, and steps of all vertices together under them
    python benchmarks/recipes.py unroll                     # losses that look at one, two and three steps, in equal time
    python benchmarks/recipes.py paper_head                 # the paper's own network, one choice of paper_fast taken back

Every run is ``hood train`` in a process of its own with one thread, ``--jobs`` of them side by side; its time is the CPU time
of that process, so that a busy machine changes nothing. Every finished run is evaluated by ``hood evaluate`` on motions it
was not trained on: γ of the states its own rollouts reach (median and 95th percentile), strain and rg. The command goes on
where it was stopped; runs that are done are not done again. The table is printed and written as ``SUITE.csv`` in ``--output``.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import statistics
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

SMALL = ("model=small",)
#: The small model's size, told what the potential asks of single vertices and taking a share of it: one pass of model=passes.
ONE_PASS = (*SMALL, "model.features=local", "model.output=local_steps")
#: The small model's size in the paper's parametrisation.
SMALL_PAPER = (
    "model=ours",
    "model.latent_dim=48",
    "model.schedule='2x(mesh+coarse0) 1x(coarse0+coarse1) 2x(coarse1+coarse2) 1x(coarse0+coarse1) 2x(mesh+coarse0)'",
)
PAPER_SCALE = 0.01  # of the paper's 150,000 iterations
EQUAL_UPDATES = 600
SHIPPED_UPDATES = 800

EVALUATION = ("garments=[tshirt,trousers,dress,skirt]", "num_frames=60", "gap_states=4", "gap_iterations=100")
COLUMNS = ("recipe", "seed", "updates", "cpu_s", "gap", "gap_p95", "strain_p99", "rg", "worn", "sound", "ms", "failed_at")


@dataclass(frozen=True)
class Recipe:
    """Settings of ``hood train`` under a name, and those of the ``hood evaluate`` that judges what comes of it."""

    name: str
    overrides: tuple[str, ...]
    evaluation: tuple[str, ...] = EVALUATION


def fast(name: str, updates: int, *overrides: str) -> Recipe:
    """``trainer=fast`` shortened to ``updates``; the horizon gets as long as in a full run, in the same share of it."""
    every = max(round(25 * updates / 2400), 1)
    return Recipe(name, ("trainer=fast", f"trainer.iterations={updates}", f"trainer.horizon.every={every}", *overrides))


def paper(name: str, *overrides: str) -> Recipe:
    """``trainer=paper`` with its whole schedule shortened alike."""
    return Recipe(name, (*overrides, "trainer=paper", f"trainer.time_scale={PAPER_SCALE}"))


UNAUGMENTED = ("data.sampling.piecewise_fraction=0.0", "data.sampling.random_yaw=false", "data.sampling.mirror=false")
SHORT = 100  # updates of trainer=fast: less than a fifth of the time of the paper's at PAPER_SCALE, on the same model

TWO_PASSES = "2x(mesh+coarse0) 1x(coarse0+coarse1) 2x(coarse1+coarse2) 1x(coarse0+coarse1) 2x(mesh+coarse0) | 1x(mesh)"
FIVE_PASSES = (
    "1x(mesh+coarse0) | 1x(coarse0+coarse1) 1x(mesh+coarse0) | 1x(coarse1+coarse2) 1x(coarse0+coarse1) 1x(mesh+coarse0) | "
    "1x(mesh+coarse0) | 2x(mesh)"
)
LEVELS = {
    "small1": "8x(mesh)",
    "small2": "2x(mesh+coarse0) 4x(coarse0+coarse1) 2x(mesh+coarse0)",
    "small3": "2x(mesh+coarse0) 1x(coarse0+coarse1) 2x(coarse1+coarse2) 1x(coarse0+coarse1) 2x(mesh+coarse0)",
}
#: The same network and features with edges as output.
EDGES = ("model=edges",)
EIGHT_PASSES = fast("8 passes, 11 steps", SHORT, "model=passes")

#: The same with corrections to the forces as output, in one pass and in several.
FORCES = ("model=forces",)
FOUR_PASSES = "1x(mesh+coarse0) | 1x(coarse0+coarse1) 1x(mesh+coarse0) | 1x(mesh) | 1x(mesh)"

#: The paper's network, narrower, by the trainer of paper_fast with its whole schedule shortened to 1,500 updates.
NARROW = ("model=fine15", "model.latent_dim=32", f"trainer.time_scale={PAPER_SCALE}")


#: After so short a training all cloth is torn before two seconds are over; a second tells the recipes apart.
ONE_SECOND = (EVALUATION[0], "num_frames=30", *EVALUATION[2:])


def head(name: str, *overrides: str) -> Recipe:
    """``experiment=paper_fast`` with a choice taken back; averaged weights as young as its own are in a longer run."""
    return Recipe(name, ("experiment=paper_fast", *NARROW, "trainer.ema_decay=0.99", *overrides), ONE_SECOND)


SUITES: dict[str, list[Recipe]] = {
    "baseline": [
        paper("paper throughout", *SMALL_PAPER, *UNAUGMENTED),
        paper("paper trainer", *SMALL),
        fast("fast, half as short", SHORT // 2, *SMALL),
        fast("fast, short", SHORT, *SMALL),
        fast("fast, batch of two, short", round(1.7 * SHORT), *SMALL, "trainer.batch_size=2", "trainer.schedule.warmup=10"),
        fast("fast", 5 * SHORT, *SMALL),
        paper("paper trainer, passes", "model=passes"),
        fast("fast, passes, short", SHORT // 2, "model=passes"),
        EIGHT_PASSES,
    ],
    "choices": [
        fast("fast, short", SHORT, *SMALL),
        fast("adam 1e-3", SHORT, *SMALL, "trainer.optimizer=adam", "trainer.learning_rate=1e-3"),
        fast("unscaled signal", SHORT, *SMALL, "trainer.signal=potential"),
        fast("horizon 5", SHORT, *SMALL, "trainer.horizon.maximum=5"),
        fast("no averaged weights", SHORT, *SMALL, "trainer.ema_decay=0.0"),
        fast("paper's features and output", SHORT, *SMALL_PAPER),
        fast("batch of one", 4 * SHORT, *SMALL, "trainer.batch_size=1"),
    ],
    "passes": [
        EIGHT_PASSES,
        fast("5 passes, 9 steps", SHORT, "model=passes", f"model.schedule='{FIVE_PASSES}'"),
        fast("2 passes, 9 steps", SHORT, "model=passes", f"model.schedule='{TWO_PASSES}'"),
        fast("1 pass, 9 steps", SHORT, "model=passes", f"model.schedule='{TWO_PASSES.replace(' |', '')}'"),
        fast("8 passes, adam 1e-3", SHORT, "model=passes", "trainer.optimizer=adam", "trainer.learning_rate=1e-3"),
    ],
    "ablations": [
        fast("fine15", EQUAL_UPDATES, *SMALL, "model.schedule=fine15"),
        fast("ours", EQUAL_UPDATES, *SMALL, "model.schedule=ours"),
        fast("fine48", EQUAL_UPDATES, *SMALL, "model.schedule=fine48"),
        fast("ours, equal time", round(0.92 * EQUAL_UPDATES), *SMALL, "model.schedule=ours"),
        fast("fine48, equal time", round(0.36 * EQUAL_UPDATES), *SMALL, "model.schedule=fine48"),
    ],
    "levels": [fast(name, EQUAL_UPDATES, *SMALL, f"model.schedule='{schedule}'") for name, schedule in LEVELS.items()],
    "shipped": [
        fast(f"{name}, one pass", SHIPPED_UPDATES, *ONE_PASS, f"model.schedule='{schedule}'")
        for name, schedule in ({name: name for name in ("fine15", "ours", "fine48")} | LEVELS).items()
    ],
    "heads": [
        fast("positions", 2 * SHORT, *ONE_PASS),
        fast("edges", 2 * SHORT, *EDGES),
        fast("edges, physical features", 2 * SHORT, *EDGES, "model.features=physical"),
    ],
    "forces": [
        fast("forces", 2 * SHORT, *FORCES),
        fast("forces, shorter", SHORT, *FORCES),
        fast("forces, 4 passes, shorter", SHORT, *FORCES, f"model.schedule='{FOUR_PASSES}'"),
    ],
    "unroll": [
        fast("one step", 233, *EDGES, "trainer.schedule.warmup=20", "trainer.ema_decay=0.98"),
        fast("two steps", 100, *EDGES, "trainer.unroll=2", "trainer.schedule.warmup=9", "trainer.ema_decay=0.954"),
        fast("three steps", 61, *EDGES, "trainer.unroll=3", "trainer.schedule.warmup=5", "trainer.ema_decay=0.926"),
    ],
    "paper_head": [
        head("paper_fast"),
        Recipe("paper", ("experiment=paper", *NARROW), ONE_SECOND),
        head("adam 3e-4", "trainer.optimizer=adam", "trainer.learning_rate=3e-4"),
        head("no whitening", "trainer.whitening=false"),
        head("plain potential", "trainer.signal=potential"),
        head("contact full at once", "trainer.collision.start=5e5"),
        head("noise of 3 mm", "data.sampling.noise=3e-3"),
        head("output near 0", "model.output_init=0.01"),
        head("no end where torn", "trainer.torn_strain=1.5"),
        head("horizon 5", "trainer.horizon.maximum=5"),
        head("local steps", "trainer.whitening=false", "model.features=local", "model.output=local_steps"),
    ],
}


def folder_of(output: Path, recipe: Recipe, seed: int) -> Path:
    return output / recipe.name.replace(", ", "-").replace(" ", "_").replace("'", "") / f"seed{seed}"


def hood(arguments: list[str], log: Path) -> tuple[int, float]:
    """Exit code and CPU seconds of one ``hood`` command with one thread; what it prints goes to ``log``."""
    with open(log, "ab") as sink:
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", "hood.cli.main", *arguments],
            stdout=sink,
            stderr=sink,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
        )
        _, status, usage = os.wait4(process.pid, 0)
    return os.waitstatus_to_exitcode(status), usage.ru_utime + usage.ru_stime


def run(recipe: Recipe, seed: int, output: Path, kernels: str) -> dict[str, object]:
    """Train and evaluate, as far as that is not done; the row of the table."""
    folder = folder_of(output, recipe, seed)
    folder.mkdir(parents=True, exist_ok=True)
    spent_path, log = folder / "cpu_seconds.json", folder / "log.txt"
    spent = json.loads(spent_path.read_text()) if spent_path.exists() else {"train": 0.0, "done": False}
    if not spent["done"]:
        resume = f"resume={str((folder / 'run' / 'checkpoint.pt').exists()).lower()}"
        more = [f"seed={seed}", "trainer.workers=0", f"trainer.kernels={kernels}", f"output={folder}/run", resume]
        arguments = ["train", *recipe.overrides, *more]
        code, seconds = hood(arguments, log)
        spent["train"] += seconds
        spent["done"] = code == 0
        spent_path.write_text(json.dumps(spent))
        if code:
            raise SystemExit(f"{recipe.name}, seed {seed}: hood train exited with {code}, see {log}")
    table = folder / "evaluation" / "table.json"
    if not table.exists():
        models = f"models=[{folder}/run/model.safetensors]"
        code, _ = hood(["evaluate", models, *recipe.evaluation, f"output={table.parent}"], log)
        if code:
            raise SystemExit(f"{recipe.name}, seed {seed}: hood evaluate exited with {code}, see {log}")
    row = next(row for row in json.loads(table.read_text()) if row["garment"] == "all")
    last = json.loads((folder / "run" / "metrics.jsonl").read_text().splitlines()[-1])
    return {"recipe": recipe.name, "seed": seed, "updates": last["iteration"], "cpu_s": spent["train"], **row}


def cell(value: object) -> str:
    return "-" if value is None else f"{value:.3g}" if isinstance(value, float) else str(value)


def report(rows: list[dict[str, object]], path: Path) -> None:
    """Every run, then the median over seeds of every recipe; the CSV holds the runs."""
    with open(path.with_suffix(".partial"), "w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)
    os.replace(path.with_suffix(".partial"), path)
    print("  ".join(title.rjust(28 if title == "recipe" else 10) for title in COLUMNS))
    for row in rows:
        print("  ".join(cell(row.get(title)).rjust(28 if title == "recipe" else 10) for title in COLUMNS))
    print("\nmedian over seeds (lowest to highest)")
    for name in dict.fromkeys(str(row["recipe"]) for row in rows):
        mine = [row for row in rows if row["recipe"] == name]
        gaps = [float(row["gap"]) if row.get("gap") is not None else float("inf") for row in mine]  # type: ignore[arg-type]
        seconds = statistics.median(float(row["cpu_s"]) for row in mine)  # type: ignore[arg-type]
        spread = f"({min(gaps):.3g} to {max(gaps):.3g}, {len(gaps)} seeds)"
        print(f"{name:>28}  {seconds:8.0f} s  γ {statistics.median(gaps):.3g} {spread}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("suite", choices=SUITES)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="runs side by side, one thread each")
    parser.add_argument("--kernels", choices=("torch", "compiled"), default="torch", help="of every training, see hood train")
    parser.add_argument("--only", nargs="+", default=None, help="names of recipes; all by default")
    parser.add_argument("--output", type=Path, default=Path("runs/recipes"))
    arguments = parser.parse_args()
    recipes = [recipe for recipe in SUITES[arguments.suite] if arguments.only is None or recipe.name in arguments.only]
    todo = [(recipe, seed) for seed in arguments.seeds for recipe in recipes]
    begin = time.monotonic()

    def one(pair: tuple[Recipe, int]) -> dict[str, object]:
        row = run(*pair, arguments.output, arguments.kernels)
        print(f"{time.monotonic() - begin:6.0f} s  {pair[0].name}, seed {pair[1]}: γ {cell(row.get('gap'))}", file=sys.stderr)
        return row

    with ThreadPoolExecutor(arguments.jobs) as pool:
        rows = list(pool.map(one, todo))
    report(rows, arguments.output / f"{arguments.suite}.csv")


if __name__ == "__main__":
    main()
