"""``hood export``: every format is read back by a reader that is not ours, or by the few lines of its specification."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from hood.assets.formats.mesh_file import read_mesh_file
from hood.assets.motion.animated_mesh import load_mesh_sequence
from hood.cli.main import main
from hood.media.exports.sequences import clip_of
from hood.media.pieces import layer_distances
from hood.rollouts.file.reader import read_rollout
from hood.rollouts.file.recorder import RolloutWriter

FRAMES, DT = 4, 1.0 / 24.0
#: Two squares of two triangles, of two garments; the texture of the first has a seam along its diagonal.
FACES = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
UV = np.array([[0, 0], [0.4, 0], [0.4, 0.4], [0.6, 0.6], [1, 1], [0.6, 1], [0, 0.5], [0.5, 0.5], [0.5, 1], [0, 1]])
UV_FACES = np.array([[0, 1, 2], [3, 4, 5], [6, 7, 8], [6, 8, 9]])
BODY = trimesh.creation.icosphere(1, 0.3)


def _cloth(shift: float = 0.0) -> np.ndarray:
    """(T, 8, 3) m."""
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1.0]])
    rest = np.concatenate([square, square + [0, 0.1, 0]])
    random = np.random.default_rng(3)
    return np.stack([rest + [0, 0.01 * t**2, 0] + 1e-3 * random.normal(size=rest.shape) for t in range(FRAMES)]) + [shift, 0, 0]


def _rollout(
    folder: Path,
    shift: float = 0.0,
    outfit: bool = True,
    pos: np.ndarray | None = None,
    attributes: dict | None = None,
    still: dict | None = None,
) -> Path:
    pos, path = _cloth(shift) if pos is None else pos, folder / "rollout.h5"
    body = np.stack([BODY.vertices + [shift, -0.5, 0.02 * t] for t in range(FRAMES)])
    still = {"uv": UV, "uv_faces": UV_FACES, **({"piece": np.repeat([0, 1], 4)} if outfit else {}), **(still or {})}
    attributes = {"garment": "top+skirt" if outfit else "my dress.obj", **(attributes or {})}
    writer = RolloutWriter(
        path, FRAMES, pos[0], FACES, BODY.faces, len(BODY.vertices), ("rg",), DT, attributes, farthest=shift, still=still
    )
    for t in range(FRAMES):
        writer.append(pos[t], body[t], {"rg": 0.0})
    writer.close(complete=True)
    return path


def _velocities(pos: np.ndarray) -> np.ndarray:
    """(T, V, 3) m/s: central differences of positions, one-sided at the ends."""
    return np.gradient(pos.astype(np.float64), DT, axis=0)


def _glb(path: Path) -> tuple[dict, list[np.ndarray]]:
    """The document and its accessors, by the specification's two chunks."""
    content = path.read_bytes()
    magic, version, length, size, kind = struct.unpack_from("<4sIII4s", content)
    assert (magic, version, length, kind) == (b"glTF", 2, len(content), b"JSON")
    document, binary = json.loads(content[20 : 20 + size]), content[28 + size :]
    columns = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}
    arrays = []
    for accessor in document["accessors"]:
        view = document["bufferViews"][accessor["bufferView"]]
        numbers = np.frombuffer(
            binary,
            {5126: "<f4", 5125: "<u4"}[accessor["componentType"]],
            offset=view["byteOffset"],
            count=accessor["count"] * columns[accessor["type"]],
        )
        assert numbers.nbytes == view["byteLength"]
        assert view["byteOffset"] % 4 == 0
        arrays.append(numbers.reshape(accessor["count"], -1))
        if "min" in accessor:
            assert np.array_equal(arrays[-1].min(axis=0), np.float32(accessor["min"]))
            assert np.array_equal(arrays[-1].max(axis=0), np.float32(accessor["max"]))
    return document, arrays


@pytest.mark.parametrize("shift", [0.0, 3000.0])
def test_usd_is_read_back_by_pxr(tmp_path: Path, shift: float) -> None:
    pxr = pytest.importorskip("pxr", reason="usd-core has no wheel for this machine")
    from pxr import Usd, UsdGeom

    assert pxr
    assert main(["export", str(_rollout(tmp_path, shift)), "format=usd", "up=z"]) == 0
    stage = Usd.Stage.Open(str(tmp_path / "rollout.usd"))
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert stage.GetTimeCodesPerSecond() == pytest.approx(24.0)
    assert stage.GetEndTimeCode() == FRAMES - 1
    data = read_rollout(tmp_path / "rollout.h5")
    for name, wanted in (("top", data.cloth_pos[:, :4]), ("skirt", data.cloth_pos[:, 4:]), ("body", data.body_pos)):
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath(f"/rollout/{name}"))
        for t in range(FRAMES):
            place = np.array(UsdGeom.XformCache(t).GetLocalToWorldTransform(mesh.GetPrim()))
            found = np.array(mesh.GetPointsAttr().Get(t), np.float64) @ place[:3, :3] + place[3, :3]
            assert np.abs(found - wanted[t][:, [0, 2, 1]] * [1, -1, 1]).max() < 1e-6
            speed = np.array(mesh.GetVelocitiesAttr().Get(t), np.float64)  # m/s: metres are the unit, seconds are seconds
            assert np.abs(speed - _velocities(wanted)[t][:, [0, 2, 1]] * [1, -1, 1]).max() < 1e-5
    texture = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/rollout/top")).GetPrimvar("st")
    assert np.allclose(texture.ComputeFlattened(), UV[UV_FACES[:2].reshape(-1)])


@pytest.mark.parametrize("shift", [0.0, 3000.0])
def test_usd_is_a_body_and_a_garment_again(tmp_path: Path, shift: float) -> None:
    pytest.importorskip("pxr", reason="usd-core has no wheel for this machine")
    path = tmp_path / "z.usdc"
    assert main(["export", str(_rollout(tmp_path, shift)), "format=usd", "up=z", f"output={path}"]) == 0
    data = read_rollout(tmp_path / "rollout.h5")
    body = load_mesh_sequence(f"{path}:body", 24.0, scale=1.0)
    assert np.abs(body.verts - data.body_pos).max() < 1e-6
    assert np.array_equal(body.faces, BODY.faces)
    mesh = read_mesh_file(path)
    assert np.abs(mesh.pos[:8] - data.cloth_pos[0]).max() < 1e-6
    assert mesh.panels is not None
    assert set(mesh.panels) == {"top", "skirt", "body"}


@pytest.mark.parametrize("shift", [0.0, 3000.0])
def test_glb_moves_as_the_rollout(tmp_path: Path, shift: float) -> None:
    assert main(["export", str(_rollout(tmp_path, shift)), "format=glb"]) == 0
    document, arrays = _glb(tmp_path / "rollout.glb")
    data = read_rollout(tmp_path / "rollout.h5")
    wanted = {"top": data.cloth_pos[:, :4], "skirt": data.cloth_pos[:, 4:], "body": data.body_pos}
    animation = document["animations"][0]
    assert [channel["target"]["node"] for channel in animation["channels"]] == [0, 1, 2]
    sampler = animation["samplers"][0]
    times, weights = arrays[sampler["input"]][:, 0], arrays[sampler["output"]].reshape(FRAMES, -1)
    assert np.allclose(times, data.time, atol=1e-6)
    for node in document["nodes"]:
        primitive = document["meshes"][node["mesh"]]["primitives"][0]
        base = arrays[primitive["attributes"]["POSITION"]].astype(np.float64)
        targets = [arrays[target["POSITION"]] for target in primitive["targets"]]
        here = wanted[node["name"]]
        for t in range(FRAMES):
            moved = base + sum(w * target for w, target in zip(weights[t], targets, strict=True)) + node["translation"]
            miss = np.abs(moved[:, None] - here[t][None]).max(axis=2).min(axis=1)  # points on seams come twice
            assert miss.max() < 1e-6
    top = document["meshes"][0]["primitives"][0]
    uv, faces = arrays[top["attributes"]["TEXCOORD_0"]], arrays[top["indices"]].reshape(-1, 3)
    assert np.allclose(uv[faces] * [1, -1] + [0, 1], UV[UV_FACES[:2]], atol=1e-6)
    assert len(trimesh.load(tmp_path / "rollout.glb").geometry) == 3


@pytest.mark.parametrize("form", ["usd", "glb", "pc2"])
def test_a_place_that_cannot_be_written_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str], form: str) -> None:
    if form == "usd":
        pytest.importorskip("pxr", reason="usd-core has no wheel for this machine")
    source, blocked = _rollout(tmp_path), tmp_path / ("x" * 250)  # too long a name with the draft's prefix
    target = blocked.with_name(blocked.name + (".usd" if form == "usd" else f".{form}"))
    assert main(["export", str(source), f"format={form}", f"output={target}"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert target.name in error
    assert [file.name for file in tmp_path.iterdir()] == ["rollout.h5"]


def test_glb_has_velocities_where_they_are_asked_for(tmp_path: Path) -> None:
    source = _rollout(tmp_path)
    document, _ = _glb_of(source, tmp_path / "plain.glb")
    assert "_VELOCITY" not in str(document)
    document, arrays = _glb_of(source, tmp_path / "fast.glb", "velocities=true")
    data = read_rollout(source)
    for mesh, pos in zip(document["meshes"], (data.cloth_pos[:, :4], data.cloth_pos[:, 4:], data.body_pos), strict=True):
        primitive = mesh["primitives"][0]
        base, places = (arrays[primitive["attributes"][name]] for name in ("_VELOCITY", "POSITION"))
        vertex = np.linalg.norm(places[:, None] - pos[0][None], axis=2).argmin(axis=1)  # points on seams come twice
        found = np.stack([base, *(base + arrays[target["_VELOCITY"]] for target in primitive["targets"])])
        np.testing.assert_allclose(found, _velocities(pos)[:, vertex], atol=1e-5)


def test_mdd_cache(tmp_path: Path) -> None:
    folder = tmp_path / "cache"
    assert main(["export", str(_rollout(tmp_path)), "format=mdd", f"output={folder}"]) == 0
    data, content = read_rollout(tmp_path / "rollout.h5"), (folder / "skirt.mdd").read_bytes()
    assert struct.unpack_from(">ii", content) == (FRAMES, 4)
    np.testing.assert_allclose(np.frombuffer(content, ">f4", FRAMES, 8), data.time, atol=1e-6)
    assert np.array_equal(np.frombuffer(content, ">f4", offset=8 + 4 * FRAMES).reshape(FRAMES, 4, 3), data.cloth_pos[:, 4:])
    assert len(trimesh.load(folder / "skirt.obj", process=False, maintain_order=True).faces) == 2
    body = load_mesh_sequence(folder / "body.mdd", 24.0, scale=1.0)
    assert np.abs(body.verts - data.body_pos).max() < 1e-6


def test_point_cache(tmp_path: Path) -> None:
    assert main(["export", str(_rollout(tmp_path)), "format=pc2", f"output={tmp_path / 'pc'}"]) == 0
    data = read_rollout(tmp_path / "rollout.h5")
    content = (tmp_path / "pc" / "skirt.pc2").read_bytes()
    assert struct.unpack_from("<12siiffi", content) == (b"POINTCACHE2\0", 1, 4, 0.0, 1.0, FRAMES)
    assert np.array_equal(np.frombuffer(content, "<f4", offset=32).reshape(FRAMES, 4, 3), data.cloth_pos[:, 4:])
    mesh = trimesh.load(tmp_path / "pc" / "skirt.obj", process=False, maintain_order=True)
    assert len(mesh.faces) == 2


@pytest.mark.parametrize("form", ["obj", "ply"])
def test_sequences(tmp_path: Path, form: str) -> None:
    assert main(["export", str(_rollout(tmp_path, outfit=False)), f"format={form}", "num_frames=3"]) == 0
    data, folder = read_rollout(tmp_path / "rollout.h5"), tmp_path / f"rollout_{form}"
    assert len(list(folder.iterdir())) == 6
    for name, wanted, faces in (("my_dress_obj", data.cloth_pos, FACES), ("body", data.body_pos, BODY.faces)):
        mesh = trimesh.load(folder / f"{name}_0003.{form}", process=False, maintain_order=True)
        corners = mesh.vertices[mesh.faces]  # trimesh splits vertices on seams
        assert np.abs(corners - wanted[2][faces]).max() < 1e-6


def _layers(pos: np.ndarray) -> float:
    """How far the layers of a garment of four vertices are apart [m], nearly the same everywhere."""
    apart = np.linalg.norm(pos[:4] - pos[4:8], axis=1)
    assert np.ptp(apart) < 1e-6
    return float(apart.mean())


def test_cloth_with_a_thickness_is_closed_in_every_frame(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of the outfit every garment by itself, with the UVs of the sheet on both sides and those of the rim on the strip."""
    source, folder = _rollout(tmp_path), tmp_path / "ply"
    assert main(["export", str(source), "format=ply", "thickness=0.003", f"output={folder}"]) == 0
    assert "cloth 3 mm thick" in capsys.readouterr().out
    for name, sheet in (("top", slice(0, 4)), ("skirt", slice(4, 8))):
        for frame, wanted in enumerate(_cloth()[:, sheet]):
            mesh = trimesh.load(folder / f"{name}_{frame + 1:04d}.ply", process=False, maintain_order=True)
            assert mesh.is_watertight
            assert abs(mesh.volume) == pytest.approx(0.003, rel=0.02)
            assert _layers(mesh.vertices) == pytest.approx(0.003, abs=1e-6)
            np.testing.assert_allclose((mesh.vertices[:4] + mesh.vertices[4:]) / 2.0, wanted, atol=1e-6)
    document, arrays = _glb_of(source, tmp_path / "thick.glb", "thickness=0.003")
    top = document["meshes"][0]["primitives"][0]
    uv, faces = arrays[top["attributes"]["TEXCOORD_0"]] * [1, -1] + [0, 1], arrays[top["indices"]].reshape(-1, 3)
    assert len(faces) == 2 + 2 + 2 * 4
    assert np.allclose(uv[faces[:2]], UV[UV_FACES[:2]], atol=1e-6)
    assert np.allclose(uv[faces[2:4]], UV[UV_FACES[:2, ::-1]], atol=1e-6)
    rims = {tuple(np.round(row, 3)) for row in UV[UV_FACES[:2]].reshape(-1, 2)}
    assert {tuple(np.round(row, 3)) for row in uv[faces[4:]].reshape(-1, 2)} <= rims
    targets = [arrays[target["POSITION"]] for target in top["targets"]]
    assert len(targets) == FRAMES - 1
    assert {len(target) for target in targets} == {len(uv)}


def _glb_of(source: Path, target: Path, *words: str) -> tuple[dict, list[np.ndarray]]:
    assert main(["export", str(source), "format=glb", f"output={target}", *words]) == 0
    return _glb(target)


def test_the_fabrics_say_how_thick_they_are(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two garments of two fabrics."""
    attributes = {"fabric_names": "wool_felt+silk"}
    still = {"fabric": np.repeat([0, 1], 4)}
    source = _rollout(tmp_path, attributes=attributes, still=still)
    assert main(["export", str(source), "format=obj", "thickness=auto", "num_frames=1", f"output={tmp_path / 'both'}"]) == 0
    assert "cloth 0.12 to 2 mm thick" in capsys.readouterr().out
    for name, wanted in (("top", 2e-3), ("skirt", 1.2e-4)):
        lines = (tmp_path / "both" / f"{name}_0001.obj").read_text().splitlines()
        pos = np.array([line.split()[1:] for line in lines if line.startswith("v ")], float)
        assert _layers(pos) == pytest.approx(wanted, abs=2e-7)
        assert sum(line.startswith("vt ") for line in lines) == len(UV)


def test_the_mesh_of_what_rides_on_cloth_is_its_outer_side(tmp_path: Path) -> None:
    """A pocket, here the upper square, is a shell below it; a solid button, closed as it is, stays."""
    ridden = _rollout(tmp_path, attributes={"riding_vertices": 4, "riding_faces": 2}, outfit=False)
    words = ["format=ply", "thickness=0.004", "num_frames=1", "parts=[cloth]"]
    assert main(["export", str(ridden), *words, f"output={tmp_path / 'pocket'}"]) == 0
    mesh = trimesh.load(tmp_path / "pocket" / "my_dress_obj_0001.ply", process=False, maintain_order=True)
    assert mesh.is_watertight
    assert len(mesh.vertices) == 2 * 8
    np.testing.assert_allclose(mesh.vertices[4:8], _cloth()[0, 4:], atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices[:8] - mesh.vertices[8:], axis=1), 0.004, atol=1e-6)
    data = read_rollout(ridden)
    ball = data.cloth_faces.max() + 1 + BODY.faces
    data = replace(
        data,
        cloth_faces=np.concatenate([data.cloth_faces, ball]),
        cloth_pos=np.concatenate([data.cloth_pos, data.body_pos], axis=1),
        attributes={**data.attributes, "riding_vertices": 4 + len(BODY.vertices), "riding_faces": 2 + len(BODY.faces)},
        still={},
    )
    both = clip_of(data, ["cloth"], layers=layer_distances(data, 0.004)).parts[0]
    assert both.pos.shape[1] == 2 * 8 + len(BODY.vertices)
    np.testing.assert_array_equal(both.pos[:, 8 : 8 + len(BODY.vertices)], data.body_pos)


def test_only_what_is_asked_for(tmp_path: Path) -> None:
    assert main(["export", str(_rollout(tmp_path)), "format=ply", "parts=[body]", "num_frames=1"]) == 0
    assert [path.name for path in (tmp_path / "rollout_ply").iterdir()] == ["body_0001.ply"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["format=abc"], "Alembic is not written (Python has no official package); take format=usd"),
        (["format=fbx"], "usd"),
        (["format=glb", "up=z"], "leave up= out"),
        (["format=glb", "output=a.usd"], "ends in .glb"),
        (["format=glb", "parts=[shoes]"], "[cloth,body]"),
        (["format=glb", "num_frames=0"], "at least 1"),
        (["format=glb", "velocities=fast"], "velocities=fast: give true or false"),
        (["format=mdd", "velocities=true"], "format=mdd holds positions alone; take format=usd or glb"),
        (["thickness=0"], "none, auto (what the fabrics have), or metres above 0"),
        (["thickness=0.5"], "at most 0.02"),
        (["thickness=thin"], "none, auto"),
        (["thickness=auto", "parts=[body]"], "leave thickness= out"),
    ],
)
def test_refusals_name_the_way_out(tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], said: str) -> None:
    path = _rollout(tmp_path)
    assert main(["export", str(path), *words]) == 2
    assert said in capsys.readouterr().err
    assert [file.name for file in tmp_path.iterdir()] == ["rollout.h5"]


def test_a_frame_that_is_not_finite_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pos = _cloth()
    pos[2, 1] = np.nan
    path = _rollout(tmp_path, outfit=False, pos=pos)
    assert main(["export", str(path), "format=glb"]) == 2
    assert "num_frames=2 " in capsys.readouterr().err
    assert main(["export", str(path), "format=glb", "num_frames=2"]) == 0


def test_a_folder_with_something_in_it_stays(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, folder = _rollout(tmp_path), tmp_path / "mine"
    folder.mkdir()
    (folder / "notes.txt").write_text("keep")
    assert main(["export", str(path), "format=obj", f"output={folder}"]) == 2
    assert "new or empty" in capsys.readouterr().err
    assert [file.name for file in folder.iterdir()] == ["notes.txt"]


def test_too_large_a_glb_is_refused_before_it_is_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from hood.media.exports import scene_files

    monkeypatch.setattr(scene_files, "_LARGEST", 1000)
    assert main(["export", str(_rollout(tmp_path)), "format=glb"]) == 2
    assert "num_frames=" in capsys.readouterr().err
    assert not (tmp_path / "rollout.glb").exists()


SHORT = (
    "garment=skirt",
    "sequence=plie",
    "num_frames=2",
    "stepper=refine",
    "refine=1",
    "metrics=none",
    "video=none",
    "sheet=false",
)


def test_a_rollout_writes_formats_and_replaces_its_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "rollout_obj").mkdir()
    (tmp_path / "rollout_obj" / "frame_9999.obj").write_text("of a longer run before")
    assert main(["rollout", *SHORT, "formats=[glb,obj]", f"output={tmp_path}"]) == 0
    told = capsys.readouterr().out
    assert "rollout.glb: " in told
    assert "2 frames at 30 fps" in told
    pos = read_rollout(tmp_path / "rollout.h5").cloth_pos
    document, _ = _glb(tmp_path / "rollout.glb")
    assert {mesh["name"] for mesh in document["meshes"]} >= {"skirt", "body"}
    files = sorted((tmp_path / "rollout_obj").glob("*.obj"))
    assert "frame_9999.obj" not in {file.name for file in files}
    loaded = trimesh.load(files[-1], process=False, group_material=False)
    parts = [loaded] if isinstance(loaded, trimesh.Trimesh) else list(loaded.geometry.values())
    vertices = np.concatenate([part.vertices for part in parts])
    near = np.linalg.norm(vertices[:, None] - pos[-1][None, :5], axis=2).min(axis=0)
    assert float(near.max()) < 1e-6
    assert not list(tmp_path.glob(".partial*"))


@pytest.mark.parametrize(("forms", "word"), [("[abc]", "Alembic"), ("[glb,fbx]", "choose usd or glb")])
def test_formats_are_refused_before_the_first_frame(
    forms: str, word: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["rollout", *SHORT, f"formats={forms}", f"output={tmp_path / 'run'}"]) == 2
    assert word in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
