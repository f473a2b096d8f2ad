"""The verdict of the command agrees with what a person saw: twenty scenes fast, both tables slow."""

from __future__ import annotations

import os
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.verdict.table.scene import run
from tests.verdict.table.scenes import FAST, LABELS, SCENES, SECOND, SECOND_LABELS, run_named

#: Share of the scenes on which rule and person have to agree, and of the doubts of a person that have to be told.
AGREEMENT, TOLD = 0.97, 0.8


def agrees(label: dict[str, Any], summary: dict[str, Any], code: int) -> bool:
    """Whether the command says what the label does. Where the input alone is wrong, a doubt of its kind says so; what is broken
    may also be refused."""
    if code == 2:
        return bool(label["label"] == "broken")
    if label["label"] == "right":
        return summary["sound"] is True
    told = {doubt["kind"] for doubt in summary["doubts"]}
    return summary["sound"] is False or (label["cause"] == "input" and bool(told & set(label["doubts"])))


def untold(label: dict[str, Any], summary: dict[str, Any], code: int) -> set[str]:
    """Doubts that a person has and the command does not tell."""
    return set() if code == 2 else set(label["doubts"]) - {doubt["kind"] for doubt in summary["doubts"]}


@pytest.mark.parametrize("name", FAST)
def test_the_verdict_is_that_of_a_person(name: str, tmp_path: Path, compiled_layers: None) -> None:
    summary, code = run(SCENES[name], tmp_path)
    assert agrees(LABELS[name], summary, code), (LABELS[name]["why"], summary["unsound_reasons"], summary["notes"])
    assert not untold(LABELS[name], summary, code)
    assert code == (0 if summary["sound"] else 3)


@pytest.mark.slow
def test_both_tables(tmp_path: Path, compiled_layers: None) -> None:
    """An hour of a core. No scene that is clearly broken is called sound without a doubt."""
    labels, names = {**LABELS, **SECOND_LABELS}, [*SCENES, *SECOND]
    with ProcessPoolExecutor(os.cpu_count(), get_context("spawn"), torch.set_num_threads, (1,)) as pool:
        found = dict(zip(names, pool.map(run_named, names, [tmp_path / name for name in names]), strict=True))
    wrong = {name: labels[name] for name, one in found.items() if not agrees(labels[name], *one)}
    assert [name for name, label in wrong.items() if (label["label"], label["margin"]) == ("broken", "clear")] == []
    assert len(wrong) <= (1.0 - AGREEMENT) * len(found), sorted(wrong)
    missing = {name: kinds for name, one in found.items() if (kinds := untold(labels[name], *one))}
    asked = sum(len(labels[name]["doubts"]) for name, (_, code) in found.items() if code != 2)
    assert sum(map(len, missing.values())) <= (1.0 - TOLD) * asked, missing
