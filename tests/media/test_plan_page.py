"""The page of a plan: one valid file that loads nothing, with answers made of the plan's own numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from hood.media.plan_page import Difference, write_page
from hood.testing import cylinder, sphere

ROWS = [
    {"part": "bending", "purpose": "folds", "words": [], "force": 0.1, "gamma_p95": 0.002, "mm": 3.0, "ms": 8.0, "saved": 0.2,
     "decision": "left out", "reason": "without it <γ> = 0.002 more", "command": "hood plan 'parts=[bending]'"},
    {"part": "friction", "purpose": "hangs", "words": [], "force": 2.0, "gamma_p95": 0.3, "mm": 9.0, "ms": 9.0, "saved": 0.1,
     "decision": "kept", "reason": "without it γ = 0.3 more", "command": "hood plan 'parts=[friction]'"},
    {"part": "gravity", "purpose": "weight", "words": [], "force": 1.0, "decision": "absent", "reason": "none", "command": "x"},
]  # fmt: skip
FACTS = {"vertices": 995, "edge_mm": 36.0, "influence_edges": 40.0, "levels": None, "finer": ["dress_4k", "dress_12k"]}


def plan(**facts: Any) -> dict[str, Any]:
    windows = [{"first": 0, "measured_from": 2, "reason": "the start"}]
    return {"rows": ROWS, "full": {"ms": 10.0}, "frames": 3, "windows": windows, "facts": FACTS | facts}


def written(tmp_path: Path, given: dict[str, Any], shown: list[Difference]) -> str:
    write_page(tmp_path / "plan.html", given, "Left out: bending.", shown)
    text = (tmp_path / "plan.html").read_text(encoding="utf-8")
    ElementTree.fromstring(text.partition("\n")[2])
    assert "http" not in text
    return text


def test_every_question_has_an_answer_of_the_plan(tmp_path: Path) -> None:
    text = written(tmp_path, plan(), [])
    assert "It is left out: without it &lt;γ&gt; = 0.002 more. Without it 2.0 ms of the 10.0 ms" in text
    assert "no cloth contact" in text
    assert "wider than 144 mm" in text
    assert "dress_4k or dress_12k" in text
    assert "felt 40 edges away" in text
    assert "friction costs most, 10% of a frame" in text
    assert "hood plan &#x27;parts=[bending]&#x27;" in text


def test_a_network_has_levels_and_the_finest_mesh_no_finer_one(tmp_path: Path) -> None:
    text = written(tmp_path, plan(levels=2, finer=[]), [])
    assert "2 coarse level(s)" in text
    assert "hood prepare can refine" in text


@pytest.mark.parametrize("with_body", [True, False])
def test_differences_are_pictures_in_the_page(tmp_path: Path, with_body: bool) -> None:
    pytest.importorskip("PIL")
    pos, faces = cylinder(12, 4, 0.3, 0.4)
    body, body_faces = sphere(1) if with_body else (np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    one = Difference("bending", 5, 3.14, pos, pos + [0.0, 0.1, 0.0], faces, 0.2 * body, body_faces)
    text = written(tmp_path, plan(), [one])
    assert text.count("data:image/png;base64,") == 1
    assert "Without bending: frame 5, 3.1 mm" in text
