"""The page of the trade between time and accuracy: one file, nothing loaded from elsewhere, for people who are no experts.

What the page of time against accuracy says in words.
"""

from __future__ import annotations

from html import escape
from pathlib import Path

from hood.assets.files.atomic import write_atomically
from hood.evaluation.bootstrap import DRAWS, LEVEL, Estimate
from hood.evaluation.gap import AGREEMENT
from hood.evaluation.table import NEWTON
from hood.media.bars import paragraph, section, table, whole_page, write_png
from hood.studies.tradeoff.charts import FLOOR, below_floor, cost_chart, front_chart, inline_svg, series_colours
from hood.studies.tradeoff.comparison import (
    LEAST_ROLLOUTS,
    NETWORK,
    OPEN,
    REFINED,
    SOLVER,
    USEFUL,
    Study,
    at_equal_gap,
    at_equal_time,
    pareto_front,
    refined_networks,
)
from hood.studies.tradeoff.results import OVERSTRETCHED, Reached

#: Accuracies of the table of choices.
_TARGETS = (USEFUL, 0.1, 0.03, 0.01)
_VERDICTS = {NETWORK: "network faster", SOLVER: "solver faster", OPEN: "open"}
_TIME_VERDICTS = {REFINED: "refined more accurate", NETWORK: "network alone more accurate", OPEN: "open"}


def write_tradeoff_page(study: Study, folder: Path) -> Path:
    """Write ``index.html`` and the charts as PNG; returns the page's path."""
    pictures = _pictures(study, folder)
    parts = ["<h1>Speed and accuracy of cloth dynamics</h1>", f'<p class="lead">{escape(study.sentence)}</p>']
    if study.warning:
        parts.append(f'<p class="lead warning">{escape(study.warning)}</p>')
    parts += [*map(paragraph, introduction(study)), _choices(study)]
    for size in study.sizes:
        parts.append(_size_section(study, size, pictures))
    parts += [
        _all_points(study),
        _left_out(study),
        section("How it was measured", "".join(map(paragraph, method(study)))),
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
    return section("Which setting to choose", paragraph(_CHOICES) + table(head, rows))


def _size_section(study: Study, size: str, pictures: dict[str, str]) -> str:
    items = study.at(size)
    parts = [
        f"<figure>{pictures[f'front_{size}']}<figcaption>{escape(caption(study, size))}</figcaption></figure>",
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
    return "<h3>Network and solver at equal γ</h3>" + paragraph(EQUAL_GAP) + table(head, rows)


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
    return "<h3>Refined and alone at equal time</h3>" + paragraph(EQUAL_TIME) + table(head, rows)


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
    return "<h3>Does refinement ever make it worse?</h3>" + paragraph(ABOUT_REFINED) + table(head, rows)


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
    return section("All points and their commands", paragraph(_COMMANDS) + table(head, rows, raw=len(head) - 1))


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


_CHOICES = (
    "The cheapest setting whose median γ is below the limit with its whole interval, and whose strain stays within "
    f"{OVERSTRETCHED:g} times the converged solver's."
)
EQUAL_GAP = (
    "How long the solver alone takes to be as accurate, as a multiple of the setting's own time: above 1 the network earns its "
    "place. Between measured settings of the solver a straight line in the chart is assumed; where it was not measured as "
    "inaccurate or as accurate as the setting, only a bound is known (0 or ∞ at the other end). A verdict is given only where "
    "the whole interval lies on one side of 1; settings of the solver that overstretch the cloth do not count."
)
EQUAL_TIME = (
    "Beside every refined setting the most accurate network alone that takes no longer. A verdict is given only where the "
    "interval of the difference leaves out 0."
)
ABOUT_REFINED = (
    "Every iteration lowers the energy of its frame, but a rollout could still come out worse. So the same rollouts with and "
    "without: p99 strain, median over frames, beside that of the converged solver; share of vertices deeper than 2 mm under "
    "the skin and the deepest vertex, means over frames; and how many rollouts have more than without. Refinement leads to the "
    "solver's strain, up or down: worse is what has more strain than without and than the solver, or more penetration in the "
    "median rollout."
)
_COMMANDS = (
    "Every point is one command; run it to check the point. It prints the point's table and writes it to outputs/evaluate. "
    "Flags say where figures are bounds or doubtful."
)


def introduction(study: Study) -> list[str]:
    """Paragraphs for people who have not seen γ before."""
    return [
        "Every frame of a cloth simulation asks for the positions that minimise one energy: stretching, bending, inertia, "
        "gravity, contact and friction together. A network guesses them in one go; a solver comes down step by step; a network "
        "refined by k iterations does a little of both. This page shows what each of them costs and how close it comes, on the "
        "states that it reaches by itself.",
        "γ (gamma) says how close: the energy that is left above the minimum, in units of e0, what it costs to be wrong about "
        "every vertex's acceleration by 1 g, the acceleration of free fall. The root of γ is about the error of the "
        "acceleration in g: γ = 1 is off by 1 g, γ = 0.01 by 0.1 g. At 30 frames per second 0.1 g is 1.1 mm per frame. "
        f"Smaller is better. Below about {AGREEMENT:g} the figure itself is uncertain: folded cloth has several minima, that "
        "far apart.",
        f"Measured on {study.device}, one thread per setting. Bars in the charts and ranges in brackets are {LEVEL:.0%} "
        "confidence intervals.",
    ]


def caption(study: Study, size: str) -> str:
    """What the chart of a size shows, and what it does not."""
    items = study.at(size)
    text = (
        "Left and down is better. Lines join iterations (numbers); squares and dashes are lower "
        "precision, dots sweeps; the broad band (left) is the Pareto front: settings that none beats in both time and γ."
    )
    if any(item.point.model == NEWTON for item in items):
        text += f" Hollow: p99 strain exceeds {OVERSTRETCHED:g} times the converged solver's, or a rollout broke down."
    else:
        text += " The converged solver was not measured at this size, so no strain is too much: only breakdowns are hollow."
    for quantity, name in (("gap", "median"), ("gap_p95", "95th percentile")):
        text += _below(below_floor(items, quantity), quantity, name)
    missing = [item.label for item in items if not item.charted]
    return text + (f" Without a γ and so not in the chart: {', '.join(missing)}." if missing else "")


def _below(below: list[Reached], quantity: str, name: str) -> str:
    if not below:
        return ""
    values = ", ".join(f"{item.label} ({getattr(item, quantity).value:.1e})" for item in below)
    point, verb, mark = ("point", "lies", "a triangle") if len(below) == 1 else ("points", "lie", "triangles")
    return (
        f" In the {name} {len(below)} {point} {verb} below the chart's floor of {FLOOR:g}: {values}; only the time is "
        f"shown, by {mark} at the lower edge."
    )


def method(study: Study) -> list[str]:
    """Paragraphs on how far the figures can be trusted."""
    states, unsure, apart, doubtful = (
        sum(getattr(i, name) for i in study.reached) for name in ("states", "unconverged", "disagreeing", "doubtful")
    )
    jobs = max((int(item.record.get("jobs", 1)) for item in study.reached), default=1)
    loads = [float(item.record["load_at_start"]) for item in study.reached if item.record.get("load_at_start") is not None]
    load = f" When a setting began the machine had {min(loads):.1f} to {max(loads):.1f} busy processes." if loads else ""
    return [
        "Times are wall-clock time from one frame to the next, search for contact, features, network and refinement included; "
        f"the first frames are left out. Up to {jobs} settings were measured side by side.{load}",
        "The minimum is the lowest of three minimisations in float64, from the inertial guess, the previous positions and the "
        f"setting's own result. Of {states:,} states, the reference of {unsure:,} missed its accuracy (γ is a lower bound "
        f"there) and minimisations of {apart:,} ended more than {AGREEMENT:g} e0 apart (the lowest counts), of {doubtful:,} by "
        "more than a tenth of γ as well; all are kept. "
        "A setting that beats every minimisation is the reference itself, with γ = 0, and counts as unconverged.",
        f"Intervals: rollouts are drawn again with replacement, then states within each, {DRAWS:,} times with a fixed seed, "
        "alike for all settings that were measured on the same rollouts; fewer rollouts give wider intervals. With a handful "
        f"they are too narrow all the same, so below {LEAST_ROLLOUTS} rollouts no verdict is given. They say how far other "
        f"rollouts of this kind would move a figure. Tables compare settings one by one at {LEVEL:.0%}; the sentence at the "
        "top looks at all settings of a size at once and asks for more certainty of each, so it may leave open what a table "
        f"decides. It considers settings whose γ is surely below {USEFUL:g}: faster ones that are further off are no choice.",
        "rg is the unbalanced force in units of the weight; p99 strain the 99th percentile of the change of edge lengths; both "
        "are medians over frames.",
    ]
