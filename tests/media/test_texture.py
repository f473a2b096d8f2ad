"""Images on garments: what may be one, and what a picture shows of it in every pixel."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest

from hood.assets.formats import raw_mesh as texture_module
from hood.assets.formats.raw_mesh import Texture, read_texture
from hood.media.pieces import pieces_of, split_seams
from hood.media.renderer import raster, render, shading
from hood.media.renderer import raster as drawing
from hood.media.renderer.raster import Camera
from hood.media.renderer.render import Print, RenderMesh, pixels_of, render_frame
from hood.rollouts.file.reader import RolloutData

RED, GREEN, BLUE, WHITE = (255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255)
#: Left to right, the top row first.
QUARTERS = np.array([[RED, GREEN], [BLUE, WHITE]], dtype=np.uint8).repeat(32, axis=0).repeat(32, axis=1)


def encoded(pixels: np.ndarray, form: str = "PNG") -> bytes:
    from PIL import Image

    content = io.BytesIO()
    Image.fromarray(pixels).save(content, form)
    return content.getvalue()


@pytest.mark.parametrize("form, kind, suffix", [("PNG", "image/png", ".png"), ("JPEG", "image/jpeg", ".jpg")])
def test_the_first_bytes_say_what_a_file_is(tmp_path: Path, form: str, kind: str, suffix: str) -> None:
    path = tmp_path / "print.bin"
    path.write_bytes(encoded(QUARTERS, form))
    found = read_texture(path)
    assert (found.kind, found.suffix, found.content) == (kind, suffix, path.read_bytes())
    assert found.address.startswith(f"data:{kind};base64,")


def test_what_is_no_image_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "print.png"
    with pytest.raises(FileNotFoundError, match="no such file"):
        read_texture(path)
    path.write_bytes(b"GIF89a" + bytes(50))
    with pytest.raises(ValueError, match="neither PNG nor JPEG"):
        read_texture(path)
    path.write_bytes(encoded(QUARTERS))
    monkeypatch.setattr(texture_module, "_LARGEST", path.stat().st_size - 1)
    with pytest.raises(ValueError, match="save it smaller"):
        read_texture(path)
    with pytest.raises(ValueError, match="cannot be decoded"):
        pixels_of(Texture(encoded(QUARTERS)[:60], "image/png", ".png"))


def test_coordinates_begin_at_the_lower_left_and_repeat() -> None:
    image = pixels_of(Texture(encoded(QUARTERS), "image/png", ".png"))
    one = Print(image, np.zeros(0, dtype=np.int64), np.zeros((0, 3, 2)))
    places = np.array([[0.25, 0.75], [0.75, 0.75], [0.25, 0.25], [0.75, 0.25]])
    for shift in ([0, 0], [3, -2]):
        assert np.allclose(one.at(places + shift), np.array([RED, GREEN, BLUE, WHITE]) / 255)
    assert np.allclose(one.at(np.array([[0.5, 0.75]])), [[0.5, 0.5, 0]])  # between red and green


def sheet() -> RenderMesh:
    """An upright square that faces the camera, with the image on it; its corners lie at -1 and 1."""
    pos = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    image = pixels_of(Texture(encoded(QUARTERS), "image/png", ".png"))
    uv = 0.5 * (pos[:, :2] + 1.0)
    return RenderMesh(pos, faces, (0.5, 0.5, 0.5), prints=[Print(image, np.arange(2), uv[faces])])


@pytest.mark.parametrize("compiled", [True, False])
def test_every_pixel_shows_its_place_in_the_image(monkeypatch: pytest.MonkeyPatch, compiled: bool) -> None:
    if compiled and drawing.library() is None:
        pytest.skip("needs a C++ compiler")
    if not compiled:
        for module in (raster, render, shading):
            monkeypatch.setattr(module, "library", lambda: None)
    camera = Camera((0.0, 0.0, 6.0), (0.0, 0.0, 0.0), 25.0)
    far = RenderMesh(np.array([[5.0, 0, -5], [6, 0, -5], [5, 1, -5]]), np.array([[0, 1, 2]]))
    shown = render_frame([far, sheet()], camera, 120, 120, floor=-5.0).astype(int)  # its faces are counted after another's
    quarter = 24  # pixels from the middle to that of a quarter
    for row, column, wanted in ((-1, -1, RED), (-1, 1, GREEN), (1, -1, BLUE)):
        pixel = shown[60 + row * quarter, 60 + column * quarter]
        strong, weak = pixel[np.array(wanted) == 255], pixel[np.array(wanted) == 0]
        assert strong.min() > weak.max() + 80
    assert np.ptp(shown[60 + quarter, 60 + quarter]) < 60  # white


def test_a_mesh_without_an_image_is_drawn_as_before() -> None:
    camera = Camera((0.0, 0.0, 6.0), (0.0, 0.0, 0.0), 25.0)
    plain = RenderMesh(sheet().pos, sheet().faces, (0.5, 0.5, 0.5))
    nothing = Print(np.ones((1, 1, 3)), np.zeros(0, dtype=np.int64), np.zeros((0, 3, 2)))
    empty = RenderMesh(sheet().pos, sheet().faces, (0.5, 0.5, 0.5), prints=[nothing])
    assert np.array_equal(render_frame([plain], camera, 60, 60), render_frame([empty], camera, 60, 60))


def test_vertices_on_seams_are_several_points() -> None:
    faces, uv_faces = np.array([[0, 1, 2], [0, 2, 3]]), np.array([[0, 1, 2], [4, 5, 3]])
    vertex, coordinate, split = split_seams(faces, uv_faces)
    assert len(vertex) == 6
    assert np.array_equal(vertex[split], faces)
    assert np.array_equal(coordinate[split], uv_faces)


def test_garments_without_coordinates_lie_in_one_point() -> None:
    faces = np.array([[0, 1, 2], [3, 4, 5]])
    uv = np.array([[0, 0], [1, 0], [0, 1.0], [0, 0]])
    still = {"piece": np.array([0, 0, 0, 1, 1, 1]), "uv": uv, "uv_faces": np.array([[0, 1, 2], [3, 3, 3]])}
    pos = np.zeros((1, 6, 3))
    data = RolloutData(
        pos, faces, pos[0], np.zeros((1, 0, 3)), np.zeros((0, 3), int), np.zeros(1), {}, {"garment": "a+b"}, still=still
    )
    assert [(piece.name, piece.is_mapped, piece.faces.tolist()) for piece in pieces_of(data)] == [
        ("a", True, [0]),
        ("b", False, [1]),
    ]
