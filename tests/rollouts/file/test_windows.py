"""Windows of frames from many rollouts: what an item holds, which rows are taken, workers, and what is refused."""

from __future__ import annotations

import json
import multiprocessing
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from test_compact import CHEAP, FACES
from torch.utils.data import DataLoader

import hood
from hood.cli.main import main
from hood.rollouts.file import dataset
from hood.rollouts.file.compact import BOTH, POSITION_STEP, make_compact
from hood.rollouts.file.dataset import RolloutDataset
from hood.rollouts.file.recorder import RolloutWriter

DT = 0.5
FABRIC = {"_target_": "hood.assets.material.Material", "density": 0.2, "bending_stiffness": 4e-5}


def write(path: Path, frames: int, start: float) -> None:
    """A rollout whose vertices are all at ``start`` + t + t² / 10 [m] in frame t."""
    path.parent.mkdir(parents=True, exist_ok=True)
    attributes = {"garment": "rag", "material": FABRIC}
    with RolloutWriter(path, frames, np.eye(4, 3), FACES, FACES[:1], 3, (), DT, attributes, double=True) as target:
        for t in range(frames):
            target.append(np.full((4, 3), at(start, t)), np.full((3, 3), -at(start, t)), {})


def at(start: float, t: int) -> float:
    return start + t + 0.1 * t * t


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Rows of several verdicts, with 10, 11, … frames, the second one compact."""
    lines = []
    for index, verdict in enumerate(("sound", "sound", "doubtful", "unsound", "failed", "sound")):
        name = f"{'shirt' if index % 2 else 'dress'}/walk{index}"
        line = {"row": name, "verdict": verdict, "settings": {"material": "silk" if index == 5 else "default"}}
        if verdict != "failed":
            write(tmp_path / name / "rollout.h5", 10 + index, 100.0 * index)
            line |= {"stored_frames": 10 + index} if index != 5 else {}
        lines.append(json.dumps(line))
    make_compact(tmp_path / "shirt" / "walk1" / "rollout.h5", BOTH, None)
    lines.insert(0, json.dumps({"row": "dress/walk0", "verdict": "failed"}))  # it was made again later
    (tmp_path / "manifest.jsonl").write_text("\n".join(lines) + '\n{"row": "cut o')
    return tmp_path


def test_items_are_windows_of_frames(folder: Path) -> None:
    data = RolloutDataset(folder, window=3, stride=2, velocities=True, body="pos", dtype=torch.float64)
    assert data.names == ["dress/walk0", "shirt/walk1", "shirt/walk5"]
    starts = [(rollout, frame) for rollout, frames in enumerate((10, 11, 15)) for frame in range(1, frames - 2, 2)]
    assert len(data) == len(starts)
    for index, (rollout, frame) in enumerate(starts):
        item = data[index]
        assert (item["rollout"], item["frame"], item["name"]) == (rollout, frame, data.names[rollout])
        true = np.array([at((0.0, 100.0, 500.0)[rollout], t) for t in range(frame - 1, frame + 3)])
        assert item["cloth_pos"].shape == item["cloth_vel"].shape == (3, 4, 3)
        assert item["body_pos"].shape == (3, 3, 3)
        error = POSITION_STEP if rollout == 1 else 1e-12
        np.testing.assert_allclose(item["cloth_pos"][:, 0, 0], true[1:], rtol=0, atol=error)
        np.testing.assert_allclose(item["cloth_vel"][:, 3, 2], np.diff(true) / DT, rtol=0, atol=2 * error / DT)
        np.testing.assert_allclose(item["body_pos"][:, 1, 1], -true[1:], rtol=0, atol=5e-5)
        assert item["dt"] == DT
        assert item["garment"] == "rag"
        assert item["fabric"] == {"density": 0.2, "bending_stiffness": 4e-5}
    assert data[-1]["frame"] == starts[-1][1]
    with pytest.raises(IndexError):
        data[len(data)]


@pytest.mark.parametrize(
    ("choice", "names"),
    [
        ({"verdict": ("sound", "doubtful")}, ["dress/walk0", "shirt/walk1", "dress/walk2", "shirt/walk5"]),
        ({"verdict": ("unsound",)}, ["shirt/walk3"]),
        ({"rows": ["shirt/*"]}, ["shirt/walk1", "shirt/walk5"]),
        ({"where": lambda line: line["settings"]["material"] == "silk"}, ["shirt/walk5"]),
        ({"window": 12}, ["shirt/walk5"]),
        ({"frames": (4, 6)}, ["dress/walk0", "shirt/walk1", "shirt/walk5"]),
    ],
)
def test_rows_are_taken_by_choice(folder: Path, choice: dict[str, Any], names: list[str]) -> None:
    data = RolloutDataset(folder / "manifest.jsonl", **choice)
    assert data.names == names
    if "frames" in choice:
        assert [item["frame"] for item in data] == [4, 4, 4]  # type: ignore[attr-defined]


def test_meshes_are_shared(folder: Path) -> None:
    data = RolloutDataset(folder)
    assert data.mesh(0) is data.mesh(2)
    np.testing.assert_array_equal(data.mesh(0).faces, FACES)
    np.testing.assert_array_equal(data.mesh(0).rest_pos, np.eye(4, 3))


def test_few_files_stay_open(folder: Path) -> None:
    data = RolloutDataset(folder, open_files=1)
    in_order = [data[index]["cloth_pos"] for index in range(len(data))]
    for index in (0, len(data) - 1, 5, 12, 0):
        assert torch.equal(data[index]["cloth_pos"], in_order[index])
    assert len(data._files) == 1


@pytest.mark.filterwarnings("ignore:This DataLoader will create")  # where the tests have one processor
@pytest.mark.parametrize("method", sorted({"fork", "spawn"} & {*multiprocessing.get_all_start_methods()}))
def test_workers_read_what_one_process_reads(folder: Path, method: str) -> None:
    data = RolloutDataset(folder, where=lambda line: True)
    alone = [data[index]["cloth_pos"] for index in range(len(data))]  # files are open when the workers begin
    loader = DataLoader(data, batch_size=4, num_workers=2, multiprocessing_context=method)
    read = torch.cat([batch["cloth_pos"] for batch in loader])
    assert torch.equal(read, torch.stack(alone))


def test_a_pickled_data_set_has_no_open_files(folder: Path) -> None:
    data = RolloutDataset(folder)
    first = data[0]["cloth_pos"]
    assert torch.equal(pickle.loads(pickle.dumps(data))[0]["cloth_pos"], first)


def test_the_parameters_of_a_body_give_its_vertices(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    main(["rollout", *CHEAP, "num_frames=12", "formats=[cloth]", "output=out"])
    given = RolloutDataset(["out"], window=3, body="parameters", dtype=torch.float64)[7]
    shown = RolloutDataset(["out/rollout.h5"], window=3, body="pos", dtype=torch.float64)[7]
    sequence = hood.PoseSequence.from_arrays(given["body_poses"].numpy(), given["body_transl"].numpy(), 30.0)
    body, betas = hood.load_body(), given["body_betas"].numpy()
    surface = body.surface(sequence, betas, torch.float64).numpy() + body.translation(sequence, betas)[:, None]
    np.testing.assert_allclose(surface, shown["body_pos"], atol=1e-9)
    np.testing.assert_allclose(surface, hood.read_rollout("out/rollout.h5").body_pos[7:10], atol=1e-6)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"window": 0}, "window=0: give a whole number above 0"),
        ({"stride": 1.5}, "stride=1.5"),
        ({"body": "mesh"}, "unknown value for body 'mesh'"),
        ({"verdict": ("fine",)}, "unknown verdict 'fine'"),
        ({"window": 99}, "none of 3 rollouts has 99 frames"),
        ({"rows": ["coat/*"]}, "no row is taken; it has 3 sound, 1 doubtful, 1 unsound, 1 failed"),
    ],
)
def test_what_cannot_be_used_is_refused(folder: Path, given: dict[str, Any], told: str) -> None:
    with pytest.raises(ValueError, match=told.replace("(", r"\(")):
        RolloutDataset(folder, **given)


def test_files_that_cannot_be_read_are_named(folder: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"none/rollout\.h5: no such file|none: no such file"):
        RolloutDataset([folder / "none"])
    with pytest.raises(FileNotFoundError, match="give the output folder of hood dress"):
        RolloutDataset(folder / "dress")
    with pytest.raises(ValueError, match="one file; give a list"):
        RolloutDataset(folder / "dress" / "walk0" / "rollout.h5")
    with pytest.raises(ValueError, match=r"walk0/rollout\.h5: has the body's vertices, not its parameters"):
        RolloutDataset(folder, body="parameters")[0]
    data = RolloutDataset(folder)
    write(folder / "dress" / "walk0" / "rollout.h5", 4, 0.0)
    with pytest.raises(ValueError, match=r"walk0/rollout\.h5: has 4 frames, not 10; make the data set anew"):
        data[0]
    (folder / "dress" / "walk0" / "rollout.h5").write_text("nothing")
    with pytest.raises(ValueError, match=r"walk0/rollout\.h5: not a rollout file"):
        data[0]


def test_bodies_of_windows_that_cross_chunks_are_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    main(["rollout", *CHEAP, "num_frames=36", "formats=[cloth]", "output=out"])
    monkeypatch.setattr(dataset, "_KEPT", 0)  # nothing stays
    data = RolloutDataset(["out"], window=5, body="pos")
    whole = hood.read_rollout("out/rollout.h5").body_pos
    for index in (0, 29, 31):
        np.testing.assert_allclose(data[index]["body_pos"], whole[index : index + 5], rtol=0, atol=1e-6)
    assert data[31]["body_pos"].dtype == torch.float32
    assert not data._unpacked
    assert data._kept == 0
