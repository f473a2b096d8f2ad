"""The page of ``hood plan``: what a scene needs, for people who are no experts. One file, nothing loaded from elsewhere."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from hood.assets.files.atomic import write_atomically
from hood.media.bars import paragraph, section, table, whole_page

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
