"""docs/extending.md to the letter: its package is written, registered as pip would, and its commands are run."""

from __future__ import annotations

import json
import re
import runpy
import shlex
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest

import hood
from hood import plugins
from hood.app.settings.compose import load_config
from hood.assets.garment.garment import load_garment
from hood.assets.motion.load import load_sequence
from hood.cli.main import main
from hood.model.parts import SetSettings, build_features
from hood.steppers.checkpoint import load_simulator, read_header, save_simulator
from hood.steppers.network import build_simulator
from hood.studies.envelope.tasks import command_of, make_tasks
from hood.studies.tradeoff.tradeoff import check_models

PAGE = Path(__file__).resolve().parents[2] / "docs" / "extending.md"
BLOCK = re.compile(r"(?P<before>[^\n]*)\n\n```(?P<language>\w*)\n(?P<body>.*?)^```$", re.DOTALL | re.MULTILINE)
#: What makes a command of the page short; words of its own stand.
SHORT = {
    "rollout": ["garment=tank", "sequence=walk_proud", "num_frames=3", "video=none", "sheet=false", "fail_on=nothing"],
    "train": [
        "model.latent_dim=4", "model.schedule='1x(mesh)'", "trainer.iterations=2", "trainer.batch_size=1",
        "trainer.log_every=1", "data.garments=[tank]", "data.sequences=[walk_proud]",
    ],
    "evaluate": ["garments=[tank]", "num_frames=4", "gap_states=0"],
    "prepare": [],
}  # fmt: skip
RECIPES = (
    *("An energy", "A fabric", "A group of features", "An output and a network", "A stepper", "A file format"),
    *("An optimiser and a schedule", "A logger", "A callback", "A data set"),
)


def sections() -> dict[str, str]:
    """Text of the page by its headings."""
    parts = re.split(r"^## (.+)$", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return {"": parts[0], **dict(zip(parts[1::2], parts[2::2], strict=True))}


def blocks(text: str) -> list[tuple[str, str, str]]:
    """Blocks of code: the file that the line before names ("" for none), the language, the text."""
    found = []
    for match in BLOCK.finditer(text):
        named = re.findall(r"`(my_cloth/[^`]+\.\w+)`", match["before"])
        found.append((named[-1] if named else "", match["language"], match["body"]))
    return found


def write_package(folder: Path, text: str) -> None:
    """The files that a text of the page names, and their registration."""
    record = folder / "my_cloth-1.0.dist-info"
    record.mkdir()
    (record / "METADATA").write_text("Metadata-Version: 2.1\nName: my-cloth\nVersion: 1.0\n", encoding="utf-8")
    (folder / "my_cloth").mkdir()
    (folder / "my_cloth" / "__init__.py").write_text("", encoding="utf-8")
    groups = ""
    for name, language, body in blocks(text):
        if language == "toml":
            for group, points in tomllib.loads(body).get("project", {}).get("entry-points", {}).items():
                groups += f"[{group}]\n" + "".join(f"{key} = {value}\n" for key, value in points.items())
        elif language in ("python", "yaml"):
            assert name, f"the page does not say where this belongs:\n{body}"
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(body, encoding="utf-8")
    (record / "entry_points.txt").write_text(groups, encoding="utf-8")
    forget()


def commands(text: str) -> list[list[str]]:
    lines = [line for _, language, body in blocks(text) if not language for line in body.splitlines()]
    return [shlex.split(line)[1:] for line in lines]


def run(words: list[str]) -> int:
    """A command of the page, on little."""
    command, *own = words
    keys = {word.partition("=")[0] for word in own}
    return main([command, *(word for word in SHORT[command] if word.partition("=")[0] not in keys), *own])


def forget() -> None:
    plugins.forget()
    for name in [name for name in sys.modules if name.split(".")[0] == "my_cloth"]:
        del sys.modules[name]


def write_files() -> None:
    """The files that the last recipe reads, from what ships."""
    tank, walk = load_garment("tank"), load_sequence("walk_proud")
    rows = [f"{len(tank.rest_pos)} {len(tank.faces)}"]
    rows += [" ".join(map(repr, map(float, row))) for row in tank.rest_pos] + [" ".join(map(str, row)) for row in tank.faces]
    Path("shirt.tri").write_text("\n".join(rows), encoding="utf-8")
    poses = walk.poses[:20].reshape(20, -1)[:, :66]
    np.savetxt("walk.pose", np.concatenate([walk.transl[:20], poses], axis=1))


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty folder of packages that Python looks into."""
    folder = tmp_path / "site"
    folder.mkdir()
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.chdir(tmp_path)
    yield folder
    forget()


@pytest.fixture
def installed(site: Path) -> Path:
    """All of the page's package."""
    write_package(site, "".join(sections().values()))
    return site


@pytest.mark.parametrize("recipe", RECIPES)
def test_a_recipe_works(recipe: str, site: Path) -> None:
    text = sections()
    needed = {"An output and a network": ("A group of features",)}.get(recipe, ())
    write_package(site, "".join(text[name] for name in ("", *needed, recipe)))
    write_files()
    found = commands(text[recipe])
    assert found
    for words in found:
        assert run(words) == 0, words
    for test in sorted((site / "my_cloth").rglob("test_*.py")):
        own = [function for name, function in runpy.run_path(str(test)).items() if name.startswith("test_")]
        assert own
        for function in own:
            function()


def test_every_recipe_is_short_and_tried() -> None:
    text = sections()
    assert set(RECIPES) == {*text} - {"", "Inside hood"}
    for name in RECIPES:
        for file, language, body in blocks(text[name]):
            classes = re.split(r"^(?=class |def )", body, flags=re.MULTILINE)[1:] if language == "python" else []
            for part in classes:
                assert len([line for line in part.splitlines() if line.strip()]) <= 12, (file, part)


def test_a_trained_model_says_what_it_needs(
    installed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert run(["train", "model=bounded", "output=runs/bounded"]) == 0
    path = tmp_path / "runs" / "bounded" / "model.safetensors"
    simulator = load_simulator(path)
    assert type(simulator.output).__name__ == "Bounded"
    assert simulator.output.limit == 0.02
    assert type(simulator.network).__name__ == "Halved"
    assert type(simulator.clone().features.node[-1]).__name__ == "Speed"
    needed = json.loads(read_header(path)["plugins"])
    assert needed == dict.fromkeys(["features/speed", "outputs/bounded", "networks/halved"], "my-cloth 1.0")
    (installed / "my_cloth-1.0.dist-info").rename(tmp_path / "gone")  # the package can still be imported, and must not be
    forget()
    assert run(["rollout", f"checkpoint={path}"]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert "from the package my-cloth 1.0, which is not installed here; install my-cloth" in told
    assert "my_cloth" not in sys.modules


def test_scenes_of_a_package_are_the_same_by_workers_and_after_an_interruption(
    installed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its sampler, rates and callback as well."""
    monkeypatch.setattr("hood.training.prefetch._WARM_UP", 0)
    parts = ["trainer.optimizer={_target_: my_cloth.rates.Signed}", "trainer.schedule={_target_: my_cloth.rates.Sawtooth}"]
    words = ["train", "model=small", "data=tall", *parts, "trainer.horizon.start=1", "trainer.iterations=5"]
    kept = "callbacks=[{_target_: my_cloth.enough.Enough, loss: 1e9, times: 4}]"
    for name, workers in (("alone", 0), ("helped", 1)):
        assert run([*words, f"trainer.workers={workers}", f"output=runs/{name}", kept]) == 0
    stopped = [*words, "output=runs/parts"]
    assert run([*stopped, kept.replace("4", "2")]) == 0
    assert run([*stopped, "resume=true"]) == 0  # without the callback
    losses = [
        [json.loads(line)["loss"] for line in Path(f"runs/{name}/metrics.jsonl").read_text().splitlines()]
        for name in ("alone", "helped", "parts")
    ]
    assert losses[0] == losses[1]
    assert (len(losses[0]), len(losses[2])) == (4, 5)
    assert losses[2][:4] == losses[0]


def test_an_option_of_data_without_the_usual_keys_is_refused(installed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    option = installed / "my_cloth" / "configs" / "data" / "tall.yaml"
    option.write_text("_target_: my_cloth.tall.Tall\n", encoding="utf-8")
    short = [word for word in SHORT["train"] if not word.startswith("data.")]
    assert main(["train", "model=small", "data=tall", *short, "output=run"]) == 2
    told = "data.body is missing; let the option begin with defaults: [default, _self_]"
    assert told in capsys.readouterr().err
    assert not Path("run").exists()


def test_a_data_set_of_another_class_is_refused(installed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    option = installed / "my_cloth" / "configs" / "data" / "other.yaml"
    option.write_text("defaults: [default, _self_]\n_target_: my_cloth.speed.Speed\n", encoding="utf-8")
    assert run(["train", "model=small", "data=other", "output=run"]) == 2
    assert "data: my_cloth.speed.Speed is no class of hood.training.scenes.SceneSampler" in capsys.readouterr().err
    assert not Path("run").exists()


def test_models_of_hood_alone_name_no_package(tmp_path: Path) -> None:
    assert "plugins" not in read_header(Path(hood.__file__).parent / "data" / "weights" / "quickstart.safetensors")
    simulator = build_simulator("physical", "velocity_base", "1x(mesh)", latent_dim=4)
    assert not {"network", "output_options"} & {*simulator.config}


def test_a_package_of_the_same_names_is_told_apart(installed: Path, tmp_path: Path) -> None:
    assert run(["train", "model=bounded", "output=runs/bounded"]) == 0
    record = installed / "my_cloth-1.0.dist-info"
    (record / "METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 3.0\n", encoding="utf-8")
    record.rename(installed / "other-3.0.dist-info")
    forget()
    with pytest.raises(ValueError, match=r"is another one here \(other 3.0\); install my-cloth"):
        load_simulator(tmp_path / "runs" / "bounded" / "model.safetensors")


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["model=small", "model.output=my_cloth.bounded.Bounded"], "model.output is 'my_cloth.bounded.Bounded'; choose"),
        (["model=small", "model.features=physical+os"], "no installed package has a group 'os' (known: speed)"),
        (["model=ours", "model.output=bounded", "trainer.statistics_iterations=0"], None),
        (["model=bounded", "model.features=local"], "this output needs model.features=paper or model.features=physical"),
        (["model=bounded", "model.schedule='1x(mesh) | 1x(mesh)'"], "several passes"),
    ],
)
def test_only_names_that_are_registered_are_found(
    words: list[str], told: str | None, installed: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    short = [word for word in SHORT["train"] if "schedule" not in word or not any("schedule" in own for own in words)]
    assert main(["train", *short, *words, "output=run"]) == (0 if told is None else 2)
    if told is not None:
        assert told in capsys.readouterr().err


def test_what_is_registered_and_no_such_class_is_refused(installed: Path) -> None:
    points = installed / "my_cloth-1.0.dist-info" / "entry_points.txt"
    text = points.read_text(encoding="utf-8")
    for old, new, words in (
        ("my_cloth.speed:Speed", "my_cloth.bounded:Bounded", "register a class of NodeGroup or EdgeGroup"),
        ("my_cloth.speed:Speed", "my_cloth.gone:Speed", "cannot be imported"),
        ("my_cloth.bounded:Bounded", "my_cloth.speed:Speed", "register a class of Output"),
    ):
        points.write_text(text.replace(old, new), encoding="utf-8")
        forget()
        with pytest.raises(ValueError, match=words):
            build_simulator("physical+speed", "bounded", "1x(mesh)", latent_dim=4)


def test_normalised_groups_stand_before_those_that_are_not(installed: Path) -> None:
    features = build_features("paper+speed", SetSettings(num_levels=1))
    names = [type(group).__name__ for group in features.node]
    assert names[-2:] == ["Speed", "NodeMaterial"]
    assert features.node_width == 21


def test_a_steppers_own_key_and_word_reach_it(installed: Path) -> None:
    speeds = {}
    for words in (["stepper=newton"], ["stepper=damped"], ["stepper=damped", "stepping.share=0.9"]):
        assert run(["rollout", *words, "num_frames=8", "output=out"]) == 0
        with h5py.File("out/rollout.h5") as file:
            pos = np.asarray(file["cloth/pos"])
            assert file.attrs["stepper"] == words[0].partition("=")[2]
        speeds[" ".join(words)] = float(np.abs(np.diff(pos, axis=0)).mean())
    usual, damped, more = speeds.values()
    assert usual != damped
    assert damped != more


def test_other_commands_take_a_steppers_word(installed: Path) -> None:
    check_models(["damped"])
    (task, *_) = [
        task
        for task in make_tasks(load_config("envelope", ["models=[damped]", "factors=[dt]"]))
        if task.model == "damped" and not task.cell.bad_input
    ]
    assert not task.alone
    words = command_of(task, load_config("envelope"), Path("map"))
    assert {"stepper=damped", "refine=0"} <= {*words}
    load_config("rollout", words[1:])


def test_a_garment_and_a_motion_in_formats_of_others_are_the_same_ones(installed: Path) -> None:
    write_files()
    found, expected = load_garment("shirt.tri"), load_garment("tank")
    assert np.array_equal(found.rest_pos, expected.rest_pos)
    assert np.array_equal(found.faces, expected.faces)
    motion, walk = load_sequence("walk.pose", up="y"), load_sequence("walk_proud")
    assert np.allclose(motion.poses[:, :22], walk.poses[:20, :22], atol=1e-12)
    assert np.allclose(motion.transl, walk.transl[:20], atol=1e-12)


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("shirt.tri", "three", "shirt.tri: the reader of .tri files: "),
        ("shirt.tri", "3 1 0 0 0 1 0 0 0 1 0 0 1 7", "shirt.tri: face 0 refers to vertex 8 of 3"),
        ("walk.pose", "1 2 3", "walk.pose: the reader of .pose files: "),
        ("walk.pose", "\n".join(" ".join("0" * 60) for _ in range(3)), "walk.pose: body_pose has shape"),
    ],
)
def test_what_a_reader_cannot_read_is_told_with_the_file(
    name: str, content: str, told: str, installed: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path(name).write_text(content, encoding="utf-8")
    key = "garment" if name.endswith(".tri") else "sequence"
    assert run(["rollout", f"{key}={name}", "stepper=newton", "output=out"]) == 2
    said = capsys.readouterr().err
    assert told in said
    assert said.count("\n") == 1


@pytest.mark.parametrize(
    ("name", "told"), [("npz", "its suffix is hood's own"), (".tri", "small letters"), ("Tri", "small letters")]
)
def test_names_that_cannot_be_registered_are_told(name: str, told: str, installed: Path) -> None:
    points = installed / "my_cloth-1.0.dist-info" / "entry_points.txt"
    points.write_text(points.read_text(encoding="utf-8").replace("tri =", f"{name} ="), encoding="utf-8")
    forget()
    with pytest.raises(ValueError, match=told):
        plugins.names("meshes")


def test_two_packages_of_one_name_are_refused(installed: Path) -> None:
    record = installed / "other-3.0.dist-info"
    record.mkdir()
    (record / "METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 3.0\n", encoding="utf-8")
    (record / "entry_points.txt").write_text("[hood.meshes]\ntri = other:read\n", encoding="utf-8")
    forget()
    with pytest.raises(ValueError, match="uninstall one of the two"):
        plugins.names("meshes")


@pytest.mark.parametrize(
    ("needed", "told"),
    [
        ("[]", "its list of plugins cannot be read"),
        ('{"speed": "my-cloth 1.0"}', "its list of plugins cannot be read"),
        ("nonsense", "its list of plugins cannot be read"),
        ('{"outputs/bounded": "my-cloth 1.0"}', "is not installed here; install my-cloth"),
    ],
)
def test_what_a_file_says_of_plugins_is_checked(needed: str, told: str, site: Path) -> None:
    forget()
    save_simulator(site / "m.safetensors", build_simulator("physical", "velocity_base", "1x(mesh)", 4), {"plugins": needed})
    with pytest.raises(ValueError, match=told):
        load_simulator(site / "m.safetensors")
