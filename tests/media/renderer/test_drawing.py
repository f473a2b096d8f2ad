"""Drawing in C++ gives the pictures of drawing in numpy."""

from __future__ import annotations

import numpy as np
import pytest

from hood.media.renderer import raster, render, shading
from hood.media.renderer import raster as drawing
from hood.media.renderer.raster import Camera, rasterise
from hood.media.renderer.render import RenderMesh, hem_distance, render_frame, render_views
from hood.testing import cylinder

needs_compiler = pytest.mark.skipif(drawing.library() is None, reason="needs a C++ compiler")


@pytest.fixture
def in_numpy(monkeypatch: pytest.MonkeyPatch):
    """A function that draws without the compiled form."""

    def draw(function, *args, **kwargs):
        with monkeypatch.context() as patch:
            for module in (raster, render, shading):
                patch.setattr(module, "library", lambda: None)
            return function(*args, **kwargs)

    return draw


def scene() -> list[RenderMesh]:
    """An open tube, seen from outside and inside, coloured by vertex, round a thinner one."""
    pos, faces = (np.asarray(values) for values in cylinder(24, 9, radius=0.3, height=0.8))
    colour = np.abs(np.sin(7.0 * pos))
    inner = RenderMesh(0.5 * pos + 0.02, faces, (0.7, 0.7, 0.6), behind=0.001)
    return [inner, RenderMesh(pos, faces, colour, hem_distance(pos, faces))]


def same(one: np.ndarray, other: np.ndarray) -> bool:
    """But for rounding: the last of 256 steps, and a pixel here and there whose centre lies on an edge."""
    return bool((np.abs(one - other) > 1).mean() <= 1e-3)


@needs_compiler
@pytest.mark.parametrize("elevation", [-40.0, 0.0, 8.0, 80.0])
def test_pictures_are_the_same(in_numpy, elevation):
    meshes = scene()
    camera = Camera.framing(np.concatenate([np.asarray(mesh.pos) for mesh in meshes]), 30.0, elevation)
    shown = render_frame(meshes, camera, 90, 120).astype(int)
    assert len(np.unique(shown)) > 50
    assert same(shown, in_numpy(render_frame, meshes, camera, 90, 120))
    low = render_frame(meshes, camera, 90, 120, floor=-2.0).astype(int)
    assert same(low, in_numpy(render_frame, meshes, camera, 90, 120, floor=-2.0))
    assert (low != shown).any() == (elevation >= 0)  # from below there is no floor


@needs_compiler
@pytest.mark.parametrize(("width", "height"), [(24, 32), (1, 3), (7, 10), (17, 1)])
def test_small_pictures_are_the_same(in_numpy, width, height):
    """Samples look less than a pixel far there, at themselves, and keep no light off; some are narrower than a register."""
    meshes = scene()
    camera = Camera.framing(np.concatenate([np.asarray(mesh.pos) for mesh in meshes]), 30.0, 8.0)
    shown = render_frame(meshes, camera, width, height).astype(int)
    expected = in_numpy(render_frame, meshes, camera, width, height)
    assert same(shown, expected) if width * height > 100 else np.abs(shown - expected).max() <= 1


@needs_compiler
@pytest.mark.parametrize("background", [(0.2, 0.5, 0.9), "transparent"])
def test_pictures_before_other_backgrounds_are_the_same(in_numpy, background):
    meshes = scene()
    camera = Camera.framing(np.concatenate([np.asarray(mesh.pos) for mesh in meshes]), 30.0, 8.0)
    cameras = [camera, Camera.framing(camera.target, 200.0, 8.0)]
    shown = render_views(meshes, cameras, 61, 90, background=background).astype(int)
    assert shown.shape == (90, 122, 4 if background == "transparent" else 3)
    assert same(shown, in_numpy(render_views, meshes, cameras, 61, 90, background=background))


@needs_compiler
def test_the_nearest_face_is_the_same_for_any_triangles(in_numpy):
    rng = np.random.default_rng(0)
    for _ in range(20):
        screen = rng.uniform(-40.0, 140.0, (60, 2)).round(int(rng.integers(0, 4)))
        nearness, faces = rng.uniform(0.1, 1.0, 60), rng.integers(0, 60, (80, 3))
        one, other = rasterise(screen, nearness, faces, 100, 70), in_numpy(rasterise, screen, nearness, faces, 100, 70)
        for pixel in zip(*np.nonzero(one.face != other.face), strict=True):  # faces meet at their corners: equally near there
            assert set(faces[one.face[pixel]]) & set(faces[other.face[pixel]])
        drawn = other.face >= 0
        assert (drawn == (one.face >= 0)).all()
        assert np.allclose(one.nearness[drawn], other.nearness[drawn], rtol=0, atol=4e-6)  # float32 in C++


@needs_compiler
def test_no_faces_leave_the_background(in_numpy):
    far = RenderMesh(np.array([[0.0, 0.0, 50.0], [1.0, 0.0, 50.0], [0.0, 1.0, 50.0]]), np.array([[0, 1, 2]]))
    camera = Camera((0.0, 1.0, 0.0), (0.0, 1.0, -5.0))
    shown = render_frame([far], camera, 40, 30).astype(int)
    assert same(shown, in_numpy(render_frame, [far], camera, 40, 30))
