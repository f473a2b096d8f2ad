"""The compact layout of ``rollout.h5``: its error, what it keeps, what gives the body back, and what is refused."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path

import h5py
import numpy as np
import pytest

from hood.assets.body.body import Body
from hood.assets.body.load import load_body
from hood.cli.main import main
from hood.rollouts.file.compact import BOTH, FULL, POSITION_STEP, PositionTable, make_compact
from hood.rollouts.file.reader import read_rollout
from hood.rollouts.file.recorder import RolloutWriter
from hood.testing import grid

FACES = np.array([[0, 1, 2], [1, 3, 2]])
#: What makes a rollout cheap.
CHEAP = ["garment=tank", "stepper=guess", "settle=0", "metrics=none", "guard=off", "video=none", "sheet=false"]


def write(path: Path, cloth: np.ndarray, body: np.ndarray, double: bool = True) -> None:
    """A rollout of positions (T, 4, 3) and (T, 3, 3) [m]."""
    farthest = float(np.nanmax(np.abs(body)))
    rest, names = np.eye(4, 3), ("strain_p99",)
    with RolloutWriter(
        path, len(cloth), rest, FACES, FACES[:1], 3, names, 0.5, {"garment": "rag"}, farthest, ("rg",), double
    ) as target:
        for index, (own, under) in enumerate(zip(cloth, body, strict=True)):
            target.append(own, under, {"strain_p99": 0.1 * index}, {"rg": np.full(4, index)})


def walk(frames: int, far: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Cloth and a body that walk from a place ``far`` [m] away."""
    rng = np.random.default_rng(3)
    way = np.cumsum(rng.normal(0.05, 0.02, (frames, 1, 3)), axis=0) + far
    return way + rng.normal(0.0, 0.3, (frames, 4, 3)), way + rng.normal(0.0, 0.3, (frames, 3, 3))


def off(one: np.ndarray, other: np.ndarray) -> float:
    """The greatest distance [m] of vertices."""
    return float(np.linalg.norm(one.astype(np.float64) - other, axis=-1).max())


@pytest.mark.parametrize("frames", [1, 2, 7, 8, 9, 17])
@pytest.mark.parametrize("far", [0.0, 5000.0])
def test_no_vertex_is_off_by_a_step(tmp_path: Path, frames: int, far: float) -> None:
    cloth, body = walk(frames, far)
    write(tmp_path / "r.h5", cloth, body)
    before = read_rollout(tmp_path / "r.h5")
    make_compact(tmp_path / "r.h5", BOTH, None)
    data = read_rollout(tmp_path / "r.h5")
    assert 0.0 < off(data.cloth_pos, cloth) < POSITION_STEP
    assert off(data.body_pos, before.body_pos) < POSITION_STEP
    assert data.cloth_pos.dtype == before.cloth_pos.dtype
    assert data.body_pos.dtype == before.body_pos.dtype
    for name in ("cloth_faces", "rest_pos", "body_faces", "time"):
        np.testing.assert_array_equal(getattr(data, name), getattr(before, name))
    np.testing.assert_array_equal(data.metrics["strain_p99"], before.metrics["strain_p99"])
    np.testing.assert_array_equal(data.fields["rg"], before.fields["rg"])
    assert data.attributes["position_error"] == POSITION_STEP
    assert data.attributes["store"] == BOTH
    assert {**before.attributes, "store": BOTH, "position_error": POSITION_STEP} == data.attributes
    assert [path.name for path in tmp_path.iterdir()] == ["r.h5"]


def test_frames_that_are_not_finite_or_very_far_come_back_as_they_were(tmp_path: Path) -> None:
    cloth, body = walk(20)
    cloth[9, 2], cloth[15, 1, 0], cloth[18] = np.nan, np.inf, 1e30
    write(tmp_path / "r.h5", cloth, body)
    make_compact(tmp_path / "r.h5", BOTH, None)
    data = read_rollout(tmp_path / "r.h5")
    for index in (9, 15, 18):
        np.testing.assert_array_equal(data.cloth_pos[index], cloth[index])
    others = [index for index in range(20) if index not in (9, 15, 18)]
    assert off(data.cloth_pos[others], cloth[others]) < POSITION_STEP


def test_any_frames_are_read_as_the_whole(tmp_path: Path) -> None:
    cloth, body = walk(19)
    cloth[10] = np.nan
    write(tmp_path / "r.h5", cloth, body)
    make_compact(tmp_path / "r.h5", BOTH, None)
    whole = read_rollout(tmp_path / "r.h5").cloth_pos
    with h5py.File(tmp_path / "r.h5") as file:
        table = PositionTable(file, "cloth")
        for start in range(19):
            for stop in range(start + 1, 20):
                np.testing.assert_array_equal(table.read(start, stop), whole[start:stop])


def test_a_rollout_that_ended_early_stays_so(tmp_path: Path) -> None:
    cloth, body = walk(5)
    target = RolloutWriter(tmp_path / "r.h5", 9, np.eye(4, 3), FACES, FACES[:1], 3, (), 0.5, {}, double=True)
    for own, under in zip(cloth, body, strict=True):
        target.append(own, under, {})
    target.close(complete=False)
    make_compact(tmp_path / "r.h5", BOTH, None)
    data = read_rollout(tmp_path / "r.h5")
    assert len(data.cloth_pos) == len(data.time) == 5
    assert not data.attributes["complete"]


def test_a_full_disk_leaves_the_file_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cloth, body = walk(9)
    write(tmp_path / "r.h5", cloth, body)
    before = (tmp_path / "r.h5").read_bytes()

    def refuse(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.raises(OSError, match=r"No space left on device.*r\.h5"):
        make_compact(tmp_path / "r.h5", BOTH, None)
    assert (tmp_path / "r.h5").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["r.h5"]


@pytest.mark.parametrize(
    ("harm", "told"),
    [
        (lambda file: file["cloth/steps"].attrs.__delitem__("origin"), "origin"),
        (lambda file: file["cloth/steps"].attrs.__setitem__("dtype", "U9"), "not positions"),
        (lambda file: file["cloth/exact_frames"].__setitem__(0, 99), "exact_pos"),
        (lambda file: file.__delitem__("body/exact_pos"), "exact_pos is missing"),
    ],
)
def test_tables_that_do_not_belong_together_are_refused(tmp_path: Path, harm: object, told: str) -> None:
    cloth, body = walk(9)
    cloth[3] = np.nan
    write(tmp_path / "r.h5", cloth, body)
    make_compact(tmp_path / "r.h5", BOTH, None)
    with h5py.File(tmp_path / "r.h5", "a") as file:
        harm(file)  # type: ignore[operator]
    with pytest.raises(ValueError, match=rf"r\.h5: not a rollout file \(.*{told}"):
        read_rollout(tmp_path / "r.h5")


def test_a_table_that_claims_more_than_it_holds_is_refused(tmp_path: Path) -> None:
    cloth, body = walk(9)
    write(tmp_path / "r.h5", cloth, body)
    make_compact(tmp_path / "r.h5", BOTH, None)
    with h5py.File(tmp_path / "r.h5", "a") as file:
        says = dict(file["cloth/steps"].attrs)
        del file["cloth/steps"]
        table = file.create_dataset("cloth/steps", (9, 10**9, 3), np.uint32, chunks=(9, 1000, 3), compression="gzip")
        table.attrs.update(says)
    with pytest.raises(ValueError, match="cloth/steps claims the shape"):
        read_rollout(tmp_path / "r.h5")


# ---- hood rollout ----------------------------------------------------------------------------------------------------


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def roll(folder: str, *words: str) -> int:
    return main(["rollout", *CHEAP, "num_frames=12", f"output={folder}", *words])


@pytest.mark.parametrize("rate", [[], ["fps=60", "output_fps=30"], ["fps=30", "output_fps=24"]], ids=["every", "second", "24"])
def test_the_body_comes_back_from_its_parameters(here: Path, rate: list[str]) -> None:
    for store in ("full", "cloth", "cloth+body"):
        roll(store, f"formats=[{store}]", "betas=[1.5]", *rate)
    full, cloth, both = (read_rollout(Path(store) / "rollout.h5") for store in ("full", "cloth", "cloth+body"))
    assert len(cloth.body_pos) == len(full.body_pos)
    assert off(cloth.body_pos, full.body_pos) < 1e-6
    assert off(both.body_pos, full.body_pos) < POSITION_STEP
    np.testing.assert_array_equal(cloth.body_faces, full.body_faces)
    assert off(cloth.cloth_pos, full.cloth_pos) < POSITION_STEP
    sizes = [os.path.getsize(Path(store) / "rollout.h5") for store in ("cloth", "cloth+body", "full")]
    assert sizes == sorted(sizes)
    assert 6 * sizes[0] < sizes[2]


def test_without_a_body_there_is_none(here: Path) -> None:
    roll("bare", "formats=[cloth]", "body=none", "pins=[0]")
    assert read_rollout("bare/rollout.h5").body_pos.shape == (12, 0, 3)


def test_another_body_model_is_refused_and_the_own_can_be_given(here: Path) -> None:
    roll("out", "formats=[cloth]")
    path = Path("out/rollout.h5")
    with h5py.File(path, "a") as file:
        file["body"].attrs["model"] = "gone.npz"
    with pytest.raises(ValueError, match=r"rollout\.h5: the body model gone\.npz cannot be loaded .*body=hood\.load_body"):
        read_rollout(path)
    own = load_body()
    assert read_rollout(path, body=own).body_pos.shape == (12, 6890, 3)
    other = Body(own.name, 1.01 * own.v_template, own.shapedirs, own.joint_regressor, own.weights, own.parents, own.faces)
    with pytest.raises(ValueError, match="is not the one of the rollout"):
        read_rollout(path, body=other)


def test_a_mesh_body_is_refused_before_anything_is_written(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pos, faces = grid(6, 6)
    lines = [f"v {x} {y + 2.5} {z}" for x, y, z in pos] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
    Path("sheet.obj").write_text("\n".join(lines))
    roll("full", "garment=sheet.obj", "worn=false")
    assert roll("refused", "formats=[cloth]", "body=full/rollout.h5", "garment=sheet.obj") == 2
    assert "full/rollout.h5 is a mesh, which no parameters give back; choose formats=[cloth+body]" in capsys.readouterr().err
    assert not Path("refused").exists()
    roll("both", "formats=[cloth+body]", "body=full/rollout.h5", "garment=sheet.obj", "worn=false")
    assert off(read_rollout("both/rollout.h5").body_pos, read_rollout("full/rollout.h5").body_pos) < POSITION_STEP


def test_another_word_is_refused(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert roll("out", "formats=[cloth,cloth+body]") == 2
    assert "are layouts of one file" in capsys.readouterr().err
    assert roll("out", "formats=[cloths]") == 2
    assert "cloth or cloth+body" in capsys.readouterr().err


def test_an_interrupted_rollout_keeps_the_layout_that_it_was_written_in(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = RolloutWriter.append

    def interrupted(self: RolloutWriter, *given: object) -> None:
        if self.frames_done == 5:
            raise KeyboardInterrupt
        whole(self, *given)  # type: ignore[arg-type]

    monkeypatch.setattr(RolloutWriter, "append", interrupted)
    assert roll("out", "formats=[cloth]") == 130
    with h5py.File("out/rollout.h5") as file:
        assert file["cloth/pos"].shape[0] == 5
        assert "store" not in file.attrs


def test_resume_keeps_what_is_there_and_makes_another_layout_again(here: Path) -> None:
    roll("out", "formats=[cloth]")
    first = Path("out/rollout.h5").stat().st_mtime_ns
    roll("out", "formats=[cloth]", "resume=true")
    assert Path("out/rollout.h5").stat().st_mtime_ns == first
    roll("out", f"formats=[{FULL}]", "resume=true")
    with h5py.File("out/rollout.h5") as file:
        assert "cloth/pos" in file


def test_commands_read_compact_rollouts(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    roll("out", "formats=[cloth,glb]", "garment=tank")
    assert list(Path("out").glob("*.glb"))
    assert main(["inspect", "out"]) in (0, 1)
    told = capsys.readouterr().out
    assert "rollout.h5: rollout" in told
    assert "store: cloth" in told
    assert main(["export", "out", "format=obj", "num_frames=2", "output=obj"]) == 0
    assert main(["view", "out", "output=page.html"]) == 0
    assert main(["rollout", *CHEAP, "body=out/rollout.h5", "output=again", "num_frames=2"]) == 2
    assert "a rollout of formats=[cloth], whose body is no mesh here; make it without" in capsys.readouterr().err
    assert json.loads(Path("out/summary.json").read_text())["num_frames"] == 12
