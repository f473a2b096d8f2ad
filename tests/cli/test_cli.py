"""The command line, in process: a rollout's files, and user errors in one line with exit code 2."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from hood import __version__
from hood.assets.files.library import names
from hood.cli.main import COMMANDS, main
from hood.rollouts.file.reader import read_rollout
from hood.steppers.checkpoint import save_simulator
from hood.steppers.network import build_simulator

UNTRAINED = ["checkpoint=untrained", "model=small", "model.latent_dim=8", "model.schedule='1x(mesh+coarse0)'"]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands run in an empty folder: what they leave behind is seen."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HOOD_TRACEBACK", raising=False)


def tiny_model(path: Path, **options: object) -> Path:
    torch.manual_seed(0)
    arguments = {"features": "physical", "output": "velocity_base", "schedule": "1x(mesh)", "latent_dim": 4}
    save_simulator(path, build_simulator(**{**arguments, **options}))
    return path


def folder(name: str) -> Path:
    path = Path(name)
    path.mkdir()
    return path


def quads(path: Path) -> Path:
    path.write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n")
    return path


def motion(path: Path, bad_frame: int | None = None) -> Path:
    poses = np.zeros((8, 156))
    if bad_frame is not None:
        poses[bad_frame, 4] = np.nan
    np.savez(path, poses=poses, trans=np.zeros((8, 3)), mocap_framerate=30.0, betas=np.zeros(16), gender="neutral")
    return path


def not_amass(path: Path) -> Path:
    np.savez(path, trans=np.zeros((8, 3)), frames=np.zeros((8, 3)))
    return path


def text_file(path: Path) -> Path:
    path.write_text("hello")
    return path


Prepare = Callable[[], object]
ERRORS: dict[str, tuple[list[str], tuple[str, ...], Prepare]] = {
    "misspelt command": (["rolout"], ("'rolout'", "'rollout'"), lambda: None),
    "misspelt key": (["rollout", "garmnet=dress"], ("'garmnet'", "'garment'"), lambda: None),
    "misspelt option": (["rollout", "material=demin"], ("'demin'", "'denim'"), lambda: None),
    "misspelt model": (["rollout", "checkpoint=untrained", "model=smal"], ("'smal'", "'small'"), lambda: None),
    "misspelt garment": (["rollout", *UNTRAINED, "garment=tshrt"], ("'tshrt'", "'tshirt'"), lambda: None),
    "misspelt sequence": (["rollout", *UNTRAINED, "sequence=walk_prod"], ("'walk_prod'", "'walk_proud'"), lambda: None),
    "misspelt body": (["rollout", *UNTRAINED, "body=defalt"], ("'defalt'", "'default'"), lambda: None),
    "unknown checkpoint": (["rollout", "checkpoint=zzzz"], ("'zzzz'",), lambda: None),
    "missing checkpoint": (["rollout", "checkpoint=a/m.safetensors"], ("a/m.safetensors", "no such file"), lambda: None),
    "misspelt device": (["rollout", *UNTRAINED, "device=cup"], ("'cup'", "'cpu'"), lambda: None),
    "misspelt video": (["rollout", *UNTRAINED, "video=mp5"], ("'mp5'", "'mp4'"), lambda: None),
    "wrong type": (["rollout", *UNTRAINED, "num_frames=abc"], ("num_frames=abc", "a whole number"), lambda: None),
    "no frames": (["rollout", *UNTRAINED, "num_frames=0"], ("num_frames=0",), lambda: None),
    "negative seed": (["rollout", *UNTRAINED, "seed=-1"], ("seed=-1",), lambda: None),
    "frame rate": (["rollout", *UNTRAINED, "fps=0"], ("fps",), lambda: None),
    "up axis": (["rollout", *UNTRAINED, "up=w"], ("up", "w"), lambda: None),
    "betas": (["rollout", *UNTRAINED, "betas=[.nan]"], ("betas",), lambda: None),
    "text betas": (["rollout", *UNTRAINED, "betas=[a]"], ("betas",), lambda: None),
    "untrained without model": (["rollout", "checkpoint=untrained"], ("model=small",), lambda: None),
    "missing garment file": (["rollout", *UNTRAINED, "garment=my.obj"], ("my.obj", "no such file"), lambda: None),
    "missing motion file": (["rollout", *UNTRAINED, "sequence=x/walk.npz"], ("x/walk.npz",), lambda: None),
    "not a motion": (
        ["rollout", *UNTRAINED, "sequence=other.npz"], ("other.npz", "not an AMASS"), lambda: not_amass(Path("other.npz")),
    ),
    "text as motion": (
        ["rollout", *UNTRAINED, "sequence=text.npz"], ("text.npz", "not a readable"), lambda: text_file(Path("text.npz")),
    ),
    "NaN poses": (
        ["rollout", *UNTRAINED, "sequence=nan.npz"], ("nan.npz", "frame 5"), lambda: motion(Path("nan.npz"), 5),
    ),
    "quads": (
        ["rollout", *UNTRAINED, "garment=q.obj"], ("q.obj", "face 0", "triangulate=true"), lambda: quads(Path("q.obj")),
    ),
    "pickled body": (
        ["rollout", *UNTRAINED, "body=smpl.pkl"], ("smpl.pkl", "pickle"), lambda: text_file(Path("smpl.pkl")),
    ),
    "text as checkpoint": (
        ["rollout", "checkpoint=m.safetensors"], ("m.safetensors", "not a model file"),
        lambda: text_file(Path("m.safetensors")),
    ),
    "wrong model for a checkpoint": (
        ["rollout", "checkpoint=m.safetensors", "model=small"], ("m.safetensors", "not the model asked for"),
        lambda: tiny_model(Path("m.safetensors")),
    ),
    "output below a file": (
        ["rollout", *UNTRAINED, "output=file/run"], ("file", "not a directory"), lambda: text_file(Path("file")),
    ),
    "output is a file": (
        ["rollout", *UNTRAINED, "output=file"], ("file", "exists"), lambda: text_file(Path("file")),
    ),
    "unparsable override": (["rollout", "garment=[dress"], ("garment=[dress",), lambda: None),
    "word without value": (["rollout", "dress"], ("'dress'", "key=value"), lambda: None),
    "added key": (["rollout", "+speed=2"], ("+speed",), lambda: None),
    "foreign target": (
        ["rollout", *UNTRAINED, "material._target_=os.system"], ("os.system", "not allowed"), lambda: None,
    ),
    "foreign model": (
        ["rollout", *UNTRAINED, "model._target_=subprocess.run"], ("subprocess.run", "not allowed"), lambda: None,
    ),
    "unphysical fabric": (["rollout", *UNTRAINED, "material.density=-1"], ("density",), lambda: None),
    "unknown schedule": (["rollout", *UNTRAINED[:2], "model.schedule=ourz"], ("'ourz'", "'ours'"), lambda: None),
    "training garment": (["train", "data.garments=[tnak]", "output=run"], ("'tnak'", "'tank'"), lambda: None),
    "training key": (["train", "trainer.iteration=3"], ("'trainer.iteration'", "'trainer.iterations'"), lambda: None),
    "training value": (["train", "trainer.iterations=0", "output=run"], ("trainer.iterations",), lambda: None),
    "training signal": (["train", "trainer.signal=scald", "output=run"], ("scald",), lambda: None),
    "training device": (["train", "device=gpu", "output=run"], ("'gpu'",), lambda: None),
    "evaluated model": (["evaluate", "models=[untrained:our]", "output=run"], ("'our'",), lambda: None),
    "evaluated checkpoint": (["evaluate", "models=[zzzz]", "output=run"], ("'zzzz'",), lambda: None),
    "no models": (["evaluate", "models=[]", "output=run"], ("models=[]", "give some"), lambda: None),
    "no garments": (["evaluate", "garments=[]", "output=run"], ("garments=[]", "give some"), lambda: None),
    "no bodies": (["evaluate", "shapes=[]", "output=run"], ("shapes=[]", "give some"), lambda: None),
    "model given twice": (["evaluate", "models=[newton,guess,guess]", "output=run"], ("'guess'", "twice"), lambda: None),
    "evaluated precision": (["evaluate", "models=[guess]", "precision=fp8", "output=run"], ("'fp8'", "fp32"), lambda: None),
    "evaluated kernels": (["evaluate", "models=[guess]", "kernels=fast", "output=run"], ("'fast'", "torch"), lambda: None),
    "evaluated rate": (["evaluate", "fps=0", "output=run"], ("fps=0", "above 0"), lambda: None),
    "evaluation nowhere": (["evaluate", "output=null"], ("output", "no folder"), lambda: None),
    "rollout nowhere": (["rollout", *UNTRAINED, "output=null"], ("output", "no folder"), lambda: None),
    "training nowhere": (["train", "output=null"], ("output", "no folder"), lambda: None),
    "two models of one name": (
        ["evaluate", "models=[a/small.safetensors,b/small.safetensors]", "output=run"], ("names must differ", "small, small"),
        lambda: [tiny_model(folder(name) / "small.safetensors") for name in "ab"],
    ),
    "spectrum of nothing": (["evaluate", "spectrum=table", "gap_states=0", "output=run"], ("gap_states",), lambda: None),
    "no rollouts": (["evaluate", "max_rollouts=0", "output=run"], ("max_rollouts=0", "at least 1"), lambda: None),
    "evaluated frames": (["evaluate", "num_frames=1", "output=run"], ("num_frames=1",), lambda: None),
}  # fmt: skip


@pytest.mark.parametrize("case", ERRORS)
def test_user_errors_are_one_line_and_leave_nothing(case: str, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    arguments, words, prepare = ERRORS[case]
    prepare()
    before = sorted(path.name for path in tmp_path.rglob("*"))
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith("hood: error: ")
    assert captured.err.count("\n") == 1, captured.err
    assert all(word in captured.err for word in words), captured.err
    assert sorted(path.name for path in tmp_path.rglob("*")) == before


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_a_help_that_says_what_each_key_is(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    from hood.app.settings.compose import load_config, notes, plain

    assert main([command, "--help"]) == 0
    text = capsys.readouterr().out
    assert f"\n  hood {command}" in text  # an example
    said = notes(command)
    for key, value in load_config(command).items():
        if not isinstance(plain(value), dict):
            assert f"  {key}=" in text
            assert len(said[str(key)]) > 10, key
    assert max(len(line) for line in text.splitlines()) <= 120


def test_help_of_groups_has_each_key_with_its_meaning(capsys: pytest.CaptureFixture[str]) -> None:
    for command, keys in (
        ("train", ("trainer.iterations", "trainer.horizon.start", "data.sampling.mirror")),
        ("rollout", ("material.density", "solver.target_rg")),
    ):
        assert main([command, "--help"]) == 0
        text = capsys.readouterr().out
        for key in keys:
            (line,) = [line for line in text.splitlines() if line.startswith(f"  {key}=")]
            assert len(line.split("  ")[-1]) > 10, line


def test_the_help_of_a_rollout_has_headings(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["rollout", "--help"]) == 0
    text = capsys.readouterr().out
    places = [
        text.index(f"\n{title}\n  {key}=")
        for title, key in (("The scene", "garment"), ("The run", "seed"), ("Time and forces", "fps"))
    ]
    assert places == sorted(places)


@pytest.mark.parametrize("command", ["train", "rollout", "evaluate", "tradeoff", "envelope"])
def test_help_lists_keys_groups_and_names(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    from hood.app.settings.compose import load_config, plain

    assert main([command, "--help"]) == 0
    text = capsys.readouterr().out
    for key, value in load_config(command).items():
        if not isinstance(plain(value), dict):
            assert f"  {key}=" in text
    assert all(name in text for name in names("garments") + names("motions"))
    assert max(len(line) for line in text.splitlines()) <= 120


@pytest.mark.parametrize("command", ["train", "rollout", "evaluate", "tradeoff", "envelope"])
def test_names_stand_behind_keys_of_the_command(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    from omegaconf import OmegaConf

    from hood.app.settings.compose import CONFIG_FOLDER, load_config

    assert main([command, "--help"]) == 0
    text, config = capsys.readouterr().out, load_config(command)
    part = text.split("these keys take files as well\n")[1].split("\n\n")[0]
    keys = [line.split("=")[0].strip() for line in part.splitlines() if "=" in line]
    assert len(keys) >= 3
    for key in keys:
        assert OmegaConf.select(config, key, default="absent") != "absent", key
    if command == "train":
        assert keys == ["data.garments", "data.sequences", "data.body", "weights"]
        assert f"keys of model.*, losses.* stand in the files of the options:\n  {CONFIG_FOLDER}/GROUP/" in text


def test_the_process_is_set_up_before_torch_is_loaded() -> None:
    """OpenMP reads the number of threads when torch is loaded; a step takes twice the time and more on two."""
    code = """
import sys
from hood.cli import main
main.main([])
main.main(["--version"])
for command in main.COMMANDS:
    main.main([command, "--help"])
assert not {"torch", "scipy"} & set(sys.modules), "what is only printed loads torch"
main._keep_memory_mapped()
import torch
assert torch.get_num_threads() == 1, torch.get_num_threads()
"""
    environment = {key: value for key, value in os.environ.items() if key != "OMP_NUM_THREADS"}
    done = subprocess.run([sys.executable, "-P", "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_usage_and_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    usage = capsys.readouterr().out
    assert all(command in usage for command in ("train", "rollout", "evaluate", "tradeoff", "envelope", "compare"))
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.strip() == f"hood {__version__} (hood-cloth)"


@pytest.mark.parametrize("arguments", ["--help", "sizes --help", "inspect tank skirt"])
def test_a_reader_that_has_seen_enough_is_no_error(arguments: str) -> None:
    command = f"PYTHONUNBUFFERED=1 {sys.executable} -m hood.cli.main {arguments} | true; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, timeout=120, check=False)
    assert (done.returncode, done.stderr) == (130, "")


def test_traceback_on_demand(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOOD_TRACEBACK", "1")
    with pytest.raises(ValueError, match="garmnet"):
        main(["rollout", "garmnet=dress"])


def test_an_interrupt_has_its_own_exit_code(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """Ctrl-C during the second step keeps the frames done."""
    from hood.steppers.network import NetworkStepper

    step, calls = NetworkStepper.predict, []

    def interrupted(*arguments: object) -> object:
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return step(*arguments)

    monkeypatch.setattr(NetworkStepper, "predict", interrupted)
    assert main(["rollout", *UNTRAINED, "garment=tank", "num_frames=9", "video=none", "output=run"]) == 130
    assert "2 frames done are kept" in capsys.readouterr().err
    data = read_rollout(tmp_path / "run" / "rollout.h5")
    assert len(data.cloth_pos) == 2
    assert not data.attributes["complete"]
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["num_frames"] == 2
    assert not list(tmp_path.rglob("*.partial"))


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (MemoryError(), "the memory is used up; free some"),
        (RuntimeError("[enforce fail at alloc_cpu.cpp:1] DefaultCPUAllocator: can't allocate memory"), "the memory is used up"),
        (
            ImportError("libtorch_cpu.so: failed to map segment from shared object"),
            "failed to map segment from shared object; ",
        ),
        (OSError(27, "File too large", "run/rollout.h5"), "run/rollout.h5: file too large; raise the limit on the size of"),
    ],
)
def test_faults_of_the_machine_are_one_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], error: Exception, said: str
) -> None:
    from hood.steppers.network import NetworkStepper

    def fail(*arguments: object) -> object:
        raise error

    monkeypatch.setattr(NetworkStepper, "predict", fail)
    monkeypatch.delenv("HOOD_TRACEBACK", raising=False)
    command = ["rollout", *UNTRAINED, "garment=tank", "num_frames=3", "video=none", "sheet=false", "output=run"]
    assert main(command) == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith("hood: error: ")
    assert said in last


def test_other_errors_of_a_program_keep_their_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    import hood.cli.rollout as command

    def fail(words: object) -> int:
        raise RuntimeError("a fault of the program")

    monkeypatch.setattr(command, "run", fail)
    with pytest.raises(RuntimeError, match="a fault of the program"):
        main(["rollout"])


def test_a_running_rollout_is_told_from_one_that_was_stopped(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """While it runs its frames so far are read, and a second run into its folder is refused with nothing changed."""
    from hood.steppers.network import NetworkStepper

    step, calls, reports = NetworkStepper.predict, [], []
    command = ["rollout", *UNTRAINED, "garment=tank", "video=none", "sheet=false", "output=run"]

    def look(*arguments: object) -> object:
        calls.append(1)
        if len(calls) == 2:
            capsys.readouterr()
            assert main(["inspect", "run/rollout.h5"]) in (0, 1)  # untrained weights need not be sound
            reports.append(capsys.readouterr().out)
            before = (tmp_path / "run" / "config.yaml").read_bytes()
            assert main([*command, "num_frames=4"]) == 2
            reports.append(capsys.readouterr().err)
            assert (tmp_path / "run" / "config.yaml").read_bytes() == before
        if len(calls) == 3:
            raise KeyboardInterrupt
        return step(*arguments)

    monkeypatch.setattr(NetworkStepper, "predict", look)
    assert main([*command, "num_frames=9"]) == 130
    assert "  so far: 2 of 9 frames, its run goes on\n" in reports[0]
    assert "not finished" not in reports[0]
    assert "hood: error: run: another run is writing there; wait for its end or choose another output\n" in reports[1]
    assert main(["inspect", "run/rollout.h5"]) == 1
    assert "! not finished: 3 of 9 frames, and no run on this machine is writing it; run hood" in capsys.readouterr().out


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rollout") / "run"
    arguments = ["garment=skirt", "num_frames=3", "video=none", "material.density=0.3", f"output={folder}"]
    assert main(["rollout", *UNTRAINED, *arguments]) == 0
    return folder


def test_a_rollout_writes_its_files_and_nothing_else(run_folder: Path) -> None:
    assert sorted(path.name for path in run_folder.iterdir()) == [
        "config.yaml", "contact_sheet.png", "rollout.h5", "summary.json", "versions.json",
    ]  # fmt: skip


def test_rollout_file_has_the_documented_content(run_folder: Path) -> None:
    with h5py.File(run_folder / "rollout.h5", "r") as file:
        num_vertices, num_body = file["cloth/rest_pos"].shape[0], file["body/pos"].shape[1]
        assert file["cloth/pos"].shape == (3, num_vertices, 3)
        assert file["body/pos"].shape == (3, num_body, 3)
        assert file["cloth/faces"][:].max() < num_vertices
        assert file["body/faces"][:].max() < num_body
        np.testing.assert_allclose(file["time"][:], np.arange(3) / 30)
        for name in ("strain_p50", "strain_p99", "strain_max", "penetration_count", "penetration_share", "penetration_depth"):
            assert np.isfinite(file[f"metrics/{name}"][:]).all()
        for name in ("cut_face_share", "cut_edge_share", "skin_depth", "self_crossings", "garment_crossings", "cut_in_folds"):
            assert np.isfinite(file[f"metrics/{name}"][:]).tolist() == [True, False, True]  # first and last
        for name in ("energy_stretching", "energy_total", "gradient_norm", "relative_gradient", "e0", "ms_total"):
            values = file[f"metrics/{name}"][:]
            assert np.isnan(values[0])
            assert np.isfinite(values[1:]).all()
        attributes = dict(file.attrs)
    assert attributes["num_frames"] == 3
    assert bool(attributes["complete"])
    assert attributes["garment"] == "skirt"
    assert attributes["sequence"] == "walk_proud"
    assert attributes["checkpoint"] == attributes["checkpoint_sha256"] == "untrained"
    assert json.loads(attributes["material"])["density"] == 0.3
    assert json.loads(attributes["config"])["num_frames"] == 3
    assert json.loads(attributes["model"])["latent_dim"] == 8
    assert attributes["dt"] == pytest.approx(1 / 30)
    assert attributes["surface_stride"] == 5


def test_a_rollout_without_metrics_holds_times_and_its_start_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["garment=tank", "num_frames=3", "video=none", "sheet=false", f"output={tmp_path / 'run'}"]
    assert main(["rollout", *UNTRAINED, *arguments, "metrics=none"]) == 0
    assert "strain p50 n/a p99 n/a, vertices inside the body n/a\n" in capsys.readouterr().out
    names = set(read_rollout(tmp_path / "run" / "rollout.h5").metrics)
    times = {f"ms_{part}" for part in ("search", "features", "network", "rest", "total", "guard", "metrics")}
    assert names == times | {
        "settle_steps",
        "settle_seconds",
        "settle_speed",
        "settle_reached",
        "settle_away",
        "settle_sunk",
    }
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["strain_p50"] is summary["potential_mean_J"] is summary["first_frame"]["strain_p99"] is None
    assert summary["ms_per_frame"]["network"]["median"] > 0
    assert main(["rollout", *UNTRAINED, *arguments, "metrics=some"]) != 0
    assert "unknown value for metrics 'some'" in capsys.readouterr().err


def test_records_of_the_run(run_folder: Path) -> None:
    summary = json.loads((run_folder / "summary.json").read_text())
    assert summary["num_frames"] == 3
    assert summary["complete"]
    assert summary["first_nonfinite_frame"] is None
    assert summary["first_frame"]["strain_p99"] <= 0.15
    assert "density: 0.3" in (run_folder / "config.yaml").read_text()
    assert json.loads((run_folder / "versions.json").read_text())["seed"] == 0
    picture = (run_folder / "contact_sheet.png").read_bytes()
    assert picture.startswith(b"\x89PNG")
    assert len(picture) > 5000


def test_own_files_and_a_checkpoint(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A garment from an OBJ, a motion of eight frames, a model file; fewer frames than asked for."""
    import hashlib

    from hood.assets.garment.garment import load_garment

    garment = load_garment("tank")
    lines = [f"v {x} {y} {z}" for x, y, z in garment.rest_pos] + [f"f {a} {b} {c}" for a, b, c in garment.faces + 1]
    (tmp_path / "mine.obj").write_text("\n".join(lines))
    motion(tmp_path / "stand.npz")
    model = tiny_model(tmp_path / "m.safetensors")
    arguments = ["garment=mine.obj", "sequence=stand.npz", "checkpoint=m.safetensors", "video=none", "sheet=false"]
    assert main(["rollout", *arguments, "num_frames=20", "output=out", "fail_on=nothing"]) == 0
    assert "stand has 8 frames" in capsys.readouterr().out
    data = read_rollout(tmp_path / "out" / "rollout.h5")
    assert len(data.cloth_pos) == 8
    np.testing.assert_array_equal(data.cloth_faces, garment.faces)
    assert data.attributes["checkpoint_sha256"] == hashlib.sha256(model.read_bytes()).hexdigest()


def test_train_resume_and_refuse(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = [
        "model.latent_dim=4", "model.schedule='1x(mesh)'", "trainer.batch_size=1", "trainer.log_every=1",
        "data.garments=[tank]", "data.sequences=[walk_proud]", "output=run",
    ]  # fmt: skip
    assert main(["train", *options, "trainer.iterations=2"]) == 0
    assert {"checkpoint.pt", "model.safetensors", "metrics.jsonl", "config.yaml", "versions.json"} <= {
        path.name for path in (tmp_path / "run").iterdir()
    }
    assert len((tmp_path / "run" / "metrics.jsonl").read_text().splitlines()) == 2
    capsys.readouterr()
    assert main(["train", *options, "trainer.iterations=2"]) == 2
    assert "resume=true" in capsys.readouterr().err
    assert main(["train", *options, "trainer.iterations=2", "resume=true", "seed=4"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert main(["train", *options, "trainer.iterations=2", "resume=true"]) == 0
    assert (
        main(["rollout", "checkpoint=run/model.safetensors", "garment=tank", "num_frames=2", "video=none", "sheet=false"]) == 0
    )


def test_evaluate_writes_its_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tiny_model(tmp_path / "m.safetensors")
    arguments = [
        "models=[m.safetensors,newton]", "garments=[tank]", "sequences=[walk_proud]", "num_frames=5", "output=table",
        "spectrum=picture", "solver.max_iterations=2", "gap_states=1", "gap_iterations=3",
    ]  # fmt: skip
    assert main(["evaluate", *arguments]) == 0
    printed = capsys.readouterr().out
    assert "tank" in printed
    assert "2 of 2 reference minima did not converge" in printed
    page = (tmp_path / "table" / "table1.md").read_text()
    assert "hood evaluate 'models=[m.safetensors,newton]' 'garments=[tank]' 'sequences=[walk_proud]' num_frames=5" in page
    assert "m: its file does not say." in page
    assert "| m | tank | 1 | 1 | 1 |" in page
    waves = json.loads((tmp_path / "table" / "spectrum.json").read_text())
    assert {(row["model"], row["garment"], row["states"]) for row in waves} == {("m", "tank", 1), ("newton", "tank", 1)}
    assert (tmp_path / "table" / "spectrum.png").read_bytes().startswith(b"\x89PNG")
    rows = json.loads((tmp_path / "table" / "table.json").read_text())
    assert [(row["model"], row["garment"]) for row in rows] == [
        (model, garment) for model in ("m", "newton") for garment in ("tank", "all")
    ]
    assert rows[0]["radius"] == rows[0]["steps"] == 1
    assert (rows[2]["radius"], rows[2]["weights"], rows[2]["gap_states"]) == (None, "none", 1)
    assert main(["evaluate", *arguments[:-2], "gap_states=-1"]) == 2
    assert "gap_states=-1" in capsys.readouterr().err
