"""``hood convert rollout=``: rollouts of the published code in and out, exactly; and what cannot be used."""

from __future__ import annotations

import io
import json
import os
import pickle
import pickletools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import hood
from hood.cli.main import main
from hood.rollouts.file.compact import BOTH, make_compact
from hood.rollouts.file.recorder import RolloutWriter
from hood.testing import grid, sphere

FRAMES = 5


def published() -> dict[str, Any]:
    """A rollout as the published code writes it."""
    random = np.random.default_rng(0)
    pos, faces = grid(4, 4)
    body, body_faces = sphere(1)
    return {
        "pred": (pos + random.normal(size=(FRAMES, 16, 3))).astype(np.float32),
        "obstacle": np.repeat(body[None], FRAMES, axis=0).astype(np.float32),
        "cloth_faces": faces.astype(np.int64),
        "obstacle_faces": body_faces.astype(np.int64),
        "metrics": {"stretching energy": [float(n) for n in range(FRAMES)], "fps": 12.0, "loss": torch.arange(1.0, FRAMES)},
    }


def save(path: Path, content: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickle.dumps(content))
    return path


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def dress_set(folder: Path) -> None:
    """A data set of two sound rows, one of them compact, and an unsound one."""
    lines = []
    for index, row in enumerate(("rag/walk.v2", "rag/jump", "rag/torn")):
        path = folder / row / "rollout.h5"
        path.parent.mkdir(parents=True)
        pos, faces = grid(4, 4)
        body, body_faces = sphere(1)
        with RolloutWriter(path, FRAMES, pos, faces, body_faces, len(body), ("ms",), 0.04, {"garment": "rag"}) as target:
            for frame in range(FRAMES):
                target.append(pos + 0.1 * frame + index, body, {"ms": float(frame)})
        if index == 1:
            make_compact(path, BOTH, None)
        lines.append({"row": row, "verdict": "unsound" if index == 2 else "sound", "settings": {}})
    (folder / "manifest.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))


def test_a_published_rollout_is_read_and_given_back(capsys: pytest.CaptureFixture[str]) -> None:
    content = published()
    save(Path("walk.pkl"), content)
    assert main(["convert", "rollout=walk.pkl", "output=out/rollout.h5"]) == 0
    told = capsys.readouterr().out
    assert "has no rest_pos; strains are from the cloth's shape in frame 0" in told
    assert "metrics that are not one number a frame are left out: fps" in told
    assert "5 frames of 16 vertices, 30 fps" in told
    data = hood.read_rollout("out/rollout.h5")
    np.testing.assert_array_equal(data.cloth_pos, content["pred"])
    np.testing.assert_array_equal(data.body_pos, content["obstacle"])
    np.testing.assert_array_equal(data.rest_pos, content["pred"][0])
    np.testing.assert_array_equal(data.metrics["stretching_energy"], np.arange(5.0))
    np.testing.assert_array_equal(data.metrics["loss"], [np.nan, 1, 2, 3, 4])
    np.testing.assert_allclose(data.time, np.arange(5) / 30)
    assert data.attributes["complete"]
    assert main(["convert", "rollout=out", "output=back.pkl"]) == 0
    back = pickle.loads(Path("back.pkl").read_bytes())
    for key in ("pred", "obstacle", "cloth_faces", "obstacle_faces"):
        assert back[key].dtype == content[key].dtype
        np.testing.assert_array_equal(back[key], content[key])
    assert main(["convert", "rollout=walk.pkl", "fps=60"]) == 0
    assert hood.read_rollout("walk.h5").attributes["dt"] == 1 / 60
    assert {path.name for path in Path().iterdir()} == {"walk.pkl", "walk.h5", "out", "back.pkl"}


def test_what_is_written_names_numpys_parts_as_numpy_1_does() -> None:
    dress_set(Path("set"))
    assert main(["convert", "rollout=set/rag/jump/rollout.h5"]) == 0
    written = Path("set/rag/jump/rollout.pkl").read_bytes()
    operations = [*pickletools.genops(io.BytesIO(written))]
    assert {argument for code, argument, _ in operations if code.name == "GLOBAL"} == {"numpy.core.multiarray _reconstruct"}
    assert not any("_core" in argument for code, argument, _ in operations if "UNICODE" in code.name)
    content = pickle.loads(written)
    assert all(
        type(value) is np.ndarray for value in {**content, **content["metrics"]}.values() if value is not content["metrics"]
    )


@pytest.mark.parametrize("command", ["inspect", "view", "export"])
def test_other_commands_read_what_is_made(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    save(Path("walk.pkl"), published())
    assert main(["convert", "rollout=walk.pkl"]) == 0
    words = [] if command == "inspect" else ["output=walk.html"] if command == "view" else ["output=walk.glb"]
    assert main([command, "walk.h5", *words]) in (0, 1)  # what lies in the body is no garment's place
    told = capsys.readouterr()
    assert "16" in told.out
    assert "error" not in told.err
    assert main(["inspect", "walk.pkl"]) == 0


def test_a_data_set_goes_there_and_back_by_its_manifest(capsys: pytest.CaptureFixture[str]) -> None:
    dress_set(Path("set"))
    Path("pickles").mkdir()
    assert main(["convert", "rollout=set", "output=pickles"]) == 0
    assert sorted(path.relative_to("pickles").as_posix() for path in Path("pickles").rglob("*.pkl")) == [
        "rag/jump.pkl",
        "rag/walk.v2.pkl",
    ]
    assert "written to pickles: 2 rollouts" in capsys.readouterr().out
    assert main(["convert", "rollout=pickles", "output=again"]) == 0
    data = hood.RolloutDataset("again", window=FRAMES, verdict=["unjudged"], body="pos")
    assert data.names == ["rag/jump", "rag/walk.v2"]
    for item in (data[0], data[1]):
        before = hood.read_rollout(Path("set") / item["name"] / "rollout.h5")
        np.testing.assert_array_equal(item["cloth_pos"], before.cloth_pos)
        np.testing.assert_array_equal(item["body_pos"], before.body_pos)
        assert item["dt"] == 0.04
    np.testing.assert_array_equal(data.mesh(0).rest_pos, before.rest_pos.astype(np.float32))
    assert main(["convert", "rollout=set", "output=torn", "verdict=[unsound]"]) == 0
    assert [path.name for path in Path("torn").rglob("*.pkl")] == ["torn.pkl"]


class Harmful:
    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, ("harmed",)


def without(*keys: str) -> dict[str, Any]:
    return {key: value for key, value in published().items() if key not in keys}


def late_nan() -> dict[str, Any]:
    content = published()
    content["pred"][3, 2, 1] = np.nan
    return content


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (without("obstacle", "pred"), "has no pred and no obstacle, but cloth_faces, obstacle_faces, metrics"),
        (published() | {"pred": np.zeros((5, 16))}, "pred is (5, 16) of float64; it has to be (frames, vertices, 3)"),
        (published() | {"pred": [np.zeros((4, 3)), np.zeros((5, 3))]}, "pred is (0,) of object"),
        (published() | {"obstacle": np.zeros((4, 8, 3))}, "pred has 5 frames and obstacle 4"),
        (published() | {"cloth_faces": np.array([[0, 1, 16]])}, "cloth_faces names vertex 16"),
        (published() | {"obstacle_faces": np.zeros((3, 4), int)}, "obstacle_faces is (3, 4) of int64"),
        (published() | {"rest_pos": np.zeros((3, 3))}, "rest_pos (3, 3) does not belong to pred (5, 16, 3)"),
        (published() | {"dt": "fast"}, "dt is 'fast'; it has to be seconds above 0"),
        (late_nan(), "pred has numbers that are not finite from frame 3 on; leave those frames out"),
        ([1, 2], "holds no dictionary"),
        ({"pred": Harmful()}, "names posix.mkdir, which is not read"),
        (None, "not a readable pickle"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("many", [False, True])
def test_pickles_that_cannot_be_used_are_named_and_leave_nothing(
    content: object, said: str, many: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    path = save(Path("in/walk.pkl"), content)
    if content is None:
        path.write_bytes(b"hello")
    if many:
        save(Path("in/a.pkl"), published())
    before = sorted(Path().rglob("*"))
    assert main(["convert", f"rollout={'in' if many else 'in/walk.pkl'}", "output=out" if many else "output=out.h5"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("hood: error: in/walk.pkl: ")
    assert said in error
    assert error.count("\n") == 1
    assert sorted(Path().rglob("*")) == before


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["rollout=none.pkl"], "none.pkl: no such file"),
        (["rollout=walk.txt"], "rollout=walk.txt: give a .pkl of the published code, or a rollout.h5"),
        (["rollout=empty", "output=x"], "rollout=empty: has no manifest.jsonl of hood dress, no rollout.h5 and no .pkl"),
        (["rollout=walk.pkl", "output=walk.txt"], "output=walk.txt: name a file that ends in .h5"),
        (["rollout=walk.pkl", "output=there.h5"], "output=there.h5: is there already; name a file that is new"),
        (["rollout=twice", "output=x"], "twice/a.pickle: another pickle beside it has this name"),
        (["rollout=set"], "output is not given: the folder for the files of rollout=set"),
        (["rollout=set", "output=full"], "output=full: is there already; name a folder that is new"),
        (["rollout=set", "output=x", "verdict=[fine]"], "unknown verdict 'fine'"),
        (["rollout=set", "output=x", "verdict=[doubtful]"], "no row is taken"),
        (["rollout=set", "output=x", "fps=30"], "fps=30: set/rag/walk.v2/rollout.h5 says its frame rate itself"),
        (["rollout=walk.pkl", "fps=0"], "fps=0: give frames per second"),
        (["rollout=walk.pkl", "half=true"], "half=True: is of a model"),
        (["rollout=walk.pkl", "checkpoint=a.pth"], "checkpoint=a.pth: is of a model"),
        (["checkpoint=a.pth", "fps=30"], "fps=30: is of rollout=walk.pkl"),
        (["rollout=there.h5"], "there.h5: not a rollout file"),
    ],
)
def test_words_that_cannot_be_meant_are_refused(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    save(Path("walk.pkl"), published())
    dress_set(Path("set"))
    for name in ("walk.txt", "there.h5", "full/file", "twice/a.pkl", "twice/a.pickle"):
        Path(name).parent.mkdir(exist_ok=True)
        Path(name).write_text("something")
    Path("empty").mkdir()
    before = sorted(Path().rglob("*"))
    assert main(["convert", *words]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert sorted(Path().rglob("*")) == before


def test_a_rollout_without_a_body_that_is_not_finished(capsys: pytest.CaptureFixture[str]) -> None:
    pos, faces = grid(4, 4)
    target = RolloutWriter(Path("rollout.h5"), 3, pos, faces, faces[:0], 0, ("ms",), 0.04, {})
    target.append(pos, np.zeros((0, 3)), {"ms": 1.0})
    assert main(["convert", "rollout=rollout.h5"]) == 0
    assert "rollout.h5: is not finished; 1 of 3 frames are there" in capsys.readouterr().out
    target.close(False)
    content = pickle.loads(Path("rollout.pkl").read_bytes())
    save(Path("bare.pkl"), content | {"obstacle_faces": np.zeros((0, 3))})
    assert main(["convert", "rollout=bare.pkl"]) == 0
    data = hood.read_rollout("bare.h5")
    np.testing.assert_array_equal(data.cloth_pos, pos[None].astype(np.float32))
    assert data.body_pos.shape == (1, 0, 3)


def test_frames_that_are_not_finite_are_not_published(capsys: pytest.CaptureFixture[str]) -> None:
    pos, faces = grid(4, 4)
    with RolloutWriter(Path("rollout.h5"), 2, pos, faces, faces[:0], 0, (), 0.04, {}) as target:
        target.append(pos, np.zeros((0, 3)), {})
        target.append(np.full_like(pos, np.nan), np.zeros((0, 3)), {})
    assert main(["convert", "rollout=rollout.h5", "output=new/out.pkl"]) == 2
    assert "rollout.h5: cloth/pos has numbers that are not finite from frame 1 on" in capsys.readouterr().err
    assert not Path("new").exists()
    assert [path.name for path in Path().iterdir()] == ["rollout.h5"]
