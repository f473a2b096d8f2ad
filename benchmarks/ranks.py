"""Throughput of training with one process and with several, one batch in all: ``python benchmarks/ranks.py --ranks 1 2 4``.

Every run is ``hood train`` under torchrun with one thread per process; the batch is the same, so that the runs do the same
updates. They take turns, ``--rounds`` times; the medians are printed. On fewer cores than processes there is nothing to gain.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path


def measure(ranks: int, batch_size: int, iterations: int, options: list[str]) -> float:
    """Iterations per second after the first half, from the log of the run."""
    with tempfile.TemporaryDirectory() as folder:
        arguments = [
            "train", f"trainer.batch_size={batch_size}", f"trainer.iterations={iterations}", f"output={folder}/run",
            "trainer.log_every=1", f"trainer.checkpoint_every={iterations}", "trainer.workers=0", *options,
        ]  # fmt: skip
        launcher = [sys.executable, "-P", "-m"]
        if ranks > 1:
            launcher += ["torch.distributed.run", "--standalone", "--nproc-per-node", str(ranks), "-m"]
        environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONSAFEPATH": "1"}
        result = subprocess.run([*launcher, "hood.cli.main", *arguments], env=environment, capture_output=True, text=True)
        if result.returncode:
            sys.exit(result.stderr[-2000:])
        lines = [json.loads(line) for line in (Path(folder) / "run" / "metrics.jsonl").read_text().splitlines()]
    # Seconds since the start of the loop, by its own clock; the first half warms up.
    seconds = {line["iteration"]: line["iteration"] / line["iterations_per_second"] for line in lines}
    half = iterations // 2
    return (iterations - half) / (seconds[iterations] - seconds[half])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ranks", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--batch-size", type=int, default=4, help="scenes per update, over all processes")
    parser.add_argument("--iterations", type=int, default=20)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("options", nargs="*", help="more settings of hood train, e.g. model=ours data.garments=[dress]")
    arguments = parser.parse_args()
    rates: dict[int, list[float]] = {ranks: [] for ranks in arguments.ranks}
    for _ in range(arguments.rounds):
        for ranks, values in rates.items():
            values.append(measure(ranks, arguments.batch_size, arguments.iterations, arguments.options))
    first = statistics.median(rates[arguments.ranks[0]])
    print(f"batch {arguments.batch_size}, {' '.join(arguments.options) or 'defaults'}, {os.cpu_count()} cores")
    print(f"{'processes':>9}  {'it/s':>7}  {'scenes/s':>8}  {'speed-up':>8}  lowest to highest it/s")
    for ranks, values in rates.items():
        rate = statistics.median(values)
        spread = f"{min(values):.3f} to {max(values):.3f}"
        print(f"{ranks:>9}  {rate:>7.3f}  {rate * arguments.batch_size:>8.2f}  {rate / first:>8.2f}  {spread}")


if __name__ == "__main__":
    main()
