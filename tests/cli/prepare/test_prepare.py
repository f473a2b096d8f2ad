"""``hood prepare`` makes wearable files of garments as they are found, and says what it did."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from wild import write_wild_garment

from hood.assets.body.body import Body
from hood.assets.garment.binding import posed_body, signed_distances
from hood.assets.garment.garment import Garment, load_garment
from hood.assets.motion.sequence import PoseSequence
from hood.assets.motion.sequence_edit import arms_down
from hood.cli.main import main
from hood.mesh import geometry, topology
from hood.rollouts.file.reader import read_rollout
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
#: Nothing about the garment's place is looked for.
AS_GIVEN = ("scale=1", "up=y", "offset=[0,0,0]")


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
        "garments": 3,
    }
    assert wild.num_inside == pytest.approx(0.05 * len(wild.garment.rest_pos), abs=1)
    garment = load_garment("wild.npz")
    assert len(np.unique(topology.connected_components(len(garment.rest_pos), topology.unique_edges(garment.faces)))) == 3
    assert np.ptp(garment.rest_pos[:, 1]) == pytest.approx(np.ptp(wild.garment.rest_pos[:, 1]), rel=0.02)
    assert garment.uv is not None
    assert report["garments"][0]["rest_lengths"]["change_max"] < 1e-3
    start = report["starts"]["tpose"]
    assert start["stretch_max"] < 0.1
    assert start["depth_max"] < 2e-3
    assert main(["rollout", "garment=wild.npz", "output=out", "num_frames=3", *UNTRAINED, "fail_on=nothing"]) == 0
    data = read_rollout(Path("out/rollout.h5"))
    assert data.cloth_pos.shape == (3, len(garment.rest_pos), 3)
    assert np.isfinite(data.cloth_pos).all()


def shrunk(pos: np.ndarray, factor: float) -> np.ndarray:
    """``pos`` smaller by ``factor``, about the middle of its box."""
    middle = (pos.min(axis=0) + pos.max(axis=0)) / 2
    return middle + factor * (pos - middle)


def lengths(pos: np.ndarray, edges: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.norm(pos[edges[:, 0]] - pos[edges[:, 1]], axis=1))


@pytest.mark.parametrize(("name", "angle", "factor"), [("tank", 0.0, 0.95), ("shorts", 0.0, 0.95), ("longsleeve", 45.0, 0.95)])
def test_the_rest_shape_is_that_of_the_file(
    capsys: pytest.CaptureFixture[str], garments: dict[str, Garment], body: Body, name: str, angle: float, factor: float
) -> None:
    """A garment too tight by 3 to 5%: vertices inside the body start outside; lengths and angles at rest are the file's."""
    scene = build_scene(garments[name], body, arms_down(angle))
    state = scene.start(0, relaxed=False)
    pos, faces = shrunk(state.pos.double().numpy() + state.origin[0].numpy(), factor), garments[name].faces
    write_obj(Path("tight.obj"), pos, faces)
    report = prepare(capsys, "garment=tight.obj", "output=tight.npz", f"pose={'apose' if angle else 'tpose'}", *AS_GIVEN)
    tight = load_garment("tight.npz")
    edges = topology.unique_edges(faces)
    np.testing.assert_allclose(lengths(tight.shaped(np.zeros(10)), edges), lengths(pos, edges), rtol=1e-6)
    hinges = torch.as_tensor(topology.hinges(faces).vertices)
    angles = [geometry.dihedral_angles(torch.as_tensor(p), hinges) for p in (tight.shaped(np.zeros(10)), pos)]
    torch.testing.assert_close(angles[0], angles[1], atol=1e-6, rtol=0.0)
    posed = posed_body(body, arms_down(angle), 0, np.zeros(10))
    assert changes(report)["pushed_out"] == (signed_distances(pos, posed.surface, posed.faces) < 0).sum() > 0.03 * len(pos)
    worn = np.einsum("vj,jab->vab", tight.lbs_weights, posed.transforms)
    skin = np.c_[tight.tpose(np.zeros(10)), np.ones(len(pos))]
    worn_pos = np.einsum("vab,vb->va", worn, skin)
    assert signed_distances(worn_pos, posed.surface, posed.faces).min() > 1e-3
    stretch = lengths(worn_pos, edges) / lengths(pos, edges) - 1
    part = report["garments"][0]
    assert part["rest_lengths"] == {"change_max": pytest.approx(0.0, abs=1e-6), "changed_share": 0.0}
    assert part["worn"]["stretch_max"] == pytest.approx(stretch.max(), abs=1e-3)
    assert part["worn"]["compression_max"] == pytest.approx(-stretch.min(), abs=1e-3)
    assert 0.03 < stretch.max() < 0.1


def test_a_tight_garment_is_simulated(capsys: pytest.CaptureFixture[str], garments: dict[str, Garment]) -> None:
    """Cloth with the lengths of its file, on a body that it is too tight for, is at rest nowhere, but sound; as it is put on:
    where it settles to it slides down the hips."""
    write_obj(Path("tight.obj"), shrunk(garments["skirt"].rest_pos, 0.95), garments["skirt"].faces)
    assert changes(prepare(capsys, "garment=tight.obj", "output=tight.npz", *AS_GIVEN))["pushed_out"] > 20
    keys = ("garment=tight.npz", "stepper=newton", "settle=paper", "num_frames=4", "output=out", "video=none", "sheet=false")
    assert main(["rollout", *keys]) == 0
    summary = json.loads(Path("out/summary.json").read_text())
    assert summary["solver_steps_not_converged"] == 0
    assert summary["strain_p99"] < 0.12
    assert summary["penetration_share_max"] == 0.0


def squeezed_tube() -> tuple[np.ndarray, np.ndarray]:
    """A tube around the waist with two rings that are too narrow for it."""
    pos, faces = cylinder(24, 10, radius=0.25, height=0.3)
    pos = pos + [0, 0.05, 0]
    heights = np.unique(pos[:, 1].round(6))
    pos[np.isin(pos[:, 1].round(6), heights[4:6])] *= [0.35, 1.0, 0.35]
    return pos, faces


def test_what_is_too_small_is_refused_unless_it_is_asked_for(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hood.scene.start._MOST_ITERATIONS", 60)  # no number of them makes it fit
    write_obj(Path("tube.obj"), *squeezed_tube())
    words = ["garment=tube.obj", "output=tube.npz", "pose=tpose", *AS_GIVEN]
    assert main(["prepare", *words]) == 2
    error = capsys.readouterr().err
    assert "too small for the body" in error
    assert "allow_misfit=true" in error
    assert not Path("tube.npz").exists()
    assert main(["prepare", *words, "allow_misfit=true"]) == 0
    assert "it does not fit" in capsys.readouterr().out
    assert load_garment("tube.npz").skin_pos is not None


def test_a_weld_that_changes_lengths_is_refused(capsys: pytest.CaptureFixture[str], garments: dict[str, Garment]) -> None:
    """Triangles torn apart: where their corners coincide welding changes nothing, where they lie 3 mm apart it does."""
    tank = garments["tank"]
    torn, faces = 100.0 * tank.rest_pos[tank.faces].reshape(-1, 3), np.arange(tank.faces.size).reshape(-1, 3)
    write_obj(Path("torn.obj"), torn, faces)
    report = prepare(capsys, "garment=torn.obj", "output=torn.npz")
    assert report["num_vertices"] == len(tank.rest_pos)
    assert report["garments"][0]["rest_lengths"]["change_max"] < 1e-3
    write_obj(Path("torn.obj"), torn + np.random.default_rng(0).uniform(-0.15, 0.15, torn.shape), faces)
    assert main(["prepare", "garment=torn.obj", "output=loose.npz", "weld=0.006"]) == 2
    assert "give a smaller weld" in capsys.readouterr().err


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
        pose = next(change for change in report["garments"][0]["changes"] if change["what"] == "pose")
        assert abs(pose["details"]["angle"] - 45.0) <= 3.0


def test_an_outfit_in_one_command(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["garment=[tshirt,trousers]", "pins=waistband", "output=out", "num_frames=3", "fail_on=nothing"]
    assert main(["rollout", *words, *UNTRAINED]) == 0
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
    "alike": (["garment=far.obj"], ("two places fit alike", "offset")),
    "wide": (["garment=wide.obj"], ("if it was made around this body, scale=0.01 is enough; else",)),
    "wide, told more": (["garment=wide.obj", "scale=0.01", "up=x"], ("; give the body that it was made for",)),
    "far": (["garment=far.obj", "offset=[0,0,0]"], ("does not surround the body", "offset")),
    "flat": (["garment=flat.obj"], ("no face has an area",)),
    "output": (["garment=tank", "output=tank.obj"], (".npz",)),
    "scale": (["garment=far.obj", "scale=-1"], ("scale=-1", "auto")),
    "weld": (["garment=far.obj", "weld=much"], ("weld=much",)),
    "region": (["garment=tank", "pins=waisband"], ("did you mean 'waistband'",)),
    "colours": (["garment=tank", "pins=painted"], ("no vertex colours",)),
    "frame": (["garment=far.obj", "pose=walk_proud", "frame=99999"], ("frame=99999",)),
    "number": (["garment=tank", "pins=99999"], ("vertex 99999 of 1016",)),
    "empty": (["garment=[]"], ("garment=[]",)),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refusals_are_one_line(capsys: pytest.CaptureFixture[str], case: str) -> None:
    pos, faces = cylinder(12, 4)
    write_obj(Path("far.obj"), pos + [3.0, 0, 0], faces)
    write_obj(Path("flat.obj"), pos * [1.0, 0, 0], faces)
    flare = 0.75 + 1.1 * (1.0 - pos[:, 1:2] / 0.5)  # a wide skirt in centimetres, from the waist down
    write_obj(Path("wide.obj"), 100.0 * (pos * np.hstack([flare, np.ones_like(flare), flare]) + [0.0, -0.27, 0.03]), faces)
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


@pytest.mark.parametrize("weld", ["auto", "none"])
def test_a_coat_of_ones_own_gets_a_zipper(capsys: pytest.CaptureFixture[str], weld: str) -> None:
    """The edges of its front lie on each other in the file, where open seams are welded."""
    jacket = load_garment("jacket")
    assert jacket.skin_pos is not None
    assert jacket.fasteners is not None
    pos, pairs = jacket.skin_pos.copy(), jacket.fasteners["front_zip"]
    pos[pairs, 0] = 0.0
    write_obj(Path("coat.obj"), pos, jacket.faces)
    words = ("garment=coat.obj", "output=coat.npz", "pose=tpose", f"weld={weld}", *AS_GIVEN)
    report = prepare(capsys, *words, "fasten={front_zip: {heights: [-0.1, 0.62]}}")
    assert report["fasteners"] == {"front_zip": len(pairs)}
    assert changes(report)["drawn_apart"] == 2 * len(pairs)
    coat = load_garment("coat.npz")
    assert len(coat.rest_pos) == len(pos)
    assert coat.fasteners is not None
    found = coat.fasteners["front_zip"]
    assert {frozenset(pair) for pair in found.tolist()} == {frozenset(pair) for pair in pairs.tolist()}
    np.testing.assert_allclose(np.linalg.norm(np.diff(coat.rest_pos[found], axis=1)[:, 0], axis=1), 0.004, atol=1e-6)
    assert main(["inspect", "coat.npz"]) == 0
    assert f"fasteners: front_zip ({len(pairs)} pairs)" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("garment=tank", "fasten=3"), "fasten=3: give rows by name, such as fasten={front_zip:"),
        (("garment=[tank,skirt]", "fasten={a: {heights: [0, 1]}}"), "fasten=…: prepare the garments one by one"),
        (("garment=tank", "fasten={a: {heights: [2, 3]}}"), "fasten: a: between 2 and 3 m the garment has no edges"),
    ],
)
def test_fasteners_that_cannot_be_made_are_refused(
    words: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["prepare", *words, "output=out.npz"]) == 2
    assert message in capsys.readouterr().err
