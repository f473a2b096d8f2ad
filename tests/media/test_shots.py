"""Films of several views: the whole body in every frame, transparent and coloured backgrounds, sheets of all views."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hood.media.film import Film, Shots, _is_closed, write_video
from hood.media.renderer.raster import Camera
from hood.media.renderer.render import RenderMesh, render_frame
from hood.media.video import PngWriter
from hood.rollouts.file.reader import RolloutData
from hood.testing import cylinder, sphere

Image = pytest.importorskip("PIL.Image")


def walker(frames: int = 5) -> RolloutData:
    """A tall ball in a tube that walks 3 m along z, throws an arm to the side and jumps."""
    tube, faces = cylinder(16, 6, 0.2, 0.5)
    ball, ball_faces = sphere(2, 0.1)
    body, cloth = [], []
    for frame in range(frames):
        step = np.array([0.0, 0.4 * (frame == 2), 3.0 * frame / max(frames - 1, 1)])
        shape = ball * [1.0 + 6.0 * (frame == 3), 9.0, 1.0]
        body.append(shape + [0.0, 0.9, 0.0] + step)
        cloth.append(tube + [0.0, 0.9 - tube[:, 1].mean(), 0.0] + step)
    return RolloutData(np.stack(cloth), faces, tube, np.stack(body), ball_faces, np.arange(frames) / 30, {}, {})


@pytest.mark.parametrize("camera", ["follow", "fixed", "orbit"])
def test_the_whole_body_is_in_every_view_of_every_frame(camera: str) -> None:
    data = walker()
    film = Film(data, 480, 180, shots=Shots(("front", "turntable", 250.0), camera))
    share = []
    for frame in range(len(data.cloth_pos)):
        cloud = np.concatenate([data.body_pos[frame], data.cloth_pos[frame]])
        for take in film._takes:
            seen = take.at(film._path[frame], frame / len(data.cloth_pos))
            x, y, depth = ((cloud - seen.position) @ seen.axes().T).T
            half = np.tan(np.radians(seen.fov) / 2)
            share.append([np.abs(x / depth).max() / (half * 160 / 180), np.abs(y / depth).max() / half])
    assert np.max(share) < 1.0
    assert np.max(share) > 0.85  # as near as it can be
    assert film.frame(0).shape == (180, 480, 3)
    distances = [np.linalg.norm(np.subtract(take.camera.position, take.camera.target)) for take in film._takes]
    assert np.ptp(distances) < 1e-9


def test_cloth_that_comes_towards_the_camera_is_in_the_picture() -> None:
    """A doll, and a strip that would be beside or behind a camera that looked at the doll alone."""
    ball, ball_faces = sphere(2, 0.1)
    towards = np.array([0.34, 0.14, 0.93])
    along = np.linspace(0.0, 0.68, 24)[:, None] * towards
    strip = np.concatenate([along - [0.1, 0.0, 0.0], along + [0.1, 0.0, 0.0]]) + [0.0, 1.0, 0.0]
    first = np.arange(23)
    faces = np.concatenate([np.stack([first, first + 1, first + 24], 1), np.stack([first + 1, first + 25, first + 24], 1)])
    body = (ball + [0.0, 1.0, 0.0])[None]
    data = RolloutData(strip[None], faces, strip, body, ball_faces, np.zeros(1), {}, {})
    (take,) = Film(data, 320, 320, shots=Shots(("front",)))._takes
    x, y, depth = ((np.concatenate([strip, body[0]]) - take.camera.position) @ take.camera.axes().T).T
    half = np.tan(np.radians(take.camera.fov) / 2)
    assert depth.min() > 0.0
    assert max(np.abs(x / depth).max(), np.abs(y / depth).max()) < half


def test_cameras_that_follow_move_smoothly_and_fixed_ones_do_not() -> None:
    data = walker(30)
    for camera, steps in (("follow", 1e-2), ("fixed", 1e-12)):
        film = Film(data, 64, 64, shots=Shots(("side",), camera))
        places = np.array([film._takes[0].at(film._path[frame], frame / 30).position for frame in range(30)])
        assert np.abs(np.diff(places, n=2, axis=0)).max() < steps
        assert (np.ptp(places[:, 2]) > 1.0) == (camera == "follow")


def test_a_transparent_picture_has_straight_alpha() -> None:
    """Colours of the surface do not depend on what is behind it; beside it there is nothing."""
    data = walker(2)
    clear = Film(data, 200, 100, shots=Shots(background="transparent")).frame(0)
    plain = Film(data, 200, 100, shots=Shots(background=(0.0, 1.0, 0.0))).frame(0)
    alpha = clear[..., 3]
    assert set(np.unique(alpha)) >= {0, 64, 255}
    assert 0.05 < (alpha == 255).mean() < 0.5
    assert (np.abs(clear[..., :3].astype(int) - plain)[alpha == 255] <= 1).all()
    assert (plain[5, 5] == [0, 255, 0]).all()
    edge = (alpha > 0) & (alpha < 255)
    assert (plain[edge][:, 1].astype(int) > clear[edge][:, 1].astype(int)).mean() > 0.9  # green behind shines through


def test_a_sheet_has_a_row_for_every_view() -> None:
    data = walker(7)
    film = Film(data, 320, 120, shots=Shots(("front", "side", "back"), background="transparent"))
    sheet = film.sheet(7, columns=4)
    assert sheet.shape[0] == 6 * 120  # two blocks of three rows
    assert sheet.shape[2] == 3
    assert (sheet == film.sheet(7, 4, {0: film.frame(0)})).all()


def test_png_films_are_whole_or_not_there(tmp_path: Path) -> None:
    data = walker(3)
    film = Film(data, 64, 64, shots=Shots(("front",), background="transparent"))
    path, _ = write_video(film, tmp_path / "rollout_png")
    assert sorted(file.name for file in path.iterdir()) == ["00000.png", "00001.png", "00002.png"]
    with Image.open(path / "00001.png") as picture:
        assert (np.asarray(picture) == film.frame(1)).all()
    with pytest.raises(AttributeError), PngWriter(path) as writer:
        writer.append(None)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["rollout_png"]
    assert len(list(path.iterdir())) == 3


def test_the_inner_side_of_a_closed_surface_is_never_seen() -> None:
    ball, faces = sphere(2, 0.4)
    assert _is_closed(ball, faces)
    assert not _is_closed(ball, faces[:, ::-1])
    assert not _is_closed(ball, faces[1:])
    camera = Camera.framing(ball)
    pictures = [render_frame([RenderMesh(ball, faces, closed=closed)], camera, 60, 60) for closed in (False, True)]
    assert (np.abs(pictures[0].astype(int) - pictures[1]) <= 2).mean() > 0.99


def test_garments_have_colours_of_their_own_where_fabrics_look_alike() -> None:
    data = walker(1)
    tube, faces = data.cloth_pos[0], data.cloth_faces
    two = replace(
        data,
        cloth_pos=np.concatenate([tube, tube - [0.0, 0.5, 0.0]])[None],
        cloth_faces=np.concatenate([faces, faces + len(tube)]),
        rest_pos=np.concatenate([tube, tube - [0.0, 0.5, 0.0]]),
        attributes={"garment": "top+skirt", "fabric_names": "denim+denim_12oz"},
        still={"piece": np.repeat([0, 1], len(tube)), "fabric": np.repeat([0, 1], len(tube))},
    )
    for fabric_looks in (True, False):
        film = Film(two, 64, 64, shots=Shots(("front",), fabric_looks=fabric_looks))
        first, second = film._own_colour[0], film._own_colour[-1]
        assert np.linalg.norm(first - second) > 0.2
