"""How far a step is felt in a cloth, how wide its mesh is, and which shipped networks reach as far.

What the page of ``hood plan`` shows besides its table: facts of the mesh, and the cloth with and without parts.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from hood.app.setup import Setup
from hood.app.stepping.cloth_contact import acts, why_not
from hood.assets.files.library import locate, names
from hood.cloth.cloth import Cloth
from hood.model.graph.builder import edge_set_names, parse_schedule, radius
from hood.model.graph.hierarchy import num_passed_over
from hood.steppers.checkpoint import CAUTION, read_header
from hood.steppers.static_shapes.simulator import network_of
from hood.studies.plan.ablation import Begun, Effect
from hood.studies.plan.choices import levels_of
from hood.studies.plan.page import SHOWN, Difference, write_plan_page

#: Nine tenths of what a push does in one step is felt within so many times the way of a wave.
_FELT = 2.9


def reach_facts(cloth: Cloth, dt: float) -> dict[str, Any]:
    """Of a cloth and a step [s]: numbers that say how far a network has to pass messages on, and which shipped ones do.

    ``wave_speed`` [m/s]; ``influence_edges``, 2.9 c dt in mean edges; ``diameter_edges`` of the mesh; ``needed_edges``, the
    smaller of the two; ``models``, of every shipped network its schedule's radius in edges, its coarse levels, and whether
    the radius suffices.
    """
    speed = wave_speed(cloth)
    influence, wide = _FELT * speed * dt / cloth.mean_edge, diameter(cloth)
    needed = min(influence, float(wide))
    return {
        "wave_speed": speed,
        "influence_edges": influence,
        "diameter_edges": wide,
        "needed_edges": needed,
        "models": [one | {"suffices": one["radius"] >= needed} for one in _shipped(cloth.mean_edge)],
    }


def wave_speed(cloth: Cloth) -> float:
    """Speed [m/s] of waves in the plane of the cloth, √((λ + 2 μ) h / ρ), of its mean fabric along the stiffer thread."""
    stiffness = (cloth.lame_lambda + 2.0 * cloth.lame_mu) * cloth.thickness
    if cloth.weave is not None:
        stiffness = stiffness * cloth.weave[:, :2].amax(dim=1)
    density = cloth.mass.sum() / cloth.rest_area.sum()
    return float((torch.as_tensor(stiffness).double().mean() / density.double()).sqrt())


def diameter(cloth: Cloth) -> int:
    """Edges from one end of the mesh to the other, of its widest piece: from the vertex that is farthest from any, the way to
    the farthest. No two vertices are farther apart than twice that."""
    first, second = cloth.edges.cpu().numpy().T
    graph = coo_matrix((np.ones(len(first)), (first, second)), shape=(cloth.num_vertices,) * 2).tocsr()
    widest, left = 0.0, np.ones(cloth.num_vertices, dtype=bool)
    while left.any():
        start = int(np.flatnonzero(left)[0])
        for _ in range(2):
            steps = dijkstra(graph, directed=False, indices=start, unweighted=True)
            there = np.isfinite(steps)
            start = int(np.where(there, steps, -1.0).argmax())
        widest, left = max(widest, float(steps[there].max())), left & ~there
    return int(widest)


def _shipped(edge: float) -> list[dict[str, Any]]:
    """Name, radius in edges and number of coarse levels of every shipped network that no one is warned of, on a mesh of this
    mean edge [m]."""
    found = []
    for name in names("weights"):
        header = read_header(locate("weights", name))
        if CAUTION in header:
            continue
        model = json.loads(header["model"])
        schedule, passed_over = parse_schedule(str(model["schedule"])), num_passed_over(edge, model.get("coarse_edge"))
        found.append({"name": name, "radius": radius(schedule, passed_over), "levels": len(edge_set_names(schedule)) - 1})
    return sorted(found, key=lambda one: (one["radius"], one["name"]))


def reach_sentence(facts: dict[str, Any]) -> str:
    """The evidence in a sentence."""
    enough = [f"{one['name']} ({one['radius']})" for one in facts["models"] if one["suffices"]]
    short = [f"{one['name']} ({one['radius']})" for one in facts["models"] if not one["suffices"]]
    return (
        f"hierarchy: in one step a push is felt {facts['influence_edges']:.0f} edges away (2.9 c dt, c = "
        f"{facts['wave_speed']:.0f} m/s), the mesh is {facts['diameter_edges']} edges wide, so messages have to pass "
        f"{facts['needed_edges']:.0f} edges; schedules that do: {', '.join(enough) or 'none'}; that do not: "
        f"{', '.join(short) or 'none'}"
    )


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
        write_plan_page(path, plan, sentence, shown)
    except ImportError as error:
        write_plan_page(path, plan, sentence, [])
        return f"page in {path}, without pictures: {error}"
    return f"page in {path}"
