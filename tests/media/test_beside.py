"""Rollouts side by side: same moments, same camera, one scale; what does not belong together is refused."""

from __future__ import annotations

import importlib.util
from dataclasses import replace

import numpy as np
import pytest

from hood.media.beside import Panel, SideBySide, require_same_motion
from hood.rollouts.file.reader import RolloutData
from hood.testing import cylinder, sphere

needs_pillow = pytest.mark.skipif(importlib.util.find_spec("PIL") is None, reason="needs Pillow")
WIDTH, HEIGHT = 90, 120


def tube(sides: int, wider: float, num_frames: int = 3, body: bool = True, rg: float = 1.0) -> RolloutData:
    """A tube of ``sides`` sides about a rising ball, wider from frame to frame."""
    pos, faces = cylinder(sides, 4, 0.3, 0.5)
    ball, ball_faces = sphere(1, 0.25)
    stretch = 1.0 + wider * np.arange(num_frames)[:, None, None] * np.array([1.0, 0.0, 1.0])
    rise = np.arange(num_frames)[:, None, None] * np.array([0.0, 0.02, 0.0])
    shape = ball[None] + [0.0, 0.25, 0.0] + rise if body else np.zeros((num_frames, 0, 3))
    fields = {"rg": np.full((num_frames, len(pos)), rg)}
    fields["rg"][0] = np.nan
    rows = ball_faces if body else np.zeros((0, 3), dtype=int)
    return RolloutData(pos * stretch + rise, faces, pos, shape, rows, np.arange(num_frames) / 30, {}, {}, fields)


def view(*rollouts: RolloutData, colour: str = "strain") -> SideBySide:
    return SideBySide([Panel(data, f"take {i}") for i, data in enumerate(rollouts)], colour, WIDTH, HEIGHT)


@needs_pillow
def test_pictures_stand_side_by_side_with_one_camera_and_one_scale() -> None:
    calm, wild = tube(16, 0.0), tube(24, 0.1)
    shown = view(calm, wild)
    picture = shown.frame(2).astype(int)
    assert picture.shape[1] == 2 * WIDTH
    cameras = [film._camera for film in shown._films]
    assert cameras[0] == cameras[1]
    top = picture.shape[0] - HEIGHT - 60
    left, right = picture[top : top + HEIGHT, :WIDTH], picture[top : top + HEIGHT, WIDTH:]
    # Nothing is stretched on the left, and the scale is that of the right.
    middle = slice(HEIGHT // 2 - 10, HEIGHT // 2 + 10), slice(WIDTH // 2 - 8, WIDTH // 2 + 8)
    assert left[middle].mean() > right[middle].mean() + 30
    alone = view(calm, calm).frame(2)[top : top + HEIGHT, :WIDTH]
    assert abs(alone[middle].mean() - left[middle].mean()) < 3  # the same colour; the camera holds the wild one as well
    bare = view(calm, wild, colour="none")
    assert bare.frame(0).shape[0] == picture.shape[0] - 60


@needs_pillow
def test_a_sheet_has_a_row_for_each_and_begins_where_there_are_values() -> None:
    shown = view(tube(16, 0.0, 5), tube(16, 0.1, 5), tube(16, 0.2, 5), colour="rg")
    sheet = shown.sheet(3)
    assert sheet.shape[1] == 3 * WIDTH
    assert sheet.shape[0] > 3 * HEIGHT
    # Values are the highest of the scale: a coloured, not a grey tube in the first column.
    row = shown.sheet(3)[30 : 30 + HEIGHT, :WIDTH].astype(int)
    assert np.ptp(row[HEIGHT // 2 - 5 : HEIGHT // 2 + 5, WIDTH // 2 - 5 : WIDTH // 2 + 5], axis=2).min() > 10


@needs_pillow
def test_without_a_body_the_camera_sees_the_cloth_of_all() -> None:
    near, far = tube(16, 0.0, body=False), tube(16, 0.0, body=False)
    far = replace(far, cloth_pos=far.cloth_pos + [1.0, 0.0, 0.0])
    picture = view(near, far, colour="none").frame(1)[-HEIGHT:].astype(int)
    blue = picture[..., 2] - picture[..., 0] > 40
    left, right = np.flatnonzero(blue[:, :WIDTH].any(axis=0)), np.flatnonzero(blue[:, WIDTH:].any(axis=0))
    assert len(left) > 5
    assert len(right) > 5
    assert left.max() < right.min() + 5


@needs_pillow
def test_long_titles_are_shortened_in_the_middle() -> None:
    data = tube(16, 0.0)
    long = [Panel(data, "begin" + "x" * 200 + "end"), Panel(data, "short")]
    heading = SideBySide(long, "none", WIDTH, HEIGHT).frame(0)[:20]
    assert (heading[:, WIDTH - 4 : WIDTH] == 255).all()
    assert (heading[:, : WIDTH // 2] < 128).any()


def test_only_frames_of_the_same_motion_go_together() -> None:
    first, finer = tube(16, 0.0), tube(24, 0.1)
    both = [("a.h5", first), ("b.h5", finer)]
    assert [data.cloth_pos.shape[1] for data in require_same_motion(both)] == [64, 96]
    assert {len(data.fields["rg"]) for data in require_same_motion(both, 2)} == {2}
    longer = ("b.h5", tube(16, 0.0, 5))
    assert [len(data.time) for data in require_same_motion([both[0], longer], 3)] == [3, 3]
    moved = replace(finer, body_pos=finer.body_pos + np.array([0.0, 0.0, 2e-3])[None] * np.array([0, 1, 1])[:, None, None])
    rounded = replace(finer, body_pos=finer.body_pos.astype(np.float32))
    assert len(require_same_motion([both[0], ("b.h5", rounded)])) == 2
    refused = {
        "3 and 5 frames; show those that all have with num_frames=3": longer,
        "the bodies move differently, 0.002 m apart in frame 1": ("b.h5", moved),
        "30 and 60 frames per second show different moments": ("b.h5", replace(finer, time=finer.time / 2)),
        "the bodies are different ones, with 42 and 0 vertices": ("b.h5", tube(16, 0.0, body=False)),
    }
    for words, other in refused.items():
        with pytest.raises(ValueError, match=rf"a\.h5 and b\.h5: {words}"):
            require_same_motion([both[0], other])
    with pytest.raises(ValueError, match="num_frames=4: these rollouts have 1 to 3 frames in common"):
        require_same_motion(both, 4)
    with pytest.raises(ValueError, match="1 rollouts cannot be compared"):
        view(first)
