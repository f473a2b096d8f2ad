"""The verdict of the command agrees with what a person saw: twenty scenes fast, the whole table slow."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.verdict.table.scene import run
from tests.verdict.table.scenes import FAST, LABELS, SCENES

#: Share of the table on which rule and person have to agree.
AGREEMENT = 0.97


def agrees(name: str, summary: dict[str, Any], code: int) -> bool:
    """Whether the command says what the label does. Where the input alone is wrong, a doubt of its kind says so; what is broken
    may also be refused."""
    label = LABELS[name]
    if code == 2:
        return bool(label["label"] == "broken")
    if label["label"] == "right":
        return summary["sound"] is True
    told = {doubt["kind"] for doubt in summary["doubts"]}
    return summary["sound"] is False or (label["cause"] == "input" and bool(told & set(label["doubts"])))


def untold(name: str, summary: dict[str, Any], code: int) -> set[str]:
    """Doubts that a person has and the command does not tell."""
    return set() if code == 2 else set(LABELS[name]["doubts"]) - {doubt["kind"] for doubt in summary["doubts"]}


@pytest.mark.parametrize("name", FAST)
def test_the_verdict_is_that_of_a_person(name: str, tmp_path: Path, compiled_layers: None) -> None:
    summary, code = run(SCENES[name], tmp_path)
    assert agrees(name, summary, code), (LABELS[name]["why"], summary["unsound_reasons"], summary["notes"])
    assert not untold(name, summary, code)
    assert code == (0 if summary["sound"] else 3)


@pytest.mark.slow
def test_the_whole_table(tmp_path: Path, compiled_layers: None) -> None:
    """Half an hour. No scene that is clearly broken is called sound without a doubt."""
    found = {name: run(scene, tmp_path / name) for name, scene in SCENES.items()}
    wrong = [name for name, (summary, code) in found.items() if not agrees(name, summary, code)]
    silent = [name for name in wrong if (LABELS[name]["label"], LABELS[name]["margin"]) == ("broken", "clear")]
    assert silent == []
    assert len(wrong) <= (1.0 - AGREEMENT) * len(found), wrong
    assert {name: kinds for name, (summary, code) in found.items() if (kinds := untold(name, summary, code))} == {}
