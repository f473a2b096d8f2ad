"""The evaluation table as text.

A log of the rollouts of an evaluation, one line each, so that an interrupted evaluation goes on where it was.

Tables as files: the same rows as CSV and as JSON.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

from hood.assets.files.atomic import write_atomically
from hood.evaluation.gap import AGREEMENT
from hood.evaluation.table import ALL, FAILURE_STRAIN, INTERVALS, TERMS, MeasuredRollout, other_terms

_NAMES = ("model", "weights", "garment")
_MAIN = ("steps", "radius", "ms", "ms_p99", "fps", "L_total", "gradient_norm", "rg")
_GAP = ("gap", "gap_p95", "L_above", "unconverged", "disagree")
_TERMS = ("L_guess", *(f"L_{name}" for name in TERMS))
_STATE = ("distance", "strain_p99", "penetration", "penetration_worst", "drift")
_SURFACE = ("cut_faces", "cut_faces_worst", "crossings")
_FAILURE = ("sound", "worn", "unsound_for", "failed_at", "failed", "frames_to_failure")
_ENDS = tuple(f"{column}_{end}" for column in INTERVALS for end in ("low", "high"))
#: Characters of a line at most.
_WIDTH = 160


def columns(rows: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    """The columns of the rows' files: the same ones for all rows, and one for every other energy that acts in some of them."""
    counts = ("rollouts", "frames", "gap_states", "gap_spread", "L_states", "network", "as_in_paper")
    return (*_NAMES, *_MAIN, *_GAP, *_TERMS, *_others(rows), *_STATE, *_SURFACE, *_FAILURE, *counts, *_ENDS)


def format_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows as fixed-width tables: cost and accuracy, energies, state of the cloth; all in one would be wider than a
    screen."""
    others = _others(rows)
    energies = [fixed_width(rows, (*_NAMES, *_TERMS, *others))]
    if energies[0].index("\n") > _WIDTH:
        energies = [fixed_width(rows, (*_NAMES, *some)) for some in (_TERMS, others)]
    first, last = (*_NAMES, *_MAIN, *_GAP, "sound"), (*_NAMES, "worn", "failed", *_STATE, *_SURFACE)
    return "\n\n".join((fixed_width(rows, first), *energies, fixed_width(rows, last)))


def describe_rows(rows: Sequence[Mapping[str, Any]]) -> str:
    """Meaning and units of the columns, and how far the figures of these rows can be trusted."""
    lines = [
        "ms per frame; means: L [J], L_guess of the inertial guess, gradient_norm [N], penetration, the share of vertices "
        "deeper than 2 mm, cut_faces, the share of the cloth's triangles that the body cuts, crossings, the pairs of triangles "
        "that pass through each other; medians over frames: rg = ‖∇Φ‖ / ‖M g‖ and strain_p99; drift [m] is to the side",
        "gap = (Φ - Φ*) / e0, the energy above the minimum of the same step: median and 95th percentile; √gap is about the "
        "error of the accelerations in g; L_above [J] is the same energy, median. L_total is a mean over frames and contains "
        "gravity: cloth that slides off the body has a lower one, so read it beside worn and gap",
        "sound: share of the rollouts that the verdict calls so (docs/verdict.md; unsound_for in the files says why not); "
        "worn: share of the frames before a part of the garment has come off the body; distance [m] to the minimum of a step, "
        "99th percentile over the vertices, median over frames",
        f"failed: share of the rollouts with a frame that is not finite or whose strain_p99 exceeds {FAILURE_STRAIN:.0%}; "
        "frames_to_failure (in the files) is the median of those frames. 95% intervals over rollouts are in the files",
    ]
    whole = [row for row in rows if row["garment"] == ALL]
    states = sum(row["gap_states"] for row in whole)
    flagged = round(sum(row["gap_states"] * row.get("unconverged", 0.0) for row in whole))
    apart = round(sum(row["gap_states"] * row.get("disagree", 0.0) for row in whole))
    if flagged:
        lines.append(
            f"{flagged} of {states} reference minima did not converge (column unconverged): their gaps are lower bounds"
        )
    if apart:
        lines.append(
            f"minimisations of {apart} of {states} states ended in minima more than {AGREEMENT:g} e0 apart (column disagree); "
            "the lowest counts"
        )
    if any(row["weights"] == "untrained" for row in rows):
        lines.append("untrained: random weights; steps, radius and times of these rows mean something, their accuracy does not")
    return "\n".join(lines)


def _others(rows: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    return tuple(f"L_{name}" for name in other_terms(rows))


def fixed_width(rows: Sequence[Mapping[str, Any]], columns: Sequence[str]) -> str:
    """One table of these columns, with a dash where a row lacks one."""
    cells = [[_cell(row.get(column)) for column in columns] for row in rows]
    widths = [max(len(title), *(len(line[i]) for line in cells)) for i, title in enumerate(columns)]
    lines = ["  ".join(title.rjust(width) for title, width in zip(columns, widths, strict=True))]
    lines += ["  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)) for line in cells]
    return "\n".join(lines)


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


class EvaluationUnit(NamedTuple):
    """One rollout of an evaluation."""

    model: int  # place in the list of candidates
    garment: str
    motion: str
    shape: int = 0  # place in the list of body shapes


class RolloutLog:
    """Lines of ``rollouts.RANK.jsonl`` in ``folder``: one process appends to its own file, every process reads all of them."""

    def __init__(self, folder: Path, rank: int = 0) -> None:
        self.folder = folder
        self.path = folder / f"rollouts.{rank}.jsonl"

    def read(self, digests: Sequence[str] | None) -> dict[EvaluationUnit, MeasuredRollout]:
        """What was written for candidates whose weights have these ``digests``, the latest of every rollout; None for whatever
        weights they had. Lines cut by a kill are passed over."""
        found = {}
        for path in sorted(self.folder.glob("rollouts.*.jsonl")):
            for line in path.read_text(encoding="utf-8").splitlines():
                try:
                    entry = json.loads(line)
                    unit = EvaluationUnit(*entry["unit"])
                    if digests is None or digests[unit.model] == entry["weights"]:
                        found[unit] = MeasuredRollout(**entry["measured"])
                except (ValueError, KeyError, TypeError, IndexError):
                    continue
        return found

    def write(self, unit: EvaluationUnit, digest: str, measured: MeasuredRollout) -> None:
        """Add a rollout.

        Raises:
            OSError: the disk refuses; the error names the file.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        entry = {"unit": unit, "weights": digest, "measured": asdict(measured)}
        try:
            with open(self.path, "ab", buffering=0) as file:
                # A line of its own even after one that was cut.
                line = memoryview(f"\n{json.dumps(entry)}\n".encode())
                while line:
                    line = line[file.write(line) or 0 :]
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self.path)) from error


def write_rows(rows: Sequence[Mapping[str, Any]], columns: Sequence[str], folder: Path, name: str) -> tuple[Path, Path]:
    """Write ``name.csv``, of these columns, and ``name.json``, of all keys, atomically; returns their paths.

    A column that a row lacks is empty.

    Raises:
        OSError: a file cannot be written; names it.
    """
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, columns, extrasaction="ignore")
    writer.writeheader()
    writer.writerows(rows)
    csv_path, json_path = folder / f"{name}.csv", folder / f"{name}.json"
    write_atomically(csv_path, text.getvalue().encode())
    write_atomically(json_path, json.dumps(list(rows), indent=1).encode())
    return csv_path, json_path
