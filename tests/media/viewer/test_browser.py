"""The page of ``hood view`` in a browser: it draws what the software renderer draws, plays, and follows its controls.

Needs Chromium on the PATH.
"""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hood.assets.formats.raw_mesh import Texture
from hood.media.renderer.raster import Camera
from hood.media.renderer.render import RenderMesh, render_frame
from hood.media.viewer.page import view_page
from hood.rollouts.file.reader import RolloutData
from hood.testing import cylinder, sphere
from tools.browser import Browser

pytestmark = pytest.mark.slow
FRAMES = 240
WHITE, BLACK = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def data() -> RolloutData:
    """A ball that rises a metre in a tube that widens, with colours by strain, unbalanced force and contact."""
    pos, faces = cylinder(48, 12, 0.3, 0.9)
    ball, ball_faces = sphere(3, 0.25)
    time = np.arange(FRAMES)
    wide = np.stack([1.0 + time / FRAMES, np.ones(FRAMES), 1.0 + time / FRAMES], axis=1)
    body = ball + np.stack([0 * time, time / FRAMES, 0 * time], axis=1)[:, None]
    figures = {"strain_p99": time / FRAMES, "ms_total": np.full(FRAMES, 40.0)}
    rg = np.full((FRAMES, len(pos)), 0.1, dtype=np.float32)
    cloth = pos * wide[:, None] - [0.0, 0.45, 0.0]
    return RolloutData(cloth, faces, pos, body, ball_faces, time / 30, figures, {}, {"rg": rg})


@pytest.fixture(scope="module")
def page(data: RolloutData, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """The page of one rollout, open."""
    folder = tmp_path_factory.mktemp("page")
    (folder / "page.html").write_text(view_page([("one", data)], "a tube"), encoding="utf-8")
    with Browser() as browser:
        browser.downloads(folder)
        browser.open(folder / "page.html")
        browser.folder = folder  # type: ignore[attr-defined]
        yield browser


def scrub(page: Browser, frame: int) -> np.ndarray:
    """(H, W, 3) of the canvas after the timeline was moved to ``frame``."""
    page.run(
        "(() => { const time = document.getElementById('time');"
        f"time.value = {frame}; time.dispatchEvent(new Event('input')); }})()"
    )
    return canvas(page, "canvas")


def canvas(page: Browser, name: str) -> np.ndarray:
    """(H, W, 3) of what a canvas shows two animation frames later."""
    later = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"
    text = page.run(f"{later}.then(() => document.getElementById('{name}').toDataURL('image/png'))")
    return picture(base64.b64decode(text.split(",")[1]))


def picture(png: bytes) -> np.ndarray:
    from PIL import Image

    with Image.open(io.BytesIO(png)) as image:
        return np.asarray(image.convert("RGB")).astype(int)


def said(page: Browser, name: str) -> str:
    return str(page.run(f"document.getElementById('{name}').textContent"))


def choose(page: Browser, name: str, value: str) -> None:
    page.run(f"(() => {{ const it = document.getElementById('{name}'); it.value = '{value}'; it.onchange(); }})()")


def tick(page: Browser, name: str, on: bool) -> None:
    page.run(
        f"(() => {{ const it = document.getElementById('{name}'); it.checked = {str(on).lower()};"
        "if (it.onchange) it.onchange(); })()"
    )


def covered(image: np.ndarray) -> np.ndarray:
    """(H, W) where something stands before the plain background, whose colour is that of a corner."""
    return np.abs(image - image[0, 0]).sum(axis=2) > 12


@pytest.mark.parametrize("frame", [0, 200])
def test_the_silhouette_is_that_of_the_software_renderer(page: Browser, data: RolloutData, frame: int) -> None:
    """From the page's first camera: 35 degrees, 1.7 diagonals before the middle of the body, which it follows upwards."""
    tick(page, "floor", False)
    shown = covered(scrub(page, frame))
    tick(page, "floor", True)
    start, now = data.body_pos[0], data.body_pos[frame]
    extent = float(np.linalg.norm(start.max(axis=0) - start.min(axis=0)))
    target = 0.5 * (now.max(axis=0) + now.min(axis=0))
    position = target + [0.0, 0.15 * extent, 1.7 * extent]
    camera = Camera(tuple(position), tuple(target), 35.0)  # type: ignore[arg-type]
    parts = (data.cloth_pos[frame], data.cloth_faces), (data.body_pos[frame], data.body_faces)
    height, width = shown.shape
    light, dark = (
        render_frame([RenderMesh(*part, colour) for part in parts], camera, width, height, floor=-50.0).astype(int)
        for colour in (WHITE, BLACK)
    )
    ours = np.abs(light - dark).sum(axis=2) > 12
    assert 0.02 < ours.mean() < 0.98
    assert (shown & ours).sum() / (shown | ours).sum() > 0.98


def test_frames_differ_and_nothing_is_complained_about(page: Browser) -> None:
    first, later = scrub(page, 0), scrub(page, 200)
    assert np.abs(first - later).sum(axis=2).astype(bool).mean() > 0.05
    np.testing.assert_array_equal(scrub(page, 0), first)
    assert page.complaints == []


def test_the_chart_follows_the_timeline_and_moves_it(page: Browser) -> None:
    scrub(page, 30)
    assert said(page, "frame") == f"frame 30 of {FRAMES - 1}, 1.00 s"
    before = canvas(page, "chart")
    scrub(page, 180)
    assert np.abs(canvas(page, "chart") - before).any()
    left, top, width, height = page.run(
        "(() => { const box = document.getElementById('chart').getBoundingClientRect();"
        "return [box.left, box.top, box.width, box.height]; })()"
    )
    page.press(left + 60 + 0.5 * (width - 72), top + 0.5 * height)
    assert said(page, "frame").split(",")[0] in (f"frame {at} of {FRAMES - 1}" for at in (119, 120))


@pytest.mark.parametrize("colour", ["plain", "strain", "rg", "contact"])
def test_every_colouring_paints_the_cloth(page: Browser, colour: str) -> None:
    choose(page, "colour", "fabric")
    fabric = scrub(page, 120)
    choose(page, "colour", colour)
    assert np.abs(canvas(page, "canvas") - fabric).sum(axis=2).astype(bool).mean() > 0.05
    assert (said(page, "scale") != "") == (colour != "plain")
    choose(page, "colour", "fabric")
    np.testing.assert_array_equal(canvas(page, "canvas"), fabric)


def test_the_still_is_a_png_of_what_is_seen(page: Browser) -> None:
    shown = scrub(page, 42)
    page.run("document.getElementById('still').click()")
    target = Path(page.folder) / "a_tube_42.png"  # type: ignore[attr-defined]
    page.run("new Promise((done) => setTimeout(done, 100))")
    for _ in range(100):
        if target.is_file():
            break
        page.run("new Promise((done) => setTimeout(done, 100))")
    np.testing.assert_array_equal(picture(target.read_bytes()), shown)


def test_it_plays_and_stops_at_the_end(page: Browser) -> None:
    scrub(page, FRAMES - 20)
    page.run("document.getElementById('loop').checked = false")
    page.run("document.getElementById('play').click()")
    playing = "new Promise((done) => { const look = () => document.getElementById('play').textContent === 'play' ? done() :"
    page.run(playing + " setTimeout(look, 50); look(); })")
    assert said(page, "frame").startswith(f"frame {FRAMES - 1} of")


def test_rollouts_beside_and_over_each_other(data: RolloutData, tmp_path: Path) -> None:
    path = tmp_path / "two.html"
    path.write_text(view_page([("one", data), ("two", data)], "two tubes"), encoding="utf-8")
    with Browser() as browser:
        browser.open(path)
        tick(browser, "floor", False)
        beside = covered(scrub(browser, 100))
        half = beside.shape[1] // 2
        assert (beside[:, :half] == beside[:, half : 2 * half]).mean() > 0.99
        choose(browser, "layout", "over")
        over = covered(canvas(browser, "canvas"))
        columns = np.flatnonzero(over.any(axis=0))
        assert abs(columns.mean() - half) < 3
        assert browser.complaints == []


def test_events_are_marked_and_lead_to_their_frames(data: RolloutData, tmp_path: Path) -> None:
    """Of three events close to each other no label covers another, and each begins at its place in the chart."""
    events = [{"frame": frame, "open": "front_buttons"} for frame in (100, 104, 108)]
    told = {"dt": 1 / 30, "config": json.dumps({"events": events, "wind": 3})}
    path = tmp_path / "events.html"
    path.write_text(view_page([("one", replace(data, attributes=told))], "a tube"), encoding="utf-8")
    with Browser() as browser:
        browser.open(path)
        boxes = np.array(
            browser.run(
                "[...document.querySelectorAll('#moments button')].map((one) => { const box = one.getBoundingClientRect();"
                "return [box.left, box.top, box.right, box.bottom]; })"
            )
        )
        assert len(boxes) == 3
        assert (boxes[1:, 1] >= boxes[:-1, 3]).all()
        wide = browser.run("document.getElementById('chart').clientWidth")
        assert np.allclose(boxes[:, 0], 60 + (wide - 72) * np.array([100, 104, 108]) / (FRAMES - 1), atol=1.0)
        browser.press(boxes[1, 0] + 8, 0.5 * (boxes[1, 1] + boxes[1, 3]))
        assert said(browser, "frame").startswith("frame 104 of")
        assert said(browser, "names") == "onewind 3 m/s"
        assert browser.complaints == []


def test_an_image_lies_on_the_garment(data: RolloutData, tmp_path: Path) -> None:
    """Half of the tube has a red image and the other half a blue one, side by side in one file; a seam runs where they meet."""
    from PIL import Image

    content = io.BytesIO()
    Image.fromarray(np.array([[[255, 0, 0], [0, 0, 255]]], np.uint8).repeat(8, axis=0).repeat(8, axis=1)).save(content, "PNG")
    right = data.rest_pos[data.cloth_faces][..., 0].mean(axis=1) > 0
    still = {"uv": np.array([[0.25, 0.5], [0.25, 0.6], [0.75, 0.5], [0.75, 0.6]])}
    still["uv_faces"] = np.where(right[:, None], [2, 3, 2], [0, 1, 0])
    texture = Texture(content.getvalue(), "image/png", ".png")
    path = tmp_path / "image.html"
    path.write_text(view_page([("one", replace(data, still=still))], "a tube", [{"cloth": texture}]), encoding="utf-8")
    with Browser() as browser:
        browser.open(path)
        shown = scrub(browser, 0)
        red, blue = (shown[..., one] > 2 * shown[..., other] for one, other in ((0, 2), (2, 0)))
        left_of, right_of = (np.flatnonzero(half.any(axis=0)).mean() for half in (red, blue))
        assert min(red.mean(), blue.mean()) > 0.01
        assert left_of < shown.shape[1] / 2 < right_of
        choose(browser, "colour", "plain")
        plain = canvas(browser, "canvas")
        assert not ((plain[..., 0] > 2 * plain[..., 2]) & covered(plain)).any()
        assert browser.complaints == []
