"""The stability map in plain words: where each method holds, as a section of a document."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from hood.assets.files.atomic import write_atomically
from hood.studies.envelope.cells import NOMINAL, ORDERED
from hood.studies.envelope.judge import CLASSES, REFUSED, SOUND, shares

BEGIN, END = "<!-- written by hood envelope: begin -->", "<!-- written by hood envelope: end -->"
#: Hexadecimal digits of a digest that are printed.
_DIGITS = 12

Rows = Sequence[Mapping[str, Any]]


def require_marks(path: Path) -> None:
    """Raise ValueError unless the document is there and has the marks between which the section is written."""
    text = path.read_text(encoding="utf-8") if path.is_file() else None
    if text is None:
        raise ValueError(f"document={path}: no such file; give a Markdown file with the lines {BEGIN} and {END}")
    if text.count(BEGIN) != 1 or text.count(END) != 1 or text.index(BEGIN) > text.index(END):
        raise ValueError(f"document={path}: write the lines {BEGIN} and {END} into it once, where the section is to stand")


def write_section(path: Path, rows: Rows, models: Sequence[str]) -> None:
    """Write the section anew between the marks of the document.

    Raises:
        ValueError: see :func:`require_marks`.
    """
    require_marks(path)
    text = path.read_text(encoding="utf-8")
    before, after = text[: text.index(BEGIN) + len(BEGIN)], text[text.index(END) :]
    write_atomically(path, f"{before}\n{map_section(rows, models)}\n{after}".encode())


def map_section(rows: Rows, models: Sequence[str]) -> str:
    """Shares of the classes, ranges of the factors, and every cell that is not sound, in Markdown.

    The cells of a method that is not sound in the nominal scene are counted, not listed: they are most of the map.
    """
    parts = [_origin(rows, models), _shares(rows, models), _ranges(rows, models), _worse(rows, models)]
    return "\n\n".join(parts)


def _origin(rows: Rows, models: Sequence[str]) -> str:
    count = len({(row["factor"], row["value"], row["garment"]) for row in rows})
    weights = {row["model"]: str(row["weights"])[:_DIGITS] for row in rows if row["weights"] != "none"}
    named = ", ".join(f"{model} {weights[model]}" for model in models if model in weights)
    return f"{count} cells, {len(rows)} judged rollouts." + (f" SHA-256 of the weights begin with: {named}." if named else "")


def _shares(rows: Rows, models: Sequence[str]) -> str:
    counted = [kind for kind in CLASSES if kind != REFUSED]
    lines = [f"| method | cells | {' | '.join(counted)} | bad input refused |", "|" + "---|" * (len(counted) + 3)]
    for model in models:
        kinds = [row["class"] for row in rows if row["model"] == model]
        refused = kinds.count(REFUSED)
        parts = " | ".join(f"{share:.1%}" for share in shares(kinds).values())
        lines.append(f"| {model} | {len(kinds) - refused} | {parts} | {refused} |")
    return "\n".join(lines)


def _ranges(rows: Rows, models: Sequence[str]) -> str:
    lines = [
        "Where a method is sound: how many settings of a factor, and which of those that form a range.",
        "",
        f"| factor | {' | '.join(models)} |",
        "|" + "---|" * (len(models) + 1),
    ]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in ranges(rows, models))])


def ranges(rows: Rows, models: Sequence[str]) -> list[list[str]]:
    """A row for every factor: its name, and where each method holds."""
    factors = dict.fromkeys(row["factor"] for row in rows if row["class"] != REFUSED)
    return [
        [factor, *(holds([row for row in rows if row["factor"] == factor and row["model"] == model]) for model in models)]
        for factor in factors
    ]


def holds(rows: Rows) -> str:
    """Where rows of one factor and one method are sound, in words; a setting holds where it does for all garments."""
    values = list(dict.fromkeys(row["value"] for row in rows if row["class"] != REFUSED))
    sound = [all(row["class"] == SOUND for row in rows if row["value"] == value) for value in values]
    if not values:
        return ""
    if not any(sound):
        return f"none of {len(values)}"
    count = f"all {len(values)}" if all(sound) else f"{sum(sound)} of {len(values)}"
    if rows[0]["factor"] not in ORDERED or len(values) == 1:
        return count
    stretches = [[values[index] for index in run] for run in _runs(sound)]
    return f"{count}: " + ", ".join(run[0] if len(run) == 1 else f"{run[0]} to {run[-1]}" for run in stretches)


def _runs(sound: Sequence[bool]) -> Iterator[list[int]]:
    """Stretches of indices that are sound."""
    for is_sound, group in groupby(range(len(sound)), key=lambda index: sound[index]):
        if is_sound:
            yield list(group)


def _worse(rows: Rows, models: Sequence[str]) -> str:
    nominal = {row["model"]: row for row in rows if row["factor"] == NOMINAL and row["class"] not in (SOUND, REFUSED)}
    lines = ["Settings that are not sound, with the methods and the cause:", ""]
    for (factor, value, garment), group in groupby(rows, key=lambda row: (row["factor"], row["value"], row["garment"])):
        bad = [row for row in group if row["class"] not in (SOUND, REFUSED) and row["model"] not in nominal]
        if bad:
            name = f"{factor} {value}" + ("" if factor in (NOMINAL, "garment", "input") else f" ({garment})")
            lines.append(f"- **{name}** " + "; ".join(f"{row['model']}: {_cause(row)}" for row in bad))
    for model in (model for model in models if model in nominal):
        count = sum(row["model"] == model and row["class"] not in (SOUND, REFUSED) for row in rows)
        lines.append(
            f"- **{model}** is not sound in the nominal scene: {_cause(nominal[model])}. The page has its {count} settings"
        )
    return "\n".join(lines) if len(lines) > 2 else "Every setting is sound for every method."


def _cause(row: Mapping[str, Any]) -> str:
    return f"{row['class']}, {row['reasons'].replace('; ', ', ')}"
