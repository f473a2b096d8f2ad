"""Sewing patterns of our own, drawn for tests, in the form of a GarmentCode ``specification.json``; centimetres."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

Points = list[list[float]]
Curves = dict[int, Any]


def panel(
    points: Points,
    curves: Curves | None = None,
    translation: tuple[float, float, float] = (0, 0, 0),
    turn: tuple[float, float, float] = (0, 0, 0),
    back: bool = False,
    labels: dict[int, str] | None = None,
) -> dict[str, Any]:
    """A panel with the outline ``points``; edge k goes from point k to the next one. ``back``: the same points, clockwise, so
    that edge k is that of the front, the other way round; it comes in place ``len(points) - 1 - k``."""
    count = len(points)
    edges: list[dict[str, Any]] = []
    for k in range(count):
        edge: dict[str, Any] = {"endpoints": [k, (k + 1) % count]}
        if curves and k in curves:
            edge["curvature"] = curves[k]
        if labels and k in labels:
            edge["label"] = labels[k]
        edges.append(edge)
    if back:
        edges = [_reversed(edge) for edge in reversed(edges)]
    return {"vertices": points, "edges": edges, "translation": list(translation), "rotation": list(turn)}


def _reversed(edge: dict[str, Any]) -> dict[str, Any]:
    turned = edge | {"endpoints": edge["endpoints"][::-1]}
    curve = edge.get("curvature")
    if isinstance(curve, list):
        turned["curvature"] = [1.0 - curve[0], -curve[1]]
    elif curve is not None and curve["type"] == "circle":
        radius, large, right = curve["params"]
        turned["curvature"] = {"type": "circle", "params": [radius, large, 1 - right]}
    elif curve is not None:
        turned["curvature"] = {"type": curve["type"], "params": [[1.0 - x, -y] for x, y in reversed(curve["params"])]}
    return turned


def specification(panels: dict[str, Any], stitches: list[Any], units: float = 100) -> dict[str, Any]:
    """The whole file; stitches as (panel, edge, panel, edge)."""
    pairs = [[{"panel": a, "edge": i}, {"panel": b, "edge": j}] for a, i, b, j in stitches]
    properties = {"units_in_meter": units, "curvature_coords": "relative", "normalized_edge_loops": True}
    return {"pattern": {"panels": panels, "stitches": pairs}, "parameters": {}, "parameter_order": [], "properties": properties}


def both_sides(count: int, edges: list[int]) -> list[tuple[str, int, str, int]]:
    """Stitches of ``front`` to ``back`` along the same edges."""
    return [("front", k, "back", count - 1 - k) for k in edges]


def skirt(waist: float = 80, hem: float = 132, length: float = 50, top: float = 107) -> dict[str, Any]:
    """A tube skirt of two panels."""
    half, low = waist / 4, hem / 4
    points: Points = [[-low, 0], [low, 0], [half, length], [-half, length]]
    curves: Curves = {1: [0.6, -0.06], 3: [0.4, -0.06]}
    names = {2: "lower_interface"}
    front = panel(points, curves, (0, top - length, 20), labels=names)
    back = panel(points, curves, (0, top - length, -16), back=True, labels=names)
    return specification({"front": front, "back": back}, both_sides(4, [1, 3]))


def _body(half: float, neck: float, hem: float) -> tuple[Points, Curves]:
    points: Points = [
        [-half - 1, hem], [half + 1, hem], [half, 130], [20.5, 144], [10.5, 148], [-10.5, 148], [-20.5, 144], [-half, 130],
    ]  # fmt: skip
    armhole = {"type": "cubic", "params": [[0.35, 0.2], [0.7, 0.12]]}
    other = {"type": "cubic", "params": [[0.3, 0.12], [0.65, 0.2]]}
    return points, {2: armhole, 4: [0.5, neck], 6: other}


def tshirt(half: float = 27, sleeve: float = 18, hem: float = 88) -> dict[str, Any]:
    """A T-shirt: front, back, and two panels a sleeve."""
    front, curves = _body(half, 0.9, hem)
    panels = {
        "front": panel(front, curves, (0, 0, 20)),
        "back": panel(front, curves | {4: {"type": "circle", "params": [17.0, 0, 0]}}, (0, 0, -16), back=True),
    }
    stitches = both_sides(8, [1, 3, 5, 7])
    for side, sign in (("left", 1.0), ("right", -1.0)):
        cap: Points = [[2, -9], [sleeve, -9], [sleeve, 9], [-3.5, 8]]
        shape = cap if sign > 0 else [[-x, y] for x, y in reversed(cap)]
        at = (sign * 25, 136)
        panels[f"{side}_sleeve_front"] = panel(shape, None, (*at, 15), (0, 0, -45 * sign))
        panels[f"{side}_sleeve_back"] = panel(shape, None, (*at, -15), (0, 0, -45 * sign), back=True)
        # Edges of a left sleeve: below, end, above, cap; those of the right one are mirrored.
        below, above, seam = (0, 2, 3) if sign > 0 else (2, 0, 3)
        for k in (below, above):
            stitches.append((f"{side}_sleeve_front", k, f"{side}_sleeve_back", 3 - k))
        armhole = 2 if sign > 0 else 6
        stitches += [("front", armhole, f"{side}_sleeve_front", seam), ("back", 7 - armhole, f"{side}_sleeve_back", 3 - seam)]
    return specification(panels, stitches)


def bodice(half: float = 28) -> dict[str, Any]:
    """A sleeveless bodice with two darts in the waist, front and back."""
    points, curves = _body(half, 0.8, 105)
    waist: Points = [
        [-half + 3, 105], [-12, 105], [-10.5, 120], [-9, 105], [9, 105], [10.5, 120], [12, 105], [half - 3, 105],
    ]  # fmt: skip
    points, shift = waist + points[2:], 6
    curves = {k + shift: curve for k, curve in curves.items()}
    panels = {"front": panel(points, curves, (0, 0, 20)), "back": panel(points, curves, (0, 0, -16), back=True)}
    count = len(points)
    darts = [("front", 1, "front", 2), ("front", 4, "front", 5)]
    darts += [("back", count - 1 - a, "back", count - 1 - b) for a, b in ((1, 2), (4, 5))]
    return specification(panels, both_sides(count, [7, 9, 11, 13]) + darts)


def trousers(waist: float = 84, hip: float = 104, hem: float = 44) -> dict[str, Any]:
    """Trousers of four panels."""
    panels, stitches = {}, []
    for side, sign in (("left", 1.0), ("right", -1.0)):
        for face, crotch, z in (("front", 4.0, 20), ("back", 7.0, -16)):
            points: Points = [
                [3, 12], [3 + hem / 2, 12], [hip / 4, 86], [waist / 4, 104], [0, 104], [0, 86], [-crotch, 76],
            ]  # fmt: skip
            curves: Curves = {5: [0.35, -0.2]}
            if sign < 0:
                points = [[-x, y] for x, y in reversed(points)]
                curves = {0: [0.65, -0.2]}
            back, names = face == "back", {3 if sign > 0 else 2: "lower_interface"}
            panels[f"{side}_{face}"] = panel(points, curves, (4 * sign, 0, z), back=back, labels=names) | {"label": "leg"}
        # Edges of a left panel: hem, outer seam (2), waist, centre (2), inner seam; mirrored in a right one.
        own = (lambda k: k) if sign > 0 else (lambda k: (5 - k) % 7)
        for k in (1, 2, 6):
            stitches.append((f"{side}_front", own(k), f"{side}_back", 6 - own(k)))
    for face, turned in (("front", False), ("back", True)):
        for k in (4, 5):
            other = (5 - k) % 7
            edges = (6 - k, 6 - other) if turned else (k, other)
            stitches.append((f"left_{face}", edges[0], f"right_{face}", edges[1]))
    return specification(panels, stitches)


#: Every pattern by name.
PATTERNS = {"skirt": skirt, "tshirt": tshirt, "bodice": bodice, "trousers": trousers}


def write(path: Path, content: dict[str, Any]) -> Path:
    """The file, written."""
    path.write_text(json.dumps(content))
    return path
