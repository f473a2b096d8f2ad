"""``refine_mesh``: stored frames on a finer mesh, outside the body, with what is measured left to the simulated mesh."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch
from jogging import WORDS, jog

import hood
from hood.assets.garment.binding import signed_distances
from hood.cli.inspect.findings import inspect_rollout
from hood.cli.main import main
from hood.cloth.state import State
from hood.media.colouring import colouring_of, vertex_strain
from hood.media.exports.sequences import clip_of
from hood.mesh.editing.subdivision import Subdivision
from hood.mesh.penetration.crossing import self_crossings
from hood.mesh.topology import unique_edges
from hood.rollouts.file.reader import RolloutData, read_rollout
from hood.rollouts.frame import Frame
from hood.rollouts.frames import refined_frames
from hood.rollouts.verdict.rule import judge_rollout
from hood.testing import cylinder, grid

ROLLOUT = ["rollout", *WORDS, "garment=dress", "num_frames=5"]
OTHER = ("refined_mesh", "ms_per_frame", "warnings", "settled", "cloth_contact", "output", "num_frames", "dt")


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def rollout(*words: str, output: str = "run") -> tuple[RolloutData, dict[str, Any]]:
    return jog("garment=dress", "num_frames=5", *words, output=output)


@pytest.mark.parametrize("levels", [1, 2])
def test_a_dress_is_stored_finer_and_measured_as_it_was_simulated(levels: int, capsys: pytest.CaptureFixture[str]) -> None:
    coarse, usual = rollout("metrics={fields:[rg]}", output="coarse")
    assert coarse.refined is None
    assert "refined_mesh" not in usual
    assert not {"refine_mesh", "simulated_vertices"} & set(coarse.attributes)
    data, summary = rollout("metrics={fields:[rg]}", f"refine_mesh={levels}")
    count = coarse.cloth_pos.shape[1]
    assert len(data.cloth_faces) == len(coarse.cloth_faces) * 4**levels
    assert data.refined is not None
    np.testing.assert_array_equal(data.refined.faces, coarse.cloth_faces)
    np.testing.assert_array_equal(data.cloth_pos[:, :count], coarse.cloth_pos)
    np.testing.assert_array_equal(data.rest_pos[:count], coarse.rest_pos)
    np.testing.assert_array_equal(data.fields["rg"][:, :count], coarse.fields["rg"])
    for name, values in coarse.metrics.items():
        if not name.startswith("ms_"):
            np.testing.assert_array_equal(data.metrics[name], values, err_msg=name)
    assert {key: value for key, value in summary.items() if key not in OTHER} == {
        key: value for key, value in usual.items() if key not in OTHER
    }
    assert (summary["refined_mesh"]["vertices"], summary["refined_mesh"]["simulated_vertices"]) == (
        data.cloth_pos.shape[1],
        count,
    )
    assert inspect_rollout("run/rollout.h5").facts["simulated cloth vertices"] == count
    assert "no wrinkle that the simulated mesh has not" in summary["refined_mesh"]["what"]
    assert f"refined from {count}: a smooth surface" in capsys.readouterr().out
    for cloth, body in zip(data.cloth_pos, data.body_pos, strict=True):
        assert signed_distances(cloth, body.astype(np.float64), data.body_faces).min() > 1.9e-3
        assert len(self_crossings(cloth, data.cloth_faces)) == 0
    half = np.concatenate([data.cloth_faces[:, pair] for pair in ([0, 1], [1, 2], [2, 0])])
    assert len(np.unique(half, axis=0)) == len(half)


def test_films_and_files_of_other_programs_show_the_finer_mesh() -> None:
    coarse, _ = rollout("metrics=strain", "guard=off", output="coarse")
    data, _ = rollout(
        "refine_mesh=1", "output_fps=60", "metrics=strain", "guard=off", "sheet=true", "colour=strain", "formats=[ply]"
    )
    assert len(data.cloth_pos) == 9
    count = coarse.cloth_pos.shape[1]
    np.testing.assert_array_equal(data.cloth_pos[::2, :count], coarse.cloth_pos)
    np.testing.assert_allclose(vertex_strain(data)[::2, :count], vertex_strain(coarse), atol=1e-7)
    colouring = colouring_of(data, "strain")
    assert colouring is not None
    assert colouring.values.shape == data.cloth_pos.shape[:2]
    assert (Path("run") / "contact_sheet.png").stat().st_size > 10_000
    cloth = clip_of(data).parts[0]
    assert cloth.pos.shape[1] == data.cloth_pos.shape[1]
    assert cloth.uv is not None
    assert cloth.uv_faces is not None
    assert len(cloth.uv_faces) == len(data.cloth_faces)
    written = next(path for path in Path("run").rglob("*.ply") if "dress" in path.as_posix())
    assert f"element face {len(data.cloth_faces)}".encode() in written.read_bytes()[:1000]


def test_an_outfit_stays_two_garments() -> None:
    data, _ = rollout("garment=[tank,skirt]", "num_frames=2", "metrics=strain", "guard=off", "refine_mesh=1")
    names = [part.name for part in clip_of(data).parts]
    assert names == ["tank", "skirt", "body"]
    assert sum(len(part.faces) for part in clip_of(data).parts[:2]) == len(data.cloth_faces)


def test_the_verdict_is_that_of_the_simulated_mesh() -> None:
    coarse, usual = rollout("metrics=none", "guard=off", output="coarse")
    data, summary = rollout("metrics=none", "guard=off", "refine_mesh=2")
    assert judge_rollout(data) == judge_rollout(coarse)
    assert summary["sound"] == usual["sound"]


def test_python_gives_the_finer_mesh() -> None:
    keys: dict[str, Any] = {"stepper": "newton", "metrics": "strain", "guard": "off", "num_frames": 2}
    usual = list(hood.simulate("tank", "walk_proud", **keys))
    simulation = hood.simulate("tank", "walk_proud", refine_mesh=1, **keys)
    assert len(simulation.faces) == 4 * len(simulation.scene.garment.faces)
    for frame, other in zip(simulation, usual, strict=True):
        count = len(other.world_pos)
        assert len(frame.world_pos) == count + len(unique_edges(simulation.scene.garment.faces)) == simulation.faces.max() + 1
        assert torch.equal(frame.world_pos[:count], other.world_pos)
        assert torch.equal(frame.state.pos, other.state.pos)


def test_rollouts_refined_otherwise_are_not_taken_for_finished() -> None:
    Path("motions").mkdir()
    still = {"poses": np.zeros((8, 156)), "trans": np.zeros((8, 3)), "betas": np.zeros(16)}
    for name in ("a", "b"):
        np.savez(Path("motions") / f"{name}.npz", **still, mocap_framerate=30.0, gender="neutral")
    words = [*ROLLOUT, "sequence=motions", "start=null", "up=y", "num_frames=2", "metrics=strain", "guard=off", "resume=true",
             "output=many"]  # fmt: skip
    found = []
    for levels in (0, 1, 1, 0):
        assert main([*words, f"refine_mesh={levels}"]) == 0
        found.append({path: path.stat().st_mtime_ns for path in Path("many").rglob("rollout.h5")})
    assert found[1] == found[2]
    assert not set(found[0].values()) & set(found[1].values())
    assert not set(found[1].values()) & set(found[3].values())


@pytest.mark.parametrize("levels", ["-1", "3"])
def test_numbers_that_no_mesh_is_refined_by(levels: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*ROLLOUT, f"refine_mesh={levels}"]) == 2
    assert f"refine_mesh={levels}: give how often every face is cut into four" in capsys.readouterr().err


def test_files_whose_meshes_do_not_belong_together_are_refused() -> None:
    rollout("num_frames=2", "metrics=strain", "guard=off", "refine_mesh=1")
    path = Path("run/rollout.h5")
    with h5py.File(path, "r+") as file:
        file["cloth/simulated_faces"][0, 0] = 10**6
    with pytest.raises(ValueError, match=r"not a rollout file \(cloth/faces .* are not .* simulated faces"):
        read_rollout(path)
    with h5py.File(path, "r+") as file:
        file["cloth/simulated_faces"][0, 0] = 0
    with pytest.raises(ValueError, match="are not cloth/simulated_faces, refined"):
        vertex_strain(read_rollout(path))


def frames(pos: np.ndarray, body: np.ndarray) -> Iterator[Frame]:
    tensor = torch.as_tensor(pos)
    state = State(tensor, torch.zeros_like(tensor), torch.zeros(1, 3, dtype=torch.float64))
    yield Frame(0, state, tensor, torch.as_tensor(body), {"strain": 1.0}, {"rg": tensor[:, 0].float()})


def test_new_vertices_come_out_of_the_body() -> None:
    """A square tube around a round body that bulges through its sides between the corners."""
    pos, faces = cylinder(4, 4, 0.2, 0.3)
    body, body_faces = cylinder(48, 25, 0.15, 0.6)
    finer = Subdivision(faces, pos, 2)
    (frame,) = refined_frames(frames(pos, body), finer, body_faces, 2e-3)
    found = frame.world_pos.numpy()
    assert signed_distances(finer.spread(pos), body, body_faces).min() < -5e-3
    assert np.array_equal(found[: len(pos)], pos)
    assert signed_distances(found, body, body_faces).min() > 1.9e-3
    assert frame.metrics == {"strain": 1.0}
    np.testing.assert_allclose(frame.fields["rg"].numpy(), finer.spread(pos)[:, 0], atol=1e-6)


def test_smooth_surfaces_do_not_pass_through_each_other() -> None:
    """A hexagonal tube 5 mm beside a flat sheet, through which the round tube would pass."""
    pos, faces = cylinder(6, 4, 0.1, 0.3)
    corner = pos[faces[0, 0], [0, 2]]
    angle = np.arctan2(corner[1], corner[0]) + np.pi / 6
    out, along = np.array([np.cos(angle), 0.0, np.sin(angle)]), np.array([-np.sin(angle), 0.0, np.cos(angle)])
    square, more = grid(5, 5, 0.4)
    middle = np.array([0.0, pos[:, 1].mean(), 0.0]) + (0.1 * np.cos(np.pi / 6) + 0.005) * out
    sheet = middle + (square[:, :1] - 0.2) * along + (square[:, 2:] - 0.2) * np.array([0.0, 1.0, 0.0])
    both, all_faces = np.concatenate([pos, sheet]), np.concatenate([faces, more + len(pos)])
    finer = Subdivision(all_faces, both, 1)
    assert len(self_crossings(both, all_faces)) == 0
    assert len(self_crossings(finer.positions(both), finer.faces)) > 0
    (frame,) = refined_frames(frames(both, np.zeros((0, 3))), finer, np.zeros((0, 3), dtype=np.int64), 2e-3)
    found = frame.world_pos.numpy()
    assert len(self_crossings(found, finer.faces)) == 0
    assert np.array_equal(found[: len(both)], both)
    assert np.linalg.norm(found - finer.spread(both), axis=1).max() > 5e-3  # elsewhere the tube is round
