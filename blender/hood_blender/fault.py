"""What went wrong, in one sentence, with the parts of a mesh that it names."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any


class BakeError(Exception):
    """A bake cannot go on. The sentence names object, index and fix; the attributes say what of it to select."""

    def __init__(self, sentence: str, garment: str = "", vertices: Sequence[int] = (), faces: Sequence[int] = ()) -> None:
        super().__init__(sentence)
        self.garment, self.vertices, self.faces = garment, list(vertices), list(faces)


@dataclass
class Fault:
    """One row of the panel's list: ``vertices`` and ``faces`` are numbers of the garment's exported mesh."""

    text: str
    garment: str = ""
    frame: int | None = None  # of the simulation, from 0
    vertices: list[int] = field(default_factory=list)
    faces: list[int] = field(default_factory=list)
    repair: str = ""  # a key of REPAIRS


#: What the panel offers: the label of the button, and the words that the next bake adds to the command of hood.
REPAIRS: dict[str, tuple[str, tuple[str, ...]]] = {
    "settle": ("Start from relaxing steps", ("settle=3",)),
    "finer": ("Solve further and check every frame", ("solver.target_rg=0.003", "guard=repair")),
    "sew": ("Sew rims up to 5 mm apart", ()),
    "smaller": ("5% smaller", ("size=0.95",)),
    "larger": ("5% larger", ("size=1.05",)),
}
_REPAIR_OF = {
    "not_worn": "smaller",
    "strain": "larger",
    "distance": "finer",
    "solver_target": "finer",
    "gradient": "finer",
    "skin_through_cloth": "finer",
    "skin_depth": "finer",
    "inside_body": "settle",
    "cloth_through_cloth": "settle",
    "garments_through_each_other": "settle",
}
_LISTS = {
    "vertices": re.compile(r"\b(?:vertex|vertices) ((?:\d+)(?:(?:, | and )\d+)*)"),
    "faces": re.compile(r"\b(?:face|faces|triangle|triangles) ((?:\d+)(?:(?:, | and )\d+)*)"),
}


def numbers_in(sentence: str) -> dict[str, list[int]]:
    """Numbers of vertices and faces that a sentence of hood names."""
    found: dict[str, list[int]] = {}
    for what, pattern in _LISTS.items():
        numbers = [int(number) for part in pattern.findall(sentence) for number in re.findall(r"\d+", part)]
        found[what] = list(dict.fromkeys(numbers))
    return found


def garment_in(sentence: str, names: Sequence[str]) -> str:
    """The garment that a sentence names: the only one, or the first whose name or file stands in it; empty where none does."""
    if len(names) == 1:
        return names[0]
    return next((name for name in names if re.search(rf"\b{re.escape(name)}\b", sentence)), "")


def error_of(log: str) -> str:
    """The last error that hood has said, without its mark; else the last line of the log, of a process that broke off."""
    lines = [line.strip() for line in log.splitlines() if line.strip()]
    said = [line for line in lines if line.startswith("hood: error: ")]
    return said[-1].removeprefix("hood: error: ") if said else (lines[-1] if lines else "")


def fault_of(sentence: str, names: Sequence[str]) -> Fault:
    """An error of hood as a row of the list."""
    sewn = "sew" if re.search(r"\bsew|\bweld|\brims?\b|cut off and moved", sentence) else ""
    return Fault(sentence, garment_in(sentence, names), None, **numbers_in(sentence), repair=sewn)


def faults_in(summary: Path, names: Sequence[str]) -> list[Fault]:
    """What ``summary.json`` of hood says against the result: reasons, doubts, faults with numbers; empty where it is not there.

    Numbers of an outfit count through its garments, see :func:`own_numbers`.
    """
    try:
        content = json.loads(summary.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return []
    reasons = [row for row in content.get("reasons") or [] if content.get("sound") is not True]
    rows = [*(content.get("faults") or []), *reasons, *(content.get("doubts") or [])]
    sentences = {
        row.get("kind"): row.get("sentence") for row in reversed(rows) if isinstance(row, Mapping) and "sentence" in row
    }
    placed = {row.get("kind") for row in content.get("faults") or []}
    found = []
    for row in rows:
        if not isinstance(row, Mapping):
            found.append(fault_of(str(row), names))
        elif "sentence" not in row or row.get("kind") not in placed:  # what is placed is not told a second time
            found.append(_from_table(row, names, sentences.get(row.get("kind"))))
    told = {fault.text for fault in found}
    found += [fault_of(str(text), names) for text in content.get("unsound_reasons") or [] if str(text) not in told]
    unique: dict[tuple[str, str, int | None], Fault] = {}
    for fault in found:
        unique.setdefault((fault.text, fault.garment, fault.frame), fault)
    return list(unique.values())


def _from_table(row: Mapping[str, Any], names: Sequence[str], sentence: Any) -> Fault:
    """A row of the summary; ``sentence`` is what is said of its kind."""
    kind = str(row.get("kind") or "")
    fix = f"; {row['fix']}" if row.get("fix") else ""
    text = str(row.get("sentence") or sentence or kind.replace("_", " ") + fix or row)
    said = numbers_in(text)
    garment = str(row.get("garment") or "")
    garment = garment if garment in names else garment_in(text, names)
    frame = row.get("first_frame", row.get("frame"))
    return Fault(
        text,
        garment,
        frame if isinstance(frame, int) else None,
        _numbers(row, "vertices", "vertex", "edges") or said["vertices"],
        _numbers(row, "triangles", "faces", "pairs") or said["faces"],
        _REPAIR_OF.get(kind, ""),
    )


def _numbers(row: Mapping[str, Any], *keys: str) -> list[int]:
    for key in keys:
        value = row.get(key)
        if isinstance(value, int) and not isinstance(value, bool):
            return [value]
        if isinstance(value, list) and value:
            flat = [n for item in value for n in (item if isinstance(item, list) else [item])]
            if all(isinstance(n, int) for n in flat):
                return list(dict.fromkeys(flat))
    return []


def own_numbers(numbers: Sequence[int], start: int, count: int) -> list[int]:
    """Of numbers that count through an outfit those of the garment whose ``count`` begin at ``start``, counted from 0."""
    return [number - start for number in numbers if start <= number < start + count]
