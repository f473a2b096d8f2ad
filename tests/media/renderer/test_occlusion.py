"""Shade where surfaces are near each other: none in the open, most in a corner, whatever the order of what is drawn."""

from __future__ import annotations

import numpy as np

from hood.media.renderer.raster import Camera, VisibilityBuffer
from hood.media.renderer.render import RenderMesh, render_frame
from hood.media.renderer.shading import AROUND, openness

FOCAL, SIZE = 400.0, 200


def seen(depth: np.ndarray) -> VisibilityBuffer:
    """A surface at ``depth`` (H, W) [m] in every pixel; not finite where there is none."""
    there = np.isfinite(depth)
    return VisibilityBuffer(np.where(there, 0, -1), np.where(there, 1.0 / np.where(there, depth, 1.0), -np.inf))


def along(depth: np.ndarray, columns: np.ndarray, normal: tuple[float, float, float]) -> np.ndarray:
    """Openness at ``columns`` of the middle row, the mean over the four places of a pixel."""
    values = [
        openness(
            seen(depth), FOCAL, np.full(len(columns), SIZE // 2 + row), columns + column, np.tile(normal, (len(columns), 1))
        )
        for row in (0, 1)
        for column in (0, 1)
    ]
    return np.mean(values, axis=0)


def test_a_plane_in_the_open_is_not_shaded() -> None:
    flat = np.full((SIZE, SIZE), 2.0)
    assert (along(flat, np.arange(2, SIZE - 2), (0.0, 0.0, -1.0)) == 1.0).all()
    flat[:, ::3] = np.nan  # what is not seen keeps nothing off
    assert (along(flat, np.arange(4, SIZE - 4, 6), (0.0, 0.0, -1.0)) == 1.0).all()


def test_a_step_shades_the_wall_behind_it_near_by_only() -> None:
    """A wall at 2 m, left of it one 3 cm closer: dark beside the step, not beyond the reach, and not upon the step."""
    depth = np.full((SIZE, SIZE), 2.0)
    depth[:, : SIZE // 2] = 1.97
    values = along(depth, np.arange(SIZE - 4), (0.0, 0.0, -1.0))
    beside = SIZE // 2
    assert values[beside] < 0.92
    assert values[beside] < values[beside + 8] < 1.0
    assert (values[beside + 22 :] == 1.0).all()  # 18 pixels are 9 cm
    assert (values[: beside - 2] == 1.0).all()


def test_places_cover_the_disc_evenly() -> None:
    places = AROUND.reshape(-1, 2)
    assert (np.linalg.norm(places, axis=1) <= 1.0).all()
    assert np.abs(places.mean(axis=0)).max() < 0.12
    assert len(np.unique(places.round(6), axis=0)) == len(places)


def test_contact_is_darker_in_the_picture() -> None:
    """A strip 3 cm before a wall darkens the wall within the reach beside it, on the side of the lamp as well."""
    pos = np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 2.0, 0.0], [-1.0, 2.0, 0.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    camera = Camera((0.0, 1.0, 3.0), (0.0, 1.0, 0.0), 20.0)
    wall = RenderMesh(pos, faces, (0.8, 0.8, 0.8))
    strip = RenderMesh(pos * [0.05, 1.0, 1.0] + [0.0, 0.0, 0.03], faces, (0.8, 0.2, 0.2))
    bare, dressed = (render_frame(meshes, camera, 120, 120)[60].mean(axis=1) for meshes in ([wall], [wall, strip]))
    darker = bare - dressed  # the strip spans the columns 54 to 66
    assert darker[52:54].mean() > 5
    assert np.abs(darker[20:40]).max() < 1
