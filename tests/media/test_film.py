"""Films draw the body as it is, or thinner by as much as the picture says."""

from __future__ import annotations

import io
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from hood.assets.formats.raw_mesh import Texture
from hood.media.film import Film
from hood.media.video import drawn
from hood.rollouts.file.reader import RolloutData
from hood.testing import cylinder, grid, sphere

Image = pytest.importorskip("PIL.Image")


def ball_in_a_tube() -> RolloutData:
    """A ball that sticks out of a coarse tube by up to 5 mm."""
    pos, faces = cylinder(24, 12, 0.1, 0.4)
    ball, ball_faces = sphere(3, 0.105)
    ball = ball + pos.mean(axis=0)
    return RolloutData(pos[None], faces, pos, ball[None], ball_faces, np.zeros(1), {}, {})


def skin(picture: np.ndarray) -> int:
    """Pixels of the body's colour in the middle of the picture, where the cloth is."""
    height, width = picture.shape[:2]
    part = picture[height // 3 : 2 * height // 3, width // 3 : 2 * width // 3].astype(int)
    return int((part[..., 0] > part[..., 2] + 5).sum())


def test_skin_through_cloth_is_seen_unless_the_body_is_thinner() -> None:
    data = ball_in_a_tube()
    true, thin = Film(data, 160, 224).frame(0), Film(data, 160, 224, thinner=0.02).frame(0)
    assert skin(true) > 500
    assert skin(thin) == 0


def test_the_picture_says_so() -> None:
    """In its upper right corner, where nothing is drawn; a rollout without a body has nothing to be thinned."""
    data = ball_in_a_tube()
    drawn = (0.0, 1e-9, 0.002)
    plain, hardly, told = (Film(data, 160, 224, thinner=thinner).frame(0)[:14, 60:].astype(int) for thinner in drawn)
    assert (plain - told).max() > 80
    assert (plain - hardly).max() > 80
    bare = replace(data, body_pos=np.empty((1, 0, 3)), body_faces=np.empty((0, 3), dtype=np.int64))
    assert (Film(bare, 160, 224, thinner=0.002).frame(0) == Film(bare, 160, 224).frame(0)).all()


def test_the_camera_frames_the_garment() -> None:
    """A skirt on a tall body fills the picture; the head of a tall one is not in it. Cloth that blew up does not count."""
    pos, faces = cylinder(24, 12, 0.2, 0.5)
    ball, ball_faces = sphere(2, 0.1)
    cloth = pos + [0.0, 0.9 - pos[:, 1].mean(), 0.0]
    body = ball * [1.0, 9.0, 1.0] + [0.0, 0.9, 0.0]
    still = RolloutData(np.stack([cloth] * 3), faces, pos, np.stack([body] * 3), ball_faces, np.arange(3) / 30, {}, {})
    film = Film(still, 160, 224)
    blue = film.frame(0).astype(int)
    rows = np.flatnonzero((blue[..., 2] > blue[..., 0] + 40).any(axis=1))
    assert 0.55 < (rows[-1] - rows[0]) / 224 < 0.95
    lost = still.cloth_pos.copy()
    lost[1] *= 1e6
    lost[2] = np.nan
    near, wild = film._camera, Film(replace(still, cloth_pos=lost), 160, 224)._camera
    assert np.linalg.norm(np.subtract(wild.position, wild.target)) < 4 * np.linalg.norm(np.subtract(near.position, near.target))


@pytest.mark.parametrize("threads", [1, 3])
def test_frames_that_are_drawn_ahead_are_the_same_and_in_order(threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    data = ball_in_a_tube()
    turned = np.stack([data.cloth_pos[0] + [0.02 * number, 0.0, 0.0] for number in range(7)])
    film = Film(replace(data, cloth_pos=turned, body_pos=np.repeat(data.body_pos, 7, axis=0), time=np.arange(7) / 30), 96, 128)
    expected = [film.frame(index) for index in (6, 0, 3, 3, 1)]
    used = set()

    def seen(index: int) -> np.ndarray:
        used.add(threading.get_ident())
        time.sleep(0.02)  # so that one thread cannot do it all
        return Film.frame(film, index)

    monkeypatch.setattr("hood.media.video.processors", lambda: threads)
    monkeypatch.setattr(film, "frame", seen)
    pairs = list(drawn(film.frame, iter((6, 0, 3, 3, 1))))
    assert [index for index, _ in pairs] == [6, 0, 3, 3, 1]
    found = [picture for _, picture in pairs]
    assert all(np.array_equal(a, b) for a, b in zip(found, expected, strict=True))
    assert len(used) == threads
    assert (threading.get_ident() in used) == (threads == 1)


def test_a_frame_that_cannot_be_drawn_ends_the_film(monkeypatch: pytest.MonkeyPatch) -> None:
    film = Film(ball_in_a_tube(), 96, 128)
    monkeypatch.setattr("hood.media.video.processors", lambda: 2)
    with pytest.raises(IndexError):
        list(drawn(film.frame, [0, 99]))


def _napkin(fabric: str) -> RolloutData:
    """5 cm of cloth, level."""
    pos, faces = grid(5)
    pos = 0.05 * pos
    attributes = {"fabric_names": fabric}
    uv = {"uv": pos[:, [0, 2]] / 0.05, "uv_faces": faces}
    empty = np.empty((1, 0, 3)), np.empty((0, 3), dtype=np.int64)
    return RolloutData(pos[None], faces, pos, *empty, np.zeros(1), {}, attributes, still=uv)


@pytest.mark.parametrize("colour", ["none", "strain"])
def test_the_thickness_of_cloth_shows_where_a_pixel_is_thinner(colour: str) -> None:
    """The plate of 2 mm of felt takes more rows of the picture than silk of 0.12 mm, which is drawn as a sheet."""
    films = {fabric: Film(_napkin(fabric), 160, 160, 0.0, colour) for fabric in ("silk", "wool_felt")}
    assert films["silk"]._shell is None
    empty = np.median(films["silk"].picture(0).astype(int), axis=(0, 1))
    silk, felt = (
        int((np.abs(films[fabric].picture(0)[:, 80].astype(int) - empty).sum(axis=1) > 90).sum())
        for fabric in ("silk", "wool_felt")
    )
    camera = films["silk"]._camera
    pixels = 2e-3 * camera.focal(160) / np.linalg.norm(np.subtract(camera.position, camera.target))
    assert felt - silk == pytest.approx(pixels, abs=2)
    assert pixels > 3


def test_an_image_is_on_the_shell_as_well() -> None:
    content = io.BytesIO()
    Image.new("RGB", (4, 4), (250, 40, 30)).save(content, "PNG")
    texture = Texture(content.getvalue(), "image/png", ".png")
    red = []
    for fabric in ("silk", "wool_felt"):
        picture = Film(_napkin(fabric), 160, 160, 0.0, textures={"cloth": texture}).picture(0).astype(int)
        red.append(int((picture[..., 0] > 2 * picture[..., 2]).sum()))
    assert red[1] > 1.2 * red[0] > 500
