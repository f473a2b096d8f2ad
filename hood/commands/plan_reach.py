"""How far a step is felt in a cloth, how wide its mesh is, and which shipped networks reach as far."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from hood.assets.files.library import locate, names
from hood.dynamics.checkpoint import read_header
from hood.graph.hierarchy import num_passed_over
from hood.nn.schedule import edge_set_names, parse_schedule, radius
from hood.scene.cloth import Cloth

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
    """Name, radius in edges and number of coarse levels of every shipped network, on a mesh of this mean edge [m]."""
    found = []
    for name in names("weights"):
        model = json.loads(read_header(locate("weights", name))["model"])
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
