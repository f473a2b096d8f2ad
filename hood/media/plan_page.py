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
from hood.media.page import paragraph, section, table, whole_page

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


def write_page(path: Path, plan: Mapping[str, Any], sentence: str, differences: Sequence[Difference]) -> None:
    """Write the page of ``plan``, as its file holds it; ``sentence`` says what was decided."""
    parts = ["<h1>What this scene needs</h1>", f'<p class="lead">{escape(sentence)}</p>']
    parts += [section("Questions", _questions(plan)), section("Every part", _table(plan)), _pictures(differences)]
    where = ", ".join(f"{one['measured_from']} ({one['reason']})" for one in plan["windows"])
    method = (
        f"From frames {where}, {plan['frames']} steps each. In every window the full model and each variant take the same "
        "steps from the same state. γ is the energy that the first step leaves above the exact one, in units of what it costs "
        "to be wrong by 1 g everywhere; mm is the distance from the full model when the window ends. Parts that are far off, "
        "or kept anyway, are looked at in the first window alone."
    )
    parts.append(section("How it was measured", paragraph(method)))
    write_atomically(path, whole_page("What this scene needs", "".join(parts), _STYLE).encode())


def _table(plan: Mapping[str, Any]) -> str:
    head = ("part", "what it is for", "force / weight", "γ without", "mm", "ms saved", "decision", "reason", "again")
    rows = []
    for row in plan["rows"]:
        saved = "" if row.get("saved") is None else f"{row['saved'] * plan['full']['ms']:.1f} ({100 * row['saved']:.0f}%)"
        numbers = [_short(row.get(key)) for key in ("force", "gamma_p95", "mm")]
        said = [row["decision"], row["reason"]]
        rows.append([row["part"], row["purpose"], *numbers, saved, *said, f"<code>{escape(row['command'])}</code>"])
    return table(head, rows, raw=len(head) - 1)


def _questions(plan: Mapping[str, Any]) -> str:
    asked = {
        "Why is contact of cloth with cloth on or off?": _of_part(plan, "cloth contact"),
        "What would bending cost?": _of_part(plan, "bending"),
        "Is a finer mesh needed?": _mesh(plan["facts"]),
        "How many levels does the network need?": _levels(plan["facts"]),
        "What limits the speed now?": _limit(plan),
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


def _mesh(facts: Mapping[str, Any]) -> str:
    edge = facts["edge_mm"]
    text = (
        f"The mesh has {facts['vertices']:,} vertices and edges of {edge:.0f} mm. A fold takes about four edges, so it shows "
        f"folds wider than {4 * edge:.0f} mm and none that are narrower; no setting changes that."
    )
    finer = facts["finer"]
    if not finer:
        return text + " Where narrower ones are wanted, hood prepare can refine the garment."
    return text + f" Where narrower ones are wanted, take {' or '.join(finer)}, and plan again: hood plan garment={finer[0]}."


def _levels(facts: Mapping[str, Any]) -> str:
    edges = facts["influence_edges"]
    reach = f"In one step a push on this fabric is felt {edges:.0f} edges away (2.9 c dt, c the speed of waves in it)"
    if facts["levels"] is None:
        return f"None: no network takes the steps. {reach}, which the solver follows by itself."
    return (
        f"{reach}. A network without coarse levels passes a message on by one edge in every pass, so it needs as many passes; "
        f"the one used here has {facts['levels']} coarse level(s)."
    )


def _limit(plan: Mapping[str, Any]) -> str:
    kept = [row for row in plan["rows"] if row["decision"] == "kept" and (row.get("saved") or 0.0) > 0.0]
    if not kept:
        return "None of the parts that were measured: what is left is stretching, inertia and the step itself."
    most = max(kept, key=lambda row: row["saved"])
    return f"Of what is kept, {most['part']} costs most, {100 * most['saved']:.0f}% of a frame, and stays: {most['reason']}."


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
    from hood.media.render import BODY_COLOR, Camera, RenderMesh, captioned, render_frame

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
