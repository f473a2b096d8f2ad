"""Garments, bodies and motions of arrays: the same as those of files, and one clear sentence where they cannot be used."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hood
from hood.testing import cylinder

SHORT: dict[str, Any] = {"num_frames": 4, "metrics": "none", "stepper": "newton"}


def frames(*given: Any, **keys: Any) -> np.ndarray:
    """(T, V, 3) m: what a simulation gives."""
    return np.stack([frame.world_pos.numpy() for frame in hood.simulate(*given, **(SHORT | keys))])


def write_obj(path: Path, pos: np.ndarray, faces: np.ndarray) -> Path:
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in pos.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (faces + 1).tolist()]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def band() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A sleeve around the trunk: positions [m], faces, and the rim that is held."""
    pos, faces = cylinder(24, 6, 0.24, 0.15)
    pos = pos + [0.0, -0.05, 0.02]
    return pos, faces, np.flatnonzero(pos[:, 1] > pos[:, 1].max() - 1e-6)


@pytest.fixture(scope="module")
def ball() -> tuple[np.ndarray, np.ndarray]:
    """A ball of 12 cm that goes up and aside, at 30 frames per second: (T, W, 3) [m], faces."""
    turns = np.linspace(0.0, 2 * np.pi, 12, endpoint=False)
    rings = [np.stack([np.cos(turns) * r, np.full(12, y), np.sin(turns) * r], axis=1) for y, r in RINGS]
    pos = 0.12 * np.concatenate([[[0.0, -1.0, 0.0]], *rings, [[0.0, 1.0, 0.0]]])
    faces = []
    for ring in range(len(RINGS) - 1):
        for k in range(12):
            a, b = 1 + 12 * ring + k, 1 + 12 * ring + (k + 1) % 12
            faces += [[a, a + 12, b], [b, a + 12, b + 12]]
    last = len(pos) - 1
    faces += [[0, 1 + k, 1 + (k + 1) % 12] for k in range(12)]
    faces += [[last, last - 12 + (k + 1) % 12, last - 12 + k] for k in range(12)]
    moved = np.stack([pos + [0.0, 0.004 * t, 0.002 * t] for t in range(6)])
    return moved, np.array(faces)


RINGS = [(np.sin(a), np.cos(a)) for a in np.linspace(-1.2, 1.2, 7)]


def test_a_garment_and_a_motion_of_arrays_are_those_of_files(tmp_path: Path, band: Any) -> None:
    pos, faces, pins = band
    plie = hood.load_sequence("plie")
    tables = {"poses": plie.poses[:20].reshape(20, -1), "transl": plie.transl[:20], "betas": np.zeros(10)}
    np.savez(tmp_path / "motion.npz", fps=30.0, **tables)
    file = write_obj(tmp_path / "band.obj", pos, faces)
    by_file = frames(str(file), str(tmp_path / "motion.npz"), up="y", pins=pins)
    motion = hood.PoseSequence.from_arrays(plie.poses[:20], plie.transl[:20], fps=30)
    by_arrays = frames(hood.Garment.from_arrays(pos, faces, pins), motion)
    np.testing.assert_allclose(by_arrays, by_file, rtol=0, atol=1e-6)


def test_a_moving_body_of_arrays_is_that_of_a_file(tmp_path: Path, ball: Any) -> None:
    vertices, body_faces = ball
    side = np.linspace(-0.15, 0.15, 9)
    x, z = np.meshgrid(side, side, indexing="ij")
    sheet = np.stack([x.ravel(), np.full(81, 0.125), z.ravel()], axis=1)
    a = (9 * np.arange(8)[:, None] + np.arange(8)).ravel()
    faces = np.concatenate([np.stack([a, a + 1, a + 9], axis=1), np.stack([a + 1, a + 10, a + 9], axis=1)])
    np.savez(tmp_path / "ball.npz", verts=vertices, faces=body_faces, fps=30.0)
    file = write_obj(tmp_path / "sheet.obj", sheet, faces)
    by_file = frames(str(file), body=str(tmp_path / "ball.npz"), sequence="none")
    mesh, cloth = hood.BodyMesh(vertices, body_faces, fps=30), hood.Garment.from_arrays(sheet, faces)
    by_body, by_sequence = frames(cloth, body=mesh), frames(cloth, mesh)
    np.testing.assert_allclose(by_body, by_file, rtol=0, atol=1e-6)
    assert np.array_equal(by_body, by_sequence)


def test_a_motion_of_arrays_takes_the_rate_of_the_simulation(band: Any) -> None:
    plie = hood.load_sequence("plie", fps=60)
    simulation = hood.simulate("tank", plie, fps=30, output_fps=24, **SHORT)
    by_name = hood.simulate("tank", "plie", fps=30, output_fps=24, **SHORT)
    bodies = [[frame.body_pos.numpy() for frame in one] for one in (simulation, by_name)]
    np.testing.assert_allclose(bodies[0], bodies[1], rtol=0, atol=1e-3)


def test_an_outfit_mixes_objects_and_names(band: Any) -> None:
    pos, faces, pins = band
    own = hood.Garment.from_arrays(pos + [0.0, 0.2, 0.0], faces, pins, name="belt")
    scene = hood.simulate(["skirt", own], "plie", layers=["skirt", "belt"], **SHORT).scene
    assert scene.garment.name == "skirt+belt"
    assert scene.layers == (0, 1)


def call(**changed: Any) -> Callable[[], Any]:
    given = {"poses": np.zeros((4, 22, 3)), "transl": np.zeros((4, 3)), "fps": 30} | changed
    return lambda: hood.PoseSequence.from_arrays(**given)


TETRAHEDRON = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
SIDES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def with_nan(array: np.ndarray, *place: int) -> np.ndarray:
    changed = array.copy()
    changed[place] = np.nan
    return changed


BROKEN: dict[str, tuple[Callable[[], Any], str]] = {
    "joints": (call(poses=np.zeros((4, 5, 3))), r"sequence: poses have shape \(4, 5, 3\); give"),
    "nan": (call(poses=with_nan(np.zeros((4, 22, 3)), 2, 1, 0)), r"sequence: poses\[2, 1, 0\] is nan; give finite"),
    "degrees": (call(poses=np.full((4, 22, 3), 90.0)), r"poses\[0\] turns .* np.radians"),
    "text": (call(poses="walk"), "sequence: poses is of type <U4; give an array of numbers"),
    "lengths": (call(transl=np.zeros((3, 3))), "transl has 3 frames, poses have 4"),
    "centimetres": (call(transl=100.0 * np.arange(12).reshape(4, 3)), "m/s after frame 0; give metres"),
    "rate": (call(fps=0), "sequence: fps is 0; give frames per second"),
    "betas": (call(betas=[np.inf]), r"betas\[0\] is not finite"),
    "body shape": (lambda: hood.BodyMesh(TETRAHEDRON[:, :2], SIDES), r"body: vertices has shape \(4, 2\); give"),
    "body nan": (lambda: hood.BodyMesh(with_nan(TETRAHEDRON[None], 0, 3, 1), SIDES), r"vertices\[0, 3, 1\] is nan"),
    "body faces": (lambda: hood.BodyMesh(TETRAHEDRON, SIDES + 1), r"body: faces\[1\] is \[1, 2, 4\]; give .* 0 to 3"),
    "body float faces": (
        lambda: hood.BodyMesh(TETRAHEDRON, SIDES * 1.0),
        "body: faces are of type float64; give whole numbers",
    ),
    "body quads": (lambda: hood.BodyMesh(TETRAHEDRON, [[0, 1, 2, 3]]), r"faces have shape \(1, 4\); give .* triangles"),
    "body units": (
        lambda: hood.simulate("tank", body=hood.BodyMesh(100 * TETRAHEDRON, SIDES)),
        "100 m large; .*unit=0.01",
    ),
    "pins": (lambda: hood.Garment.from_arrays(TETRAHEDRON, SIDES, [9]), r"pins\[0\] is 9; give vertex numbers from 0 to 3"),
    "mask": (lambda: hood.Garment.from_arrays(TETRAHEDRON, SIDES, [True]), r"pins have shape \(1,\); .*\(4,\)"),
    "garment units": (lambda: hood.simulate(hood.Garment.from_arrays(1e3 * TETRAHEDRON, SIDES)), "times the body's height"),
    "two motions": (lambda: hood.simulate("tank", "plie", body=hood.BodyMesh(TETRAHEDRON, SIDES)), "performs its own motion"),
    "two bodies": (lambda: hood.simulate("tank", hood.BodyMesh(TETRAHEDRON, SIDES), body="none"), "leave body or sequence out"),
    "no joints": (lambda: hood.simulate("tank", hood.load_sequence("plie"), body="none"), "sequence: body=none has its own"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_arrays_that_cannot_be_used_are_told_in_a_sentence(case: str) -> None:
    function, said = BROKEN[case]
    with pytest.raises(ValueError, match=said) as told:
        function()
    assert "\n" not in str(told.value)
