"""Curves of a rollout of the stability map as a small drawing inside a page."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from html import escape

import numpy as np

from hood.evaluation.envelope import Criteria
from hood.limits import CUT_UNSOUND

#: Pixels of a panel, of the gap between two and around them, and points of a curve at most.
_WIDTH, _HEIGHT, _GAP, _EDGE, _POINTS = 320, 120, 56, 30, 120
_OWN, _SOLVER, _LIMIT = "#2a6fbb", "#888888", "#d1544a"


@dataclass(frozen=True)
class Curve:
    """By frame, NaN where it was not measured."""

    strain_p99: np.ndarray  # (T,)
    cut_face_share: np.ndarray  # (T,)


def curve_svg(curve: Curve, solver: Curve | None, name: str, criteria: Criteria) -> str:
    """Strain p99 and cut share over the rollout, those of the solver behind them, and the limits of a sound one.

    Frames are spread over the width, so that rollouts of one motion at different time steps lie on each other.
    """
    panels = (
        ("strain p99", "strain_p99", criteria.strain),
        ("share of triangles cut by the skin", "cut_face_share", CUT_UNSOUND.value),
    )
    width, height = 2 * _WIDTH + _GAP + 2 * _EDGE, _HEIGHT + 2 * _EDGE
    parts = []
    for place, (title, key, limit) in enumerate(panels):
        others = None if solver is None else getattr(solver, key)
        content = "".join(_panel(getattr(curve, key), others, limit, title))
        parts.append(f'<g transform="translate({_EDGE + place * (_WIDTH + _GAP) + 10},{_EDGE})">{content}</g>')
    label = escape(f"Strain p99 and cut share by frame, {name} in blue, the solver in grey, limits in red", quote=True)
    return (
        f'<svg role="img" aria-label="{label}" viewBox="0 0 {width} {height}" xmlns="http://www.w3.org/2000/svg" '
        f'font-family="sans-serif" font-size="11">{"".join(parts)}</svg>'
    )


def _panel(values: np.ndarray, solver: np.ndarray | None, limit: float, title: str) -> Iterator[str]:
    tables = [table for table in (values, solver) if table is not None]
    highest = max([limit, *(float(table[np.isfinite(table)].max()) for table in tables if np.isfinite(table).any())])
    top = 1.1 * highest
    yield f'<text x="0" y="-8" fill="#222">{title}</text>'
    yield f'<path d="M0,0 V{_HEIGHT} H{_WIDTH}" fill="none" stroke="#999"/>'
    for share in {limit, highest}:
        y = _HEIGHT * (1.0 - share / top)
        yield f'<text x="-4" y="{y + 4:.1f}" text-anchor="end" fill="#555">{100 * share:.3g}%</text>'
    y = _HEIGHT * (1.0 - limit / top)
    yield f'<path d="M0,{y:.1f} H{_WIDTH}" stroke="{_LIMIT}" stroke-dasharray="3 3"/>'
    if solver is not None:
        yield _line(solver, top, _SOLVER)
    yield _line(values, top, _OWN)
    yield f'<text x="{_WIDTH}" y="{_HEIGHT + 14}" text-anchor="end" fill="#555">{len(values)} frames</text>'


def _line(values: np.ndarray, top: float, colour: str) -> str:
    """Of long rollouts the largest value of every stretch, so that no peak is lost."""
    known = np.where(np.isfinite(values), values, -np.inf)
    parts = np.array_split(np.arange(len(known)), min(len(known), _POINTS))
    peaks = [int(part[known[part].argmax()]) for part in parts]
    scale = _WIDTH / max(len(known) - 1, 1)
    points = (f"{scale * at:.1f},{_HEIGHT * (1.0 - known[at] / top):.1f}" for at in peaks if np.isfinite(known[at]))
    return f'<polyline points="{" ".join(points)}" fill="none" stroke="{colour}" stroke-width="1.6"/>'
