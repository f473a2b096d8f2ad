"""What a rollout's file says about the cloth's surface: skin through cloth and cloth through cloth, in numbers and in words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from hood.limits import CUT_UNSOUND

#: A frame with a larger share of cut triangles is warned about.
WORST_CUT = CUT_UNSOUND.value


def summarise_surface(metrics: Mapping[str, np.ndarray], stride: int | None) -> dict[str, Any] | None:
    """Means and worst frames of :data:`hood.dynamics.surface.SURFACE_METRICS` by frame (T,); None where none was measured."""
    share = metrics.get("cut_face_share", np.empty(0))
    measured = int(np.isfinite(share).sum())
    if measured == 0:
        return None
    folds = metrics.get("cut_in_folds")  # older files have none
    apart = {} if folds is None else {"cut_apart_from_folds": _mean_and_worst(share - folds)}
    return {
        "stride": stride,
        "frames_measured": measured,
        "cut_face_share": _mean_and_worst(share),
        **apart,
        "cut_edge_share": _mean_and_worst(metrics["cut_edge_share"]),
        "skin_depth_m": _mean_and_worst(metrics["skin_depth"]),
        "self_crossings": _mean_and_worst(metrics["self_crossings"]),
        "garment_crossings": _mean_and_worst(metrics["garment_crossings"]),
    }


def describe_surface(surface: Mapping[str, Any] | None) -> list[str]:
    """A line on what was found, none where nothing was measured, and a warning for each thing that pictures show."""
    if surface is None:
        return []
    cut, depth, stride = surface["cut_face_share"], surface["skin_depth_m"], surface["stride"]
    every = "" if stride is None else " (every frame)" if stride == 1 else f" (one frame in {stride}, first and last)"
    crossed = [
        f"{surface[key]['mean']:.1f} pairs of triangles of {what} pass through each other on average"
        for key, what in (("self_crossings", "one garment"), ("garment_crossings", "two garments"))
        if surface[key]["worst"] > 0
    ]
    found = [
        f"the body cuts {cut['mean']:.1%} of the cloth's triangles on average, {cut['worst']:.1%} in frame {cut['frame']}"
        + _apart_from_folds(surface),
        f"skin at most {1e3 * depth['worst']:.1f} mm above the cloth",
        *crossed,
    ]
    return [f"surface{every}: {', '.join(found)}", *surface_warnings(surface)]


def _apart_from_folds(surface: Mapping[str, Any]) -> str:
    """What is left without the triangles that are caught where the body passes through itself; empty without such."""
    rest = surface.get("cut_apart_from_folds")
    if rest is None or rest["mean"] == surface["cut_face_share"]["mean"]:
        return ""
    return f" ({rest['mean']:.2%} and {rest['worst']:.2%} apart from where the body passes through itself)"


def cut_at_worst(surface: Mapping[str, Any] | None) -> str:
    """The worst frame in a few words, for a line among many."""
    return "skin through cloth n/a" if surface is None else f"skin cuts {surface['cut_face_share']['worst']:.1%} at worst"


def surface_warnings(surface: Mapping[str, Any]) -> list[str]:
    cut, lines = surface["cut_face_share"], []
    if cut["worst"] > WORST_CUT:
        lines.append(
            f"warning: the body's skin cuts {cut['worst']:.1%} of the cloth's triangles in frame {cut['frame']}; "
            "pictures show it"
        )
    for key, what in (("self_crossings", "the cloth"), ("garment_crossings", "two garments")):
        worst = surface[key]
        if worst["worst"] > 0:
            lines.append(
                f"warning: {worst['worst']:.0f} pairs of triangles of {what} pass through each other in frame {worst['frame']}"
            )
    return lines


def _mean_and_worst(values: np.ndarray) -> dict[str, Any]:
    """Over the measured ones of the frames; the first of equally bad frames is named."""
    worst = int(np.nanargmax(values))
    return {"mean": float(np.nanmean(values)), "worst": float(values[worst]), "frame": worst}
