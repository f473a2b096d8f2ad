"""The page: one well-formed file that holds everything and says what it cannot show."""

from __future__ import annotations

import collections
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
from measured_points import point, reached, solver

from hood.studies.tradeoff import page as tradeoff_page
from hood.studies.tradeoff.comparison import Study
from hood.studies.tradeoff.page import write_tradeoff_page
from hood.studies.tradeoff.results import overstretched

CURVE = {k: (10.0 * k, 1.0 / k**2) for k in (1, 2, 5, 10)}


@pytest.fixture(scope="module")
def study() -> Study:
    items = [
        *(reached("a<b", k, 200.0 + 10 * k, 0.04 / (k + 1), strain=0.3 if k else 0.1) for k in (0, 2)),
        *solver(CURVE),
        *(reached("a<b", k, 10.0 + 5 * k, 0.04 / (k + 1), size="4k", vertices=4000) for k in (0, 2)),
        *solver(CURVE, size="4k", vertices=4000),
    ]
    left_out = [(point("lost", 5), "exit code 1: hood: error: no luck", "points/lost/log.txt")]
    return Study(items, overstretched(items), left_out, ["fine48"])


@pytest.fixture(scope="module")
def page(study: Study, tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("page")
    path = write_tradeoff_page(study, folder)
    names = sorted(item.name for item in folder.iterdir())
    assert names == ["cost_1k.png", "cost_4k.png", "front_1k.png", "front_4k.png", "index.html"]
    return path.read_text(encoding="utf-8")


def words(page: str) -> str:
    return "".join(ElementTree.fromstring(page.removeprefix("<!DOCTYPE html>\n")).itertext())


def test_it_is_well_formed_and_loads_nothing(page: str) -> None:
    root = ElementTree.fromstring(page.removeprefix("<!DOCTYPE html>\n"))
    tags = [element.tag.rpartition("}")[2] for element in root.iter()]
    assert tags.count("svg") == 4
    assert not {"script", "link", "img", "iframe", "object"} & set(tags)
    assert not re.search(r'(src|href)="(?!#)', page)
    assert "@import" not in page
    ids = [element.get("id") for element in root.iter() if element.get("id")]
    assert len(ids) == len(set(ids))


def test_every_point_stands_beside_its_command(study: Study, page: str) -> None:
    text = words(page)
    for item in study.reached:
        assert item.point.command in text
        assert item.label in text
    assert study.left_out[0][0].command in text


def test_it_says_what_matters(study: Study, page: str) -> None:
    text = words(page)
    assert study.sentence in text
    assert "vertices on this CPU (made up) the solver alone is the better choice" in study.sentence
    assert "γ (gamma) says how close" in text
    assert "below the chart's floor of 0.0001" in text
    assert "solver alone, converged (1.0e-07)" in text
    assert "no luck" in text
    assert "points/lost/log.txt" in text
    assert "fine48" in text
    assert "1.5 to 1.5 busy processes" in text
    assert "Of 448 states" in text


def test_it_says_whether_refinement_made_rollouts_worse(page: str) -> None:
    text = words(page)
    assert "a<b + 2, fp32210.00%30.00%10.00%8 of 80.0000%0.0000%0 of 80.000.00worse" in text  # 1,000 vertices: more strain
    assert "a<b + 2, fp32210.00%10.00%10.00%0 of 80.0000%0.0000%0 of 80.000.00no worse" in text  # 4,000


def test_verdicts_are_given_where_intervals_separate(page: str) -> None:
    text = words(page)
    assert "solver faster" in text
    assert "network faster" in text
    assert "overstretches the cloth" in text
    assert "refined more accurate" in text


def test_without_the_converged_solver_nothing_is_called_too_much(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tradeoff_page, "_pictures", lambda study, folder: collections.defaultdict(str))
    items = [reached("net", 0, 10.0, 0.1, strain=5.0), reached("guess", 2, 10.0, 0.1)]
    text = words(write_tradeoff_page(Study(items, overstretched(items)), tmp_path).read_text(encoding="utf-8"))
    assert "The converged solver was not measured at this size" in text
    assert "Nothing: every point of the grid gave a result." in text
