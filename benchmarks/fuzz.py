"""Damaged and harmful files for every reader: a table of what became of them.

    nice python benchmarks/fuzz.py --count 10000 --seed 0

A file may be read, or refused by one ValueError or OSError of one line that names it. Anything else is a failure: other
exceptions, more than 10 s of the processor, more than 2 GB, a process that dies, commands, connections, files opened outside
the file's folder, answers that blame the memory, and harmful files that are read as if they were sound. Inputs are numbered;
an input depends on the seed and its number alone, ``--first N --count 1`` makes it again and ``--keep FOLDER`` keeps the
failing ones.

The files are read in processes of their own (``--worker``), each with limits on memory; one that dies costs one input.
"""

from __future__ import annotations

import argparse
import json
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from fuzz_hostile import hostile
from fuzz_inputs import Sample, damage, encode, rollout, samples

import hood
from hood.app.settings.compose import CONFIG_FOLDER
from hood.assets.identify import identify
from hood.testing import cylinder

MEMORY, SECONDS = 2 << 30, 10
#: Inputs of one process; the limit on memory counts from what it used before the first.
CHUNK = 2000
#: Seconds without an answer after which a process is given up: a reader that never comes back to Python.
PATIENCE = 600
_HARMFUL = (
    "os.system", "os.exec", "os.posix_spawn", "os.fork", "subprocess.Popen", "socket.connect", "socket.getaddrinfo",
    "shutil.rmtree", "urllib.Request", "ctypes.dlopen",
)  # fmt: skip
#: Endings of which every harmful file must be refused; other texts may be odd and yet sound.
_REFUSED = ("pkl", "pth", "npz", "h5", "gltf", "safetensors")


class Slow(BaseException):
    """Raised when a reader has used up its time."""


class Watch:
    """Python's own record of what a reader does besides reading its file."""

    def __init__(self, folder: Path) -> None:
        self.seen: list[str] = []
        self.on = False
        own = (folder, Path(hood.__file__).parent, CONFIG_FOLDER, sys.prefix, sys.base_prefix)
        self._allowed = tuple(map(str, own))
        sys.addaudithook(self._hear)

    def _hear(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self.on:
            return
        if event in _HARMFUL:
            self.seen.append(event)
        elif event == "open" and isinstance(arguments[0], (str, bytes)):
            name = arguments[0].decode(errors="replace") if isinstance(arguments[0], bytes) else arguments[0]
            if not name.startswith(self._allowed):
                self.seen.append(f"open {name}")


def make_input(number: int, seed: int, sample: Sample, mark: Path, outside: Path) -> tuple[str, bytes]:
    """How an input was made (damaged, changed or harmful), and its bytes."""
    rng = np.random.default_rng([seed, number])
    evil = hostile(sample, mark, outside) if rng.random() < 0.2 else []
    if evil:
        return "harmful", evil[rng.integers(len(evil))]
    fields = not isinstance(sample.content, bytes)
    changed = fields and rng.random() < 0.5
    data = encode(sample.suffix, sample.content, rng if changed else None)
    if not fields or not changed or rng.random() < 0.5:
        return "damaged", damage(data, rng)
    return "changed", data


def attempt(path: Path, read: Callable[[Path], Any], names_file: bool) -> tuple[bool, str | None]:
    """Whether ``read`` refused the file, and what is wrong with how it dealt with it; None: nothing."""
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        read(path)
    except (ValueError, OSError) as error:
        return True, _wrong_answer(error, path, names_file)
    except Slow:
        return True, f"more than {SECONDS} s"
    except BaseException:
        return True, traceback.format_exc(limit=-4)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
    return False, None


def _wrong_answer(error: Exception, path: Path, names_file: bool) -> str | None:
    text, named = str(error), str(getattr(error, "filename", ""))
    if "\n" in text:
        return f"several lines: {text!r}"
    if len(text) > 1000:
        return f"{len(text)} characters: {text[:200]!r}"
    names = (path.stem, "config.yaml") if path.suffix == ".yaml" else (path.stem,)
    if names_file and not any(name in text or name in named for name in names):
        return f"does not name the file: {text!r}"
    return f"memory: {text!r}" if "MemoryError" in text or "allocate" in text else None


def work(first: int, last: int, seed: int, folder: Path) -> None:
    """Read the inputs ``first`` to ``last``; prints a line of JSON for each."""
    outside, inputs = folder / "outside.h5", folder / "inputs"
    inputs.mkdir()
    outside.write_bytes(rollout(*cylinder(6, 3)))
    mark = folder / "executed"
    warnings.simplefilter("ignore")

    def ring(*_: Any) -> None:
        raise Slow

    signal.signal(signal.SIGPROF, ring)  # processor time: other work on the machine does not count
    files = samples(inputs)
    for sample in files:  # everything is imported and sound before the limits fall
        path = inputs / f"sound.{sample.suffix}"
        path.write_bytes(encode(sample.suffix, sample.content))
        refused, wrong = attempt(path, sample.read, sample.names_file)
        if wrong or (refused and sample.reader != "run record"):
            raise SystemExit(f"the sound {sample.suffix} file of {sample.reader} is not read: {wrong}")
        path.unlink()
    _limit_memory()
    watch = Watch(inputs)
    for number in range(first, last):
        sample = files[number % len(files)]
        kind, data = make_input(number, seed, sample, mark, outside)
        path = inputs / f"input{number}.{sample.suffix}"
        path.write_bytes(data)
        watch.on, begin = True, time.process_time()
        refused, wrong = attempt(path, sample.read, sample.names_file)
        seconds = time.process_time() - begin
        if wrong is None and sample.names_file and sample.suffix != "yaml":
            _, wrong = attempt(path, lambda file: identify(str(file)), True)
        watch.on = False
        if watch.seen or mark.exists():
            wrong = f"executed or opened {watch.seen or mark}"
            watch.seen.clear()
            mark.unlink(missing_ok=True)
        if wrong is None and kind == "harmful" and sample.suffix in _REFUSED and not refused:
            wrong = "a harmful file was read"
        name = f"{sample.reader} {sample.suffix}"
        print(json.dumps([number, name, kind, refused, round(seconds, 3), wrong]), flush=True)
        if wrong is None:
            path.unlink()


def _limit_memory() -> None:
    """Let the process take :data:`MEMORY` more than it has."""
    status = Path("/proc/self/status").read_text().splitlines()
    used = int(next(line for line in status if line.startswith("VmSize")).split()[1])
    resource.setrlimit(resource.RLIMIT_AS, (used * 1024 + MEMORY, resource.RLIM_INFINITY))


def answers(first: int, last: int, seed: int, keep: Path | None) -> Iterator[list[Any]]:
    """The lines of the processes that read the inputs; one that dies leaves a line that says so."""
    while first < last:
        until = min(last, first + CHUNK)
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, __file__, "--worker", folder, "--first", str(first), "--count", str(until - first)]
            worker = subprocess.Popen([*command, "--seed", str(seed)], stdout=-1, stderr=-1, text=True)
            try:
                out, said = worker.communicate(timeout=PATIENCE)
            except subprocess.TimeoutExpired:
                worker.kill()
                out, said = worker.communicate()
            rows = [json.loads(line) for line in out.splitlines() if line.startswith("[")]
            if not rows and worker.returncode == 1:
                raise SystemExit(said)
            yield from rows
            first += len(rows)
            if first < until:
                yield [first, "?", "?", True, 0.0, f"the process ended with {worker.returncode}: {said[-500:]}"]
                first += 1
            if keep is not None:
                for path in (Path(folder) / "inputs").glob("input*"):
                    keep.mkdir(parents=True, exist_ok=True)
                    (keep / path.name).write_bytes(path.read_bytes())


def table(rows: list[list[Any]]) -> str:
    """Markdown: inputs by reader, what became of them, and the slowest."""
    lines = ["| reader | inputs | read | refused | failures | slowest s |", "|---|---|---|---|---|---|"]
    for name in [*sorted({row[1] for row in rows}), "all"]:
        mine = [row for row in rows if name in ("all", row[1])]
        known = Counter("failures" if row[5] else "refused" if row[3] else "read" for row in mine)
        figures = [len(mine), known["read"], known["refused"], known["failures"], max(row[4] for row in mine)]
        lines.append(f"| {name} | {' | '.join(map(str, figures))} |")
    return "\n".join(lines)


def main() -> int:
    """Returns 1 where an input failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--worker", type=Path, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.worker is not None:
        work(asked.first, asked.first + asked.count, asked.seed, asked.worker)
        return 0
    rows = list(answers(asked.first, asked.first + asked.count, asked.seed, asked.keep))
    failures = [row for row in rows if row[5]]
    print(table(rows))
    for row in failures:
        print(f"\n{row[0]} {row[1]} ({row[2]}): {row[5]}")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
