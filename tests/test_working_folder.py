"""The command runs nothing, and looks up nothing, in the folder where it is called: files there may have any name."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
#: Modules that hood, its packages or Python import; a namespace that Hydra looks through.
NAMES = ("yaml", "types", "numpy", "torch", "h5py", "hood", "json", "typing", "random", "hydra_plugins/mine")
MARK = "import os\nopen(os.environ['MARKS'] + '/' + __name__, 'w').close()\n"
#: What is installed as the command, without the guard that pip writes; it also notes what is opened or listed below the working
#: folder, but the outputs.
COMMAND = """
import os, sys
here = os.getcwd()
def note(event, arguments):
    if event in ("open", "os.listdir", "os.scandir") and isinstance(arguments[0], str):
        path = os.path.abspath(arguments[0])
        if (path + "/").startswith(here + "/") and not path.startswith(here + "/out"):
            with open(os.environ["MARKS"] + "/looked", "a") as file:
                file.write(f"{event} {path}\\n")
sys.addaudithook(note)
from hood.cli.main import entry
sys.exit(entry())
"""
#: Before its last two lines: the processes that make the scenes of a training start at once, and it is told.
SPAWNING = """
import hood.training.prefetch as prefetch
prefetch._WARM_UP = 0
start = prefetch.SceneFeed._start_pool
prefetch.SceneFeed._start_pool = lambda feed: print("a pool", file=sys.stderr) or start(feed)
"""
#: A training whose scenes are made by a process of its own.
TRAINING = (
    "train", "model=small", "model.latent_dim=4", "model.schedule='1x(mesh)'", "data.garments=[tank]",
    "data.sequences=[walk_proud]", "trainer.iterations=2", "trainer.batch_size=2", "trainer.workers=1",
    "trainer.horizon.start=1", "trainer.statistics_iterations=0", "output=out",
)  # fmt: skip
ROLLOUT = ("rollout", "garment=tank", "stepper=newton", "num_frames=2", "video=none", "output=out")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder of such files, the folder ``marks`` beside it, and the command in ``bin``."""
    for name in ("work/hydra_plugins", "work/configs/material", "marks", "bin"):
        (tmp_path / name).mkdir(parents=True)
    for name in NAMES:
        (tmp_path / "work" / f"{name}.py").write_text(MARK)
    for group in ("", "configs/"):
        (tmp_path / "work" / group / "material").mkdir(parents=True, exist_ok=True)
        (tmp_path / "work" / group / "material" / "cotton.yaml").write_text("density: 7.0\n")
    (tmp_path / "bin" / "hood").write_text(COMMAND)
    return tmp_path / "work"


def run(folder: Path, *command: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Python with these arguments there, without a compiler, by default with no variable that changes where it looks."""
    kept = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    variables = kept | {"MARKS": str(folder.parent / "marks"), "CXX": "no-such-compiler"} | environment
    return subprocess.run([sys.executable, *command], cwd=folder, env=variables, capture_output=True, text=True, timeout=300)


def marks(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in (folder.parent / "marks").iterdir()}


@pytest.mark.parametrize("words", [("--version",), ("inspect", "tank"), ROLLOUT], ids=lambda words: words[0])
def test_no_file_of_the_working_folder_is_run_or_looked_at(words: tuple[str, ...], folder: Path) -> None:
    done = run(folder, str(folder.parent / "bin" / "hood"), *words)
    assert done.returncode == 0, done.stderr
    assert marks(folder) == {}


def test_processes_that_a_training_starts_run_nothing_there_and_not_the_command_again(folder: Path) -> None:
    command = folder.parent / "bin" / "hood"
    command.write_text(COMMAND.replace("from hood.cli.main", f"{SPAWNING}from hood.cli.main"))
    done = run(folder, str(command), *TRAINING)
    assert done.returncode == 0, done.stderr
    assert "a pool" in done.stderr
    assert "worker died" not in done.stderr
    assert marks(folder) == {}


def test_scripts_and_the_module_run_nothing_there(folder: Path) -> None:
    for command in ((str(ROOT / "scripts" / "rollout.py"), "--help"), ("-P", "-m", "hood", "rollout", "--help")):
        done = run(folder, *command)
        assert done.returncode == 0, done.stderr
        assert "usage: hood rollout" in done.stdout
    assert marks(folder) == {}


def test_commands_beside_run_nothing_there(folder: Path) -> None:
    code = (
        "from pathlib import Path; from hood.studies.processes import run_beside; "
        "print([ended.exit_code for _, ended in run_beside([(0, ['rollout', '--help'], Path('out'))], 1, 60.0)])"
    )
    assert run(folder, "-P", "-c", code).stdout.strip() == "[0]"
    assert marks(folder) == {}


def test_the_users_own_path_stays(folder: Path) -> None:
    """A package from PYTHONPATH is found; it is the user's word."""
    (folder.parent / "mine").mkdir()
    (folder.parent / "mine" / "yaml.py").write_text(MARK)
    done = run(folder, str(folder.parent / "bin" / "hood"), "rollout", "--help", PYTHONPATH=str(folder.parent / "mine"))
    assert done.returncode != 0
    assert set(marks(folder)) == {"yaml"}
