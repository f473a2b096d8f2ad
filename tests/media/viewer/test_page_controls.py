"""The controls of the page of ``hood view`` in a browser: keys, views, scales, parts, comparison, narrow windows, access.

Needs Chromium on the PATH.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hood.media.viewer.page import view_page
from hood.rollouts.file.reader import RolloutData
from hood.rollouts.verdict.rule import Reason, Verdict
from hood.testing import cylinder, sphere
from tools.browser import Browser

pytestmark = pytest.mark.slow
FRAMES = 12
LATER = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"
#: A clock that stands still until a test moves it.
CLOCK = """
window.clock = 0;
performance.now = () => window.clock;
const ask = window.requestAnimationFrame.bind(window);
window.requestAnimationFrame = (work) => ask(() => work(window.clock));
"""


def tube(shift: float = 0.0, flip: bool = False) -> RolloutData:
    """A tube of two parts, stretched by 4 %, left of a ball."""
    pos, faces = cylinder(24, 6, 0.2, 0.8)
    ball, ball_faces = sphere(2, 0.5)
    time = np.arange(FRAMES)
    tall = pos * [1.0, 1.04, 1.0] - [0.5, 0.4, 0.0]
    cloth = np.repeat(tall[None], FRAMES, axis=0) + [0.0, 0.0, shift]
    body = np.repeat((ball + [0.25, 0.0, 0.0])[None], FRAMES, axis=0)
    figures = {"strain_p99": time / FRAMES}
    alarms = [{"frame": frame, "cause": "strain", "value": 0.3, "limit": 0.25} for frame in (4, 5)]
    attributes = {"garment": "upper+lower"}
    still = {"piece": (pos[:, 1] > np.median(pos[:, 1])).astype(np.int32)}
    faces = faces[:, ::-1].copy() if flip else faces
    return RolloutData(cloth, faces, pos, body, ball_faces, time / 30, figures, attributes, {}, alarms, still)


def write(path: Path, *rollouts: RolloutData, whole: bool = False) -> Path:
    named = [(f"run {at}", data) for at, data in enumerate(rollouts)]
    path.write_text(view_page(named, "tubes", whole=rollouts if whole else None), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """The page of two rollouts that are 9 mm apart, open."""
    doubt = {"kind": "floor", "sentence": "it sinks", "frames": [9]}
    verdicts = [Verdict(False, (Reason("skin_depth", "skin stands out", ((7, 8),)),), (doubt,)), Verdict(True)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hood.media.viewer.page.judge_rollout", lambda _: verdicts.pop(0))
        path = write(tmp_path_factory.mktemp("page") / "page.html", tube(), tube(0.009), whole=True)
    with Browser() as browser:
        browser.before(CLOCK)
        browser.open(path)
        yield browser
        assert browser.complaints == []


def choose(page: Browser, name: str, value: str | bool) -> None:
    attribute = "checked" if isinstance(value, bool) else "value"
    text = str(value).lower() if isinstance(value, bool) else repr(value)
    page.run(
        f"(() => {{ const it = document.getElementById('{name}'); it.{attribute} = {text};if (it.onchange) it.onchange(); }})()"
    )


def said(page: Browser, name: str) -> str:
    return str(page.run(f"document.getElementById('{name}').textContent"))


def frame(page: Browser) -> int:
    return int(page.run("Number(document.getElementById('time').value)"))


def key(page: Browser, name: str, **more: Any) -> None:
    for kind in ("keyDown", "keyUp"):
        page.call("Input.dispatchKeyEvent", type=kind, key=name, **more)


def shown(page: Browser) -> np.ndarray:
    """(H, W, 3) of the canvas two animation frames later."""
    from PIL import Image

    text = page.run(f"{LATER}.then(() => document.getElementById('canvas').toDataURL('image/png'))")
    with Image.open(io.BytesIO(base64.b64decode(text.split(",")[1]))) as image:
        return np.asarray(image.convert("RGB")).astype(int)


def plain_again(page: Browser) -> None:
    for name, value in (("colour", "plain"), ("layout", "beside"), ("floor", False), ("body", True), ("range", "page")):
        choose(page, name, value)
    choose(page, "beyond", False)
    page.run("document.activeElement.blur()")
    key(page, "1")
    key(page, "Home")


def bluish(image: np.ndarray) -> np.ndarray:
    """(H, W) where cloth in the colour of no fabric is: greyer and bluer than skin, darker than the background."""
    return (image[..., 2] > image[..., 0]) & (image.sum(axis=2) < 690) & (np.abs(image - image[0, 0]).sum(axis=2) > 12)


def test_keys_lead_to_frames_and_the_help_tells_them(page: Browser) -> None:
    plain_again(page)
    for name, at in (
        ("ArrowRight", 1),
        ("ArrowRight", 2),
        ("ArrowLeft", 1),
        ("End", FRAMES - 1),
        ("ArrowRight", FRAMES - 1),
        ("Home", 0),
    ):
        key(page, name)
        assert frame(page) == at
    key(page, " ")
    assert said(page, "play") == "pause"
    key(page, " ")
    assert said(page, "play") == "play"
    key(page, "?")
    assert page.run("document.getElementById('help').open") is True
    assert "one frame back" in said(page, "help")
    key(page, "ArrowRight")
    assert frame(page) == 0
    key(page, "Escape", windowsVirtualKeyCode=27)
    assert page.run("document.getElementById('help').open") is False


def test_views_from_the_front_the_side_and_the_back(page: Browser) -> None:
    """The camera looks at the ball: the tube is left of it from the front and right of it from the back."""
    plain_again(page)
    pressed = "[...document.querySelectorAll('#views [aria-pressed=true]')].map((one) => one.dataset.view)"
    middles, sizes = {}, {}
    for name, view in (("1", "front"), ("2", "side"), ("3", "back")):
        key(page, name)
        image = shown(page)
        cloth = bluish(image[:, : image.shape[1] // 2])
        middles[view], sizes[view] = np.argwhere(cloth)[:, 1].mean() / cloth.shape[1] if cloth.any() else None, cloth.sum()
        assert page.run(pressed) == [view]
    assert middles["front"] < 0.4 < 0.6 < middles["back"]
    assert sizes["side"] < 0.3 * sizes["front"]
    key(page, "ArrowLeft", modifiers=8)
    assert page.run(pressed) == ["free"]
    turned = shown(page)
    key(page, "1")
    key(page, "4")
    np.testing.assert_array_equal(shown(page), turned)


def test_speed_of_playing(page: Browser) -> None:
    """After ten frames of the clock at half speed the fifth is shown."""
    plain_again(page)
    for speed, at in (("0.5", 5), ("2", 8), ("0.25", 2)):
        key(page, "Home")
        choose(page, "speed", speed)
        key(page, " ")
        page.run(f"(window.clock += {(4 if speed == '2' else 10) * 1000 / 30 + 1}, {LATER})")
        key(page, " ")
        assert frame(page) == at
    choose(page, "speed", "1")


def test_only_what_is_beyond_the_limit_is_coloured(page: Browser) -> None:
    plain_again(page)
    grey = shown(page)
    choose(page, "colour", "strain")
    coloured = shown(page)
    choose(page, "beyond", True)
    choose(page, "limit", "99")
    assert "plain below 99%" in said(page, "scale")
    np.testing.assert_array_equal(shown(page), grey)
    choose(page, "limit", "0")
    assert np.abs(shown(page) - grey).any()
    choose(page, "beyond", False)
    np.testing.assert_array_equal(shown(page), coloured)


def test_scales_of_the_page_of_all_pages_and_by_hand(page: Browser) -> None:
    plain_again(page)
    choose(page, "colour", "strain")
    assert "0% to 5%" in said(page, "scale")
    own = shown(page)
    choose(page, "range", "fixed")
    assert "0% to 10%" in said(page, "scale")
    assert np.abs(shown(page) - own).any()
    choose(page, "range", "hand")
    choose(page, "high", "5")
    np.testing.assert_array_equal(shown(page), own)
    choose(page, "high", "0")
    assert said(page, "wrong") == "The two ends of the scale are the same; change one."
    assert page.run("document.getElementById('high').ariaInvalid") == "true"
    assert "0% to 5%" in said(page, "scale")  # as before the wrong number
    choose(page, "high", "5")
    assert said(page, "wrong") == ""
    np.testing.assert_array_equal(shown(page), own)


def test_the_difference_of_two_rollouts_in_millimetres(page: Browser) -> None:
    """The second is 9 mm off everywhere, so that a limit of 8 mm leaves it coloured and one of 10 mm plain."""
    plain_again(page)
    grey = shown(page)
    half = grey.shape[1] // 2
    choose(page, "colour", "difference")
    assert said(page, "scale").startswith("distance from the first rollout: 0 mm to 10 mm")
    choose(page, "beyond", True)
    choose(page, "limit", "10")
    np.testing.assert_array_equal(shown(page), grey)
    choose(page, "limit", "8")
    changed = np.abs(shown(page) - grey).any(axis=(0, 2))
    assert not changed[:half].any()
    assert changed[half:].any()
    choose(page, "layout", "over")
    assert np.abs(shown(page) - grey).any()


def test_parts_and_the_body_are_hidden(page: Browser) -> None:
    plain_again(page)
    whole = bluish(shown(page)).sum()
    boxes = page.run("[...document.querySelectorAll('#parts [data-part]')].map((box) => box.dataset.part)")
    assert boxes == ["upper", "lower"]
    page.run("document.querySelector('[data-part=upper]').click()")
    assert 0.2 < bluish(shown(page)).sum() / whole < 0.8
    page.run("document.querySelector('[data-part=lower]').click()")
    choose(page, "body", False)
    image = shown(page)
    assert not np.abs(image - image[0, 0]).any()
    page.run("document.querySelectorAll('#parts [data-part]').forEach((box) => box.click())")
    choose(page, "floor", True)
    assert np.abs(shown(page) - image).any()


def test_marks_of_alarms_and_of_the_verdict(page: Browser) -> None:
    marks = page.run("[...document.querySelectorAll('#moments button')].map((one) => [one.className, one.ariaLabel])")
    assert marks == [
        ["alarm", "alarm: strain, frames 4–5, 0.13 s"],
        ["unsound", "unsound: skin depth (run 0), frames 7–8, 0.23 s"],
        ["doubt", "doubt: floor (run 0), frame 9, 0.30 s"],
    ]
    page.run("document.querySelector('#list .unsound').click()")
    assert frame(page) == 7
    assert "skin stands out" in said(page, "list")


#: What is wrong with the page for people who do not see it well or use no mouse.
FINDINGS = """(() => {
  const found = [];
  const shown = (one) => one.checkVisibility();
  const say = (one, what) => found.push(`${one.tagName} ${one.id || one.className}: ${what}`);
  const text = (one) => one?.textContent ?? '';
  for (const one of [...document.querySelectorAll('button, input, select, summary, [role=img]')].filter(shown)) {
    const by = text(document.getElementById(one.getAttribute('aria-labelledby')));
    const name = one.ariaLabel || by || [...(one.labels ?? [])].map(text).join('') || text(one);
    if (!name.trim()) say(one, 'no name');
    const { width, height } = (one.closest('label') ?? one).getBoundingClientRect();
    if (Math.min(width, height) < 24) say(one, `only ${width} x ${height} pixels`);
    if (one.tabIndex > 0) say(one, 'has an order of its own');
  }
  const ids = [...document.querySelectorAll('[id]')].map((one) => one.id);
  if (new Set(ids).size !== ids.length) found.push('an id twice');
  if (!document.documentElement.lang) found.push('no language');
  if (document.querySelectorAll('h1').length !== 1 || !document.querySelector('main')) found.push('no heading or no main part');
  if (/user-scalable|maximum-scale/.test(document.querySelector('meta[name=viewport]').content)) found.push('no zoom');
  const parts = (text) => text.match(/[\\d.]+/g).map(Number);
  const linear = (part) => part <= 0.04045 ? part / 12.92 : ((part + 0.055) / 1.055) ** 2.4;
  const light = (rgb) => [0.2126, 0.7152, 0.0722].reduce((sum, share, at) => sum + share * linear(rgb[at] / 255), 0);
  for (const one of [...document.querySelectorAll('main *')].filter(shown)) {
    const own = [...one.childNodes].some((node) => node.nodeType === 3 && node.textContent.trim());
    if (!own || one.closest(':disabled') || one.closest('noscript')) continue;
    let back = one;
    while (back && (parts(getComputedStyle(back).backgroundColor)[3] ?? 1) < 0.8) back = back.parentElement;
    const ground = one.closest('#stage') ? [229, 230, 232] : parts(getComputedStyle(back ?? document.body).backgroundColor);
    const [high, low] = [light(parts(getComputedStyle(one).color)), light(ground)].sort((a, b) => b - a);
    const contrast = (high + 0.05) / (low + 0.05);
    if (contrast < 4.5) say(one, `contrast ${contrast.toFixed(2)} of ${one.textContent}`);
  }
  return found;
})()"""


def test_everything_has_a_name_a_size_and_contrast(page: Browser) -> None:
    plain_again(page)
    page.run("document.getElementById('told').open = true")
    for colour, layout in (("strain", "beside"), ("fabric", "over")):
        choose(page, "colour", colour)
        choose(page, "layout", layout)
        assert page.run(FINDINGS) == []
    page.run("document.querySelector('#moments button').style.color = '#999'")
    assert [what for what in page.run(FINDINGS) if "contrast" in what]  # the check finds it
    page.run("document.querySelector('#moments button').style.color = ''")


def test_the_inner_side_is_as_bright_as_the_outer_one(tmp_path: Path) -> None:
    with Browser() as browser:
        browser.open(write(tmp_path / "page.html", tube(), tube(flip=True)))
        choose(browser, "colour", "plain")
        image = shown(browser)
        half = image.shape[1] // 2
        assert bluish(image).any()
        assert (np.abs(image[:, :half] - image[:, half : 2 * half]).max(axis=2) > 8).mean() < 0.005


def test_a_narrow_window_and_fingers(tmp_path: Path) -> None:
    """Four rollouts at 360 pixels, two by two: nothing sticks out, a finger moves the chart and turns the view."""
    path = write(tmp_path / "page.html", *[replace(tube(), alarms=[]) for _ in range(4)])
    with Browser(360, 740) as browser:
        browser.call("Emulation.setDeviceMetricsOverride", width=360, height=740, deviceScaleFactor=1, mobile=True)
        browser.call("Emulation.setTouchEmulationEnabled", enabled=True)
        browser.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-reduced-motion", "value": "reduce"}])
        browser.open(path)
        assert browser.run("document.getElementById('loop').checked") is False
        tops = "[...document.querySelectorAll('#names span')].map((one) => one.getBoundingClientRect().top)"
        first, second, third, fourth = browser.run(tops)
        assert first == second < third == fourth
        left, top, width, height = place(browser, "chart")
        drag(browser, (left + 80, top + 0.5 * height), (left + width - 12, top + 0.5 * height))
        assert frame(browser) == FRAMES - 1
        left, top, width, height = place(browser, "canvas")
        drag(browser, (left + 100, top + 100), (left + 160, top + 100))
        assert browser.run("document.querySelector('[data-view=free]').ariaPressed") == "true"
        browser.run("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
        choose(browser, "colour", "difference")
        assert browser.run("document.documentElement.scrollWidth") == 360
        assert browser.run(FINDINGS) == []
        assert browser.complaints == []


def place(browser: Browser, name: str) -> list[float]:
    """Left, top, width and height [pixels]."""
    box = f"document.getElementById('{name}').getBoundingClientRect()"
    found: list[float] = browser.run(f"(() => {{ const it = {box}; return [it.left, it.top, it.width, it.height]; }})()")
    return found


def drag(browser: Browser, start: tuple[float, float], end: tuple[float, float]) -> None:
    """Move a finger."""
    middle = tuple(0.5 * (a + b) for a, b in zip(start, end, strict=True))
    for kind, points in (("touchStart", [start]), ("touchMove", [middle]), ("touchMove", [end]), ("touchEnd", [])):
        browser.call("Input.dispatchTouchEvent", type=kind, touchPoints=[{"x": x, "y": y} for x, y in points])
    browser.run(LATER)


@pytest.mark.parametrize(
    "before, cut, sentence",
    [
        (
            "HTMLCanvasElement.prototype.getContext = () => null;",
            "",
            "this browser offers no WebGL; switch on hardware acceler",
        ),
        ("", "seconds", "its data lack 'seconds'; write it again with hood view."),
        ("", "parts", "its data lack 'rollouts[0].parts'; write it again with hood view."),
    ],
)
def test_what_keeps_a_page_from_being_shown_is_said_in_it(tmp_path: Path, before: str, cut: str, sentence: str) -> None:
    path = write(tmp_path / "page.html", tube())
    path.write_text(path.read_text().replace(f'"{cut}":', '"other":') if cut else path.read_text())
    with Browser() as browser:
        browser.before(before)
        browser.call("Page.navigate", url=path.as_uri())
        browser.run(
            "new Promise((done) => { const look = () => document.body?.dataset.ready === 'failed' ? done() :"
            " setTimeout(look, 50); look(); })"
        )
        assert said(browser, "said").startswith("This page cannot be shown: ")
        assert sentence in said(browser, "said")
