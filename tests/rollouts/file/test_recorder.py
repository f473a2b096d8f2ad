"""Rollouts on disk: what is read back, and what a kill, an interrupt or a full disk leaves."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from hood.rollouts.file.reader import RolloutData, read_rollout
from hood.rollouts.file.recorder import RolloutWriter
from hood.rollouts.file.step_table import OutputRate, StepPlan

NAMES = ("strain_p99", "energy_total")
FACES = np.array([[0, 1, 2], [1, 3, 2]])


def writer(path: Path, num_frames: int = 5, farthest: float = 0.0) -> RolloutWriter:
    attributes = {"garment": "rag", "config": {"fps": 30}, "model": None, "seed": 3}
    return RolloutWriter(path, num_frames, np.eye(4, 3), FACES, FACES[:1], 3, NAMES, 0.5, attributes, farthest)


def frame(index: int) -> tuple[np.ndarray, np.ndarray, dict[str, float]]:
    metrics = {"strain_p99": 0.1 * index} | ({"energy_total": float(index)} if index else {})
    return np.full((4, 3), index + 0.25), np.full((3, 3), -index - 0.5), metrics


def append(target: RolloutWriter, count: int) -> None:
    for index in range(count):
        target.append(*frame(index))


def write_until(path: Path, count: int, error: BaseException, num_frames: int = 5) -> None:
    """Write ``count`` frames; then ``error`` strikes inside the block."""
    with writer(path, num_frames) as target:
        append(target, count)
        raise error


def check(data: RolloutData, count: int) -> None:
    assert data.cloth_pos.shape == (count, 4, 3)
    assert data.body_pos.shape == (count, 3, 3)
    assert data.cloth_pos[:, 0, 0].tolist() == [index + 0.25 for index in range(count)]
    assert data.body_pos[:, 0, 0].tolist() == [-index - 0.5 for index in range(count)]
    assert data.time.tolist() == [0.5 * index for index in range(count)]
    np.testing.assert_allclose(data.metrics["strain_p99"], 0.1 * np.arange(count))


def test_round_trip(tmp_path: Path) -> None:
    with writer(tmp_path / "r.h5") as target:
        append(target, 5)
    data = read_rollout(tmp_path / "r.h5")
    check(data, 5)
    np.testing.assert_array_equal(data.cloth_faces, FACES)
    np.testing.assert_array_equal(data.rest_pos, np.eye(4, 3))
    assert data.attributes["num_frames"] == 5
    assert bool(data.attributes["complete"])
    assert data.attributes["garment"] == "rag"
    assert data.attributes["seed"] == 3
    assert json.loads(data.attributes["config"]) == {"fps": 30}
    assert json.loads(data.attributes["model"]) is None
    assert data.attributes["dt"] == 0.5
    assert data.cloth_pos.dtype == np.float32


def test_metrics_that_a_frame_lacks_are_nan(tmp_path: Path) -> None:
    with writer(tmp_path / "r.h5") as target:
        append(target, 5)
    energy = read_rollout(tmp_path / "r.h5").metrics["energy_total"]
    assert np.isnan(energy[0])
    assert energy[1:].tolist() == [1, 2, 3, 4]


def test_far_worlds_are_kept_in_float64(tmp_path: Path) -> None:
    place = np.full((4, 3), 1e4) + 1e-7
    with writer(tmp_path / "r.h5", 1, farthest=1e4) as target:
        target.append(place, np.zeros((3, 3)), {})
    np.testing.assert_allclose(read_rollout(tmp_path / "r.h5").cloth_pos[0], place, rtol=0, atol=1e-10)


def test_the_file_is_readable_while_it_is_written_to(tmp_path: Path) -> None:
    with writer(tmp_path / "r.h5") as target:
        append(target, 2)
        with h5py.File(tmp_path / "r.h5", "r") as file:
            assert file.attrs["num_frames"] == 2
            assert not file.attrs["complete"]
            # Frames to come are not a number, never a plausible zero.
            assert np.isnan(file["cloth/pos"][2:]).all()
            assert np.isnan(file["metrics/energy_total"][2:]).all()
        append(target, 3)


@pytest.mark.parametrize("frames", [0, 1, 3])
def test_a_killed_process_leaves_a_file_that_opens(tmp_path: Path, frames: int) -> None:
    code = f"""
import os, signal, sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
from pathlib import Path
from test_recorder import append, writer
target = writer(Path({str(tmp_path / "r.h5")!r}))  # held: an object that goes away closes its file
append(target, {frames})
os.kill(os.getpid(), signal.SIGKILL)
"""
    killed = subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parents[3], check=False)
    assert killed.returncode == -signal.SIGKILL
    data = read_rollout(tmp_path / "r.h5")
    check(data, frames)
    assert data.attributes["num_frames"] == frames
    assert not data.attributes["complete"]


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_an_interrupt_keeps_the_frames_done(tmp_path: Path, error: type[BaseException]) -> None:
    with pytest.raises(error):
        write_until(tmp_path / "r.h5", 2, error(), num_frames=50)
    check(read_rollout(tmp_path / "r.h5"), 2)
    with h5py.File(tmp_path / "r.h5", "r") as file:
        assert file["cloth/pos"].shape == (2, 4, 3)
        assert file["metrics/strain_p99"].shape == (2,)
        assert file["time"].shape == (2,)
        assert not file.attrs["complete"]
        assert file.attrs["garment"] == "rag"
    assert [path.name for path in tmp_path.iterdir()] == ["r.h5"]


def test_an_interrupt_before_the_first_frame_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        write_until(tmp_path / "r.h5", 0, KeyboardInterrupt())
    assert not list(tmp_path.iterdir())


def test_a_full_disk_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="No space"):
        write_until(tmp_path / "r.h5", 2, OSError(28, "No space left on device"))
    assert not list(tmp_path.iterdir())


def test_a_refused_layout_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(TypeError):
        RolloutWriter(tmp_path / "r.h5", 2, np.eye(3), FACES, FACES, 3, NAMES, 0.5, {"object": {1, 2}})
    assert not list(tmp_path.iterdir())


def test_a_writer_that_is_handed_over_and_closed_early(tmp_path: Path) -> None:
    target = writer(tmp_path / "r.h5")
    append(target, 3)
    target.close(complete=False)
    check(read_rollout(tmp_path / "r.h5"), 3)


def test_other_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "text.h5").write_text("hello")
    with pytest.raises(ValueError, match=r"text\.h5: not a rollout file"):
        read_rollout(tmp_path / "text.h5")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = 1
    with pytest.raises(ValueError, match=r"other\.h5: not a rollout file"):
        read_rollout(tmp_path / "other.h5")
    with pytest.raises(FileNotFoundError):
        read_rollout(tmp_path / "none.h5")


def test_values_of_every_vertex_are_kept_and_cut_with_the_rest(tmp_path: Path) -> None:
    """Also where the rollout ends early; files without such values stay what they were."""
    for count in (3, 2):
        path = tmp_path / f"{count}.h5"
        with RolloutWriter(path, 3, np.eye(4, 3), FACES, FACES[:1], 3, NAMES, 0.5, {}, fields=("rg",)) as target:
            for index in range(count):
                target.append(*frame(index), {"rg": np.full(4, index if index else np.nan)})
        data = read_rollout(path)
        assert list(data.fields) == ["rg"]
        assert data.fields["rg"].dtype == np.float32
        assert data.fields["rg"].shape == (count, 4)
        assert np.isnan(data.fields["rg"][0]).all()
        np.testing.assert_array_equal(data.fields["rg"][1:, 2], np.arange(1, count))
    with writer(tmp_path / "plain.h5") as target:
        append(target, 5)
    assert read_rollout(tmp_path / "plain.h5").fields == {}
    with h5py.File(tmp_path / "plain.h5", "r") as file:
        assert set(file["cloth"]) == {"pos", "faces", "rest_pos"}


READER = """
import sys, time
import numpy as np
from pathlib import Path
from hood.rollouts.file.reader import read_rollout
path, seen, polls, complete = Path(sys.argv[1]), 0, 0, False
while not complete:
    try:
        data = read_rollout(path)
    except FileNotFoundError:
        continue
    count, complete = len(data.cloth_pos), bool(data.attributes["complete"])
    assert count >= seen, (count, seen)
    assert data.attributes["num_planned"] == 1000
    index = np.arange(count)
    assert (data.cloth_pos == (index + 0.25)[:, None, None]).all()
    assert (data.body_pos == (-index - 0.5)[:, None, None]).all()
    assert np.allclose(data.metrics["strain_p99"], 0.1 * index)
    if polls == 0 and count > 0:
        print("met a growing file" if count < 1000 else "too late", flush=True)
    polls, seen = polls + (count > 0), count
    time.sleep(0.005)
print(seen)
"""


def test_a_thousand_frames_while_another_process_reads(tmp_path: Path) -> None:
    """Every file that it opens ends with the frames done and holds exactly these."""
    path = tmp_path / "r.h5"
    root = Path(__file__).parents[3]
    reader = subprocess.Popen([sys.executable, "-c", READER, str(path)], cwd=root, stdout=-1, stderr=-1, text=True)
    with writer(path, 1000) as target:
        for index in range(1000):
            target.append(*frame(index))
            if index == 500:  # the reader may start late on a busy machine
                assert reader.stdout is not None
                assert reader.stdout.readline() == "met a growing file\n"
    assert reader.communicate() == ("1000\n", "")
    check(read_rollout(path), 1000)


def test_frames_that_were_counted_but_have_not_arrived_are_left_out(tmp_path: Path) -> None:
    """A network disk may show the count first; cloth that blew up is a frame all the same."""
    path = tmp_path / "r.h5"
    with writer(path) as target:
        append(target, 2)
        target.append(np.full((4, 3), np.nan), np.zeros((3, 3)), {"strain_p99": 1.0})
        target._file.attrs.modify("num_frames", 5)
        target._file.flush()
        data = read_rollout(path)
        assert len(data.cloth_pos) == 3
        assert np.isnan(data.cloth_pos[2]).all()
        append(target, 2)
    assert len(read_rollout(path).cloth_pos) == 5


def test_a_file_takes_its_name_when_it_is_laid_out(tmp_path: Path) -> None:
    """A layout that is refused leaves the file of an earlier run; nobody ever opens half a layout."""
    path = tmp_path / "r.h5"
    with writer(path) as target:
        append(target, 5)
    with pytest.raises(TypeError):
        RolloutWriter(path, 2, np.eye(3), FACES, FACES, 3, NAMES, 0.5, {"object": {1, 2}})
    check(read_rollout(path), 5)
    with h5py.File(path, "r") as old, writer(path) as target:
        append(target, 1)
        assert old.attrs["num_frames"] == 5
        check(read_rollout(path), 1)
    assert [file.name for file in tmp_path.iterdir()] == ["r.h5"]


def write_steps(path: Path, num_steps: int = 7) -> None:
    """Frames at 24 of 120 a second; ``num_steps`` of eleven are simulated before an interrupt, all without."""
    attributes = {"garment": "rag"}
    planned = 11
    target = RolloutWriter(
        path, 3, np.eye(4, 3), FACES, FACES[:1], 3, NAMES, 1 / 24, attributes, guarded=True,
        steps=StepPlan(OutputRate(24.0, 120.0), planned, [1, 3]),
    )  # fmt: skip
    with target:
        for index in range(num_steps):
            pos, body, metrics = frame(index)
            target.append_step(pos if index != 4 else pos * np.nan, metrics)
            if index % 5 == 0:
                target.append(pos, body, metrics)
        alarm = {"frame": 6, "cause": "strain", "value": 1.0, "limit": 0.5, "repair": "none", "iterations": 0}
        target.append_alarms([{**alarm, "rg_before": np.nan, "rg_after": np.nan}])
        if num_steps < planned:
            raise KeyboardInterrupt


def test_three_alarms_of_every_frame_have_room(tmp_path: Path) -> None:
    """Of the step, of triangles in the skin that were taken out, and of the surface that is measured."""
    path = tmp_path / "r.h5"
    alarm = {"value": 1.0, "limit": 0.5, "repair": "", "iterations": 0, "rg_before": np.nan, "rg_after": np.nan}
    with RolloutWriter(path, 2, np.eye(4, 3), FACES, FACES[:1], 3, NAMES, 0.5, {"garment": "rag"}, guarded=True) as target:
        append(target, 2)
        for index in range(2):
            target.append_alarms([{**alarm, "frame": index, "cause": cause} for cause in ("force", "cut", "cut")])
    assert [row["cause"] for row in read_rollout(path).alarms] == 2 * ["force", "cut", "cut"]


@pytest.mark.parametrize("num_steps", [7, 11])
def test_simulated_frames_that_are_not_stored_have_rows_of_their_own(tmp_path: Path, num_steps: int) -> None:
    path = tmp_path / "r.h5"
    if num_steps < 11:
        with pytest.raises(KeyboardInterrupt):
            write_steps(path, num_steps)
    else:
        write_steps(path, num_steps)
    data = read_rollout(path)
    assert data.cloth_pos[:, 0, 0].tolist() == [0.25, 5.25, 10.25][: 1 + (num_steps - 1) // 5]
    assert data.time.tolist() == [index / 24 for index in range(len(data.cloth_pos))]
    assert data.metrics["energy_total"][1:].tolist() == [5.0, 10.0][: len(data.time) - 1]
    assert bool(data.attributes["complete"]) == (num_steps == 11)
    np.testing.assert_allclose(data.step_metrics["strain_p99"], 0.1 * np.arange(num_steps))
    assert data.step_finite.tolist() == [index != 4 for index in range(num_steps)]
    assert data.step_time.tolist() == [index / 120 for index in range(num_steps)]
    assert data.step_pos(np.array([3, 1]))[5].tolist() == [[5.25] * 3] * 2
    assert data.alarms[0]["frame"] == 6
    assert (data.attributes["output_fps"], data.attributes["simulated_fps"]) == (24.0, 120.0)


@pytest.mark.parametrize(
    "name, table, said",
    [
        ("steps/vertices", np.array([1, 4]), "does not name vertices"),
        ("steps/vertices", np.array([3, 1]), "does not name vertices"),
        ("steps/metrics/strain_p99", np.zeros(3), "does not fit 11 simulated frames"),
        ("steps/pos", np.zeros((11, 2, 2)), "does not fit 11 simulated frames"),
    ],
)
def test_tables_of_simulated_frames_that_do_not_belong_together_are_refused(
    tmp_path: Path, name: str, table: np.ndarray, said: str
) -> None:
    path = tmp_path / "r.h5"
    write_steps(path, 11)
    with h5py.File(path, "r+") as file:
        del file[name]
        file[name] = table
    with pytest.raises(ValueError, match=f"not a rollout file .*{said}"):
        read_rollout(path)
    with h5py.File(path, "r+") as file:
        file.attrs["output_fps"] = 0.0
    with pytest.raises(ValueError, match="output_fps is 0"):
        read_rollout(path)
