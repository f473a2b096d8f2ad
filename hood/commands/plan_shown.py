"""What the page of ``hood plan`` shows besides its table: facts of the mesh, and the cloth with and without parts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hood.commands.cloth_contact import acts, why_not
from hood.commands.plan_choices import levels_of
from hood.commands.plan_reach import reach_facts
from hood.commands.setup import Setup
from hood.dynamics.captured import network_of
from hood.evaluation.leaving_out import Begun, Effect
from hood.media.plan_page import SHOWN, Difference, write_page


def facts(ready: Setup) -> dict[str, Any]:
    """Of the mesh, its fabric and the network: numbers that say what they can show."""
    cloth, network, garment = ready.scene.cloth, network_of(ready.stepper), str(ready.config.garment)
    levels = list(levels_of(garment))
    return {
        "vertices": cloth.num_vertices,
        "edge_mm": 1e3 * cloth.mean_edge,
        **reach_facts(cloth, ready.scene.dt),
        "network": None if network is None else str(ready.config.checkpoint),
        "levels": None if network is None else network.num_coarse,
        "no_cloth_contact": _why_no_contact(ready),
        "finer": levels[levels.index(garment) + 1 :] if levels else [],
    }


def _why_no_contact(ready: Setup) -> str | None:
    """Why layers of cloth are not kept apart in this rollout; None where they are."""
    if acts(ready.config):
        return None
    return why_not(ready.config) or "cloth_contact=off was asked for"


def differences(ready: Setup, begun: Sequence[Begun], effects: Mapping[str, Effect], frames: int) -> list[Difference]:
    """The largest ones of all parts, each in its worst window."""
    found, scene = [], ready.scene
    for name, effect in effects.items():
        finite = [mm if np.isfinite(mm) else -1.0 for mm in effect.mm]
        worst = int(np.argmax(finite))
        if not name or finite[worst] <= 0.0:
            continue
        frame = begun[worst].frame + frames
        origin = np.asarray(scene.motion.translation[frame], dtype=np.float64)
        body = scene.motion.surface(frame, origin).cpu().double().numpy() + origin
        full, without = (one.last[worst].numpy() for one in (effects[""], effect))
        surfaces = full, without, scene.garment.faces, body, scene.motion.faces
        found.append(Difference(name, frame, finite[worst], *surfaces))
    return sorted(found, key=lambda one: -one.mm)[:SHOWN]


def show(path: Path, plan: Mapping[str, Any], sentence: str, shown: Sequence[Difference]) -> str:
    """Write the page; a line on it. Without the picture libraries it has no pictures."""
    try:
        write_page(path, plan, sentence, shown)
    except ImportError as error:
        write_page(path, plan, sentence, [])
        return f"page in {path}, without pictures: {error}"
    return f"page in {path}"
