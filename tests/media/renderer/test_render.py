import importlib.util
import logging
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from hood.media import video
from hood.media.renderer.raster import Camera, barycentric, rasterise
from hood.media.renderer.render import RenderMesh, contact_sheet, render_frame
from hood.media.renderer.shading import smoothing
from hood.media.video import VideoWriter, save_png

RED, GREEN = (0.9, 0.1, 0.1), (0.1, 0.8, 0.1)
HAS_PILLOW = importlib.util.find_spec("PIL") is not None
needs_pillow = pytest.mark.skipif(not HAS_PILLOW, reason="needs Pillow")


def square(z: float = 0.0, size: float = 1.0, color: object = RED) -> RenderMesh:
    """A wall that faces +z, its centre at a height of 1 m."""
    half = size / 2
    pos = np.array([[-half, 1 - half, z], [half, 1 - half, z], [half, 1 + half, z], [-half, 1 + half, z]])
    return RenderMesh(pos, np.array([[0, 1, 2], [0, 2, 3]]), color)


def front(distance: float = 4.0) -> Camera:
    return Camera((0.0, 1.0, distance), (0.0, 1.0, 0.0), fov=30.0)


def test_rasterise_agrees_with_a_point_in_triangle_test() -> None:
    rng = np.random.default_rng(0)
    screen, nearness = rng.uniform(-8, 40, size=(60, 2)), rng.uniform(0, 1, size=60)
    faces = rng.permutation(60).reshape(20, 3)
    seen = rasterise(screen, nearness, faces, 32, 24)
    row, column = np.mgrid[0:24, 0:32]
    points = np.stack([column + 0.5, row + 0.5], axis=-1).reshape(-1, 2)
    best, owner = np.full(len(points), -np.inf), np.full(len(points), -1)
    clear = np.ones(len(points), dtype=bool)
    for index, face in enumerate(faces):
        weights = barycentric(screen, np.tile(face, (len(points), 1)), points)
        near = weights @ nearness[face]
        wins = (weights.min(axis=1) >= 0) & (near > best)
        best[wins], owner[wins] = near[wins], index
        # Points on an edge may go to either side.
        clear &= np.abs(weights.min(axis=1)) > 1e-3
    np.testing.assert_array_equal(seen.face.ravel()[clear], owner[clear])
    assert clear.sum() > 600
    assert (owner >= 0).sum() > 300
    drawn = (owner >= 0) & clear
    np.testing.assert_allclose(seen.nearness.ravel()[drawn], best[drawn], rtol=5e-7)  # float32 in C++


def test_shared_edges_leave_no_holes_and_chunks_do_not_matter() -> None:
    grid = np.stack(np.meshgrid(np.linspace(1.3, 60.7, 23), np.linspace(0.2, 50.1, 19)), axis=-1).reshape(-1, 2)
    corner = (np.arange(18)[:, None] * 23 + np.arange(22)).ravel()
    faces = np.concatenate([np.stack([corner, corner + 1, corner + 24], 1), np.stack([corner, corner + 24, corner + 23], 1)])
    whole = rasterise(grid, grid[:, 0], faces, 64, 52)
    assert (whole.face[1:49, 2:60] >= 0).all()
    parts = rasterise(grid, grid[:, 0], faces, 64, 52, chunk_faces=7)
    np.testing.assert_allclose(whole.nearness, parts.nearness)


def test_the_nearer_mesh_hides_the_farther_one_in_any_order() -> None:
    near, far = square(z=0.5, color=RED), square(z=-0.5, size=2.0, color=GREEN)
    for meshes in ([near, far], [far, near]):
        image = render_frame(meshes, front(), 60, 80)
        assert image.shape == (80, 60, 3)
        assert image.dtype == np.uint8
        red, green, _ = image[40, 30].astype(int)
        assert red > 2 * green
        red, green, _ = image[40, 4].astype(int)
        assert green > 2 * red


def test_both_sides_are_drawn_alike() -> None:
    mesh = square()
    turned = RenderMesh(mesh.pos, np.asarray(mesh.faces)[:, ::-1], mesh.color)
    outside, inside = (render_frame([m], front(), 60, 80)[40, 30].astype(int) for m in (mesh, turned))
    np.testing.assert_array_equal(outside, inside)
    assert outside[0] > 60


@pytest.mark.parametrize("tilt", [0.0, 0.7])
def test_cloth_on_the_skin_is_not_cut_by_it(tilt: float) -> None:
    """Two coplanar meshes with different triangles, in either order: what is behind does not show."""
    skin = square(color=GREEN)
    turn = np.array([[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]])
    pos = np.asarray(skin.pos) @ turn.T
    body = RenderMesh(pos, skin.faces, GREEN, behind=1e-3)
    cloth = RenderMesh(pos + [0.0, 0.0, 1e-9], np.array([[0, 1, 3], [1, 2, 3]]), RED)
    for meshes in ([body, cloth], [cloth, body]):
        image = render_frame(meshes, front(), 60, 80).astype(int)
        assert (image[..., 0] > 2 * image[..., 1]).sum() > 300
        assert not (image[..., 1] > 2 * image[..., 0]).any()


def test_a_hem_is_drawn_where_it_is_given() -> None:
    plain, close = square(), Camera((0.0, 1.4, 1.5), (0.0, 1.4, 0.0), fov=30.0)
    hem = 1.5 - np.asarray(plain.pos)[:, 1]
    meshes = [RenderMesh(plain.pos, plain.faces, RED, given) for given in (None, hem)]
    bare, sewn = (render_frame([mesh], close, 180, 240).astype(int)[:, 90] for mesh in meshes)
    rows = np.flatnonzero((bare - sewn).sum(axis=1) > 12)
    top = np.flatnonzero(bare[:, 0] > 2 * bare[:, 1])[0]
    assert (rows[0] - top, rows[-1] - top) in [(0, 5), (0, 6), (0, 7)]  # the edge, and the seam 2 cm or 6 pixels below
    with pytest.raises(ValueError, match=r"mesh 0: hem is \(3,\), needs \(4,\)"):
        render_frame([RenderMesh(plain.pos, plain.faces, RED, np.zeros(3))], front())


def test_vertex_colours_are_interpolated() -> None:
    colors = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, 0, 1.0], [1.0, 0, 0]])
    image = render_frame([square(color=colors)], front(), 90, 80).astype(int)
    difference = image[40, 30:60, 0] - image[40, 30:60, 2]
    assert difference[0] > 50
    assert difference[-1] < -50
    assert (np.diff(difference) <= 0).all()


def test_a_shadow_lies_on_the_floor_only_beside_the_mesh() -> None:
    camera = Camera((0.0, 5.0, 4.0), (0.0, 0.4, 0.0), fov=50.0)
    speck = render_frame([square(size=0.001)], camera, 90, 90, floor=0.0).astype(int)
    block = render_frame([square(size=1.6)], camera, 90, 90, floor=0.0).astype(int)
    on_floor = np.ptp(block, axis=2) < 12
    darker = (speck - block).mean(axis=2) * on_floor
    assert (~on_floor).sum() > 100
    # The key light comes from the upper left of the picture.
    assert (darker[:, 45:] > 12).sum() > 30
    assert (darker[:, :30] > 12).sum() == 0


@pytest.mark.parametrize("sigma", [1.4, 4.0])
def test_shade_on_the_floor_is_smoothed_as_by_scipy(sigma: float) -> None:
    cells = len(smoothing(sigma))
    shade = np.random.default_rng(0).random((cells, cells))
    expected = gaussian_filter(shade, sigma, mode="constant", truncate=3.0)
    assert smoothing(sigma) @ shade @ smoothing(sigma) == pytest.approx(expected, abs=1e-14)


@pytest.mark.parametrize(("azimuth", "elevation", "aspect"), [(0, 0, 0.75), (135, 25, 1.6), (-60, -10, 0.5)])
def test_framing_holds_all_points_and_is_tight(azimuth: float, elevation: float, aspect: float) -> None:
    points = np.random.default_rng(1).normal(size=(200, 3)) * [0.4, 1.0, 0.3] + [3.0, 1.0, -2.0]
    camera = Camera.framing(points, azimuth, elevation, fov=35.0, aspect=aspect, margin=1.0)
    seen = (points - np.asarray(camera.position)) @ camera.axes().T
    tan = np.tan(np.radians(17.5))
    reach = np.abs(seen[:, :2]) / (seen[:, 2:] * tan * [aspect, 1.0])
    assert (seen[:, 2] > 0).all()
    assert reach.max() == pytest.approx(1.0, abs=1e-6)


def test_framing_azimuth_turns_towards_the_left_side() -> None:
    points = np.array([[-0.5, 0, -0.5], [0.5, 2, 0.5]])
    assert Camera.framing(points, 0, 0).position[2] > 1.0
    assert Camera.framing(points, 90, 0).position[0] > 1.0


def test_render_frame_refuses_what_it_cannot_draw() -> None:
    mesh = square()
    broken = np.array(mesh.pos)
    broken[2, 1] = np.nan
    with pytest.raises(ValueError, match="mesh 1: vertex 2 is not finite"):
        render_frame([mesh, RenderMesh(broken, mesh.faces)], front())
    with pytest.raises(ValueError, match=r"color is \(3, 3\)"):
        render_frame([RenderMesh(mesh.pos, mesh.faces, np.zeros((3, 3)))], front())
    with pytest.raises(ValueError, match="no meshes"):
        render_frame([], front())
    with pytest.raises(ValueError, match="finite"):
        Camera.framing(np.full((2, 3), np.inf))


@needs_pillow
def test_contact_sheet_places_images_row_by_row() -> None:
    images = [np.full((40, 30, 3), value, dtype=np.uint8) for value in (10, 20, 30)]
    sheet = contact_sheet(images, columns=2)
    assert sheet.shape == (80, 60, 3)
    assert [sheet[20, 15, 0], sheet[20, 45, 0], sheet[60, 15, 0], sheet[60, 45, 0]] == [10, 20, 30, 255]
    assert (contact_sheet(images, 2, ["a", "b", "c"])[:40, :30] != 10).any()
    with pytest.raises(ValueError, match="2 labels for 3 images"):
        contact_sheet(images, 2, ["a", "b"])
    with pytest.raises(ValueError, match="image 1"):
        contact_sheet([images[0], images[1][:20]], 2)


@needs_pillow
def test_png_round_trip(tmp_path: Path) -> None:
    from PIL import Image

    picture = np.random.default_rng(2).integers(0, 255, size=(9, 7, 3)).astype(np.uint8)
    path = save_png(tmp_path / "deep" / "x.png", picture)
    np.testing.assert_array_equal(np.asarray(Image.open(path)), picture)
    assert [file.name for file in path.parent.iterdir()] == ["x.png"]


def frames(count: int = 5, height: int = 33, width: int = 40) -> list[np.ndarray]:
    return [np.full((height, width, 3), 40 * k, dtype=np.uint8) for k in range(count)]


def test_mp4_has_even_size_and_appears_only_at_the_end(tmp_path: Path) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    path = tmp_path / "film.mp4"
    with VideoWriter(path, fps=25) as film:
        for image in frames():
            film.append(image)
        assert not path.exists()
    count, _ = ffmpeg.count_frames_and_secs(str(path))
    meta = next(ffmpeg.read_frames(str(path)))
    assert count == 5
    assert meta["size"] == (40, 32)
    assert meta["codec"].startswith("h264")
    assert [file.name for file in tmp_path.iterdir()] == ["film.mp4"]


@needs_pillow
def test_without_ffmpeg_a_gif_is_written_and_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    from PIL import Image

    monkeypatch.setattr(video, "_find_ffmpeg", lambda: None)
    with caplog.at_level(logging.WARNING), VideoWriter(tmp_path / "film.mp4", fps=20) as film:
        for image in frames():
            film.append(image)
    assert film.path == tmp_path / "film.gif"
    assert "film.gif" in caplog.text
    with Image.open(film.path) as gif:
        assert gif.n_frames == 5
        assert gif.info["duration"] == 50


def shoot(path: Path, images: list[np.ndarray], error: Exception | None = None) -> None:
    """Write a film of ``images``; ``error`` strikes after the last of them."""
    with VideoWriter(path) as film:
        for image in images:
            film.append(image)
        if error is not None:
            raise error


@needs_pillow
def test_a_failed_film_leaves_nothing_behind(tmp_path: Path) -> None:
    for suffix in ("gif", "mp4"):
        with pytest.raises(RuntimeError, match="boom"):
            shoot(tmp_path / f"film.{suffix}", [frames()[0]], RuntimeError("boom"))
    assert list(tmp_path.iterdir()) == []


def test_video_writer_refuses_bad_input(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="suffix"):
        VideoWriter(tmp_path / "film.avi")
    with pytest.raises(ValueError, match="fps"):
        VideoWriter(tmp_path / "film.gif", fps=0)
    with pytest.raises(ValueError, match="after frames"):
        shoot(tmp_path / "film.gif", [frames()[0], frames(height=20)[0]])
    with pytest.raises(ValueError, match="no frames"):
        shoot(tmp_path / "film.gif", [])


@needs_pillow
def test_what_a_killed_process_left_is_gone_after_the_next(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    picture = np.zeros((16, 16, 3), np.uint8)

    def killed(*names: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as dying:
        dying.setattr(Path, "unlink", lambda path, missing_ok=False: None)
        dying.setattr("os.replace", killed)
        with pytest.raises(KeyboardInterrupt):
            save_png(tmp_path / "a.png", picture)
        with pytest.raises(KeyboardInterrupt), VideoWriter(tmp_path / "a.mp4", fps=30.0) as writer:
            writer.append(picture)
    left = {path.name for path in tmp_path.iterdir()}
    assert left
    assert not left & {"a.png", "a.mp4", "a.gif"}
    save_png(tmp_path / "a.png", picture)
    with VideoWriter(tmp_path / "a.mp4", fps=30.0) as writer:
        writer.append(picture)
    assert {path.name for path in tmp_path.iterdir()} == {"a.png", writer.path.name}
