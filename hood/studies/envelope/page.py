"""The stability map as a page, and in plain words as a section of a document.

The page is one file without scripts; a click on a cell shows why it is in its class, with the curves of its rollout as a small
drawing, and a picture that is small enough to stand in a page with a thousand others.
"""

from __future__ import annotations

import io
from base64 import b64encode
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from hood.assets.files.atomic import write_atomically
from hood.limits import CUT_UNSOUND
from hood.media.bars import paragraph, section, table, whole_page
from hood.media.film import Film, sheet_frames
from hood.media.renderer.render import contact_sheet
from hood.rollouts.file.reader import RolloutData, read_rollout
from hood.studies.envelope.cells import NOMINAL, ORDERED
from hood.studies.envelope.judge import CLASSES, DEGRADED, FAILED, FIGURES, REFUSED, SILENT, SOUND, Criteria, Judged, shares

#: Pixels of a panel, of the gap between two and around them, and points of a curve at most.
_WIDTH, _HEIGHT, _GAP, _EDGE, _POINTS = 320, 120, 56, 30, 120
_OWN, _SOLVER, _LIMIT = "#2a6fbb", "#888888", "#d1544a"


@dataclass(frozen=True)
class Curve:
    """By frame, NaN where it was not measured."""

    strain_p99: np.ndarray  # (T,)
    cut_face_share: np.ndarray  # (T,)


def curve_svg(curve: Curve, solver: Curve | None, name: str, criteria: Criteria) -> str:
    """Strain p99 and cut share over the rollout, those of the solver behind them, and the limits of a sound one.

    Frames are spread over the width, so that rollouts of one motion at different time steps lie on each other.
    """
    panels = (
        ("strain p99", "strain_p99", criteria.strain),
        ("share of triangles cut by the skin", "cut_face_share", CUT_UNSOUND.value),
    )
    width, height = 2 * _WIDTH + _GAP + 2 * _EDGE, _HEIGHT + 2 * _EDGE
    parts = []
    for place, (title, key, limit) in enumerate(panels):
        others = None if solver is None else getattr(solver, key)
        content = "".join(_panel(getattr(curve, key), others, limit, title))
        parts.append(f'<g transform="translate({_EDGE + place * (_WIDTH + _GAP) + 10},{_EDGE})">{content}</g>')
    label = escape(f"Strain p99 and cut share by frame, {name} in blue, the solver in grey, limits in red", quote=True)
    return (
        f'<svg role="img" aria-label="{label}" viewBox="0 0 {width} {height}" xmlns="http://www.w3.org/2000/svg" '
        f'font-family="sans-serif" font-size="11">{"".join(parts)}</svg>'
    )


def _panel(values: np.ndarray, solver: np.ndarray | None, limit: float, title: str) -> Iterator[str]:
    tables = [table for table in (values, solver) if table is not None]
    highest = max([limit, *(float(table[np.isfinite(table)].max()) for table in tables if np.isfinite(table).any())])
    top = 1.1 * highest
    yield f'<text x="0" y="-8" fill="#222">{title}</text>'
    yield f'<path d="M0,0 V{_HEIGHT} H{_WIDTH}" fill="none" stroke="#999"/>'
    for share in {limit, highest}:
        y = _HEIGHT * (1.0 - share / top)
        yield f'<text x="-4" y="{y + 4:.1f}" text-anchor="end" fill="#555">{100 * share:.3g}%</text>'
    y = _HEIGHT * (1.0 - limit / top)
    yield f'<path d="M0,{y:.1f} H{_WIDTH}" stroke="{_LIMIT}" stroke-dasharray="3 3"/>'
    if solver is not None:
        yield _line(solver, top, _SOLVER)
    yield _line(values, top, _OWN)
    yield f'<text x="{_WIDTH}" y="{_HEIGHT + 14}" text-anchor="end" fill="#555">{len(values)} frames</text>'


def _line(values: np.ndarray, top: float, colour: str) -> str:
    """Of long rollouts the largest value of every stretch, so that no peak is lost."""
    known = np.where(np.isfinite(values), values, -np.inf)
    parts = np.array_split(np.arange(len(known)), min(len(known), _POINTS))
    peaks = [int(part[known[part].argmax()]) for part in parts]
    scale = _WIDTH / max(len(known) - 1, 1)
    points = (f"{scale * at:.1f},{_HEIGHT * (1.0 - known[at] / top):.1f}" for at in peaks if np.isfinite(known[at]))
    return f'<polyline points="{" ".join(points)}" fill="none" stroke="{colour}" stroke-width="1.6"/>'


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


def write_map_page(views: Sequence[View], models: Sequence[str], criteria: Criteria, folder: Path) -> Path:
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


#: Pixels of a frame, frames, and bytes of the picture at most.
_PICTURE_WIDTH, _PICTURE_HEIGHT, _FRAMES, _MOST = 130, 180, 5, 25_000
_QUALITIES = (80, 70, 60, 45, 30)


def small_sheet(folder: Path) -> bytes | None:
    """JPEG of ``folder/rollout/rollout.h5``: five frames spread over it and the one with the largest strain p99.

    It is kept as ``folder/sheet.jpg`` and drawn again for a newer rollout. None without Pillow.
    """
    path, source = folder / "sheet.jpg", folder / "rollout" / "rollout.h5"
    if path.exists() and path.stat().st_mtime >= source.stat().st_mtime:
        return path.read_bytes()
    try:
        content = _jpeg(_sheet(read_rollout(source)))
    except ImportError:
        return None
    write_atomically(path, content)
    return content


def _sheet(data: RolloutData) -> np.ndarray:
    film, strain = Film(data, _PICTURE_WIDTH, _PICTURE_HEIGHT), data.metrics.get("strain_p99")
    chosen = sheet_frames(len(data.cloth_pos), _FRAMES)
    if strain is not None and np.isfinite(strain).any():
        chosen = sorted({*chosen, int(np.nanargmax(strain))})
    return contact_sheet(
        [film.frame(index) for index in chosen], len(chosen), [f"{data.time[index]:.2f} s" for index in chosen]
    )


def _jpeg(picture: np.ndarray) -> bytes:
    """As good as it gets within the limit."""
    from PIL import Image

    for quality in _QUALITIES:
        content = io.BytesIO()
        Image.fromarray(picture).save(content, format="JPEG", quality=quality, optimize=True)
        if len(content.getvalue()) <= _MOST:
            break
    return content.getvalue()


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
    parts = [_origin(rows, models), _shares_in_words(rows, models), _ranges(rows, models), _worse(rows, models)]
    return "\n\n".join(parts)


def _origin(rows: Rows, models: Sequence[str]) -> str:
    count = len({(row["factor"], row["value"], row["garment"]) for row in rows})
    weights = {row["model"]: str(row["weights"])[:_DIGITS] for row in rows if row["weights"] != "none"}
    named = ", ".join(f"{model} {weights[model]}" for model in models if model in weights)
    return f"{count} cells, {len(rows)} judged rollouts." + (f" SHA-256 of the weights begin with: {named}." if named else "")


def _shares_in_words(rows: Rows, models: Sequence[str]) -> str:
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
