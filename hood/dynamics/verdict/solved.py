"""How far the steps of a rollout ended from their minima: by the distance where it was measured, else by the force."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hood.dynamics.verdict.cause import Cause, Found
from hood.limits import DISTANCE_UNSOUND, GRADIENT_UNSOUND, TOLERATED

#: The metric of :mod:`hood.dynamics.verdict.distance`.
DISTANCE = "distance_p99"
#: Single steps beyond the limit are mended by the next ones: so often they are beyond it, or so far, where they count.
_OFTEN, _FAR = 0.25, 2.0


def solved_causes(metrics: Mapping[str, np.ndarray], dt: float) -> Found:
    """Bad steps of ``dt`` [s], of every stepper by the distance [m] where it was measured: more than one step, and one in four,
    beyond the limit, or one beyond twice as much. Elsewhere a solver is held to its target and, as a
    refinement, to the relative gradient; a network alone to nothing: its steps are no minima, and the force says little."""
    distance = metrics.get(DISTANCE)
    if distance is not None and np.isfinite(distance).any():
        limit, measured, way = DISTANCE_UNSOUND.value * dt, np.isfinite(distance), np.nan_to_num(distance)
        often = (way > limit).sum() > max(_OFTEN * measured.sum(), 1)
        bad = way > (limit if often else _FAR * limit)
        text = f"steps ended more than {1e3 * limit:.2g} mm from their minimum (p99 over the vertices)"
        return Found([Cause("distance", text, bad, distance, limit, "m", ".0f", 1e3, " mm", measured)])
    found, converged, gradient = [], metrics.get("solver_converged"), _gradient(metrics)
    if converged is not None:
        found.append(Cause("solver_target", "the solver missed its target", converged == 0))
    if gradient is not None:
        found.append(_gradient_cause(gradient, "relative_gradient" in metrics))
    return Found(found)


def unknown_steps(metrics: Mapping[str, np.ndarray], judged: np.ndarray) -> np.ndarray | None:
    """(S,) bool: steps of which too little is known for a verdict, where these are too many; None where they are not.

    A step that met its solver's target has a small gradient.
    """
    distance, gradient = metrics.get(DISTANCE), _gradient(metrics)
    if gradient is None or (distance is not None and np.isfinite(distance).any()):
        return None
    unknown = judged & ~np.isfinite(gradient) & (np.arange(len(judged)) > 0)
    if metrics.get("solver_converged") is not None:
        unknown &= ~(metrics["solver_converged"] == 1)
    return unknown if unknown.sum() > TOLERATED.value * judged.sum() else None


def _gradient(metrics: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """(S,) relative gradient where steps are held to it, NaN where it was not computed; None for a network alone."""
    reached = metrics.get("refine_rg")
    if reached is None and "solver_converged" not in metrics:
        return None
    measured = metrics.get("relative_gradient")
    if measured is not None:
        return measured
    return np.full_like(metrics["solver_converged"], np.nan) if reached is None else reached


def _gradient_cause(gradient: np.ndarray, measured: bool) -> Cause:
    """``measured``: NaN is a gradient that is not finite, except at frame 0, and not one that nobody computed."""
    bad = gradient > GRADIENT_UNSOUND.value
    if measured:
        bad = bad | (np.isnan(gradient) & (np.arange(len(gradient)) > 0))
    text = f"the relative gradient is beyond {GRADIENT_UNSOUND.value:g}"
    return Cause("gradient", text, bad, gradient, GRADIENT_UNSOUND.value, GRADIENT_UNSOUND.unit)
