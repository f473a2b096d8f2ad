"""``hood view`` writes one page that holds what the rollout holds and loads nothing from elsewhere."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from hood.cli import main
from hood.dynamics.recorder import RolloutWriter, read_rollout
from hood.media.viewer.packing import STEP, pack_integers, pack_positions, unpack_bytes, unpack_integers, unpack_positions
from hood.testing import cylinder, sphere


def write(path: Path, num_frames: int = 5, lost: int | None = None, name: str = "tube") -> None:
    """A tube that falls about a ball that drifts sideways."""
    rest, faces = cylinder(12, 6)
    ball, ball_faces = sphere(1, 0.1)
    path.parent.mkdir(parents=True, exist_ok=True)
    metrics, attributes = ("strain_p99", "ms_total"), {"garment": name, "sequence": "s"}
    with RolloutWriter(path, num_frames, rest, faces, ball_faces, len(ball), metrics, 1 / 30, attributes) as writer:
        for frame in range(num_frames):
            pos = rest * (1 + 0.1 * frame) - [0, 0.02 * frame**2, 0]
            if frame == lost:
                pos = pos * np.nan
            writer.append(pos, ball + [0.1 * frame, 0, 0], {"strain_p99": 0.1 * frame, "ms_total": 5.0 + frame})


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def content(page: Path) -> dict:
    text = page.read_text(encoding="utf-8")
    found = re.search(r'<script type="application/json" id="content">(.*?)</script>', text, re.DOTALL)
    assert found is not None
    data: dict = json.loads(found[1])
    return data


def test_the_page_holds_the_rollout_within_a_tenth_of_a_millimetre() -> None:
    write(Path("run/rollout.h5"))
    assert main(["view", "run", "output=pages/run.html"]) == 0
    held, rollout = content(Path("pages/run.html")), read_rollout(Path("run/rollout.h5"))
    (shown,) = held["rollouts"]
    for mesh, pos, faces in (("cloth", rollout.cloth_pos, rollout.cloth_faces), ("body", rollout.body_pos, rollout.body_faces)):
        assert np.abs(unpack_positions(shown[mesh]) - pos).max() <= 1e-4
        assert np.array_equal(unpack_integers(shown[mesh]["faces"]).reshape(-1, 3), faces)
    assert held["seconds"] == pytest.approx(1 / 30)
    assert len(unpack_bytes(shown["strain"])) == rollout.cloth_pos[..., 0].size


def test_nothing_is_loaded_from_elsewhere_and_a_name_cannot_run_code() -> None:
    write(Path("</script><script>alert(1)/rollout.h5"))
    assert main(["view", "</script><script>alert(1)", "output=page.html", "title='<b>x'"]) == 0
    text = Path("page.html").read_text(encoding="utf-8")
    outside = re.sub(r'<script type="importmap">.*?</script>', "", text, flags=re.DOTALL)
    assert not re.search(r"""(?:src|href)\s*=\s*["']?(?:https?:)?//""", outside)
    assert "default-src 'none'" in text
    assert "<script>alert" not in text
    assert "<b>" not in text


def test_several_rollouts_share_a_page() -> None:
    write(Path("a/rollout.h5"))
    write(Path("b/rollout.h5"), num_frames=3)
    assert main(["view", "a", "b/rollout.h5", "output=page.html"]) == 0
    assert [one["name"] for one in content(Path("page.html"))["rollouts"]] == ["a", "b"]
    assert main(["view", "a", "output=page.html", "num_frames=2"]) == 0
    (shown,) = content(Path("page.html"))["rollouts"]
    assert shown["cloth"]["frames"] == 2


def test_frames_that_are_not_finite_are_named() -> None:
    write(Path("run/rollout.h5"), lost=3)
    assert main(["view", "run", "output=page.html"]) == 0
    (shown,) = content(Path("page.html"))["rollouts"]
    assert shown["lost"] == [3]
    assert np.isfinite(unpack_positions(shown["cloth"])).all()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["nowhere"], "no such file"),
        (["run", "output=page.png"], ".html"),
        (["run", "num_frames=0"], "at least 1"),
        (["run", "titel=x"], "title"),
        ([], "0 rollouts"),
        (["run"] * 5, "5 rollouts"),
        (["broken.h5"], "broken.h5"),
    ],
)
def test_what_cannot_be_shown_is_told_and_leaves_nothing(
    words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    write(Path("run/rollout.h5"))
    Path("broken.h5").write_bytes(b"no rollout")
    before = sorted(Path().rglob("*"))
    assert main(["view", *words]) == 2
    assert said in capsys.readouterr().err
    assert sorted(Path().rglob("*")) == before


def test_any_positions_come_back_within_half_a_step() -> None:
    rng = np.random.default_rng(0)
    pos = rng.normal(size=(7, 11, 3)) * 10.0 ** rng.uniform(-4, 3, size=(7, 1, 1))
    packed, lost = pack_positions(pos)
    assert lost == []
    assert np.abs(unpack_positions(packed) - pos).max() <= 0.5 * STEP * (1 + 1e-9)
    values = rng.integers(-(2**31), 2**31, size=100)
    assert np.array_equal(unpack_integers(pack_integers(values)), values)
