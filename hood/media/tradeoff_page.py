"""The page of the trade between time and accuracy: one file, nothing loaded from elsewhere, for people who are no experts."""

from __future__ import annotations

from html import escape
from pathlib import Path

from hood.assets.files.atomic import write_atomically
from hood.evaluation.bootstrap import Estimate
from hood.evaluation.comparison import (
    NETWORK,
    OPEN,
    REFINED,
    SOLVER,
    USEFUL,
    at_equal_gap,
    at_equal_time,
    pareto_front,
    refined_networks,
)
from hood.evaluation.study import Study
from hood.media import tradeoff_prose as prose
from hood.media.bars import write_png
from hood.media.charts import cost_chart, front_chart, inline_svg, series_colours
from hood.media.page import paragraph, section, table, whole_page

#: Accuracies of the table of choices.
_TARGETS = (USEFUL, 0.1, 0.03, 0.01)
_VERDICTS = {NETWORK: "network faster", SOLVER: "solver faster", OPEN: "open"}
_TIME_VERDICTS = {REFINED: "refined more accurate", NETWORK: "network alone more accurate", OPEN: "open"}


def write_page(study: Study, folder: Path) -> Path:
    """Write ``index.html`` and the charts as PNG; returns the page's path."""
    pictures = _pictures(study, folder)
    parts = ["<h1>Speed and accuracy of cloth dynamics</h1>", f'<p class="lead">{escape(study.sentence)}</p>']
    if study.warning:
        parts.append(f'<p class="lead warning">{escape(study.warning)}</p>')
    parts += [*map(paragraph, prose.introduction(study)), _choices(study)]
    for size in study.sizes:
        parts.append(_size_section(study, size, pictures))
    parts += [
        _all_points(study),
        _left_out(study),
        section("How it was measured", "".join(map(paragraph, prose.method(study)))),
    ]
    path = folder / "index.html"
    write_atomically(path, whole_page("Speed and accuracy of cloth dynamics", "".join(parts)).encode())
    return path


def _pictures(study: Study, folder: Path) -> dict[str, str]:
    """SVG elements by name; PNG files of the same figures in ``folder``."""
    colours, found = series_colours(study.reached), {}
    for size in study.sizes:
        items = study.at(size)
        title = f"{items[0].vertices:,} vertices, {study.device}"
        figures = {
            f"front_{size}": front_chart(items, study.rejected, colours, title),
            f"cost_{size}": cost_chart(items, title),
        }
        for name, figure in figures.items():
            write_png(figure, folder / f"{name}.png")
            kind = "milliseconds per frame against γ" if name.startswith("front") else "cost of a frame by part"
            found[name] = inline_svg(figure, name, escape(f"Chart: {kind}, {title}", quote=True))
    return found


def _choices(study: Study) -> str:
    """The cheapest setting that surely reaches an accuracy."""
    rows = []
    for size in study.sizes:
        sound = [item for item in study.at(size) if item.charted and item.point not in study.rejected]
        cells = []
        for target in _TARGETS:
            enough = [item for item in sound if item.gap.high <= target]
            best = min(enough, key=lambda item: item.ms.value, default=None)
            cells.append("none measured" if best is None else f"{best.label}: {best.ms.value:.0f} ms")
        rows.append([f"{study.at(size)[0].vertices:,} vertices", *cells])
    head = ["size", *(f"γ ≤ {target:g}" for target in _TARGETS)]
    return section("Which setting to choose", paragraph(prose.CHOICES) + table(head, rows))


def _size_section(study: Study, size: str, pictures: dict[str, str]) -> str:
    items = study.at(size)
    parts = [
        f"<figure>{pictures[f'front_{size}']}<figcaption>{escape(prose.caption(study, size))}</figcaption></figure>",
        _front_table(study, size),
        _equal_gap(study, size),
        _equal_time(study, size),
        _refined(study, size),
        "<details><summary>Where the time goes, with the fewest and the most iterations</summary>"
        f"<figure>{pictures[f'cost_{size}']}</figure></details>",
    ]
    return section(f"{items[0].vertices:,} vertices", "".join(parts))


def _front_table(study: Study, size: str) -> str:
    front = pareto_front(study.at(size), study.rejected)
    rows = [
        [i.label, _range(i.ms, ".1f"), _range(i.gap), _range(i.gap_p95), f"{i.rg:.2g}", f"{i.strain_p99:.1%}"] for i in front
    ]
    head = ["setting", "ms per frame", "γ median", "γ 95th percentile", "rg", "p99 strain"]
    return "<h3>The front</h3>" + table(head, rows)


def _equal_gap(study: Study, size: str) -> str:
    items = [item for item in study.at(size) if item.charted]
    sound = [item for item in items if item.point not in study.rejected]
    rows = []
    for item in (i for i in items if not i.point.alone):
        found = at_equal_gap(item, [other for other in sound if other.point.alone])
        if found is None:
            continue
        ratio = "not measured there" if found.ratio is None else f"{found.ratio:.2g}"
        verdict = "overstretches the cloth" if item.point in study.rejected else _VERDICTS[found.verdict]
        rows.append([item.label, str(item.point.refine), f"{item.gap.value:.2g}", f"{item.ms.value:.1f}", ratio,
                     f"{_end(found.low)} to {_end(found.high)}", verdict])  # fmt: skip
    if not rows:
        return ""
    head = ["setting", "k", "γ", "ms", "solver's time / its own", "95% interval", "verdict"]
    return "<h3>Network and solver at equal γ</h3>" + paragraph(prose.EQUAL_GAP) + table(head, rows)


def _equal_time(study: Study, size: str) -> str:
    items = [item for item in study.at(size) if item.charted and not item.point.alone]
    networks = [item for item in items if item.point.refine == 0 and item.point not in study.rejected]
    rows = []
    for item in (i for i in items if i.point.refine and i.point not in study.rejected):
        found = at_equal_time(item, networks)
        if found is not None:
            rows.append([item.label, str(item.point.refine), f"{item.ms.value:.1f}", f"{item.gap.value:.2g}", found.best.label,
                         f"{found.best.gap.value:.2g}", _range(found.gain), _TIME_VERDICTS[found.verdict]])  # fmt: skip
    if not rows:
        return ""
    head = ["setting", "k", "ms", "γ", "network alone in that time", "its γ", "difference", "verdict"]
    return "<h3>Refined and alone at equal time</h3>" + paragraph(prose.EQUAL_TIME) + table(head, rows)


def _refined(study: Study, size: str) -> str:
    rows = []
    for found in refined_networks(study.at(size)):
        item, plain = found.reached, found.plain
        strains = plain.strain_p99, item.strain_p99, found.solver
        rows.append([item.label, str(item.point.refine), *(f"{strain:.2%}" for strain in strains),
                     f"{found.stretched} of {item.rollouts}", *(f"{one.penetration:.4%}" for one in (plain, item)),
                     f"{found.deeper} of {item.rollouts}", *(f"{1e3 * one.depth:.2f}" for one in (plain, item)),
                     "worse" if found.worse else "no worse"])  # fmt: skip
    if not rows:
        return ""
    head = ["setting", "k", "p99 strain alone", "refined", "solver's", "rollouts with more", "deeper than 2 mm alone",
            "refined", "rollouts with more", "deepest alone [mm]", "refined", "verdict"]  # fmt: skip
    return "<h3>Does refinement ever make it worse?</h3>" + paragraph(prose.REFINED) + table(head, rows)


def _all_points(study: Study) -> str:
    rows = []
    for item in study.reached:
        flags = [
            f"{count} {what}"
            for count, what in (
                (item.unconverged, "references unconverged"),
                (item.disagreeing, "references disagree"),
                (item.doubtful, "with doubt about γ"),
                (item.failures, "rollouts broke down"),
            )
            if count
        ]
        flags += [f"{item.unsolved:.1%} of the steps not converged"] if item.unsolved else []
        flags += [f"processor {item.record['cpu_share']:.0%} of the time"] if item.disturbed else []
        flags += ["overstretched"] if item.point in study.rejected and not item.failures else []
        rows.append([item.point.size, item.label, _range(item.ms, ".1f"), _range(item.ms_p95, ".1f"), _range(item.gap),
                     _range(item.gap_p95), f"{item.rg:.2g}", f"{item.strain_p99:.1%}", str(item.states), "; ".join(flags),
                     f"<code>{escape(item.point.command)}</code>"])  # fmt: skip
    head = ["size", "setting", "ms median", "ms p95", "γ median", "γ p95", "rg", "p99 strain", "states", "flags", "command"]
    return section("All points and their commands", paragraph(prose.COMMANDS) + table(head, rows, raw=len(head) - 1))


def _left_out(study: Study) -> str:
    text = ""
    if study.absent:
        text += paragraph(f"No weights of these names are embedded, so they were not measured: {', '.join(study.absent)}.")
    if study.left_out:
        rows = [[p.size, p.label, reason, log, f"<code>{escape(p.command)}</code>"] for p, reason, log in study.left_out]
        text += table(["size", "setting", "why", "log", "command"], rows, raw=4)
    return section("What is missing", text or paragraph("Nothing: every point of the grid gave a result."))


def _range(value: Estimate, form: str = ".2g") -> str:
    return f"{value.value:{form}} ({value.low:{form}} to {value.high:{form}})"


def _end(value: float) -> str:
    return "∞" if value == float("inf") else f"{value:.2g}"
