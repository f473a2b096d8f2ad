"""All that is to be known about frames on one GPU, in one call of eight minutes: networks and solver at 1k to 50k vertices.

    python benchmarks/gpu.py --minutes 8 --csv gpu.csv
    python benchmarks/gpu.py --device-specs h100            # without a GPU: computed, from that one's data sheet

The embedded dress, refined to the given number of vertices, on the embedded body of 6,890 vertices, walking. States are those
of a rollout of the solver. Every job (``benchmarks/gpu_frames.py``) is a process of its own with a limit of time. They come in
the order of their importance, until the minutes are over; rows are printed and written to the CSV file after each. A job that
fails or does not end in time is a line like any other; what was left out is said at the end. Columns:

``way``       of a network: ``plain``; ``captured``: fixed shapes, one CUDA graph; ``fused``: the same with the network's
              steps in Triton; ``compiled``: that by torch.compile. Of the solver, with so many Newton iterations: ``plain``;
              ``captured``: a graph for each of its pieces; ``compiled``: all of them one function through torch.compile. A
              network with ``× 8`` takes the step of so many garments at once.
``ms``        of a frame, search included, metrics not: median of wall-clock time between two waits for the device, ways taking
              turns state by state.
``floor ms``  what the frame's kernels take at least, one after the other: for each the longest of the gap between two kernels,
              its bytes over the bandwidth, its operations over their rate (``benchmarks/roofline.py``). On a
              GPU all of these constants are measured first, in this very run; else they are those of ``--device-specs``.
``share``     floor / ms: how near the frame is to the roofline.
``kernels``   of the traced frame, views not counted; of fused and compiled rows those before fusion.
``launches``  calls of the CUDA runtime that start something.
``MB``        of the device's memory that the first frame takes beyond scene and weights, what it keeps included.
``gamma``     median gap of the step's positions to the minimum of the potential, see :mod:`hood.evaluation.gap`.

Without a GPU everything but kernels, bytes, operations and gamma is computed, and marked so: ``ms`` is the floor then.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from gpu_frames import COMPILED, SOLVER, Row
from roofline import DATA_SHEETS, Device

from hood.cli.main import ENVIRONMENT

#: How a job is begun.
COMMAND = (sys.executable, str(Path(__file__).with_name("gpu_frames.py")))
#: Newton iterations, and garments at once at the smallest size.
ITERATIONS, COUNTS = (1, 2, 5, 10), (8, 64)
COLUMNS = ("vertices", "method", "precision", "way", "time is", "ms", "floor ms", "share", "kernels", "launches", "MB", "GB",
           "GFLOP", "GB/s", "GFLOP/s", "gamma")  # fmt: skip
Job = tuple[int, str, str]


def cells(row: Row) -> list[str]:
    share, rate = row.floor_ms / row.ms, f"{1e3 * row.gigabytes / row.ms:,.0f}"
    launches, megabytes = ("–" if value is None else f"{value:,.0f}" for value in (row.launches, row.megabytes))
    return [f"{row.vertices:,}", row.method, row.precision, row.way, row.source, f"{row.ms:.2f}",
            f"{row.floor_ms:.2f}", f"{share:.2f}", f"{row.kernels:,}", launches, megabytes, f"{row.gigabytes:.2f}",
            f"{row.gflop:.1f}", rate, f"{1e3 * row.gflop / row.ms:,.0f}", f"{row.gamma:.2g}"]  # fmt: skip


class Table:
    """Rows as they come: on the screen, and in a file that is whole at any moment."""

    def __init__(self, path: Path | None) -> None:
        self.path, self.rows = path, list[Row]()
        print(f"| {' | '.join(COLUMNS)} |\n" + "|---" * len(COLUMNS) + "|", flush=True)

    def add(self, row: Row) -> None:
        self.rows.append(row)
        print(f"| {' | '.join(cells(row))} |", flush=True)
        if self.path is not None:
            temporary = self.path.with_name(self.path.name + ".partial")
            with temporary.open("w", newline="", encoding="utf-8") as file:
                writer = csv.DictWriter(file, list(asdict(row)))
                writer.writeheader()
                writer.writerows(map(asdict, self.rows))
            os.replace(temporary, self.path)

    def fail(self, job: Job, why: str) -> None:
        """A line without numbers."""
        size, method, choice = job
        line = [f"{size:,}", method, choice, "–", why.replace("|", "/"), *["–"] * (len(COLUMNS) - 5)]
        print(f"| {' | '.join(line)} |", flush=True)


def crossover(rows: list[Row]) -> list[str]:
    """At every size, the fastest network against the solver with no larger gap."""
    sentences = []
    for size in sorted({row.vertices for row in rows}):
        own = [row for row in rows if row.vertices == size]
        networks = [row for row in own if not row.method.startswith(SOLVER)]
        if not networks:
            continue
        best = min(networks, key=lambda row: row.ms)
        as_good = [row for row in own if row.method.startswith(SOLVER) and row.gamma <= best.gamma]
        said = f"{size:,} vertices: {best.method} ({best.precision}, {best.way}) {best.ms:.2f} ms at gamma {best.gamma:.2g}"
        if as_good:
            rival = min(as_good, key=lambda row: row.ms)
            said += f"; {rival.method} {rival.ms:.2f} ms at gamma {rival.gamma:.2g}"
            said += ": the solver wins" if rival.ms < best.ms else ": the network wins"
        elif any(row.method.startswith(SOLVER) for row in own):
            said += "; no row of the solver is as near to the minimum"
        else:
            said += "; no row of the solver"
        sentences.append(said)
    return sentences


def jobs(sizes: list[int], models: list[str], on_gpu: bool) -> list[Job]:
    """Size, model or solver, and what :func:`gpu_frames.rows_of_job` chooses by; what matters most comes first."""
    first: list[Job] = []
    for size in sizes:
        first += [(size, models[0], "fp32"), (size, SOLVER, "5")]
    if on_gpu:
        first += [(sizes[0], method, COMPILED) for method in (*models[:2], SOLVER)]
        first += [(min(sizes), models[0], str(count)) for count in COUNTS]
    rest: list[Job] = []
    for size in sizes:
        rest += [(size, model, "fp32") for model in models[1:]]
        rest += [(size, SOLVER, str(count)) for count in ITERATIONS if count != 5]
    last = [(size, model, precision) for size in sizes for model in models for precision in ("bf16", "tf32")]
    return first + rest + last


def ask(words: Sequence[str], limit: float) -> tuple[list[Any], str]:
    """What a job printed, until it ended or ``limit`` seconds were over, and what went wrong."""
    job = subprocess.Popen(
        [*COMMAND, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        out, err = job.communicate(timeout=max(limit, 1.0))
        said = err.strip().splitlines() or ["nothing said"]
        why = f"exit code {job.returncode}: {said[-1][:200]}" if job.returncode else ""
    except BaseException as error:  # of a session of its own: what it has begun itself would go on
        with suppress(ProcessLookupError):
            os.killpg(job.pid, signal.SIGKILL)
        out, _ = job.communicate()
        if not isinstance(error, subprocess.TimeoutExpired):
            raise
        why = f"not done after {limit:.0f} s"
    return [json.loads(line) for line in out.splitlines() if line.endswith(("}", "null"))], why


def run(args: argparse.Namespace) -> int:
    """The exit code: 1 where a job has failed."""
    until = time.monotonic() + 60 * args.minutes
    found, why = ask(["constants"], min(args.limit, 60 * args.minutes))
    if why:
        print(f"the constants of the GPU could not be measured: {why}", file=sys.stderr)
        return 1
    on_gpu = found[0] is not None
    device = Device(**found[0]) if on_gpu else DATA_SHEETS[args.device_specs]
    rates = ", ".join(f"{name} {1e-12 * rate:.0f} TFLOP/s" for name, rate in device.matmul.items())
    origin = "measured" if on_gpu else "data sheet and assumptions; all times below are computed"
    gaps = f"{1e6 * device.launch:.1f} µs from kernel to kernel, {1e6 * device.replay:.1f} µs within a graph"
    print(f"{device.name} ({origin}): {1e-12 * device.bandwidth:.2f} TB/s, {rates}, {gaps}\n")
    table, failed, left = Table(args.csv), 0, []
    with tempfile.TemporaryDirectory() as kept:
        for job in jobs(args.sizes, args.models, on_gpu):
            remains = until - time.monotonic()
            if remains < 1:
                left.append("{1} {2} at {0:,}".format(*job))
                continue
            words = [*map(str, job), "--device", json.dumps(asdict(device)), "--kept", kept]
            rows, why = ask(words, min(args.limit, remains))
            for row in rows:
                table.add(Row(**row))
            if why:
                failed += 1
                table.fail(job, why)
    print("\n" + "\n".join(crossover(table.rows)))
    if left:
        print(f"\nleft out after {args.minutes:g} minutes: {', '.join(left)}")
    return int(failed > 0)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=8.0)
    parser.add_argument("--limit", type=float, default=150.0, help="seconds of a job at most")
    parser.add_argument("--sizes", type=int, nargs="+", default=[4400, 1000, 12000, 50000])
    parser.add_argument("--models", nargs="+", default=["quickstart", "small-ours", "small-fine15"], help="embedded weights")
    parser.add_argument("--device-specs", choices=sorted(DATA_SHEETS), default="h100", help="computed for it without a GPU")
    parser.add_argument("--csv", type=Path, default=None)
    args = parser.parse_args()
    os.environ.update({key: os.environ.get(key, value) for key, value in ENVIRONMENT.items()})  # read at process start only
    return run(args)


if __name__ == "__main__":
    sys.exit(main())
