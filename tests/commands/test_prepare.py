"""``hood prepare`` makes wearable files of garments as they are found, and says what it did."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from wild import write_wild_garment

from hood.assets.binding import posed_body
from hood.assets.body import Body
from hood.assets.garment import Garment, load_garment
from hood.assets.sequence import PoseSequence
from hood.assets.standing import arms_down
from hood.cli import main
from hood.dynamics.recorder import read_rollout
from hood.mesh import topology
from hood.scene.scene import build_scene
from hood.testing import cylinder

UNTRAINED = [
    "checkpoint=untrained",
    "model=small",
    "model.latent_dim=4",
    "model.schedule='1x(mesh)'",
    "video=none",
    "sheet=false",
]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HOOD_TRACEBACK", raising=False)


def prepare(capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, Any]:
    assert main(["prepare", *words, "format=json"]) == 0
    report: dict[str, Any] = json.loads(capsys.readouterr().out)
    return report


def changes(report: dict[str, Any]) -> dict[str, int]:
    return {change["what"]: change["count"] for part in report["garments"] for change in part["changes"]}


def write_obj(path: Path, pos: np.ndarray, faces: np.ndarray) -> None:
    path.write_text("\n".join([f"v {x} {y} {z}" for x, y, z in pos] + [f"f {a} {b} {c}" for a, b, c in faces + 1]))


def test_a_garment_from_the_wild_runs(capsys: pytest.CaptureFixture[str], garments: dict[str, Garment], body: Body) -> None:
    """Centimetres, quads, three components, torn texture seams, 5% of the vertices inside the body: two commands."""
    wild = write_wild_garment(Path("wild.obj"), garments, body)
    report = prepare(capsys, "garment=wild.obj", "output=wild.npz")
    assert changes(report) == {
        "split_polygons": wild.num_quads,
        "scaled": len(wild.garment.rest_pos) + wild.num_torn,
        "welded": wild.num_torn,
        "pushed_out": wild.num_inside,
    }
    assert wild.num_inside == pytest.approx(0.05 * len(wild.garment.rest_pos), abs=1)
    garment = load_garment("wild.npz")
    assert len(np.unique(topology.connected_components(len(garment.rest_pos), topology.unique_edges(garment.faces)))) == 3
    assert np.ptp(garment.rest_pos[:, 1]) == pytest.approx(np.ptp(wild.garment.rest_pos[:, 1]), rel=0.02)
    assert garment.uv is not None
    start = report["starts"]["tpose"]
    assert start["stretch_max"] < 0.1
    assert start["depth_max"] < 2e-3
    assert main(["rollout", "garment=wild.npz", "output=out", "num_frames=3", *UNTRAINED]) == 0
    data = read_rollout(Path("out/rollout.h5"))
    assert data.cloth_pos.shape == (3, len(garment.rest_pos), 3)
    assert np.isfinite(data.cloth_pos).all()


def test_the_file_itself_is_refused_with_the_factor(capsys: pytest.CaptureFixture[str], garments: dict[str, Garment]) -> None:
    tank = garments["tank"]
    for factor, unit in ((100.0, "centimetres"), (1000.0, "millimetres")):
        write_obj(Path("tank.obj"), factor * tank.rest_pos, tank.faces)
        assert main(["rollout", "garment=tank.obj", "num_frames=2", *UNTRAINED]) == 2
        error = capsys.readouterr().err
        assert unit in error
        assert f"scale={1 / factor:g}" in error


@pytest.mark.parametrize(("frame", "given"), [(0, "auto"), (40, "walk_proud")])
def test_garments_of_other_poses(
    capsys: pytest.CaptureFixture[str],
    garments: dict[str, Garment],
    body: Body,
    walk: PoseSequence,
    frame: int,
    given: str,
) -> None:
    """A long-sleeved top as it lies around an A-pose and around a frame of a walk: its lengths stay, and it starts there."""
    sequence = walk if given == "walk_proud" else arms_down(45.0)
    scene = build_scene(garments["longsleeve"], body, sequence)
    state = scene.start(frame, relaxed=False)
    pos = state.pos.double().numpy() + state.origin[0].numpy()
    write_obj(Path("top.obj"), pos, scene.garment.faces)
    report = prepare(capsys, "garment=top.obj", "output=top.npz", f"pose={given}", f"frame={frame}")
    top = load_garment("top.npz")
    edges = topology.unique_edges(top.faces)
    length = [np.linalg.norm(p[edges[:, 0]] - p[edges[:, 1]], axis=1) for p in (pos, top.rest_pos)]
    assert np.median(np.abs(length[1] / length[0] - 1)) < 1e-4
    worn = build_scene(top, body, sequence).start(frame, relaxed=False)
    back = worn.pos.double().numpy() + worn.origin[0].numpy()
    assert np.median(np.linalg.norm(back - pos, axis=1)) < (0.02 if given == "auto" else 2e-3)
    for name, start in report["starts"].items():
        assert start["depth_max"] < 2e-3, name
    if given == "walk_proud":
        assert report["starts"][given]["stretch_max"] < 0.1
    if given == "auto":
        assert changes(report)["pose"] == len(pos)
        assert abs(report["garments"][0]["changes"][0]["details"]["angle"] - 45.0) <= 7.5


def test_an_outfit_in_one_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["rollout", "garment=[tshirt,trousers]", "pins=waistband", "output=out", "num_frames=3", *UNTRAINED]) == 0
    assert "tshirt+trousers: 3 frames, all finite" in capsys.readouterr().out
    shirt, trousers = load_garment("tshirt"), load_garment("trousers")
    data = read_rollout(Path("out/rollout.h5"))
    assert data.cloth_pos.shape[1] == len(shirt.rest_pos) + len(trousers.rest_pos)
    np.testing.assert_array_equal(data.cloth_faces[-len(trousers.faces) :], trousers.faces + len(shirt.rest_pos))


def test_pins_keep_the_numbers_of_the_file(capsys: pytest.CaptureFixture[str], body: Body) -> None:
    """A vertex of no face comes first: the held ones move up by one with its removal."""
    pos, faces = cylinder(24, 10, radius=0.25, height=0.3)
    pos = np.concatenate([[[5.0, 5, 5]], pos + [0, 0.05, 0]])
    write_obj(Path("tube.obj"), pos, faces + 1)
    Path("held.json").write_text("[217, 218]")
    report = prepare(capsys, "garment=tube.obj", "output=tube.npz", "pins=[1,held.json]", "pose=tpose")
    assert changes(report)["removed_unused_vertices"] == 1
    np.testing.assert_array_equal(np.flatnonzero(load_garment("tube.npz").pinned), [0, 216, 217])
    report = prepare(capsys, "garment=tube.obj", "output=tube.npz", "pins=waistband", "pose=tpose")
    assert report["num_pinned"] == 24


REFUSED = {
    "nothing": ([], ("garment is not given",)),
    "far": (["garment=far.obj"], ("does not surround the body", "offset")),
    "flat": (["garment=flat.obj"], ("no face has an area",)),
    "output": (["garment=tank", "output=tank.obj"], (".npz",)),
    "scale": (["garment=far.obj", "scale=-1"], ("scale=-1", "≥ 0")),
    "weld": (["garment=far.obj", "weld=much"], ("weld=much",)),
    "region": (["garment=tank", "pins=waisband"], ("did you mean 'waistband'",)),
    "colours": (["garment=tank", "pins=painted"], ("no vertex colours",)),
    "frame": (["garment=far.obj", "pose=walk_proud", "frame=99999"], ("frame=99999",)),
    "number": (["garment=tank", "pins=99999"], ("vertex 99999 of 1021",)),
    "empty": (["garment=[]"], ("garment=[]",)),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refusals_are_one_line(capsys: pytest.CaptureFixture[str], case: str) -> None:
    pos, faces = cylinder(12, 4)
    write_obj(Path("far.obj"), pos + [3.0, 0, 0], faces)
    write_obj(Path("flat.obj"), pos * [1.0, 0, 0], faces)
    words, expected = REFUSED[case]
    assert main(["prepare", *words]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert all(word in error for word in expected), error


def test_posed_body_is_where_the_scene_has_it(body: Body, walk: PoseSequence) -> None:
    """Garments given around a frame meet the body of a rollout there."""
    betas = np.array([1.0, *[0.0] * 9])
    posed = posed_body(body, walk, 7, betas)
    surface = body.surface(walk.window(7, 8), betas)[0].double().numpy() + body.translation(walk, betas)[7]
    np.testing.assert_allclose(posed.surface, surface, atol=1e-5)
    rest = np.concatenate([body.shaped(betas)[0], np.ones((len(body.v_template), 1))], axis=1)
    skinned = np.einsum("wj,jab,wb->wa", body.weights, posed.transforms, rest)
    np.testing.assert_allclose(skinned, surface, atol=1e-5)
