"""``hood tradeoff``: its grid, what is done and not done again, failures, and the page at the end."""

from __future__ import annotations

import collections
import functools
import importlib.util
import json
import os
import shlex
import signal
import sys
import threading
import time
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
import torch
from measured_points import tiny_grid

from hood.app.settings.compose import load_config
from hood.cli.main import main
from hood.steppers.checkpoint import save_simulator
from hood.steppers.network import build_simulator
from hood.studies.tradeoff import page as tradeoff_page
from hood.studies.tradeoff import tradeoff
from hood.studies.tradeoff.comparison import LEAST_ROLLOUTS
from hood.studies.tradeoff.grid import Grid, GridSize
from hood.studies.tradeoff.points import Points
from hood.studies.tradeoff.tradeoff import chosen_models, make_grid

#: Stands for ``hood``: writes what ``hood evaluate`` would, and its own name into calls.txt. "bad" fails, "slow" sleeps.
FAKE = """
import json, re, sys, time
from pathlib import Path
settings = dict(text.split("=", 1) for text in sys.argv[2:])
folder = Path(settings["output"]); folder.mkdir(parents=True, exist_ok=True)
with open("calls.txt", "a") as file: file.write(settings["models"] + " " + settings["resume"] + "\\n")
name, k = re.fullmatch(r"\\[(.*?)(?:\\+(\\d+))?\\]", settings["models"]).groups()
print("starting")
if "bad" in name: sys.exit("hood: error: no luck with " + name)
k = int(k or 0)
ms, gap, strain = (20.0 + 10 * k, 1.0 / (1 + k) ** 2, 0.1) if name == "guess" else (100.0 + 10 * k, 0.5 / (1 + k), 0.3)
if name == "newton": ms, gap = 300.0, -1e-7
frames = [{"ms_total": ms + i, "ms_network": ms / 2, "strain_p99": strain, "relative_gradient": 1.0} for i in range(6)]
gaps = [{"gamma": gap * f, "converged": 1.0, "spread": 0.0} for f in (0.9, 1.0, 1.1)]
measured = {"frames": frames, "failures": [], "gaps": gaps, "drifts": []}
with open(folder / "rollouts.0.jsonl", "a") as file:
    file.write("\\n" + json.dumps({"unit": [0, "tank", "walk", 0], "weights": "none", "measured": measured}) + "\\n")
if "slow" in name: time.sleep(600)
rollouts = (folder / "rollouts.0.jsonl").read_text().count("unit")
if "twice" not in name or rollouts > 1: (folder / "table.json").write_text("[]")
"""
COMMAND = [
    "tradeoff", "models=[untrained:small]", "precisions=[fp32]", "garments_1k=[tank]", "refine_1k=[0,2]", "guess_1k=[2,5]",
    "garments_4k=[]", "garments_12k=[]", "sequences=[walk_proud]", "output=chart",
]  # fmt: skip


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HOOD_TRACEBACK", raising=False)
    (tmp_path / "fake.py").write_text(FAKE)
    program = (sys.executable, "-I", str(tmp_path / "fake.py"))
    monkeypatch.setattr(tradeoff, "Points", functools.partial(Points, program=program))


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pages without their charts: drawing is what takes long, and has tests of its own."""
    monkeypatch.setattr(tradeoff_page, "_pictures", lambda study, folder: collections.defaultdict(str))


def store(jobs: int = 2, turns: int = 1) -> Points:
    return Points(Path("points"), jobs, "CPU (made up)", turns, (sys.executable, "-I", "fake.py"))


def write_model(path: Path) -> None:
    torch.manual_seed(0)
    save_simulator(path, build_simulator(features="physical", output="velocity_base", schedule="1x(mesh)", latent_dim=4))


def calls() -> list[str]:
    path = Path("calls.txt")
    return path.read_text().splitlines() if path.exists() else []


def test_the_default_grid_is_the_one_described() -> None:
    config = load_config("tradeoff")
    models = ["small-fine15", "small-fine48", "small-ours", "small1", "small2", "small3"]
    points = make_grid(config, models).points()
    by_size = {size: [p for p in points if p.size == size and not p.alone] for size in ("1k", "4k", "12k")}
    assert {size: len(found) for size, found in by_size.items()} == {"1k": 6 * 2 * 6, "4k": 6 * 2 * 3 + 3, "12k": 2 * 2 * 2 + 4}
    for found in by_size.values():
        assert {p.refine for p in found if (p.name, p.precision) == ("small-ours", "fp32")} == {0, 1, 2, 5, 10, 20}
    assert {p.name for p in by_size["12k"]} == {"small-fine15", "small-ours"}
    assert {p.refine for p in by_size["1k"]} == {0, 1, 2, 5, 10, 20}
    for size, least in (("1k", 30), ("4k", 30), ("12k", 10)):
        rollouts = len(config[f"garments_{size}"]) * len(config.sequences) * len(config[f"shapes_{size}"])
        assert rollouts >= LEAST_ROLLOUTS
        assert rollouts * config[f"states_{size}"] >= least
        assert {p.rollouts for p in points if p.size == size} == {rollouts}


def test_the_dial_brings_its_model_to_every_size_or_is_off() -> None:
    models = ["small-fine15", "small-ours", "quickstart"]

    def most(*overrides: str) -> dict[str, set[int]]:
        points = make_grid(load_config("tradeoff", ["precisions=[fp32]", *overrides]), models).points()
        return {name: {p.refine for p in points if (p.size, p.name) == ("12k", name)} for name in models}

    every = {0, 1, 2, 5, 10, 20}
    assert most() == {"small-fine15": {0, 5}, "small-ours": every, "quickstart": set()}
    assert most("refined=quickstart") == {"small-fine15": {0, 5}, "small-ours": {0, 5}, "quickstart": every}
    assert most("refined=none") == {"small-fine15": {0, 5}, "small-ours": {0, 5}, "quickstart": set()}


def test_every_command_is_one_that_evaluate_reads() -> None:
    grid = make_grid(load_config("tradeoff", ['settings=["material=denim"]']), ["untrained:ours"])
    for point in {p.model: p for p in grid.points()}.values():
        words = shlex.split(point.command)
        assert words[:2] == ["hood", "evaluate"]
        config = load_config("evaluate", words[2:])
        assert len(config.models) == 1
        assert config.material == load_config("evaluate", ["material=denim"]).material


def test_models_default_to_those_that_are_embedded() -> None:
    models, absent = chosen_models(load_config("tradeoff"))
    assert "quickstart" in models
    assert set(models) | set(absent) == set(tradeoff.KNOWN)
    assert not set(models) & set(absent)


def test_what_is_done_is_not_done_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    points = tiny_grid("untrained:small").points()
    assert store().measure(points) == []
    assert sorted(calls()) == ["[guess+2] false", "[untrained:small+2] false", "[untrained:small] false"]
    assert all(store().is_done(point) for point in points)
    assert store().measure(points) == []
    assert len(calls()) == 3
    (store().folder_of(points[1]) / "point.json").unlink()
    store().measure(points)
    assert calls()[3:] == ["[untrained:small+2] true"]


def test_the_points_of_a_size_take_turns() -> None:
    for name in ("twice_a", "twice_b"):
        Path(f"{name}.safetensors").write_bytes(b"weights")
    points = tiny_grid("twice_a.safetensors", "twice_b.safetensors", refine=(0,)).points()
    assert store(jobs=1, turns=2).measure(points) == []
    a, b = "[twice_a.safetensors]", "[twice_b.safetensors]"
    assert calls() == [f"{a} false", f"{b} false", "[guess+2] false", f"{a} true", f"{b} true"]
    record = json.loads((store().folder_of(points[0]) / "point.json").read_text())
    assert record["turns"] == 2
    assert record["seconds"] > 0.0


def test_a_point_that_does_not_go_on_is_a_failure_and_ends() -> None:
    Path("fake.py").write_text("print('nothing')")
    (failure,) = store(turns=2).measure(tiny_grid("untrained:small", refine=(0,)).points()[:1])
    assert failure.reason == "a turn added no rollout and wrote no table"


def test_a_turn_is_a_share_of_the_rollouts() -> None:
    sizes = (GridSize("1k", ("tank", "dress"), (0,), (), 5, 1),)
    points = Grid(("untrained:small",), ("fp32",), ("newton",), sizes, newton=False, motions=2).points()
    store(turns=3).measure(points)
    assert "max_rollouts=2" in store().log_of(points[0]).read_text()


def test_other_weights_of_the_same_name_are_measured_anew() -> None:
    model = Path("m.safetensors")
    model.write_bytes(b"one")
    points = tiny_grid("m.safetensors", refine=(0,)).points()
    store().measure(points)
    assert store().is_done(points[0])
    model.write_bytes(b"two")
    assert not store().is_done(points[0])
    store().measure(points)
    assert calls().count("[m.safetensors] false") == 2
    lines = (store().folder_of(points[0]) / "rollouts.0.jsonl").read_text().split("\n")
    assert sum("unit" in line for line in lines) == 1  # those of the first weights are gone
    model.write_bytes(b"one")
    assert not store().is_done(points[0])


def test_a_failing_point_is_reported_with_its_log_and_the_others_go_on() -> None:
    Path("bad.safetensors").write_bytes(b"weights")
    points = tiny_grid("bad.safetensors", "untrained:small", refine=(0,)).points()
    failures = store(jobs=1).measure(points)
    assert [failure.point for failure in failures] == [points[0]]
    assert failures[0].reason == "exit code 1: hood: error: no luck with bad.safetensors"
    assert "no luck" in failures[0].log.read_text()
    assert not store().is_done(points[0])
    assert all(store().is_done(point) for point in points[1:])


def test_an_error_of_an_earlier_attempt_is_not_told_again() -> None:
    Path("bad.safetensors").write_bytes(b"weights")
    points = tiny_grid("bad.safetensors", refine=(0,)).points()[:1]
    store().measure(points)
    Path("fake.py").write_text("import os; os.kill(os.getpid(), 9)")
    assert store().measure(points)[0].reason == "ended by signal 9: no error was told"


def test_an_interruption_ends_the_processes_and_keeps_what_they_wrote() -> None:
    Path("slow.safetensors").write_bytes(b"weights")
    points = tiny_grid("slow.safetensors", refine=(0,)).points()[:1]
    rollouts = store().folder_of(points[0]) / "rollouts.0.jsonl"

    def interrupt() -> None:
        for _ in range(4000):
            if rollouts.exists():
                break
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGTERM)

    thread = threading.Thread(target=interrupt)
    begin = time.monotonic()
    thread.start()
    with pytest.raises(KeyboardInterrupt):
        store().measure(points)
    thread.join()
    assert time.monotonic() - begin < 300  # the process would have slept for longer
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
    assert not store().is_done(points[0])
    Path("fake.py").write_text(FAKE.replace("time.sleep(600)", "pass"))
    assert store().measure(points) == []
    assert calls() == ["[slow.safetensors] false", "[slow.safetensors] true"]


def test_the_command_writes_page_tables_and_charts(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(COMMAND) == 0
    printed = capsys.readouterr().out
    assert "vertices no claim is made" in printed  # a single rollout
    page = ElementTree.parse("chart/index.html").getroot()
    text = "".join(page.itertext())
    rows = json.loads(Path("chart/points.json").read_text())
    assert len(rows) == 5
    assert all(row["command"] in text for row in rows)
    assert len(Path("chart/points.csv").read_text().splitlines()) == 6
    assert [row["gap"] for row in rows if row["model"] == "newton"] == [-1e-7]
    assert Path("chart/front_1k.png").stat().st_size > 10_000
    assert Path("chart/cost_1k.png").stat().st_size > 5_000
    table = json.loads(Path("chart/refine_table_untrained-small_fp32.json").read_text())["rows"]
    assert [(row["refine"], row["ms"]) for row in table] == [(0, 102.5), (2, 122.5)]
    assert Path("chart/refine_table_guess_fp32.json").exists()
    assert not Path("chart/refine_table.json").exists()  # of the default checkpoint, which was not measured
    assert "refine_table_guess_fp32.json" in printed


@pytest.mark.usefixtures("undrawn")
def test_a_grown_grid_measures_the_new_points_alone() -> None:
    assert main(COMMAND) == 0
    before = calls()
    assert main([*COMMAND, "jobs=1"]) == 0
    assert calls() == before
    assert main([*COMMAND, "guess_1k=[2,5,10]"]) == 0
    assert len(calls()) == len(before) + 1


@pytest.mark.usefixtures("undrawn")
def test_the_page_names_what_failed_and_what_is_not_measured_yet(capsys: pytest.CaptureFixture[str]) -> None:
    write_model(Path("bad.safetensors"))
    command = [*COMMAND, "models=[untrained:small,bad.safetensors]", "refine_1k=[0]"]
    assert main(command) == 1
    said = capsys.readouterr().err
    assert "hood: left out: 1k bad, fp32: exit code 1: hood: error: no luck with bad.safetensors; chart/points/" in said
    page = Path("chart/index.html").read_text()
    assert "no luck with bad.safetensors" in page
    assert main([*command, "measure=false", "guess_1k=[2,5,20]"]) == 1
    assert "not measured yet" in Path("chart/index.html").read_text()
    assert "20 iterations: not measured yet" in capsys.readouterr().err


@pytest.mark.usefixtures("undrawn")
def test_other_settings_want_another_folder(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(COMMAND) == 0
    assert main([*COMMAND, "frames_1k=50"]) == 2
    assert "frames_1k is 24 there, 50 in this command" in capsys.readouterr().err


REFUSED = {
    "no such model": (["models=[quikstart]"], "did you mean 'quickstart'"),
    "no such garment": (["garments_1k=[tnk]"], "'tnk'"),
    "no such motion": (["sequences=[walk_prod]"], "'walk_proud'"),
    "no motion": (["sequences=[]"], "give motions"),
    "no such method": (["refine_methods=[sweep]"], "give some of newton, sweeps"),
    "no such precision": (["precisions=[fp8]"], "give some of fp32, bf16, tf32"),
    "no jobs": (["jobs=0"], "jobs=0: must be at least 1"),
    "no turns": (["turns=0"], "turns=0: must be at least 1"),
    "no states": (["states_1k=0"], "γ is what the chart shows"),
    "few frames": (["frames_1k=3"], "frames_1k=3: must be at least 4"),
    "half an iteration": (["refine_1k=[0.5]"], "refine_1k: 0.5 is no number of iterations"),
    "the solver without iterations": (["guess_1k=[0]"], "whole numbers from 1 on"),
    "a setting that is no key": (['settings=["speed=2"]'], "'speed'"),
    "a setting of its own": (['settings=["num_frames=7"]'], "num_frames is set by hood tradeoff itself"),
    "precision of its own": (['settings=["precision=bf16"]'], "precision is set by hood tradeoff itself"),
    "output of its own": (['settings=["output=here"]'], "output is set by hood tradeoff itself"),
    "a precision of other devices": (["precisions=[tf32]"], "tf32 needs device=cuda"),
    "the solver as a model": (["models=[newton]"], "newton=true"),
    "random weights of no model": (["models=[untrained:our]"], "'untrained:our' is no model"),
    "iterations twice": (["refine_1k=[0,2,2]"], "refine_1k: 2 is given twice"),
    "model twice": (["models=[quickstart,quickstart]"], "models: 'quickstart' is given twice"),
    "precision twice": (["precisions=[fp32,fp32]"], "precisions: 'fp32' is given twice"),
    "no folder": (["output="], "output: no folder is named"),
    "nothing to chart": (["measure=false"], "measure=false: chart holds none of these points"),
    "nothing to measure": (["garments_1k=[]"], "no point is left to measure"),
    "no bodies": (["shapes_1k=[]"], "shapes_1k=[]: give shape coefficients"),
    "a body that is none": (["shapes_1k=[[tall]]"], "shapes_1k"),
    "unknown model to refine": (["refined=ours"], "refined=ours: is none of the models (untrained:small)"),
    "unknown precision at a size": (["precisions_1k=[bf16]"], "precisions_1k: 'bf16' is none of the precisions (fp32)"),
    "unknown model at a size": (["models_1k=[ours]"], "models_1k: 'ours' is none of the models"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_measured_is_refused_before_anything_is_written(case: str, capsys: pytest.CaptureFixture[str]) -> None:
    overrides, words = REFUSED[case]
    assert main([*COMMAND, *overrides]) == 2
    said = capsys.readouterr().err
    assert words in said
    assert said.count("\n") == 1
    assert not Path("chart").exists()
    assert calls() == []


def test_a_file_that_is_no_model_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    Path("text.safetensors").write_text("no weights")
    assert main([*COMMAND, "models=[text.safetensors]"]) == 2
    assert "text.safetensors: not a model file" in capsys.readouterr().err
    assert not Path("chart").exists()


def test_a_missing_matplotlib_is_told_before_any_work(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *more: None if name == "matplotlib" else found(name, *more))
    assert main(COMMAND) == 2
    assert 'pip install "hood-cloth[charts]"' in capsys.readouterr().err
    assert not Path("chart").exists()


@pytest.mark.usefixtures("undrawn")
def test_a_point_is_measured_by_hood_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tradeoff, "Points", Points)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
    write_model(tmp_path / "m.safetensors")
    settings = [
        "models=[m.safetensors]", "precisions=[bf16]", "refine_1k=[0]", "guess_1k=[]", "newton=false", "frames_1k=4",
        "states_1k=1", 'settings=["gap_iterations=1"]',
    ]  # fmt: skip
    assert main([*COMMAND, *settings]) == 0
    row = json.loads(Path("chart/points.json").read_text())[0]
    assert row["states"] == row["unconverged"] == 1
    assert row["ms"] > 0
    assert row["command"].startswith("hood evaluate 'models=[m.safetensors]'")
