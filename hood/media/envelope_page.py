"""The page of the stability map: one file without scripts; a click on a cell shows why it is in its class."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from itertools import groupby
from pathlib import Path
from typing import Any

from hood.assets.files.atomic import write_atomically
from hood.evaluation.envelope import CLASSES, DEGRADED, FAILED, REFUSED, SILENT, SOUND, Criteria, Judged, shares
from hood.evaluation.envelope_figures import FIGURES
from hood.evaluation.envelope_prose import ranges
from hood.media.envelope_curve import Curve, curve_svg
from hood.media.page import paragraph, section, table, whole_page

TITLE = "Stability at the extremes"
#: Colour of a class, a sign that tells it apart without colour, and what it means.
_LOOKS = {
    SOUND: ("#7dbb86", "", "within every limit"),
    DEGRADED: ("#efc75e", "△ ", "beyond a limit, and the rollout says so"),
    FAILED: ("#e08a4f", "✕ ", "no usable result, and the rollout says so"),
    SILENT: ("#d1544a", "● ", "beyond a limit, and nothing was said"),
    REFUSED: ("#c3c8cf", "– ", "bad input, refused in one sentence; in no share"),
}
_STYLE = """
td { white-space: normal; } .map td { padding: 0; }
.map tbody th { white-space: normal; max-width: 15em; } .map tbody + tbody { border-top: 2px solid #999; }
.map td a { display: block; padding: .2em .6em; color: #222; text-decoration: none; min-width: 4em; }
.map td a:hover { outline: 2px solid #222; }
.cell { display: none; position: fixed; top: 0; right: 0; bottom: 0; width: min(760px, 92vw); overflow-y: auto; z-index: 2;
  background: #fff; border-left: 3px solid #555; padding: 0 1.4em 2em; box-shadow: -6px 0 24px #0004; box-sizing: border-box; }
.cell:target { display: block; } .cell h2 { margin-top: 1em; }
.cell img { max-width: 100%; } .cell svg { width: 100%; height: auto; }
.cell code { white-space: pre-wrap; overflow-wrap: anywhere; background: #f3f3f3; display: block; padding: .6em; }
.close { float: right; margin-top: 1.2em; } .sign { padding: .1em .6em; }
""" + "\n".join(f".k{index} {{ background: {_LOOKS[kind][0]}; }}" for index, kind in enumerate(CLASSES))


@dataclass(frozen=True)
class View:
    """What the page shows of a cell and a method."""

    row: dict[str, Any]  # of the map's tables
    judged: Judged
    curve: Curve | None = None
    solver: Curve | None = None  # what it is held against
    picture: bytes | None = None  # JPEG


def write_page(views: Sequence[View], models: Sequence[str], criteria: Criteria, folder: Path) -> Path:
    """Write ``index.html``; returns its path."""
    parts = [f"<h1>{TITLE}</h1>", *map(paragraph, _introduction(criteria)), _legend()]
    parts.append(section("Shares", _shares(views, models)))
    holds = ranges([view.row for view in views], models)
    parts.append(section("Where each method is sound", table(["factor", *models], holds)))
    parts.append(section("The map", paragraph(_HOW) + _heat_map(views, models)))
    parts += [_cell(number, view, criteria) for number, view in enumerate(views)]
    path = folder / "index.html"
    write_atomically(path, whole_page(TITLE, "".join(parts), _STYLE).encode())
    return path


def _introduction(criteria: Criteria) -> Sequence[str]:
    return (
        "Every method was given scenes beyond the ordinary, one factor at a time and several at once. A scene that breaks does "
        "not crash: it gives cloth that is finite and wrong. What matters is whether a result can be trusted, and whether the "
        "program says so where it cannot.",
        "Sound: the verdict of the rollout calls it so, for networks as for the solver: finite, worn, not torn, every step "
        "near its minimum, no skin and no cloth through cloth that a viewer sees. Beside a reference also: strain p99 in the "
        f"worst frame at most {criteria.strain:.0%}, or {criteria.strain_ratio:g} times that of the converged solver, which is "
        f"held against a quarter of the time step; the strain of a network alone within {100 * criteria.network_strain:g} "
        f"points of the solver's; at rest no climb beyond {100 * criteria.climb:g} points in 100 frames.",
        "Said: the rollout called itself unsound, ended with an error, or warned of something that the same method does not "
        "warn of in the nominal scene.",
    )


_HOW = (
    "A row is a setting of a factor, a column a method: a network alone, one refined by some iterations (NAME+5), the solver's "
    "starting guess refined (guess+5), or the converged solver (newton); NAME+repair: with steps that the guard repairs. "
    "The number is the strain p99 of the worst frame. A click shows reasons, curves, pictures and the command."
)


def _legend() -> str:
    signs = []
    for index, kind in enumerate(CLASSES):
        _, sign, meaning = _LOOKS[kind]
        signs.append(f'<span class="sign k{index}">{sign}{kind}</span> {escape(meaning)}')
    return f"<p>{'<br/>'.join(signs)}</p>\n"


def _shares(views: Sequence[View], models: Sequence[str]) -> str:
    rows = []
    for model in models:
        kinds = [view.row["class"] for view in views if view.row["model"] == model]
        parts = shares(kinds)
        counted = sum(kind != REFUSED for kind in kinds)
        rows.append([model, str(counted), *(f"{share:.1%}" for share in parts.values()), str(kinds.count(REFUSED))])
    return table(["method", "cells", *(kind for kind in CLASSES if kind != REFUSED), "bad input refused"], rows)


def _heat_map(views: Sequence[View], models: Sequence[str]) -> str:
    head = "".join(f"<th>{escape(title)}</th>" for title in ("factor", "value", "garment", *models))
    numbered = list(enumerate(views))
    bodies = []
    for factor, group in groupby(numbered, key=lambda item: item[1].row["factor"]):
        lines = []
        for (value, garment), cells in groupby(group, key=lambda item: (item[1].row["value"], item[1].row["garment"])):
            of_model = {view.row["model"]: (number, view.row) for number, view in cells}
            named = f"<th>{escape(factor)}</th><th>{escape(value)}</th><th>{escape(garment)}</th>"
            lines.append(f"<tr>{named}{''.join(_square(of_model.get(model)) for model in models)}</tr>")
        bodies.append(f"<tbody>{''.join(lines)}</tbody>")
    return f'<div class="wide"><table class="map"><thead><tr>{head}</tr></thead>{"".join(bodies)}</table></div>\n'


def _square(found: tuple[int, dict[str, Any]] | None) -> str:
    if found is None:
        return "<td></td>"
    number, row = found
    kind, strain = row["class"], row["strain_p99"]
    text = _LOOKS[kind][1] + ("" if strain is None else f"{strain:.0%}")
    words = escape(f"{kind}: {row['reasons']}" if row["reasons"] else kind, quote=True)
    return f'<td class="k{CLASSES.index(kind)}"><a href="#c{number}" title="{words}">{text or "&#160;"}</a></td>'


def _cell(number: int, view: View, criteria: Criteria) -> str:
    """What a click on a square shows."""
    row = view.row
    parts = [
        f'<a class="close" href="#-">close</a><h2>{escape(row["factor"])} {escape(row["value"])}, {escape(row["model"])}</h2>',
        f'<p><span class="sign k{CLASSES.index(row["class"])}">{escape(row["class"])}</span> exit code {row["exit_code"]}</p>',
        _sentences("Why", view.judged.reasons),
        _sentences("Said", view.judged.said),
        f"<h3>Command</h3><code>{escape(row['command'])}</code>",
    ]
    if view.curve is not None:
        parts.append(curve_svg(view.curve, view.solver, row["model"], criteria))
    if view.picture is not None:
        coded = b64encode(view.picture).decode()
        parts.append(f'<img alt="Frames of the rollout" src="data:image/jpeg;base64,{coded}"/>')
    known = [[name.replace("_", " "), _number(row[name])] for name in FIGURES if row.get(name) is not None]
    parts.append(table(["measured", ""], known) if known else "")
    return f'<section class="cell" id="c{number}">{"".join(parts)}</section>\n'


def _sentences(title: str, texts: Sequence[str]) -> str:
    if not texts:
        return ""
    return f"<h3>{title}</h3><ul>" + "".join(f"<li>{escape(text)}</li>" for text in texts) + "</ul>"


def _number(value: float) -> str:
    return f"{value:,}" if isinstance(value, int) else f"{value:.3g}"
