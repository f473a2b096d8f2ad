"""``hood compare``: what is drawn and written, what is refused, and that a blind comparison gives nothing away."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import h5py
import numpy as np
import pytest

from hood.app.common import short_names
from hood.cli.help import describe
from hood.cli.main import main
from hood.rollouts.file.recorder import RolloutWriter
from hood.testing import cylinder, sphere

pytestmark = pytest.mark.skipif(importlib.util.find_spec("PIL") is None, reason="needs Pillow")
METRICS = ("strain_p99", "relative_gradient", "ms_total")


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def record(
    path: str,
    sides: int = 12,
    wider: float = 0.1,
    frames: int = 2,
    rg: bool = True,
    shift: float = 0.0,
    dt: float = 1 / 30,
    still: dict[str, np.ndarray] | None = None,
) -> str:
    """A rollout of a tube of ``sides`` sides about a ball, on disk."""
    file = Path(path)
    file.parent.mkdir(parents=True, exist_ok=True)
    pos, faces = cylinder(sides, 3, 0.3, 0.5)
    ball, ball_faces = sphere(1, 0.25)
    fields = ("rg",) if rg else ()
    names = METRICS if rg else ()
    told = {"garment": "tube"}
    with RolloutWriter(file, frames, pos, faces, ball_faces, len(ball), names, dt, told, fields=fields, still=still) as out:
        for index in range(frames):
            step = {"strain_p99": wider * index} | ({"relative_gradient": 0.25, "ms_total": 40.0} if index else {})
            values = {"rg": np.full(len(pos), 0.5 if index else np.nan)}
            body = ball + [0.0, 0.25 + shift, 0.0]
            out.append(pos * (1.0 + wider * index), body, step if rg else {}, values if rg else {})
    return path


def test_two_rollouts_become_a_sheet_a_film_and_a_key(capsys: pytest.CaptureFixture[str]) -> None:
    files = record("runs/coarse/rollout.h5"), record("runs/fine/rollout.h5", sides=24, wider=0.2)
    assert main(["compare", f"a={files[0]}", f"b={files[1]}", "colour=rg", "video=gif", "height=140", "output=out"]) == 0
    assert sorted(path.name for path in Path("out").iterdir()) == ["comparison.gif", "contact_sheet.png", "key.json"]
    from PIL import Image

    with Image.open("out/comparison.gif") as film, Image.open("out/contact_sheet.png") as sheet:
        assert film.n_frames == 2
        assert film.width == 200
        assert sheet.height > 2 * 140
    key = json.loads(Path("out/key.json").read_text())
    assert (key["colour"], key["num_frames"], key["blind"]) == ("rg", 2, False)
    left, right = key["left_to_right"]
    assert (left["title"], left["file"], left["vertices"]) == ("coarse", files[0], 36)
    assert (right["title"], right["vertices"]) == ("fine", 72)
    assert right["strain_p99"] == pytest.approx(0.1)
    assert right["relative_gradient"] == 0.25
    assert "fine: rg 0.25, p99 strain 10.0%, 40 ms a frame\n" in capsys.readouterr().out


def test_an_image_lies_on_all_garments(capsys: pytest.CaptureFixture[str]) -> None:
    from PIL import Image

    Image.new("RGB", (4, 4), (220, 20, 20)).save("red.png")
    for name, sides in (("coarse", 12), ("fine", 24)):
        pos, faces = cylinder(sides, 3, 0.3, 0.5)
        record(f"{name}/rollout.h5", sides=sides, still={"uv": pos[:, :2].astype(np.float32), "uv_faces": faces})
    words = ["compare", "coarse", "fine", "video=none", "height=140"]
    assert main([*words, "colour=fabric", "texture=red.png", "output=red"]) == 0
    assert main([*words, "colour=fabric", "output=plain"]) == 0
    shares = []
    for folder in ("red", "plain"):
        picture = np.asarray(Image.open(f"{folder}/contact_sheet.png").convert("RGB")).astype(int)
        rows = np.array_split(picture[..., 0] - picture[..., 1:].max(axis=2) > 60, 2)
        shares.append([float(row.mean()) for row in rows])
    assert min(shares[0]) > 0.05
    assert max(shares[1]) < 0.01
    assert main([*words, "texture=red.png", "output=none"]) == 2
    assert "colour=strain: hides texture=red.png" in capsys.readouterr().err
    assert main([*words, "colour=fabric", "texture={shirt:red.png}", "output=none"]) == 2
    assert "texture: unknown garment 'shirt'" in capsys.readouterr().err
    assert not Path("none").exists()


def test_a_blind_comparison_gives_nothing_away(capsys: pytest.CaptureFixture[str]) -> None:
    secret = [record(f"{name}/rollout.h5", wider=wider) for name, wider in (("network", 0.1), ("solver", 0.3))]
    orders, sheets = [], []
    for seed in range(5):
        given = secret if seed % 2 else secret[::-1]
        small = ["video=none", "colour=fabric", "num_frames=2", "height=100", "output=out"]
        wanted = ["compare", *given, "blind=true", f"seed={seed}", *small]
        assert main(wanted) == 0
        told = capsys.readouterr()
        assert "network" not in told.out + told.err
        assert "solver" not in told.out + told.err
        rows = json.loads(Path("out/key.json").read_text())["left_to_right"]
        assert [row["title"] for row in rows] == ["A", "B"]
        orders.append([row["file"] for row in rows])
        sheets.append(Path("out/contact_sheet.png").read_bytes())
        if seed == 0:  # the order in which they are given decides nothing
            assert main([*wanted[:1], *given[::-1], *wanted[3:]]) == 0
            assert Path("out/contact_sheet.png").read_bytes() == sheets[0]
            assert [row["file"] for row in json.loads(Path("out/key.json").read_text())["left_to_right"]] == orders[0]
    assert sorted(map(tuple, orders))[0] != sorted(map(tuple, orders))[-1]


def no_rollout(path: str) -> str:
    with h5py.File(path, "w") as file:
        file["mesh/pos"] = np.zeros((3, 3))
    return path


def text(path: str) -> str:
    Path(path).write_text("hello")
    return path


def broken(path: str) -> str:
    with h5py.File(record(path), "r+") as file:
        file["cloth/faces"][0] = 4000
    return path


def empty(path: str) -> str:
    with h5py.File(record(path), "r+") as file:
        file.attrs["num_frames"] = 0
    return path


REFUSED = {
    "one file": (lambda: ["a.h5"], "number of rollouts given: 1; give two or more"),
    "no file": (lambda: [], "number of rollouts given: 0; give two or more"),
    "a file that is not there": (lambda: ["a.h5", "c.h5"], "c.h5: no such file; give the rollout.h5"),
    "text": (lambda: ["a.h5", text("t.h5")], "t.h5: not a rollout file"),
    "another HDF5 file": (lambda: ["a.h5", no_rollout("n.h5")], "n.h5: not a rollout file"),
    "faces that name no vertices": (lambda: ["a.h5", broken("b.h5")], "b.h5: not a rollout file (cloth/faces name"),
    "no frames": (lambda: ["a.h5", empty("e.h5")], "e.h5: holds no frames"),
    "other lengths": (
        lambda: ["a.h5", record("b.h5", frames=3)],
        "a.h5 and b.h5: 2 and 3 frames; show those that",
    ),
    "another frame rate": (lambda: ["a.h5", record("b.h5", dt=0.02)], "30 and 50 frames per second"),
    "another motion": (lambda: ["a.h5", record("b.h5", shift=0.1)], "the bodies move differently, 0.1 m apart in frame 0"),
    "no rg": (
        lambda: ["a.h5", record("b.h5", rg=False), "colour=rg"],
        "b.h5: colour=rg needs cloth/rg, which is",
    ),
    "a misspelt colour": (lambda: ["a.h5", "a.h5", "colour=strains"], "did you mean 'strain'"),
    "a misspelt key": (lambda: ["a.h5", "a.h5", "colours=rg"], "'colour'"),
    "an option": (lambda: ["a.h5", "a.h5", "--blind"], "unknown option '--blind'"),
    "a negative seed": (lambda: ["a.h5", "a.h5", "seed=-1"], "seed=-1: must be a whole number, at least 0"),
    "a tiny picture": (lambda: ["a.h5", "a.h5", "height=9"], "height=9: must be a whole number, at least 64"),
    "too many frames": (lambda: ["a.h5", "a.h5", "num_frames=9"], "num_frames=9: these rollouts have 1 to 2 frames in common"),
    "no picture": (lambda: ["a.h5", "a.h5", "video=none", "sheet=false"], "leave nothing to draw"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_compared_is_refused_in_a_sentence(case: str, capsys: pytest.CaptureFixture[str]) -> None:
    record("a.h5")
    arguments, words = REFUSED[case]
    assert main(["compare", *arguments(), "output=out"]) == 2
    told = capsys.readouterr().err
    assert words in told
    assert told.count("\n") == 1
    assert not Path("out").exists()


def test_names_are_as_short_as_they_may_be() -> None:
    assert short_names([Path("x/one/rollout.h5"), Path("x/two/rollout.h5")]) == ["one", "two"]
    assert short_names([Path("a/run/rollout.h5"), Path("b/run/rollout.h5")]) == ["a/run", "b/run"]
    assert short_names([Path("x/p.h5"), Path("x/q.h5")]) == ["p", "q"]
    assert short_names([Path("x/p.h5"), Path("x/p.h5")]) == ["p", "p"]


def test_help_lists_its_keys() -> None:
    told = describe("compare")
    assert "usage: hood compare FILE ... [key=value ...]" in told
    assert "blind=false" in told
