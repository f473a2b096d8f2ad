"""Commands that are killed at random moments and go on: does what they leave come out as if nothing had happened?

    nice python benchmarks/kills.py --kills 100 --seed 0

Every command runs once undisturbed; that says what it makes and how long it takes. Then it runs in another folder and is
killed (SIGKILL, with its children) at a moment drawn anew each time; it is started again, to go on where it can
(``resume=true``), killed again, and left alone in the end. After every kill the files that are there must open: rollouts,
weights, garments, tables and pictures. At the end all of them must be as in the undisturbed run, but for times. A table counts
kills by command, and by whether there were files already; failures say what was wrong.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import load_file

from hood.rollouts.file.reader import read_rollout

#: Files of this ending are half written, and no results.
PARTIAL = ".partial"
#: A command that is left alone may take so long [s].
PATIENCE = 900.0
#: Kills in a row before a command is left alone.
ROW = 4
#: What depends on the time, in names of columns and metrics.
TIMED = ("ms", "seconds", "fps", "time", "date")

SHORT = ("garment=tank", "stepper=refine", "refine=2", "video=none")
MOTIONS = ("walk_proud", "dance_mixed", "plie", "twist_and_bend")


@dataclass(frozen=True)
class Case:
    """A command of ``hood``; ``{out}`` is where it writes."""

    name: str
    arguments: tuple[str, ...]
    again: tuple[str, ...] = ()  # further arguments from the second start on


CASES = (
    Case(
        "train",
        ("train", "model=small", "trainer=fast", "trainer.iterations=8", "trainer.checkpoint_every=2", "data.garments=[tank]",
         "trainer.workers=0", "trainer.kernels=torch", "output={out}"),
        ("resume=true",),
    ),
    Case("rollout of one", ("rollout", *SHORT, f"sequence={MOTIONS[0]}", "num_frames=20", "output={out}")),
    Case(
        "rollout of many",
        ("rollout", *SHORT, "sequence={out}/../motions.txt", "num_frames=8", "output={out}"),
        ("resume=true",),
    ),
    Case(
        "evaluate",
        ("evaluate", "models=[guess+2]", "garments=[tank,shorts]", f"sequences=[{','.join(MOTIONS)}]", "num_frames=6",
         "gap_states=1", "gap_iterations=20", "output={out}"),
        ("resume=true",),
    ),
    Case("prepare", ("prepare", "garment=dress", "output={out}/dress.npz")),
    Case("envelope", ("envelope", "models=[newton,guess+1]", "factors=[turn]", "garments=[tank]", "output={out}")),
)  # fmt: skip


def start(case: Case, folder: Path, again: bool) -> subprocess.Popen[bytes]:
    """The command in a process group of its own; what it prints goes to ``printed`` beside its folder."""
    given = [*case.arguments, *(case.again if again else ())]
    texts = [text.replace("{out}", str(folder)) for text in given]
    with (folder.parent / "printed").open("ab") as printed:
        return subprocess.Popen(
            [sys.executable, "-P", "-m", "hood.cli.main", *texts],
            stdout=printed,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
        )


def finish(case: Case, folder: Path, again: bool) -> float:
    """Run it to its end; its seconds.

    Raises:
        RuntimeError: it failed; says how.
    """
    began = time.monotonic()
    process = start(case, folder, again)
    code = process.wait(timeout=PATIENCE)
    if code not in (0, 3):
        printed = (folder.parent / "printed").read_text(errors="replace").splitlines()
        raise RuntimeError(f"exit code {code}: {printed[-1] if printed else 'nothing printed'}")
    return time.monotonic() - began


def kill_at(case: Case, folder: Path, again: bool, seconds: float) -> bool:
    """Whether it was still running then."""
    process = start(case, folder, again)
    try:
        process.wait(timeout=seconds)
        return False
    except subprocess.TimeoutExpired:
        for child in children(process.pid):  # in sessions of their own
            os.kill(child, signal.SIGKILL)
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        return True


def children(pid: int) -> Iterator[int]:
    """Processes that it has started, and theirs."""
    listed = Path(f"/proc/{pid}/task/{pid}/children")
    for child in map(int, listed.read_text().split()) if listed.exists() else ():
        yield child
        yield from children(child)


def results(folder: Path) -> list[Path]:
    """Files that the command has left and that are to open; event files of tensorboard are named by the second."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and PARTIAL not in path.name)
    return [path for path in files if path.parent.name != "tensorboard"]


def fingerprint(path: Path) -> str:
    """Of what is in a file, but for times.

    Raises:
        ValueError, OSError, KeyError: it does not open.
    """
    read = READERS.get(path.name, READERS.get(path.suffix))
    return "" if read is None else hashlib.sha256(repr(read(path)).encode()).hexdigest()


def _rollout(path: Path) -> Any:
    data = read_rollout(path)
    metrics = {name: values.tobytes() for name, values in data.metrics.items() if not timed(name)}
    return data.cloth_pos.tobytes(), sorted(metrics.items())


def _weights(path: Path) -> Any:
    return sorted((name, values.tobytes()) for name, values in load_file(path).items())


def _arrays(path: Path) -> Any:
    with np.load(path, allow_pickle=False) as file:
        return sorted((name, file[name].tobytes()) for name in file.files)


def _json(path: Path) -> Any:
    return timeless(json.loads(path.read_text()))


def _lines(path: Path) -> Any:
    """The last line may have been cut off: whoever goes on drops it."""
    lines = path.read_text().splitlines()
    whole = [line for line in lines[:-1] if line]
    return [timeless(json.loads(line)) for line in whole] + [_last(lines)]


def _last(lines: list[str]) -> Any:
    try:
        return timeless(json.loads(lines[-1])) if lines and lines[-1] else None
    except ValueError:
        return None


def _picture(path: Path) -> Any:
    content = path.read_bytes()
    if not content.endswith(b"IEND\xaeB`\x82"):
        raise ValueError("a picture without an end")
    return content


#: By name or ending; files of others have to be there, and are not looked into.
READERS: dict[str, Callable[[Path], Any]] = {
    "rollout.h5": _rollout,
    ".safetensors": _weights,
    ".npz": _arrays,
    "table.json": _json,
    "envelope.json": _json,
    "metrics.jsonl": _lines,
    ".png": _picture,
}


def timed(name: str) -> bool:
    """Whether a column or a metric is a time."""
    return any(part in TIMED for part in name.replace("_", " ").replace(".", " ").split())


def timeless(value: Any) -> Any:
    """Without entries that are times, folders or commands with folders in them; NaN equals itself."""
    if isinstance(value, dict):
        return {key: timeless(one) for key, one in value.items() if not timed(key) and not placed(key)}
    if isinstance(value, list):
        return [timeless(one) for one in value]
    return "nan" if isinstance(value, float) and math.isnan(value) else value


def placed(key: str) -> bool:
    """Keys whose values name a folder, or count what went on in a second."""
    return key in ("command", "output", "said", "reasons", "iterations_per_second")


def judge(case: Case, kills: int, rng: random.Random, counts: Counter[str], scratch: Path) -> list[str]:
    """Kill the command so many times; sentences on what went wrong."""
    whole = prepare(scratch / case.name.replace(" ", "_"), 0)
    duration = finish(case, whole, False)
    expected = {path.relative_to(whole): fingerprint(path) for path in results(whole)}
    wrong, done, turn = [], 0, 0
    while done < kills:
        turn += 1
        folder, again = prepare(scratch / case.name.replace(" ", "_"), turn), False
        for _ in range(min(ROW, kills - done)):
            if kill_at(case, folder, again, duration * rng.uniform(0.1, 1.0)):
                done += 1
                counts["with files" if results(folder) else "before"] += 1
                wrong += [f"turn {turn}: {text}" for text in damage(folder)]
            again = bool(case.again) and any(folder.iterdir())
        try:
            finish(case, folder, again)
        except RuntimeError as error:
            wrong.append(f"turn {turn}: {error}")
            continue
        found = {path.relative_to(folder): fingerprint(path) for path in results(folder)}
        wrong += [f"turn {turn}: {name} {verb}" for name, verb in differences(expected, found)]
        wrong += [f"turn {turn}: {path} was left" for path in folder.rglob(f"*{PARTIAL}*")]
    return wrong


def prepare(folder: Path, turn: int) -> Path:
    """An empty folder, beside a list of motions."""
    made = folder / str(turn) / "out"
    made.mkdir(parents=True)
    (made.parent / "motions.txt").write_text("\n".join(MOTIONS) + "\n")
    return made


def damage(folder: Path) -> Iterator[str]:
    """Files that do not open."""
    for path in results(folder):
        try:
            fingerprint(path)
        except (ValueError, OSError, KeyError) as error:
            yield f"{path.relative_to(folder)} does not open: {error}"


def differences(expected: dict[Path, str], found: dict[Path, str]) -> Iterator[tuple[Path, str]]:
    """Names of files and what is wrong with them."""
    for name in sorted(expected.keys() | found.keys()):
        if name not in found:
            yield name, "is missing"
        elif name in expected and expected[name] != found[name]:
            yield name, "is another one"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=100, help="of all commands together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cases", nargs="+", choices=[case.name for case in CASES], default=[case.name for case in CASES])
    parser.add_argument("--keep", type=Path, help="folder for what the commands write; else a temporary one")
    arguments = parser.parse_args()
    rng, failures = random.Random(arguments.seed), 0
    chosen = [case for case in CASES if case.name in arguments.cases]
    with tempfile.TemporaryDirectory() as temporary:
        scratch = arguments.keep or Path(temporary)
        print(f"{'command':18} kills  before the first file  with files  failures")
        for index, case in enumerate(chosen):
            kills = arguments.kills * (index + 1) // len(chosen) - arguments.kills * index // len(chosen)
            counts: Counter[str] = Counter()
            wrong = judge(case, kills, rng, counts, scratch)
            print(f"{case.name:18} {kills:5} {counts['before']:21} {counts['with files']:11} {len(wrong):9}", flush=True)
            for text in wrong:
                print(f"  {text}", flush=True)
            failures += len(wrong)
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
