"""The stability map in words: ranges, and the section of a document that is written anew."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from hood.studies.envelope.judge import DEGRADED, REFUSED, SILENT, SOUND
from hood.studies.envelope.page import BEGIN, END, holds, map_section, write_section


def rows(factor: str, kinds: dict[str, str], model: str = "newton", garment: str = "dress") -> list[dict[str, Any]]:
    return [
        {"factor": factor, "value": value, "garment": garment, "model": model, "class": kind, "weights": "none"}
        | {"reasons": "" if kind == SOUND else f"too far at {value}"}
        for value, kind in kinds.items()
    ]


@pytest.mark.parametrize(
    ("kinds", "words"),
    [
        ({"1": SOUND, "2": SOUND, "4": SOUND}, "all 3: 1 to 4"),
        ({"1": SOUND, "2": SOUND, "4": SILENT}, "2 of 3: 1 to 2"),
        ({"1": SOUND, "2": SILENT, "4": SOUND}, "2 of 3: 1, 4"),
        ({"1": DEGRADED, "2": SILENT}, "none of 2"),
        ({"1": REFUSED}, ""),
    ],
)
def test_where_an_ordered_factor_holds(kinds: dict[str, str], words: str) -> None:
    assert holds(rows("spin", kinds)) == words


def test_other_factors_are_counted_and_a_setting_holds_for_all_garments() -> None:
    assert holds(rows("pose", {"crouch": SOUND, "split": SILENT})) == "1 of 2"
    assert holds(rows("pose", {"crouch": SOUND, "split": SOUND})) == "all 2"
    both = rows("spin", {"1": SOUND, "2": SOUND}) + rows("spin", {"1": SOUND, "2": SILENT}, garment="tank")
    assert holds(both) == "1 of 2: 1"


def test_the_section_replaces_what_was_between_the_marks(tmp_path: Path) -> None:
    path, found = tmp_path / "page.md", rows("spin", {"1": SOUND, "2": SILENT}) + rows("input", {"fps=0": REFUSED})
    found += [row | {"model": "ours", "weights": "ab" * 32} for row in rows("spin", {"1": SOUND, "2": SOUND})]
    path.write_text(f"# Page\n\n{BEGIN}\noutdated\n{END}\n\n## After\n")
    for _ in range(2):
        write_section(path, found, ["newton", "ours"])
        text = path.read_text()
        assert text.startswith(
            f"# Page\n\n{BEGIN}\n3 cells, 5 judged rollouts. SHA-256 of the weights begin with: ours abababababab."
        )
        assert text.endswith(f"{END}\n\n## After\n")
        assert "outdated" not in text
    assert "| newton | 2 | 50.0% | 0.0% | 0.0% | 50.0% | 1 |" in text
    assert "| spin | 1 of 2: 1 | all 2: 1 to 2 |" in text
    assert "- **spin 2 (dress)** newton: silent, too far at 2" in text
    assert "input" not in text.replace("bad input", "")


def test_methods_that_fail_in_the_nominal_scene_are_counted_alone() -> None:
    good, bad = ({"model": model, "weights": "none"} for model in ("newton", "ours"))
    found = [row | good for row in rows("nominal", {"all": SOUND}) + rows("spin", {"1": SOUND, "2": SILENT})]
    found += [row | bad for row in rows("nominal", {"all": DEGRADED}) + rows("spin", {"1": SOUND, "2": DEGRADED})]
    text = map_section(sorted(found, key=lambda row: (row["factor"], row["value"])), ["newton", "ours"])
    assert "- **spin 2 (dress)** newton: silent, too far at 2\n" in text
    assert text.endswith(
        "- **ours** is not sound in the nominal scene: degraded and said, too far at all. The page has its 2 settings"
    )
    assert text.count("ours:") == 0


def test_a_map_without_a_fault_says_so_and_marks_are_needed(tmp_path: Path) -> None:
    assert "Every setting is sound for every method." in map_section(rows("spin", {"1": SOUND}), ["newton"])
    path = tmp_path / "page.md"
    with pytest.raises(ValueError, match="no such file"):
        write_section(path, [], [])
    path.write_text(f"{END}\n{BEGIN}\n")
    with pytest.raises(ValueError, match="into it once, where the section is to stand"):
        write_section(path, [], [])
    assert path.read_text() == f"{END}\n{BEGIN}\n"
