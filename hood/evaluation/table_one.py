"""Table 1 of the HOOD paper beside the same columns measured here, as a page to read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NamedTuple

from hood.evaluation.table import ALL, FAILURE_STRAIN, INTERVALS, TERMS, other_terms

Row = Mapping[str, Any]


class Published(NamedTuple):
    """A row of the paper's Table 1; pairs are (dress alone, all garments)."""

    title: str
    steps: int
    radius: int
    fps: tuple[float, float]
    total: tuple[float, float]  # L_total [J]
    gradient_norm: tuple[float, float]  # [N]


#: By the names of the schedules; models with them have the name as a word of theirs (``ours``, ``small-ours``).
PAPER = {
    "fine15": Published("Fine15", 15, 15, (6.65, 13.1), (2.92, 1.68), (2.37e-2, 3.7e-2)),
    "fine48": Published("Fine48", 48, 48, (2.45, 4.99), (1.43, 1.04), (1.03e-2, 2.5e-2)),
    "ours": Published("Ours", 15, 48, (7.27, 13.6), (1.48, 1.07), (1.56e-2, 2.72e-2)),
}
#: The paper's claim that a hierarchy costs nothing: a step of Ours takes at most this many times one of Fine15.
TIME_RATIO = 1.3
_UNTRAINED = "untrained"
_COLUMNS = (
    ("model", "model"), ("garment", "garment"), ("rollouts", "rollouts"), ("steps", "steps"), ("radius", "radius"),
    ("ms", "ms/frame p50"), ("ms_p99", "p99"), ("fps", "fps"), ("L_total", "L_total [J]"),
    ("gradient_norm", "gradient norm [N]"),
    ("gap", "γ median"), ("gap_p95", "γ p95"), ("L_above", "L above the minimum [J]"), ("worn", "worn"), ("sound", "sound"),
    ("rg", "rg"), ("strain_p99", "strain p99"),
)  # fmt: skip
#: Behind the energies.
_MORE = (
    ("L_guess", "L_total of the inertial guess"), ("penetration", "penetrating"), ("penetration_worst", "worst frame"),
    ("cut_faces", "triangles cut by the skin"), ("cut_faces_worst", "worst frame"), ("crossings", "crossing pairs"),
    ("drift", "drift [m]"), ("failed", "failed rollouts"), ("frames_to_failure", "frames to failure"),
    ("unconverged", "γ unconverged"), ("disagree", "γ disagree"), ("gap_spread", "γ spread p95"), ("gap_states", "γ states"),
    ("L_states", "L_total of these states"),
)  # fmt: skip


@dataclass(frozen=True)
class TableConditions:
    """What the figures depend on besides the models."""

    command: str
    machine: str
    body: str
    motions: Sequence[str]
    num_shapes: int
    num_frames: int
    fps: float
    vertices: Mapping[str, int] = field(default_factory=dict)  # by garment
    training: Mapping[str, str] = field(default_factory=dict)  # by model, as far as known


class Check(NamedTuple):
    """A claim of the paper, looked for in the figures measured here."""

    what: str
    paper: str
    here: str
    holds: bool | None  # None: nothing to compare


def checks(rows: Sequence[Row]) -> list[Check]:
    """Radius, time and order of the losses against the paper's, for every group of rows the paper has too."""
    found = [_radius_check(rows)]
    for garment in _groups(rows):
        part = {name: row for name, row in _by_model(rows, garment).items() if row.get("ms") is not None}
        column = _paper_column(garment)
        found.append(_time_check(part, garment, column))
        for key, title in (("L_total", "L_total"), ("gradient_norm", "gradient norm")):
            values = {name: (one.total if key == "L_total" else one.gradient_norm)[column] for name, one in PAPER.items()}
            found.append(_order_check(part, garment, key, title, values))
        found.append(_order_check(part, garment, "gap", "γ", None))
    return found


def page(rows: Sequence[Row], about: TableConditions) -> str:
    """The page in Markdown; the same rows and conditions give the same text."""
    parts = [
        "# Cost, reach and accuracy",
        f"Measured with\n\n```\n{about.command}\n```\n\non {about.machine}.",
        f"## Measured\n\n{_table(rows, _COLUMNS)}\n\n{_legend()}",
        f"## Terms of the loss [J] and state of the cloth\n\n{_table(rows, (*_energies(rows), *_MORE))}",
        f"## Beside the paper\n\n{_beside(rows)}",
        f"## What the paper claims, and what was found\n\n{_check_table(checks(rows))}",
        f"## What differs from the paper\n\n{_differences(rows, about)}",
    ]
    return "\n\n".join(parts) + "\n"


def _energies(rows: Sequence[Row]) -> list[tuple[str, str]]:
    """Columns of the energies, with their titles."""
    terms = [(f"L_{name}", name.replace("_", " ")) for name in (*TERMS, *other_terms(rows))]
    return [("model", "model"), ("garment", "garment"), *terms]


def _groups(rows: Sequence[Row]) -> list[str]:
    """Garments whose rows have a counterpart in the paper."""
    return [name for name in dict.fromkeys(row["garment"] for row in rows) if name == ALL or name.startswith("dress")]


def _paper_column(garment: str) -> int:
    return 1 if garment == ALL else 0


def _by_model(rows: Sequence[Row], garment: str) -> dict[str, Row]:
    """Trained or not, the first rows of models the paper has too: networks as in the paper, then others by their name."""
    here = sorted((row for row in rows if row["garment"] == garment), key=lambda row: row.get("as_in_paper") is False)
    found: dict[str, Row] = {}
    for row in here:
        reach = (row.get("steps"), row.get("radius"))
        same = next((name for name, one in PAPER.items() if row.get("as_in_paper") and (one.steps, one.radius) == reach), None)
        name = _schedule(row) or same
        if name is not None:
            found.setdefault(name, row)
    return {name: found[name] for name in PAPER if name in found}


def _schedule(row: Row) -> str | None:
    """The schedule of the paper that the model's name names, or none."""
    return next((word for word in str(row["model"]).split("-") if word in PAPER), None)


def _radius_check(rows: Sequence[Row]) -> Check:
    here = {_schedule(row): row["radius"] for row in reversed(rows) if row["radius"] is not None}
    known = [name for name in PAPER if name in here]
    paper = " / ".join(f"{one.radius} ({one.title})" for one in PAPER.values())
    if not known:
        return Check("propagation radius [edges]", paper, "none of these models", None)
    text = " / ".join(f"{here[name]} ({PAPER[name].title})" for name in known)
    return Check("propagation radius [edges]", paper, text, all(here[name] == PAPER[name].radius for name in known))


def _time_check(part: Mapping[str, Row], garment: str, column: int) -> Check:
    what = f"time of Ours / Fine15, {garment}"
    paper = f"{PAPER['fine15'].fps[column] / PAPER['ours'].fps[column]:.2f}"
    if not {"ours", "fine15"} <= set(part):
        return Check(what, paper, "not both measured", None)
    ours, fine15 = part["ours"], part["fine15"]
    ratio = ours["ms"] / fine15["ms"]
    least, most = (_end_ratio(ours, fine15, *ends) for ends in (("ms_low", "ms_high"), ("ms_high", "ms_low")))
    holds = None if least is None or most is None or least <= TIME_RATIO < most else ratio <= TIME_RATIO
    return Check(what, paper, f"{ratio:.2f} (at most {TIME_RATIO:g} counts as the same)", holds)


def _end_ratio(over: Row, under: Row, upper: str, lower: str) -> float | None:
    ends = over.get(upper), under.get(lower)
    return None if ends[0] is None or ends[1] is None else float(ends[0] / ends[1])


def _order_check(part: Mapping[str, Row], garment: str, key: str, title: str, paper: Mapping[str, float] | None) -> Check:
    """Order of the models by a column; ≈ stands between two whose intervals overlap."""
    what = f"order by {title}, {garment}"
    values = {name: row for name, row in part.items() if row.get(key) is not None}
    expected = sorted(paper, key=lambda name: paper[name]) if paper else []
    claim = " < ".join(PAPER[name].title for name in expected) or "not reported"
    if any(row["weights"] == _UNTRAINED for row in values.values()):
        return Check(what, claim, "random weights: their order means nothing", None)
    if len(values) < 2:
        return Check(what, claim, "fewer than two of these models", None)
    order = sorted(values, key=lambda name: values[name][key])
    level = [_overlap(values[first], values[second], key) for first, second in pairwise(order)]
    text = PAPER[order[0]].title
    for same, name in zip(level, order[1:], strict=True):
        text += f" {'≈' if same else '<'} {PAPER[name].title}"
    open_yet = not expected or any(level)
    return Check(what, claim, text, None if open_yet else order == [name for name in expected if name in values])


def _overlap(lower: Row, higher: Row, key: str) -> bool:
    """Whether the intervals of two rows overlap; without intervals nothing is known apart."""
    high, low = lower.get(f"{key}_high"), higher.get(f"{key}_low")
    return high is None or low is None or bool(high >= low)


def _table(rows: Sequence[Row], columns: Sequence[tuple[str, str]]) -> str:
    lines = [[title for _, title in columns], ["---"] * len(columns)]
    lines += [[_cell(row, key) for key, _ in columns] for row in rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _cell(row: Row, key: str) -> str:
    value = row.get(key)
    text = _number(value)
    if key == "model" and row["weights"] == _UNTRAINED:
        text += " (untrained)"
    if key == "model" and _schedule(row) is not None and row.get("as_in_paper") is False:
        text += " (other network)"
    low, high = row.get(f"{key}_low"), row.get(f"{key}_high")
    return text if key not in INTERVALS or low is None else f"{text} ({_number(low)} to {_number(high)})"


def _number(value: Any) -> str:
    if value is None:
        return "–"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _legend() -> str:
    return (
        "In brackets: 95% bootstrap intervals over rollouts, where there are at least two; with a handful of rollouts they are "
        "too narrow. ms/frame includes contact search, graph and features. γ = (Φ − Φ\\*) / e0 is the energy above the minimum "
        "of the same step, on states that the model reached itself; rg = ‖∇Φ‖ / ‖M g‖. L above the minimum is the same energy "
        "in joules, the median over those states, whose own L_total is in the second table. worn is the share of the frames "
        "before a part of the garment has come off the body: cloth that falls lowers L_total, by 2 J for 0.2 kg and a "
        "metre, so compare it only between models that keep it on. Of a model "
        "marked (other network) latent size, features or output are not the paper's. L_total and gradient norm are means, "
        "ms, rg and strain p99 medians over frames. A rollout has failed at the first frame that is not finite or whose strain "
        f"p99 exceeds {FAILURE_STRAIN:.0%}; frames to failure is the median over rollouts (–: less than half failed). γ "
        "unconverged and γ disagree are the shares of the states whose reference minimum missed its accuracy, and of those "
        "where minimisations ended in different minima, of which the lowest counts; γ spread p95 [e0]: how far apart."
    )


def _beside(rows: Sequence[Row]) -> str:
    titles = ("model", "garments", "steps", "radius", "fps", "L_total [J]", "gradient norm [N]")
    lines = [" | ".join(titles), " | ".join(["---"] * len(titles))]
    for garment in _groups(rows):
        index, here = _paper_column(garment), _by_model(rows, garment)
        for name, one in PAPER.items():
            figures = (one.fps[index], one.total[index], one.gradient_norm[index])
            paper = (f"{one.title}, paper", ("dress of 12,000 vertices", "all")[index], one.steps, one.radius, *figures)
            lines.append(" | ".join(_number(value) for value in paper))
            if name in here:
                keys = ("model", "garment", "steps", "radius", "fps", "L_total", "gradient_norm")
                lines.append(" | ".join(f"**{_cell(here[name], key)}**" for key in keys))
    return "\n".join(f"| {line} |" for line in lines)


def _check_table(found: Sequence[Check]) -> str:
    words = {True: "yes", False: "**no**", None: "–"}
    lines = ["| | paper | here | as in the paper |", "|---|---|---|---|"]
    lines += [f"| {one.what} | {one.paper} | {one.here} | {words[one.holds]} |" for one in found]
    return "\n".join(lines) + "\n\n≈ stands between two models whose 95% intervals overlap, or are not known."


def _differences(rows: Sequence[Row], about: TableConditions) -> str:
    sizes = ", ".join(f"{name} {count:,}" for name, count in about.vertices.items())
    models = dict.fromkeys((row["model"], row["weights"]) for row in rows)
    budgets = [f"{name}: {_budget(name, weights, about)}" for name, weights in models if weights != "none"]
    return "\n".join(
        (
            f"- Data: {len(about.motions)} motion{'s' * (len(about.motions) > 1)} ({', '.join(about.motions)}) of at most "
            f"{about.num_frames} frames at "
            f"{about.fps:g} per second, {about.num_shapes} body shape(s); the paper trains on 52 captured sequences and shows "
            "other garments, its dress has 12,000 vertices. Vertices here: " + sizes + ".",
            f"- Body: {about.body} with contact against its triangles; the paper's is SMPL with contact against its vertices' "
            "faces by their centres. L_total contains gravity, whose zero is arbitrary: compare its differences, or γ.",
            f"- Hardware: {about.machine}; the paper's frame rates are those of a GPU. Only ratios can be compared.",
            *_networks(rows),
            "- Budget: the paper's models saw 150,000 updates of one scene (about 26 hours on a GPU). "
            + ("; ".join(budgets) + "." if budgets else "No networks here."),
        )
    )


def _networks(rows: Sequence[Row]) -> list[str]:
    """A line on networks that are not the paper's in all."""
    others = dict.fromkeys((row["model"], row["network"]) for row in rows if row.get("as_in_paper") is False)
    if not others:
        return []
    told = "; ".join(f"{name}: {network}" for name, network in others)
    return [f"- Networks: the paper's have latent 128, its features and accelerations as output. Here {told}."]


def _budget(name: str, weights: str, about: TableConditions) -> str:
    if weights == _UNTRAINED:
        return "random weights"
    return about.training.get(name) or "its file does not say"
