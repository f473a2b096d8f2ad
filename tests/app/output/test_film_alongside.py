"""Films that are drawn while frames are simulated: the files of those drawn afterwards, and nothing left of unfinished ones."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from hood.app.output import view

Image = pytest.importorskip("PIL.Image")
pytestmark = pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="only Linux says how many threads there are")

WORDS = ("garment=tank", "sequence=jumps", "num_frames=8", "video=png", "picture={width:160,height:90}", "output=out")
#: A command whose process has one thread and two processors.
COMMAND = """
import os, sys
import hood.app.output.view as view
import hood.app.rollout as rollout
from hood.cli.main import entry
from hood.native import build

build.start = lambda: None  # else a thread compiles, where nothing is compiled yet
view.processors = lambda: 2

def drawn_afterwards(*given):
    raise AssertionError("drawn afterwards")
"""


def started(folder: Path, lines: str, *words: str) -> subprocess.Popen[str]:
    folder.mkdir(exist_ok=True)
    code = f"{COMMAND}\n{lines}\nentry({['rollout', *WORDS, *words]})"
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen([sys.executable, "-P", "-c", code], cwd=folder, env=environment, text=True, **pipes)


def run(folder: Path, lines: str, *words: str) -> subprocess.CompletedProcess[str]:
    process = started(folder, lines, *words)
    out, err = process.communicate(timeout=120)
    return subprocess.CompletedProcess(process.args, process.returncode, out, err)


def pictures(folder: Path) -> dict[str, np.ndarray]:
    files = sorted([*folder.glob("out/rollout_png/*.png"), folder / "out" / "contact_sheet.png"])
    return {file.name: np.asarray(Image.open(file)) for file in files}


@pytest.fixture(scope="module")
def afterwards(tmp_path_factory: pytest.TempPathFactory) -> dict[str, np.ndarray]:
    """Of a process with one processor."""
    folder = tmp_path_factory.mktemp("afterwards")
    done = run(folder, "view.processors = lambda: 1")
    assert done.returncode == 0, done.stderr
    return pictures(folder)


def same(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> bool:
    return one.keys() == other.keys() and all(np.array_equal(one[name], other[name]) for name in one)


def lives(process: str) -> bool:
    """Whether a process does anything; one that nobody has asked about stays in the table."""
    try:
        return " Z " not in Path("/proc", process, "stat").read_text()
    except OSError:
        return False


def test_they_are_those_drawn_afterwards(tmp_path: Path, afterwards: dict[str, np.ndarray]) -> None:
    done = run(tmp_path, "rollout.draw = drawn_afterwards")
    assert done.returncode == 0, done.stderr
    assert len(afterwards) == 9
    assert same(pictures(tmp_path), afterwards)
    assert not list(tmp_path.glob("out/.*"))


def test_where_the_cloth_moves_the_cameras_they_are_drawn_afterwards(tmp_path: Path, afterwards: dict[str, np.ndarray]) -> None:
    other_eyes = "from hood.media.film import Film\nFilm.sees_as = lambda self, other: False"
    done = run(tmp_path, other_eyes)
    assert done.returncode == 0, done.stderr
    assert same(pictures(tmp_path), afterwards)
    assert run(tmp_path / "again", f"{other_eyes}\nrollout.draw = drawn_afterwards").returncode == 1


def test_where_the_system_forgets_processes_all_files_are_there(tmp_path: Path, afterwards: dict[str, np.ndarray]) -> None:
    done = run(tmp_path, "import signal\nsignal.signal(signal.SIGCHLD, signal.SIG_IGN)")
    assert done.returncode == 0, done.stderr
    assert same(pictures(tmp_path), afterwards)
    assert not list(tmp_path.glob("out/*.state"))


def test_a_group_that_is_asked_to_end_leaves_no_film(tmp_path: Path) -> None:
    process = started(tmp_path, "os.setpgid(0, 0)\nprint('GROUP', flush=True)", "num_frames=200")
    assert process.stdout is not None
    while not list(tmp_path.glob("out/.rollout_png.partial/*")) and process.poll() is None:
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGTERM)
    process.communicate()
    end = time.monotonic() + 20
    while (left := list(tmp_path.glob("out/.rollout_png.partial"))) and time.monotonic() < end:
        time.sleep(0.05)
    assert not left


def test_a_rollout_that_is_interrupted_leaves_no_film_and_no_process(tmp_path: Path) -> None:
    done = run(
        tmp_path,
        """
tell = view.FilmAlongside.tell
def interrupted(self):
    tell(self)
    if self._process is not None and not hasattr(self, "first"):
        self.first = print("PROCESS", self._process)
    elif hasattr(self, "first"):
        raise KeyboardInterrupt
view.FilmAlongside.tell = interrupted
""",
    )
    assert done.returncode == 130, done.stderr
    assert not list(tmp_path.glob("out/*png*"))
    assert not list(tmp_path.glob("out/.*.partial"))
    process = next(line.split()[1] for line in done.stdout.splitlines() if line.startswith("PROCESS"))
    assert not Path("/proc", process).exists()


def test_a_process_that_is_killed_takes_the_other_with_it(tmp_path: Path) -> None:
    process = started(
        tmp_path,
        """
tell = view.FilmAlongside.tell
def told(self):
    tell(self)
    print("PROCESS", self._process, flush=True)
view.FilmAlongside.tell = told
""",
        "num_frames=200",
    )
    assert process.stdout is not None
    other = next(line.split()[1] for line in process.stdout if line.startswith("PROCESS"))
    assert Path("/proc", other).exists()
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    end = time.monotonic() + 20
    while lives(other) and time.monotonic() < end:
        time.sleep(0.05)
    assert not lives(other)
    assert not list(tmp_path.glob("out/.rollout_png.partial"))


def test_a_process_of_several_threads_is_not_forked() -> None:
    end = threading.Event()
    thread = threading.Thread(target=end.wait)
    thread.start()
    assert not view._has_one_thread()
    end.set()
    thread.join()
