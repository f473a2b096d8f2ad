"""The page of a plan: one valid file that loads nothing, with answers made of the plan's own numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from hood.studies.plan.page import Difference, write_plan_page
from hood.testing import cylinder, sphere

ROWS = [
    {"part": "bending", "purpose": "folds", "words": [], "force": 0.1, "gamma_p95": 0.002, "mm": 3.0, "ms": 8.0, "saved": 0.2,
     "decision": "left out", "reason": "without it <γ> = 0.002 more", "command": "hood plan 'parts=[bending]'"},
    {"part": "friction", "purpose": "hangs", "words": [], "force": 2.0, "gamma_p95": 0.3, "mm": 9.0, "ms": 9.0, "saved": 0.1,
     "decision": "kept", "reason": "without it γ = 0.3 more", "command": "hood plan 'parts=[friction]'"},
    {"part": "gravity", "purpose": "weight", "words": [], "force": 1.0, "decision": "absent", "reason": "none", "command": "x"},
]  # fmt: skip
MESH = {"part": "mesh dress", "kind": "mesh", "purpose": "fewer", "words": [], "force": None, "mm_p50": 5.0, "mm": 15.0,
        "ms": 2.0, "saved": 0.8, "decision": "taken", "reason": "15 mm", "command": "y"}  # fmt: skip
FPS = MESH | {"part": "60 fps", "kind": "time step", "mm": 2.7, "saved": -0.9, "decision": "compared"}
MODELS = [{"name": "short", "radius": 8, "levels": 0, "suffices": False},
          {"name": "long", "radius": 48, "levels": 2, "suffices": True}]  # fmt: skip
FACTS = {"vertices": 995, "edge_mm": 36.0, "influence_edges": 40.0, "diameter_edges": 32, "needed_edges": 32.0,
         "wave_speed": 15.0, "models": MODELS, "network": None, "levels": None, "finer": ["dress_4k", "dress_12k"],
         "no_cloth_contact": None}  # fmt: skip


def plan(*rows: dict[str, Any], **facts: Any) -> dict[str, Any]:
    windows = [{"first": 0, "measured_from": 2, "reason": "the start"}]
    told = {"times": {"solver": 6.0, "search": 2.5}, "command": "hood rollout garment=dress", "windows": windows}
    return {"rows": [*ROWS, *rows], "full": {"ms": 10.0}, "frames": 3, "facts": FACTS | facts} | told


def written(tmp_path: Path, given: dict[str, Any], shown: list[Difference]) -> str:
    write_plan_page(tmp_path / "plan.html", given, "Left out: bending.", shown)
    text = (tmp_path / "plan.html").read_text(encoding="utf-8")
    ElementTree.fromstring(text.partition("\n")[2])
    assert "http" not in text
    return text


def test_every_question_has_an_answer_of_the_plan(tmp_path: Path) -> None:
    text = written(tmp_path, plan(), [])
    assert "It is left out: without it &lt;γ&gt; = 0.002 more. Without it 2.0 ms of the 10.0 ms" in text
    assert "no cloth contact" in text
    assert "wider than 144 mm" in text
    assert "from dress_4k or dress_12k says hood plan … parts=[mesh dress_4k]" in text
    assert "felt 40 edges away" in text
    assert "made of solver 6.0 ms, search 2.5 ms." in text
    assert "In words: hood rollout garment=dress" in text
    assert "friction costs most, 10% of a frame" in text
    assert "hood plan &#x27;parts=[bending]&#x27;" in text


def test_a_network_has_levels_and_the_finest_mesh_no_finer_one(tmp_path: Path) -> None:
    text = written(tmp_path, plan(levels=2, finer=[], network="short"), [])
    assert "messages have to pass 32 edges in a step" in text
    assert "reach so far: long (48)" in text
    assert "2 coarse level(s) and passes 8, what is farther off waits" in text
    assert "hood prepare can refine" in text
    assert "passes 48, enough" in written(tmp_path, plan(levels=2, network="long"), [])


def test_meshes_and_time_steps_answer_in_mm(tmp_path: Path) -> None:
    text = written(tmp_path, plan(MESH, FPS, finer=[]), [])
    assert "dress: 5 mm from this one in the median and 15 mm at the 95th percentile" in text
    assert "for 80% less time; taken" in text
    assert "60 fps: 5 mm from this one in the median and 2.7 mm" in text
    assert "for 1.9 times the time; compared" in text
    assert "hood prepare" not in text


def test_contact_that_is_off_has_its_reason(tmp_path: Path) -> None:
    assert "It is off: a network &lt;alone&gt;." in written(tmp_path, plan(no_cloth_contact="a network <alone>"), [])


@pytest.mark.parametrize("with_body", [True, False])
def test_differences_are_pictures_in_the_page(tmp_path: Path, with_body: bool) -> None:
    pytest.importorskip("PIL")
    pos, faces = cylinder(12, 4, 0.3, 0.4)
    body, body_faces = sphere(1) if with_body else (np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    one = Difference("bending", 5, 3.14, pos, pos + [0.0, 0.1, 0.0], faces, 0.2 * body, body_faces)
    text = written(tmp_path, plan(), [one])
    assert text.count("data:image/png;base64,") == 1
    assert "Without bending: frame 5, 3.1 mm" in text
