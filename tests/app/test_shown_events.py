"""Events in the page of ``hood view``, and frames around them in exports."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from test_events import elsewhere, rollout  # noqa: F401  the folder with the flag
from test_export import _glb
from test_view import content

from hood.cli.main import main
from hood.rollouts.file.reader import RolloutData

EVENTS = "events=[{frame: 4, open: seam}, {time: 0.3, close: seam}, {frame: 6, detach: pins}]"


@pytest.fixture
def data(elsewhere: None) -> RolloutData:  # noqa: F811
    """Twelve frames in which a row opens and closes and the pins let go."""
    return rollout("num_frames=12", EVENTS)[0]


def test_the_page_holds_what_happens_and_when(data: RolloutData) -> None:
    assert main(["view", "run", "output=page.html"]) == 0
    moments = content(Path("page.html").read_text())["moments"]
    assert [(one["frame"], one["words"]) for one in moments] == [(4, "open seam"), (6, "detach pins"), (9, "close seam")]
    assert main(["view", "run", "num_frames=7", "output=page.html"]) == 0
    assert [one["frame"] for one in content(Path("page.html").read_text())["moments"]] == [4]


def test_exported_frames_around_events_are_those_of_the_rollout(data: RolloutData) -> None:
    assert np.abs(np.diff(data.cloth_pos, axis=0)).max() > 1e-2  # what was let go falls
    for form in ("glb", "obj"):
        assert main(["export", "run", f"format={form}"]) == 0
    document, arrays = _glb(Path("run/rollout.glb"))
    primitive = document["meshes"][0]["primitives"][0]
    base = arrays[primitive["attributes"]["POSITION"]]
    for frame, pos in enumerate(data.cloth_pos):
        moved = base if frame == 0 else base + arrays[primitive["targets"][frame - 1]["POSITION"]]
        assert np.abs(moved - pos).max() <= 1e-6
        mesh = trimesh.load(f"run/rollout_obj/flag_{frame + 1:04d}.obj", process=False, maintain_order=True)
        assert np.abs(mesh.vertices - pos).max() <= 1e-6


def test_usd_frames_around_events_are_those_of_the_rollout(data: RolloutData) -> None:
    pytest.importorskip("pxr", reason="usd-core has no wheel for this machine")
    from pxr import Usd, UsdGeom

    assert main(["export", "run", "format=usd"]) == 0
    stage = Usd.Stage.Open("run/rollout.usd")
    points = UsdGeom.Mesh(stage.GetPrimAtPath("/rollout/flag")).GetPointsAttr()
    for frame, pos in enumerate(data.cloth_pos):
        assert np.array_equal(np.array(points.Get(frame)), pos.astype(np.float32))
