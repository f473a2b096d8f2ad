"""Moving meshes from every kind of file; what is refused names the file, the frame and the fix."""

from __future__ import annotations

import pickle
import struct
import warnings
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from hood.assets.body.body import Body
from hood.assets.files.said import Doubt
from hood.assets.formats.mesh_file import read_mesh
from hood.assets.motion.animated_mesh import body_kind, load_mesh_sequence
from hood.assets.motion.mesh_sequence import MeshSequence, resample_mesh
from hood.assets.motion.skeleton import UP_AXES
from hood.testing import box, sphere

POINTS, FACES = sphere(1, 0.5)
COUNT = 7


def moving(count: int = COUNT) -> np.ndarray:
    """(N, W, 3): a sphere that rises and swells."""
    time = np.arange(count)[:, None, None] / 30
    return POINTS * (1 + 0.3 * time) + time * np.array([0.2, 1.0, 0.0])


def write_obj(path: Path, pos: np.ndarray, faces: np.ndarray) -> None:
    rows = [f"v {x!r} {y!r} {z!r}" for x, y, z in pos.tolist()]
    path.write_text("\n".join([*rows, *("f " + " ".join(str(c + 1) for c in face) for face in faces)]))


def write_ply(path: Path, pos: np.ndarray, faces: np.ndarray) -> None:
    head = f"ply\nformat ascii 1.0\nelement vertex {len(pos)}\nproperty double x\nproperty double y\nproperty double z\n"
    head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    rows = [f"{x!r} {y!r} {z!r}" for x, y, z in pos.tolist()]
    path.write_text(head + "\n".join([*rows, *(f"{len(f)} " + " ".join(map(str, f)) for f in faces)]) + "\n")


def write_archive(path: Path) -> Path:
    np.savez(path, verts=moving(), faces=FACES, fps=30.0)
    return path


def write_h5(path: Path) -> Path:
    with h5py.File(path, "w") as file:
        file["verts"], file["faces"] = moving(), FACES
        file.attrs["fps"] = 30
    return path


def write_rollout(path: Path) -> Path:
    """As ``hood rollout`` writes it, stopped before its last two frames."""
    with h5py.File(path, "w") as file:
        file["body/pos"], file["body/faces"] = np.concatenate([moving(), np.full((2, *POINTS.shape), np.nan)]), FACES
        file["cloth/pos"] = np.zeros((9, 3, 3))
        file.attrs["dt"], file.attrs["num_frames"] = 1 / 30, COUNT
    return path


def write_pickle(path: Path) -> Path:
    path.write_bytes(pickle.dumps({"verts": moving(), "faces": FACES.astype(np.int32)}, 2))
    return path


def folder_of(suffix: str, write: Callable) -> Callable[[Path], Path]:
    def make(path: Path) -> Path:
        path.mkdir()
        for frame, pos in enumerate(moving(12)):
            write(path / f"take2_{frame + 3}{suffix}", pos, FACES)  # 10 comes after 9
        (path / "notes.txt").write_text("x")
        return path

    return make


def write_cache(path: Path, apart: float = 1.0) -> Path:
    """A PC2 file with its OBJ, as programs write them."""
    write_obj(path.with_suffix(".obj"), moving()[0], FACES)
    head = struct.pack("<12siiffi", b"POINTCACHE2\0", 1, len(POINTS), 0.0, apart, COUNT)
    path.write_bytes(head + moving().astype("<f4").tobytes())
    return path


FILES: dict[str, Callable[[Path], Path]] = {
    "walk.npz": write_archive,
    "walk.h5": write_h5,
    "rollout.h5": write_rollout,
    "walk.pkl": write_pickle,
    "objs": folder_of(".obj", write_obj),
    "plys": folder_of(".ply", write_ply),
}


@pytest.mark.parametrize("name", FILES)
def test_every_file_is_the_same_motion(name: str, tmp_path: Path) -> None:
    path = FILES[name](tmp_path / name)
    assert body_kind(path) == "mesh"
    found = load_mesh_sequence(path, 30.0)
    np.testing.assert_array_equal(found.faces, FACES)
    np.testing.assert_allclose(found.verts, moving(found.num_frames), rtol=0, atol=1e-15)
    assert found.num_frames == (12 if path.is_dir() else COUNT)
    assert found.fps == 30.0


@pytest.mark.parametrize("suffix", [".pkl", ".PKL"])
def test_pickles_of_vertices_are_meshes_whatever_the_case_of_their_suffix(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"rock{suffix}"
    path.write_bytes(pickle.dumps({"verts": moving()[0], "faces": FACES}))
    assert body_kind(path) == "mesh"


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".stl", ".off"])
def test_still_meshes_have_one_frame(suffix: str, tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    path = tmp_path / f"rock{suffix}"
    trimesh.Trimesh(POINTS, FACES, process=False).export(path)
    found = load_mesh_sequence(path, 50.0)
    assert found.verts.shape == (1, len(POINTS), 3)
    assert found.fps == 50.0
    assert np.ptp(found.verts) == pytest.approx(np.ptp(POINTS), abs=1e-5)


def test_a_point_cache_moves_the_mesh_beside_it(tmp_path: Path) -> None:
    path = write_cache(tmp_path / "walk.pc2")
    for given in (path, tmp_path):  # the file or its folder
        assert body_kind(given) == "mesh"
        found = load_mesh_sequence(given, 30.0)
        np.testing.assert_array_equal(found.faces, FACES)
        np.testing.assert_array_equal(found.verts, moving().astype(np.float32))
    assert load_mesh_sequence(write_cache(path, 2.0), 30.0).num_frames == 2 * COUNT - 1  # a sample every second frame
    assert load_mesh_sequence(path, 30.0, file_fps=30.0).num_frames == COUNT
    (tmp_path / "walk.obj").rename(tmp_path / "body.obj")
    assert load_mesh_sequence(path, 30.0).num_frames == 2 * COUNT - 1


def write_mdd(path: Path, times: np.ndarray, verts: np.ndarray) -> Path:
    write_obj(path.with_suffix(".obj"), POINTS, FACES)
    head = struct.pack(">ii", len(verts), len(POINTS))
    path.write_bytes(head + times.astype(">f4").tobytes() + verts.astype(">f4").tobytes())
    return path


def test_an_mdd_cache_has_times(tmp_path: Path) -> None:
    times = 2.0 + np.arange(COUNT) / 24.0
    path = write_mdd(tmp_path / "walk.mdd", times, moving())
    for given in (path, tmp_path):
        assert body_kind(given) == "mesh"
        found = load_mesh_sequence(given, 24.0)
        np.testing.assert_array_equal(found.faces, FACES)
        np.testing.assert_array_equal(found.verts, moving().astype(np.float32))
    write_mdd(path, np.arange(COUNT), moving())  # frames, no seconds
    with pytest.warns(UserWarning, match="says no frame rate, 30 fps are assumed"):
        assert load_mesh_sequence(path, 30.0).num_frames == COUNT
    assert load_mesh_sequence(write_mdd(path, times[:1], moving()[:1])).num_frames == 1


def test_an_mdd_cache_that_is_none_is_refused(tmp_path: Path) -> None:
    times = np.arange(COUNT) / 24.0
    path = write_mdd(tmp_path / "walk.mdd", times, moving())
    content = path.read_bytes()
    late = np.where(np.arange(COUNT) > 2, times + 1.0, times).astype(">f4").tobytes()
    for damaged, said in (
        (content[:-5], "cut off or no MDD file"),
        (content[:6], "0 samples of 0 points; it is no MDD file"),
        (struct.pack("<ii", COUNT, len(POINTS)) + content[8:], "MDD file"),
        (content[:8] + late + content[8 + 4 * COUNT :], "its samples are 0.0417 to 1.04 s apart; write them at one frame rate"),
    ):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=rf"walk\.mdd: .*{said}"):
            load_mesh_sequence(path)


def test_a_point_cache_that_does_not_fit_is_refused(tmp_path: Path) -> None:
    path = write_cache(tmp_path / "walk.pc2")
    content = path.read_bytes()
    for damaged, said in (
        (content[:-5], "it is cut off"),
        (b"PC2" + content[3:], "not a PC2 point cache"),
        (content[:24] + struct.pack("<f", np.nan) + content[28:], "nan frames apart"),
        (content[:16] + struct.pack("<i", -1) + content[20:], "of -1 points"),
    ):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=rf"walk\.pc2: .*{said}"):
            load_mesh_sequence(path)
    write_cache(path)
    write_obj(tmp_path / "walk.obj", POINTS[:-1], FACES[(FACES < len(POINTS) - 1).all(axis=1)])
    with pytest.raises(ValueError, match=r"walk\.obj beside it has \d+ vertices"):
        load_mesh_sequence(path)
    (tmp_path / "walk.obj").unlink()
    with pytest.raises(ValueError, match=r"0 meshes could have them.*walk\.obj"):
        load_mesh_sequence(path)
    (tmp_path / "other.pc2").write_bytes(content)
    with pytest.raises(ValueError, match=r"2 point caches \(other\.pc2, walk\.pc2\); give the one"):
        load_mesh_sequence(tmp_path)


def test_vertices_move_linearly_in_time() -> None:
    sequence = MeshSequence("s", moving(61) ** 2, FACES, 60.0)
    for fps in (30.0, 100.0, 24.0, 47.0):
        found = resample_mesh(sequence, fps)
        assert found.num_frames == int(np.floor(fps + 1e-9)) + 1
        for frame in range(0, found.num_frames, 7):
            at = frame * 60 / fps
            low, share = int(at + 1e-9), at - int(at + 1e-9)
            high = min(low + 1, 60)
            expected = sequence.verts[low] * (1 - share) + sequence.verts[high] * share
            np.testing.assert_allclose(found.verts[frame], expected, rtol=0, atol=1e-12)


def test_no_drift_after_a_minute() -> None:
    """100 → 30 fps: the frame at 60 s is the file's frame at 60 s, single precision kept."""
    verts = np.zeros((6001, 3, 3), dtype=np.float32)
    verts[:, :, 0] = np.arange(6001)[:, None] / 64  # exact in single precision
    verts[:, 1, 1], verts[:, 2, 2] = 1.0, 1.0
    found = resample_mesh(MeshSequence("s", verts, np.array([[0, 1, 2]]), 100.0), 30.0)
    assert found.verts.dtype == np.float32
    assert found.num_frames == 1801
    np.testing.assert_allclose(found.verts[:, 0, 0], np.arange(1801) / 30 * 100 / 64, atol=1e-5)
    np.testing.assert_array_equal(found.verts[::3, 0, 0], verts[::10, 0, 0])


def test_up_axis_units_and_parts_of_the_motion(tmp_path: Path) -> None:
    path = write_archive(tmp_path / "walk.npz")
    turned = load_mesh_sequence(path, up="z")
    x, y, z = np.moveaxis(moving(), -1, 0)
    np.testing.assert_array_equal(turned.verts, np.stack([x, z, -y], axis=-1))
    np.testing.assert_allclose(load_mesh_sequence(path, scale=2.0).verts, 2 * moving(), atol=1e-15)
    np.testing.assert_array_equal(load_mesh_sequence(path, start="2f", stop="4f").verts, moving()[2:5])
    np.testing.assert_allclose(load_mesh_sequence(path, 30.0, file_fps=60.0).verts, moving()[::2], atol=1e-15)
    np.savez(tmp_path / "large.npz", verts=100 * moving(), faces=FACES)
    with pytest.raises(
        ValueError, match=r"large\.npz: the mesh is 10.* m large.*unit=0\.01 \(body_scale=0\.01 in hood prepare\)"
    ):
        load_mesh_sequence(tmp_path / "large.npz")
    assert load_mesh_sequence(tmp_path / "large.npz", scale=1.0).num_frames == COUNT
    np.testing.assert_allclose(load_mesh_sequence(tmp_path / "large.npz", scale=0.01).verts, moving(), atol=1e-12)


def test_loops_must_close(tmp_path: Path) -> None:
    path = write_archive(tmp_path / "walk.npz")
    with pytest.raises(ValueError, match="ends as it began"):
        load_mesh_sequence(path, loop=2)
    there_and_back = np.concatenate([moving(), moving()[-2::-1]])
    np.savez(path, verts=there_and_back, faces=FACES)
    found = load_mesh_sequence(path, loop=3)
    assert found.num_frames == 3 * 12 + 1
    np.testing.assert_array_equal(found.verts[12:25], there_and_back)


def test_inside_out_and_quads(tmp_path: Path) -> None:
    np.savez(tmp_path / "in.npz", verts=moving(), faces=FACES[:, ::-1])
    with pytest.warns(UserWarning, match=r"in\.npz: the faces of the mesh look inwards"):
        np.testing.assert_array_equal(load_mesh_sequence(tmp_path / "in.npz").faces, FACES)
    quad = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])
    np.savez(tmp_path / "q.npz", verts=quad[None], faces=np.array([[0, 1, 2, 3]]))
    np.testing.assert_array_equal(load_mesh_sequence(tmp_path / "q.npz").faces, [[0, 1, 2], [0, 2, 3]])


def test_joints_of_the_file_are_kept(tmp_path: Path) -> None:
    bones = np.tile(np.eye(4), (COUNT, 5, 1, 1))
    bones[:, :, 0, 3] = np.arange(COUNT)[:, None]
    np.savez(tmp_path / "b.npz", verts=moving(), faces=FACES, transforms=bones, fps=60.0)
    found = load_mesh_sequence(tmp_path / "b.npz", 30.0, scale=2.0)
    assert found.transforms.shape == (4, 5, 3, 4)
    np.testing.assert_allclose(found.transforms[:, 0, 0, 3], [0, 4, 8, 12])
    np.testing.assert_allclose(found.transforms[0, 0, :, :3], np.eye(3))
    np.savez(tmp_path / "b.npz", verts=moving(), faces=FACES, transforms=bones[:-1])
    with pytest.raises(ValueError, match="transforms have shape"):
        load_mesh_sequence(tmp_path / "b.npz")


DAMAGE = {
    "nan": ({"verts": np.where(np.arange(COUNT)[:, None, None] == 4, np.nan, moving())}, "not finite in frame 4"),
    "flat": ({"verts": moving()[..., :2]}, r"verts have shape \(7, 42, 2\)"),
    "index": ({"faces": FACES + 1}, "faces refer to vertices 1 … 42 of 42"),
    "negative": ({"faces": FACES - 1}, "faces refer to vertices -1"),
    "real faces": ({"faces": FACES + 0.5}, "faces refer"),
    "text": ({"verts": np.array(["a"])}, "verts hold <U1"),
    "no faces": ({"faces": np.zeros((0, 3))}, r"faces have shape \(0, 3\)"),
    "point": ({"verts": np.zeros((2, 42, 3))}, "at one point"),
    "rate": ({"fps": 0.0}, "frame rate is 0.0"),
}


@pytest.mark.parametrize("case", DAMAGE)
def test_damaged_content_is_named(case: str, tmp_path: Path) -> None:
    change, words = DAMAGE[case]
    np.savez(tmp_path / "bad.npz", **({"verts": moving(), "faces": FACES} | change))
    with pytest.raises(ValueError, match=rf"bad\.npz: .*{words}") as error:
        load_mesh_sequence(tmp_path / "bad.npz")
    assert "\n" not in str(error.value)


def test_frames_of_a_folder_must_be_one_mesh(tmp_path: Path) -> None:
    folder = folder_of(".obj", write_obj)(tmp_path / "objs")
    write_obj(folder / "take2_9.obj", POINTS, FACES[:, [1, 2, 0]])
    with pytest.raises(ValueError, match=r"take2_9\.obj: its faces are not those of take2_3\.obj"):
        load_mesh_sequence(folder)
    write_obj(folder / "take2_9.obj", POINTS[:-1], FACES[:4])
    with pytest.raises(ValueError, match=r"take2_9\.obj: 41 vertices, take2_3\.obj has 42"):
        load_mesh_sequence(folder)
    write_ply(folder / "take2_99.ply", POINTS, FACES)
    with pytest.raises(ValueError, match="OBJ and PLY"):
        load_mesh_sequence(folder)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="no OBJ or PLY"):
        load_mesh_sequence(tmp_path / "empty")


def test_hdf5_reads_nothing_elsewhere_and_nothing_absurd(tmp_path: Path) -> None:
    """Links and external storage lead to other files; a dataset may claim what it never stored."""
    write_h5(tmp_path / "secret.h5")
    (tmp_path / "raw.bin").write_bytes(b"\0" * 8 * POINTS.size)
    path = tmp_path / "bad.h5"
    with h5py.File(path, "w") as file:
        file["faces"] = FACES
        file["verts"] = h5py.ExternalLink(str(tmp_path / "secret.h5"), "verts")
    with pytest.raises(ValueError, match=r"bad\.h5.*link"):
        load_mesh_sequence(path)
    with h5py.File(path, "w") as file:
        file["faces"] = FACES
        file.create_dataset("verts", POINTS.shape, "f8", external=[(str(tmp_path / "raw.bin"), 0, h5py.h5f.UNLIMITED)])
    with pytest.raises(ValueError, match=r"bad\.h5.*store the data itself"):
        load_mesh_sequence(path)
    for shape, words in (((10**6, 10**5, 3), "the limit is"), ((1000, 50000, 3), "claims 1200000000 bytes and stores")):
        with h5py.File(path, "w") as file:
            file["faces"] = FACES
            file.create_dataset("verts", shape, "f8", chunks=(1, 1000, 3))
        with pytest.raises(ValueError, match=words):
            load_mesh_sequence(path)


def test_unreadable_files(tmp_path: Path) -> None:
    for name in ("x.npz", "x.h5", "x.pkl", "x.glb", "x.gltf", "x.obj", "x.stl"):
        (tmp_path / name).write_bytes(b"\x00\x01nonsense")
        with pytest.raises(ValueError, match=rf"x\.{name[2:]}"):
            load_mesh_sequence(tmp_path / name)
    with pytest.raises(FileNotFoundError, match="no such file"):
        load_mesh_sequence(tmp_path / "missing.npz")
    (tmp_path / "x.fbx").write_text("x")
    with pytest.raises(ValueError, match=r"unknown format '\.fbx'"):
        load_mesh_sequence(tmp_path / "x.fbx")


def test_kinds_of_bodies(tmp_path: Path, body_file: Path) -> None:
    assert body_kind("none") == "none"
    assert body_kind("default") == body_kind(body_file) == "model"
    (tmp_path / "models").mkdir()
    (tmp_path / "SMPL_MALE.pkl").write_bytes(pickle.dumps({"v_template": np.zeros((3, 3)), "vertsy": 1}, 2))
    assert body_kind(tmp_path / "models") == body_kind(tmp_path / "SMPL_MALE.pkl") == "model"
    assert body_kind(tmp_path / "hero.glb") == "mesh"


def lying(body: Body) -> np.ndarray:
    """(W, 3) m: the body in its T-pose, which stands along z."""
    return body.v_template[:, [0, 2, 1]] * [1.0, -1.0, 1.0]


def test_a_body_that_seems_to_stand_along_z_is_told(tmp_path: Path, body: Body) -> None:
    """It is usable as it is: who says up=y hears nothing, and up=z turns it."""
    write_obj(tmp_path / "body.obj", 100.0 * lying(body), body.faces)
    with pytest.warns(UserWarning, match=r"seems to stand along z .*1\.7\d m.*; pass up=z \(body_up=z in hood prepare\)"):
        found = load_mesh_sequence(tmp_path / "body.obj", scale=0.01)
    np.testing.assert_allclose(found.verts[0], lying(body), atol=1e-9)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        given = [load_mesh_sequence(tmp_path / "body.obj", scale=0.01, up=up) for up in ("y", "z")]
    np.testing.assert_array_equal(given[0].verts, found.verts)
    np.testing.assert_allclose(given[1].verts[0], body.v_template, atol=1e-9)


@pytest.mark.parametrize("case", ["standing", "thick", "plane", "car", "box"])
def test_other_meshes_say_nothing_of_their_axis(tmp_path: Path, body: Body, case: str) -> None:
    boxed, box_faces = box()
    pos, faces = {
        "standing": (body.v_template, body.faces),
        "thick": (lying(body) * [1.0, 2.5, 1.0], body.faces),
        "plane": (lying(body) * [1.0, 0.3, 1.0], body.faces),
        "car": (2.7 * lying(body), body.faces),
        "box": (boxed * [1.0, 0.5, 2.0], box_faces),
    }[case]
    write_obj(tmp_path / "body.obj", pos, faces)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_mesh_sequence(tmp_path / "body.obj")


@pytest.mark.parametrize("unit", [0.01, 0.001])
def test_the_unit_that_makes_a_person_is_named(tmp_path: Path, body: Body, unit: float) -> None:
    write_obj(tmp_path / "body.obj", body.v_template / unit, body.faces)
    advice = rf"pass unit={unit:g} \(.*\), which makes it 1\.72 m \(unit=m takes it as it is\)"
    with pytest.raises(ValueError, match=advice):
        load_mesh_sequence(tmp_path / "body.obj")
    wrong = 10 * unit
    with pytest.warns(UserWarning, match=rf"17\.2 m large with unit={wrong:g}; {advice}"):
        load_mesh_sequence(tmp_path / "body.obj", scale=wrong)
    with pytest.warns(UserWarning, match=rf"0\.172 m large with unit={unit / 10:g}; {advice}"):
        load_mesh_sequence(tmp_path / "body.obj", scale=unit / 10)
    with pytest.raises(ValueError, match=f"unit={50 * unit:g} is not that of the file, {advice}"):
        load_mesh_sequence(tmp_path / "body.obj", scale=50 * unit)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for scale in (unit, 1.0):  # 1: as it is, whatever that is
            found = load_mesh_sequence(tmp_path / "body.obj", scale=scale)
            np.testing.assert_allclose(found.verts[0], body.v_template * scale / unit, rtol=1e-9)


def test_a_unit_that_shrinks_a_mesh_in_metres_is_told(tmp_path: Path, body: Body) -> None:
    write_obj(tmp_path / "body.obj", body.v_template, body.faces)
    with pytest.warns(
        UserWarning,
        match=r"0\.0172 m large with unit=0\.01; pass unit=1 \(body_scale=1 in hood prepare\), which makes it 1\.72 m$",
    ):
        load_mesh_sequence(tmp_path / "body.obj", scale=0.01)


@pytest.mark.parametrize("unit", [0.3048, 0.1])
def test_a_person_of_4_to_30_metres_is_told(tmp_path: Path, body: Body, unit: float) -> None:
    """In feet or decimetres. A hall and a floor of that size are taken as they are, and so is who says so."""
    write_obj(tmp_path / "body.obj", body.v_template / unit, body.faces)
    with pytest.warns(UserWarning, match=rf"seems not to be the metre; pass unit={unit:g} .*, which makes it 1\.72 m"):
        load_mesh_sequence(tmp_path / "body.obj")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_mesh_sequence(tmp_path / "body.obj", scale=1.0)
        for stretch in ([3.0, 1.0, 3.0], [6.0, 0.05, 6.0]):
            write_obj(tmp_path / "hall.obj", 2.7 * body.v_template * stretch, body.faces)
            load_mesh_sequence(tmp_path / "hall.obj")


# ---- what a file does not say -------------------------------------------------------------------------------------------


def test_an_assumed_frame_rate_is_a_doubt(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", verts=moving(), faces=FACES)
    with pytest.warns(Doubt, match="says no frame rate, 30 fps are assumed; file_fps=") as heard:
        found = load_mesh_sequence(tmp_path / "a.npz", 30.0)
    assert found.fps_assumed
    assert [said.message.kind for said in heard if isinstance(said.message, Doubt)] == ["frame_rate"]
    for name, more in (("still", {"verts": moving()[0]}), ("said", {"frameRate": "30"}), ("listed", {"mocap_fps": [30.0]})):
        np.savez(tmp_path / f"{name}.npz", **({"verts": moving(), "faces": FACES} | more))
        with warnings.catch_warnings():
            warnings.simplefilter("error", Doubt)
            assert not load_mesh_sequence(tmp_path / f"{name}.npz", 30.0).fps_assumed


@pytest.mark.parametrize("up", UP_AXES)
def test_a_mesh_is_turned_from_every_axis(up: str, tmp_path: Path) -> None:
    turn = UP_AXES[up]
    np.savez(tmp_path / "a.npz", verts=moving() @ turn, faces=FACES, fps=30.0)
    np.testing.assert_allclose(load_mesh_sequence(tmp_path / "a.npz", 30.0, up).verts, moving(), atol=1e-12)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3))
    assert np.linalg.det(turn) == pytest.approx(1.0)


def quads(folder: Path, heights: list[float], order: tuple[int, ...] = (1, 2, 3, 4)) -> Path:
    """A cube of quads in numbered OBJ files; one corner is lifted by ``heights``, so that its quads are best cut otherwise."""
    folder.mkdir(exist_ok=True)
    corners = np.array(list(np.ndindex(2, 2, 2)), dtype=float)
    faces = [order, (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)]
    for frame, height in enumerate(heights):
        points = corners.copy()
        points[7] += [0.0, height, 0.6 * height]
        lines = [f"v {x} {y} {z}" for x, y, z in points] + ["f " + " ".join(map(str, face)) for face in faces]
        (folder / f"frame_{frame}.obj").write_text("\n".join(lines))
    return folder


def test_quads_are_split_as_in_the_first_frame(tmp_path: Path) -> None:
    folder = quads(tmp_path / "q", [0.0, 0.5, -0.5, 1.0], (1, 2, 4, 3))
    splits = [read_mesh(folder / f"frame_{frame}.obj", True)[1].tolist() for frame in range(4)]
    assert splits[0] != splits[1]  # each by itself is cut otherwise
    found = load_mesh_sequence(folder, 30.0, file_fps=30.0)
    assert (found.num_frames, found.faces.shape) == (4, (12, 3))
    np.testing.assert_allclose(found.verts[3, 7], [1.0, 2.0, 1.6])


def test_other_quads_are_still_refused(tmp_path: Path) -> None:
    folder = quads(tmp_path / "q", [0.0, 0.0], (1, 2, 4, 3))
    (quads(tmp_path / "r", [0.0], (1, 3, 4, 2)) / "frame_0.obj").rename(folder / "frame_1.obj")
    with pytest.raises(ValueError, match=r"frame_1\.obj: its faces are not those of frame_0\.obj"):
        load_mesh_sequence(folder, 30.0)
