"""What ``hood plan`` prints, a table and a paragraph, and its page for people who are no experts: one file, nothing loaded from
elsewhere."""

from __future__ import annotations

import base64
import shlex
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from hood.assets.files.atomic import write_atomically
from hood.media.bars import paragraph, section, table, whole_page
from hood.studies.plan.ablation import Effect
from hood.studies.plan.choices import PartChoice
from hood.studies.plan.decide import PlanVerdict, Tolerance, why_kept
from hood.studies.plan.discretisation import Apart
from hood.studies.plan.parts import Part

_STYLE = (
    "figure img { max-width: 100%; } dt { font-weight: 600; margin-top: .8em; } td { max-width: 34em; white-space: normal; }"
)
#: Pixels of a picture, and how many parts are shown.
_WIDTH, _HEIGHT, SHOWN = 360, 480, 3


@dataclass(frozen=True)
class Difference:
    """The cloth with and without a part at the end of a window: positions (V, 3) and (W, 3) in m, world."""

    part: str
    frame: int
    mm: float
    full: np.ndarray
    without: np.ndarray
    faces: np.ndarray
    body: np.ndarray
    body_faces: np.ndarray


def write_plan_page(path: Path, plan: Mapping[str, Any], sentence: str, differences: Sequence[Difference]) -> None:
    """Write the page of ``plan``, as its file holds it; ``sentence`` says what was decided."""
    plan = {**plan, "sentence": sentence}
    parts = ["<h1>What this scene needs</h1>", f'<p class="lead">{escape(sentence)}</p>']
    parts += [section("Questions", _questions(plan)), section("Every part", _table(plan)), _pictures(differences)]
    where = ", ".join(f"{one['measured_from']} ({one['reason']})" for one in plan["windows"])
    method = (
        f"From frames {where}, {plan['frames']} steps each. In every window the full model and each variant take the same "
        "steps from the same state; other meshes and time steps begin at rest, as a rollout does. γ is the energy that the "
        "first step leaves above the exact one, in units of what it costs to be wrong by 1 g everywhere; mm is the distance "
        "from the full model when the window ends. Parts that are far off, or kept anyway, are looked at in the first window "
        "alone."
    )
    parts.append(section("How it was measured", paragraph(method)))
    write_atomically(path, whole_page("What this scene needs", "".join(parts), _STYLE).encode())


def _table(plan: Mapping[str, Any]) -> str:
    head = (
        "row", "what it is for", "force / weight", "γ without", "mm p50", "mm p95", "ms saved", "decision", "reason", "again"
    )  # fmt: skip
    rows = []
    for row in plan["rows"]:
        saved = "" if row.get("saved") is None else f"{row['saved'] * plan['full']['ms']:.1f} ({100 * row['saved']:.0f}%)"
        numbers = [_short(row.get(key)) for key in ("force", "gamma_p95", "mm_p50", "mm")]
        said = [row["decision"], row["reason"]]
        rows.append([row["part"], row["purpose"], *numbers, saved, *said, f"<code>{escape(row['command'])}</code>"])
    return table(head, rows, raw=len(head) - 1)


def _questions(plan: Mapping[str, Any]) -> str:
    asked = {
        "Why is contact of cloth with cloth on or off?": _contact(plan),
        "What would bending cost?": _of_part(plan, "bending"),
        "Is a finer mesh needed, or is a coarser one enough?": _mesh(plan),
        "Is the time step short enough?": _time_step(plan),
        "How many levels does the network need?": _levels(plan["facts"]),
        "What limits the speed now?": _limit(plan),
        "What was chosen, and how far is it from the full model?": _chosen(plan),
    }
    return "<dl>" + "".join(f"<dt>{escape(key)}</dt><dd>{escape(text)}</dd>" for key, text in asked.items()) + "</dl>"


def _of_part(plan: Mapping[str, Any], name: str) -> str:
    row = next((row for row in plan["rows"] if row["part"] == name), None)
    if row is None:
        return f"This rollout has no {name}, or it was not among the parts that were measured."
    if row.get("saved") is None:
        return f"It is {row['decision']}: {row['reason']}."
    saved = f"{row['saved'] * plan['full']['ms']:.1f} ms of the {plan['full']['ms']:.1f} ms of a frame"
    return f"It is {row['decision']}: {row['reason']}. Without it {saved} would be saved, as measured here."


def _contact(plan: Mapping[str, Any]) -> str:
    reason = plan["facts"]["no_cloth_contact"]
    return _of_part(plan, "cloth contact") if reason is None else f"It is off: {reason}."


def _mesh(plan: Mapping[str, Any]) -> str:
    facts = plan["facts"]
    edge = facts["edge_mm"]
    text = (
        f"The mesh has {facts['vertices']:,} vertices and edges of {edge:.0f} mm. A fold takes about four edges, so it shows "
        f"folds wider than {4 * edge:.0f} mm and none that are narrower; no setting changes that."
    )
    rows = [row for row in plan["rows"] if row.get("kind") == "mesh"]
    for row in rows:
        text += f" {row['part'].removeprefix('mesh ')}: {_apart(row)}."
    measured = {row["part"].removeprefix("mesh ") for row in rows}
    finer = [name for name in facts["finer"] if name not in measured]
    if finer:
        return f"{text} How far it is from {' or '.join(finer)} says hood plan … parts=[mesh {finer[0]}]."
    return text if rows or facts["finer"] else f"{text} Where narrower ones are wanted, hood prepare can refine the garment."


def _apart(row: Mapping[str, Any]) -> str:
    """Of another mesh or time step."""
    if row.get("mm") is None:
        return f"{row['decision']}, it did not stay finite"
    far = f"{_short(row['mm_p50'])} mm from this one in the median and {_short(row['mm'])} mm at the 95th percentile"
    cost = f"{100 * row['saved']:.0f}% less time" if row["saved"] > 0 else f"{1 - row['saved']:.1f} times the time"
    return f"{far} when a window ends, at points that both have, for {cost}; {row['decision']}"


def _time_step(plan: Mapping[str, Any]) -> str:
    rows = [row for row in plan["rows"] if row.get("kind") == "time step"]
    if not rows:
        return "It was not among what was measured; networks know the step of their training alone."
    return " ".join(f"{row['part']}: {_apart(row)}." for row in rows)


def _levels(facts: Mapping[str, Any]) -> str:
    edges, needed = facts["influence_edges"], facts["needed_edges"]
    reach = (
        f"In one step a push on this fabric is felt {edges:.0f} edges away (2.9 c dt, c = {facts['wave_speed']:.0f} m/s the "
        f"speed of waves in it), and the mesh is {facts['diameter_edges']} edges wide"
    )
    if facts["levels"] is None:
        return f"None: no network takes the steps. {reach}; the solver follows that by itself."
    enough = ", ".join(f"{one['name']} ({one['radius']})" for one in facts["models"] if one["suffices"])
    own = next((one for one in facts["models"] if one["name"] == facts["network"]), None)
    used = f"the one used here has {facts['levels']} coarse level(s)"
    if own is not None:
        used += f" and passes {own['radius']}, {'enough' if own['suffices'] else 'what is farther off waits for the next step'}"
    return (
        f"{reach}. So messages have to pass {needed:.0f} edges in a step; every coarse level doubles the way of a pass. "
        f"Shipped networks that reach so far: {enough or 'none'}; {used}."
    )


def _limit(plan: Mapping[str, Any]) -> str:
    kept = [row for row in plan["rows"] if row["decision"] == "kept" and (row.get("saved") or 0.0) > 0.0]
    times = ", ".join(f"{name} {ms:.1f} ms" for name, ms in plan["times"].items())
    parts = f"A frame of the full model is made of {times}."
    if not kept:
        return f"{parts} None of the parts that were measured: what is left is stretching, inertia and the step itself."
    most = max(kept, key=lambda row: row["saved"])
    costs = f"{most['part']} costs most, {100 * most['saved']:.0f}% of a frame"
    return f"{parts} Of what is kept, {costs}, and stays: {most['reason']}."


def _chosen(plan: Mapping[str, Any]) -> str:
    return f"{plan['sentence']} In words: {plan['command']}"


def _pictures(differences: Sequence[Difference]) -> str:
    if not differences:
        return ""
    figures = []
    for one in differences:
        said = f"Without {one.part}: frame {one.frame}, {one.mm:.2g} mm from the full model (left) at the 95th percentile."
        data = base64.b64encode(_png(_beside(one))).decode()
        alt = escape(said, quote=True)
        picture = f'<img alt="{alt}" src="data:image/png;base64,{data}"/>'
        figures.append(f"<figure>{picture}<figcaption>{escape(said)}</figcaption></figure>\n")
    return section("The largest differences", "".join(figures))


def _beside(one: Difference) -> np.ndarray:
    """The full model, and the cloth without the part, by one camera: (H, 2 W, 3) uint8."""
    from hood.media.renderer.render import BODY_COLOR, Camera, RenderMesh, captioned, render_frame

    camera = Camera.framing(np.concatenate([one.full, one.without]), 25.0, 8.0, aspect=_WIDTH / _HEIGHT)
    pictures = []
    for cloth, title in ((one.full, "full model"), (one.without, f"without {one.part}")):
        meshes = [RenderMesh(cloth, one.faces)]
        if len(one.body):
            meshes.insert(0, RenderMesh(one.body, one.body_faces, BODY_COLOR))
        pictures.append(captioned(render_frame(meshes, camera, _WIDTH, _HEIGHT), title))
    return np.concatenate(pictures, axis=1)


def _png(picture: np.ndarray) -> bytes:
    import io

    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(picture).save(stream, format="PNG", optimize=True)
    return stream.getvalue()


def _short(value: float | None) -> str:
    return "" if value is None else f"{value:.2g}"


#: Decisions on what the chosen combination has.
_CHOSEN = ("left out", "taken")


def describe_plan(plan: Mapping[str, Any]) -> str:
    """The table and one paragraph."""
    where = ", ".join(f"{one['measured_from']} ({one['reason']})" for one in plan["windows"])
    lines = [
        f"measured from frames {where}; {plan['frames']} steps each; the full model takes {plan['full']['ms']:.1f} ms of the "
        f"processor a frame, "
        f"γ {short(plan['full']['gamma_p95'])}",
        "",
        f"{'row':<26}{'force/weight':>13}{'γ without':>11}{'p95':>10}{'mm p50':>9}{'p95':>8}{'ms':>8}{'saved':>8}  decision",
    ]
    for row in plan["rows"]:
        numbers = "".join(f"{_cell(row, key):>{width}}" for key, width in _COLUMNS)
        lines.append(f"{row['part']:<26}{numbers}  {row['decision']}: {row['reason']}")
    missed = plan["windows_without_minimum"]
    if missed:
        lines.append(f"γ is a lower bound in {missed} of {len(plan['windows'])} windows: the exact step was not reached there")
    return "\n".join([*lines, "", sentence(plan)])


_COLUMNS = (("force", 13), ("gamma_p50", 11), ("gamma_p95", 10), ("mm_p50", 9), ("mm", 8), ("ms", 8), ("saved", 8))


def _cell(row: Mapping[str, Any], key: str) -> str:
    if key not in row or (key == "force" and row[key] is None):
        return "-"
    if key == "saved":
        return f"{100 * row[key]:.0f}%"
    return f"{row[key]:.1f}" if key == "ms" else short(row[key])


def sentence(plan: Mapping[str, Any]) -> str:
    """What was decided, for someone who does not read tables."""
    needed = [row["part"] for row in plan["rows"] if row["decision"] == "kept" and row["reason"].startswith("without it")]
    if plan.get("combination"):
        return _found(plan) + (f" Not to be spared: {', '.join(needed)}." if needed else "")
    return f"{_left_out(plan)} Needed for this accuracy: {', '.join(needed) or 'nothing else that was looked at'}."


def _left_out(plan: Mapping[str, Any]) -> str:
    """Where parts alone are left out."""
    limit = plan["accuracy"]
    left = [row["part"] for row in plan["rows"] if row["decision"] in _CHOSEN]
    if not left:
        return f"Nothing is left out: no part both saves time and stays within {_asked(limit)}."
    found = plan["together"]
    error = f"{short(found['error'])} mm" if limit["unit"] == "mm" else f"γ = {short(found['error'])} more"
    return (
        f"Left out: {', '.join(left)}. Together this costs {error} where {_asked(limit)} was accepted, and saves "
        f"{100 * found['saved']:.0f}% of a frame ({plan['full']['ms']:.1f} ms before)."
    )


def _found(plan: Mapping[str, Any]) -> str:
    """Where a combination was searched by mm."""
    found, limit, budget = plan["combination"], plan["accuracy"], plan["budget_ms"]
    without = {row["part"] for row in plan["rows"] if row["decision"] == "left out"}
    names = [f"without {name}" if name in without else name for name in found["names"]]
    figures = f"{found['ms']:.1f} ms a frame instead of {found['full_ms']:.1f}, {short(found['mm'])} mm from the full model"
    figures += f" after {plan['frames']} frames (95th percentile; {short(found['mm_p50'])} in the median)"
    whole = " Run against the full model as a whole:" if names else ""
    chosen = f"{', '.join(names)}.{whole} {figures}." if names else f"the full model, {found['ms']:.1f} ms a frame."
    if not found["fits"]:
        return f"Nothing takes {budget:g} ms a frame or less; the nearest is {chosen}"
    if budget is None:
        return f"Chosen as the cheapest within {_asked(limit)} after {plan['frames']} frames: {chosen}"
    text = f"Chosen as the nearest to the full model within {budget:g} ms a frame: {chosen}"
    if limit["unit"] == "mm" and found["mm"] > limit["value"]:
        text += f" This misses {_asked(limit)}, which nothing meets in that time."
    return text


def _asked(limit: Mapping[str, Any]) -> str:
    return f"{limit['value']:g} mm" if limit["unit"] == "mm" else f"γ = {limit['value']:g}"


def plan_command(words: Sequence[str], chosen: Sequence[str]) -> str:
    """``hood rollout`` with the words of the scene and those that were chosen, which stand for earlier ones of the same key."""
    said = {word.partition("=")[0]: word for word in (*words, *chosen)}
    return shlex.join(["hood", "rollout", *said.values(), "output=outputs/mine"])


def short(value: float | None) -> str:
    """Two digits; ``broken`` for what is not finite."""
    return "broken" if value is None else f"{value:.2g}"


#: A part that is worth more than this γ is no simplification: without it accelerations are wrong by 1 g.
BROKEN = 1.0
#: Why what would do is not chosen, where something else is and where the full model is.
_OTHERWISE, _NOTHING = "what is chosen does it better", "no combination that was run as a whole did"
#: Why another mesh or time step is not chosen by γ.
_IN_MM = "another mesh or step has no γ: accuracy=5mm or budget_ms=… decides on it"


def broken(effect: Effect, full: Effect) -> bool:
    """Whether γ rises by more than :data:`BROKEN` over that of the full model."""
    return not Tolerance(BROKEN, "gamma").error(effect, full) <= BROKEN


def of_parts(
    parts: Sequence[Part],
    effects: Mapping[str, Effect],
    stay: Mapping[str, str],
    tolerance: Tolerance,
    names: Collection[str],
) -> dict[str, PlanVerdict]:
    """By part that was measured, where the combination ``names`` was chosen."""
    found, full = {}, effects[""]
    of_mm = tolerance if tolerance.unit == "mm" else Tolerance(float("inf"), "mm")
    for part in parts:
        if part.name not in effects:
            continue
        effect = effects[part.name]
        far = of_mm.say(effect.worst_mm)
        if part.name in names:
            verdict = PlanVerdict("left out", f"without it {far}, {100 * effect.saving(full):.0f}% of a frame saved")
        elif part.name not in stay and broken(effect, full):
            verdict = PlanVerdict("kept", f"without it γ = {Tolerance(BROKEN, 'gamma').error(effect, full):.2g} more")
        else:
            reason = why_kept(part.name, effect, full, of_mm, stay, ())
            verdict = PlanVerdict("kept", reason or f"{far} without it; {_why_else(names)}")
        found[part.name] = with_it(verdict) if part.instead else verdict
    return found


def of_choice(one: PartChoice, apart: Apart, full_ms: float, names: Collection[str] | None) -> PlanVerdict:
    """Of a mesh or time step, where the combination ``names`` was chosen; None where parts alone are decided on, by γ."""
    share = apart.frame_ms(one.pace) / full_ms
    far = f"{max(apart.mm):.2g} mm from what was asked for"
    if one.finer:
        return PlanVerdict("compared", f"finer: {far}, {share:.1f} times the time")
    said = f"{far}, {100 * (1 - share):.0f}% of the time saved"
    if names is None:
        return PlanVerdict("compared", f"{said}; {_IN_MM}")
    return PlanVerdict("taken", said) if one.name in names else PlanVerdict("not taken", f"{said}; {_why_else(names)}")


def _why_else(names: Collection[str]) -> str:
    return _OTHERWISE if names else _NOTHING


def with_it(verdict: PlanVerdict) -> PlanVerdict:
    """Of a way to take the steps, which is there or not."""
    decision = {"left out": "taken", "kept": "not taken"}.get(verdict.decision, verdict.decision)
    return PlanVerdict(decision, verdict.reason.replace("without it", "with it"))
