"""``hood train -m``: one run for each combination, through two launchers; what is finished is left alone, what was killed goes
on bit for bit, and what fails costs its run alone."""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from hood.app.settings.compose import load_config
from hood.cli.main import main
from hood.training.checkpoint import load_checkpoint, reached

TINY = [
    "model.latent_dim=4", "model.schedule='1x(mesh)'", "trainer.iterations=4", "trainer.batch_size=1", "trainer.log_every=1",
    "trainer.statistics_iterations=1", "trainer.checkpoint_every=1", "trainer.horizon.start=2", "trainer.horizon.maximum=2",
    "trainer.workers=0", "trainer.kernels=torch", "data.garments=[tank]", "data.sequences=[walk_proud]",
]  # fmt: skip
NAMES = ("seed=0", "seed=1")


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HOOD_TRACEBACK", raising=False)


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sweep that nobody disturbs, of two seeds and of one that no run can have."""
    folder = tmp_path_factory.mktemp("swept") / "sweep"
    assert main(["train", "-m", "seed=0,1,-1", *TINY, f"output={folder}"]) == 2
    return folder


def weights(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name / "model.safetensors").read_bytes() for name in NAMES}


def start(*words: str) -> subprocess.Popen[bytes]:
    """A sweep in a process of its own; of ``main``, which compiles nothing ahead."""
    program = f"import sys; from hood.cli.main import main; sys.exit(main({['train', '-m', 'seed=0,1', *TINY, *words]}))"
    environment = os.environ | {"OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
    return subprocess.Popen([sys.executable, "-P", "-c", program], env=environment, stdout=subprocess.DEVNULL)


def refused(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """What is said of a command that is refused, before anything is made."""
    assert main(["train", *words]) == 2
    said = capsys.readouterr().err
    assert said.startswith("hood: error: ")
    assert said.count("\n") == 1
    assert not any(Path().iterdir())
    return said


def test_a_run_is_what_the_command_alone_makes(swept: Path) -> None:
    assert main(["train", "seed=1", *TINY, "output=alone"]) == 0
    assert Path("alone/model.safetensors").read_bytes() == weights(swept)["seed=1"]
    assert weights(swept)["seed=0"] != weights(swept)["seed=1"]


def test_what_fails_costs_its_run_alone(swept: Path) -> None:
    assert [reached(swept / name) for name in (*NAMES, "seed=-1")] == [(4, True), (4, True), (0, False)]
    assert (swept / "seed=-1" / "error.txt").read_text() == "seed=-1: must be at least 0\n"
    assert not (swept / "seed=0" / "error.txt").exists()


def test_the_same_command_leaves_alone_what_is_finished(swept: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = {path: path.stat().st_mtime_ns for path in swept.glob("seed=?/*") if path.suffix != ".log"}
    assert len(before) >= 10
    assert main(["train", "-m", "seed=0,1", *TINY, f"output={swept}"]) == 0
    assert {path: path.stat().st_mtime_ns for path in before} == before
    told = capsys.readouterr().out
    assert told.count("finished before") == 2
    assert [line.split()[-1] for line in told.splitlines()[-2:]] == ["finished", "finished"]


def test_other_settings_are_refused_run_by_run(swept: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = weights(swept)
    assert main(["train", "-m", "seed=0,1", *TINY, "trainer.batch_size=2", f"output={swept}"]) == 2
    told = capsys.readouterr().err
    for name in NAMES:
        assert f"hood: {name}: " in told
    assert told.count("trainer.batch_size is 1 there, 2 in this command") == 2
    assert weights(swept) == before
    assert main(["train", "-m", "seed=0,1", *TINY, f"output={swept}"]) == 0
    assert not (swept / "seed=0" / "error.txt").exists()


def test_a_sweep_that_was_killed_ends_where_the_undisturbed_one_does(swept: Path) -> None:
    killed = start("output=killed")
    checkpoint = Path("killed/seed=0/checkpoint.pt")
    while killed.poll() is None and not (checkpoint.exists() and load_checkpoint(checkpoint)["iteration"] >= 2):
        time.sleep(0.005)
    killed.kill()
    assert killed.wait() == -9, "it was to be killed before its end"
    assert not Path("killed/seed=1/model.safetensors").exists()
    assert main(["train", "-m", "seed=0,1", *TINY, "output=killed"]) == 0
    assert weights(Path("killed")) == weights(swept)


def test_joblib_trains_several_at_a_time(
    swept: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "1")  # as the entry of the command line does; sums depend on it
    words = ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2", "output=beside"]
    assert main(["train", "-m", "seed=0,1,-1", *TINY, *words]) == 2
    told = capsys.readouterr()
    assert "Joblib.Parallel(n_jobs=2" in told.out
    assert told.err == "hood: seed=-1: seed=-1: must be at least 0\n"
    assert weights(Path("beside")) == weights(swept)


def test_a_launcher_that_gives_up_is_told_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["hydra/launcher=joblib", "hydra.launcher.n_jobs=0", "output=none"]
    assert main(["train", "-m", "seed=0,1", *TINY, *words]) == 2
    told = capsys.readouterr()
    assert told.out.endswith("no run has begun\n")
    assert told.err.startswith("hood: none: the launcher gave up (n_jobs == 0")
    assert told.err.count("\n") == 1


def test_the_table_on_demand(swept: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["compare", str(swept), "output=tables/runs.csv"]) == 0
    head, *rows, _ = capsys.readouterr().out.splitlines()
    assert head.split() == ["run", "seed", "iteration", "of", "loss", "rg", "seconds", "state"]
    assert [row.split()[0] for row in rows] == ["seed=-1", "seed=0", "seed=1"]
    assert [row.split()[-1] for row in rows] == ["failed", "finished", "finished"]
    assert rows[1].split()[1:4] == ["0", "4", "4"]
    with open("tables/runs.csv", newline="") as file:
        written = list(csv.DictReader(file))
    last = json.loads((swept / "seed=1" / "metrics.jsonl").read_text().splitlines()[-1])
    assert [float(written[2][name]) for name in ("loss", "rg")] == [last["loss"], last["relative_gradient"]]
    assert json.loads(Path("tables/runs.json").read_text())[0]["loss"] is None


def test_runs_of_no_sweep_differ_by_their_records(swept: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["seed=5"], ["seed=5", "trainer.learning_rate=1e-3"]):
        assert main(["train", *TINY, *words, f"output=run_{len(words)}", "trainer.iterations=2"]) == 0
    capsys.readouterr()
    assert main(["compare", "run_1", "run_2"]) == 0
    head, first, second = capsys.readouterr().out.splitlines()
    assert head.split()[:4] == ["run", "trainer.learning_rate", "iteration", "of"]
    assert (first.split()[:4], second.split()[:4]) == (["run_1", "0.005", "2", "2"], ["run_2", "0.001", "2", "2"])
    Path("other").mkdir()
    assert main(["compare", "run_1", "other"]) == 2
    assert "other: is no training, and run_1 is one" in capsys.readouterr().err
    assert main(["compare", "run_1", "colour=rg"]) == 2
    assert "colour=rg: is about rollouts, and run_1 is a training" in capsys.readouterr().err
    assert main(["compare", "run_1", "output=table"]) == 2
    assert "such as output=runs.csv" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["-m"], "no key has several values"),
        (["-m", "seed=1"], "leave -m out"),
        (["seed=0,1"], "hood train -m seed=0,1"),
        (["-m", "sed=0,1"], "did you mean 'seed'"),
        (["-m", "seed=0,1", "trainer.iteration=3"], "did you mean 'trainer.iterations'"),
        (["-m", "model=ours,fin15"], "did you mean 'fine15'"),
        (["-m", "seed=0,1", "trainer=paper,long", "trainer.schedule.ever=1,2"], "did you mean 'trainer.schedule.every'"),
        (["-m", "seed=0,1", "seed=3"], "seed=3: the key has several values"),
        (["-m", "seed=0,1", "resume=false"], "a sweep goes on with what is not finished"),
        (["-m", "seed=0,1", "hydra/launcher=ray_aws"], 'pip install "hood-cloth[ray]"'),
        (["-m", "seed=0,1", "hydra/launcher=jolib"], "did you mean 'joblib'"),
        (["-m", "seed=0,1", "hydra.launcher.jobs=2"], "hydra.launcher.jobs"),
    ],
)
def test_words_that_no_sweep_can_have(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert said in refused(capsys, *words)


def test_no_sweep_under_torchrun_or_in_the_folder_of_a_run(
    swept: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "holds a run of its own" in refused(capsys, "-m", "seed=0,1", f"output={swept / 'seed=0'}")
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setenv("RANK", "0")
    assert "torchrun shares one training" in refused(capsys, "-m", "seed=0,1")
    monkeypatch.setenv("RANK", "1")
    assert main(["train", "-m", "seed=0,1"]) == 2
    assert not capsys.readouterr().err


@pytest.mark.parametrize("command", ["rollout", "dress", "plan", "compare", "evaluate"])
def test_other_commands_have_no_sweeps(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([command, "-m"]) == 2
    assert "only hood train has sweeps" in capsys.readouterr().err


def test_the_composed_config_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    from omegaconf import OmegaConf

    words = ["model=ours", "seed=3", "data.garments=[tank]"]
    assert main(["train", "--cfg", "job", *words]) == 0
    assert OmegaConf.create(capsys.readouterr().out) == load_config("train", words)
    assert main(["train", *words, "--cfg=job", "-p", "data.garments"]) == 0
    assert capsys.readouterr().out == "# @package data.garments\n- tank\n"
    assert main(["dress", "--cfg", "job", "num_frames=3", "workers=2"]) == 0
    assert {"num_frames: 3", "workers: 2"} <= {*capsys.readouterr().out.splitlines()}
    assert main(["compare", "a.h5", "height=99", "--cfg", "job", "--package", "height"]) == 0
    assert capsys.readouterr().out == "99\n"
    assert main(["train", "--cfg", "hydra", "-p", "hydra.launcher", "hydra/launcher=joblib"]) == 0
    assert "n_jobs: -1" in capsys.readouterr().out
    assert main(["train", "--cfg", "all", "-p", "hydra.sweeper.max_batch_size"]) == 0
    assert capsys.readouterr().out == "null\n"
    for words in (
        ["--cfg", "hydra", "hydra.x=1"],
        ["--cfg", "hydra", "-p", "seed"],
        ["--cfg"],
        ["--cfg", "jobs"],
        ["--info", "x=1"],
        ["--package", "seed"],
        ["--cfg", "job", "-p", "sed"],
    ):
        assert main(["train", *words]) == 2
        assert capsys.readouterr().err.count("\n") == 1


def test_what_hydra_says_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["rollout", "--info", "defaults-tree", "material=denim"]) == 0
    assert "material: denim" in capsys.readouterr().out
    assert main(["train", "--info"]) == 0
    told = capsys.readouterr().out
    assert all(title in told for title in ("Config search path", "JoblibLauncher", "Defaults List", "seed: 0"))
