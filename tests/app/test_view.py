"""``hood view``: the page holds the rollouts, loads nothing, and what cannot be shown is refused in a sentence."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from hood.cli.main import main
from hood.media.colouring import Colouring
from hood.media.viewer.page import _codes, _levels, unpack_bytes, unpack_integers, unpack_positions
from hood.rollouts.file.reader import read_rollout
from hood.rollouts.file.recorder import RolloutWriter
from hood.testing import cylinder, sphere


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def record(path: str, frames: int = 4, dt: float = 1 / 30, shift: float = 0.0, garment: str = "tube") -> str:
    """A rollout of a tube that widens about a ball, on disk."""
    file = Path(path)
    file.parent.mkdir(parents=True, exist_ok=True)
    pos, faces = cylinder(12, 3, 0.3, 0.5)
    ball, ball_faces = sphere(1, 0.25)
    names = ("strain_p99", "ms_total")
    with RolloutWriter(file, frames, pos, faces, ball_faces, len(ball), names, dt, {"garment": garment}) as out:
        for index in range(frames):
            measured = {"strain_p99": 0.1 * index} | ({"ms_total": 40.0} if index else {})
            out.append(pos * (1.0 + 0.1 * index), ball + [0.0, shift, 0.0], measured, {})
    return path


def content(page: str) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="content">(.*?)</script>', page, re.DOTALL)
    assert found is not None
    return json.loads(found[1])


def refused(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    assert main(["view", *words]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    return said


def test_the_page_holds_the_rollout() -> None:
    path = record("run/rollout.h5")
    assert main(["view", "run", "output=made/page.html"]) == 0
    assert [file.name for file in Path("made").iterdir()] == ["page.html"]
    held, data = content(Path("made/page.html").read_text()), read_rollout(Path(path))
    only = held["rollouts"][0]
    for packed, pos, faces in (
        (only["cloth"], data.cloth_pos, data.cloth_faces),
        (only["body"], data.body_pos, data.body_faces),
    ):
        assert np.abs(unpack_positions(packed) - pos).max() <= 1e-4
        assert unpack_integers(packed["faces"]).reshape(-1, 3).tolist() == faces.tolist()
    strain, contact = held["scales"]
    assert (strain["name"], strain["low"], strain["high"], contact["name"]) == ("strain", 0.0, 0.5, "contact")
    shown = np.array(strain["levels"])[np.frombuffer(unpack_bytes(only["values"]["strain"]), np.uint8).reshape(4, -1)]
    assert np.allclose(shown, 0.1 * np.arange(4)[:, None], atol=0.002)
    assert len(held["ramp"]) == 256
    assert only["figures"][0] == {"name": "strain_p99", "title": "strain p99", "values": [0.0, 0.1, 0.2, 0.3]}
    assert only["figures"][1]["values"] == [None, 40.0, 40.0, 40.0]
    assert held["seconds"] == pytest.approx(1 / 30)


def test_values_beyond_the_scale_keep_their_order_and_size() -> None:
    """A strain of 300% at one vertex in 500 does not stretch the scale of 20%, and is told from one of 60%."""
    values = np.full((10, 500), 0.15)
    values[3, 7], values[4, 7] = 3.0, 0.6
    colouring = Colouring(values, 0.0, 0.2, False, "strain", ((0.0, "0%"), (0.2, "20%")))
    levels = _levels([colouring, replace(colouring, values=values / 2)])
    held = 0.2 * levels[_codes(colouring, levels)]
    assert (len(levels), levels.min()) == (255, 0.0)
    assert (np.diff(levels) > 0).all()
    assert np.allclose(held, values, rtol=0.06, atol=0.001)
    assert held[3, 7] == pytest.approx(3.0)


def test_distances_before_a_falling_scale_and_values_that_are_missing() -> None:
    """20 mm are the start of the scale; up to 50 mm are held, within a millimetre near the scale."""
    values = np.array([[0.5, 0.021, 0.01, 0.0, np.nan]])
    colouring = Colouring(values, 0.02, 0.0, False, "distance from the body", ((0.02, "20 mm"), (0.0, "0 mm")))
    codes = _codes(colouring, levels := _levels([colouring]))
    held = 0.02 - 0.02 * levels[codes[0, :4]]
    assert np.allclose(held, [0.05, 0.021, 0.01, 0.0], atol=1e-3)
    assert np.allclose(held[2:], values[0, 2:4], atol=5e-5)
    assert codes[0, 4] == 255


def test_forces_far_from_a_logarithmic_scale_are_held_at_its_ends() -> None:
    values = np.array([[0.0, 1e-2, 1.0, 1e30]])
    colouring = Colouring(values, 1e-4, 1.0, True, "force", ((1e-4, "0.0001"), (1.0, "1")))
    levels = _levels([colouring])
    found = 1e-4 * 1e4 ** levels[_codes(colouring, levels)]
    assert np.allclose(found, [[1e-8, 1e-2, 1.0, 1e12]], rtol=0.05)


def test_frames_that_the_verdict_names_are_marked() -> None:
    path = record("run/rollout.h5", frames=8)
    with h5py.File(path, "r+") as file:
        file["cloth/pos"][2:4, 5] = np.nan
    assert main(["view", "run", "output=page.html"]) == 0
    marks = content(Path("page.html").read_text())["moments"]
    found = [(mark["frame"], mark["last"]) for mark in marks if (mark["kind"], mark["words"]) == ("unsound", "not finite")]
    assert found == [(2, 3)]


def test_the_page_loads_nothing_and_names_cannot_break_it() -> None:
    record("run/rollout.h5")
    assert main(["view", "run", "output=page.html", "title='a </script><b> & --> @@STYLE@@'"]) == 0
    page = Path("page.html").read_text()
    assert not re.search(r"""(src|href|from|import|url)\s*[=(]?\s*["']?\s*(https?:)?//\w""", page)
    assert "default-src 'none'" in page
    assert "a &lt;/script&gt;&lt;b&gt; &amp; --&gt; @@STYLE@@</title>" in page
    assert page.count("</script>") == 3
    imports = json.loads(re.search(r'<script type="importmap">(.*?)</script>', page)[1])["imports"]  # type: ignore[index]
    assert all(address.startswith("data:text/javascript;base64,") for address in imports.values())
    assert "Permission is hereby granted" in page


def test_two_rollouts_share_a_body_that_is_the_same() -> None:
    record("a/rollout.h5")
    record("same/rollout.h5", frames=3)
    record("b/rollout.h5")
    record("moved/rollout.h5", shift=0.1)
    assert main(["view", "a", "b", "moved", "same", "output=page.html"]) == 0
    held = content(Path("page.html").read_text())["rollouts"]
    assert [one["name"] for one in held] == ["a", "b", "moved", "same"]
    assert [one["body"] is None for one in held] == [False, True, False, False]
    assert held[3]["cloth"]["frames"] == 3


def test_the_first_frames_alone() -> None:
    record("run/rollout.h5")
    assert main(["view", "run", "num_frames=2", "output=page.html"]) == 0
    only = content(Path("page.html").read_text())["rollouts"][0]
    assert (only["cloth"]["frames"], only["body"]["frames"], len(only["figures"][0]["values"])) == (2, 2, 2)


def test_a_heavy_page_says_how_to_lighten_it(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    record("run/rollout.h5")
    assert main(["view", "run", "output=page.html"]) == 0
    assert capsys.readouterr().out.count("\n") == 1
    monkeypatch.setattr("hood.cli.export._HEAVY", Path("page.html").stat().st_size - 1)
    assert main(["view", "run", "output=page.html"]) == 0
    assert "of up to 42 vertices a mesh: num_frames=3 keeps it below" in capsys.readouterr().out


def test_cloth_that_blew_up_is_named_by_its_frames() -> None:
    path = record("run/rollout.h5")
    with h5py.File(path, "r+") as file:
        file["cloth/pos"][2, 5] = np.nan
    assert main(["view", "run", "output=page.html"]) == 0
    assert content(Path("page.html").read_text())["rollouts"][0]["lost"] == [2]


def test_what_cannot_be_shown_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    record("a/rollout.h5")
    record("slow/rollout.h5", dt=1 / 15)
    Path("text.h5").write_text("no rollout")
    assert "number of rollouts given: 0; give one to 4" in refused(capsys)
    assert "number of rollouts given: 5; give one to 4" in refused(capsys, *5 * ["a"])
    assert "no such file" in refused(capsys, "missing.h5")
    assert "not a rollout file" in refused(capsys, "text.h5")
    assert "unknown option '--fast'" in refused(capsys, "a", "--fast")
    assert "num_frames=0" in refused(capsys, "a", "num_frames=0")
    assert "ends in .html" in refused(capsys, "a", "output=page.txt")
    assert "show rollouts of one frame rate together" in refused(capsys, "a", "slow")
    assert sorted(path.name for path in Path().iterdir()) == ["a", "slow", "text.h5"]
