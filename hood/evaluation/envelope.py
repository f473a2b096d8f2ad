"""The stability map: which cells it has, and what a rollout in one of them comes to."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hood.assets.material import Material

SOUND, DEGRADED, FAILED, SILENT, REFUSED = "sound", "degraded and said", "failed and said", "silent", "refused"
#: From best to worst; a refusal of bad input counts with none of them.
CLASSES = (SOUND, DEGRADED, FAILED, SILENT, REFUSED)

#: Standard gravity [m/s²].
_G = 9.81
#: Frames of a rollout, least and most, whatever the time step.
_FRAMES = (20, 300)


@dataclass(frozen=True)
class Cell:
    """One setting of one factor, or of two that interact; everything else is nominal."""

    factor: str
    value: str
    settings: tuple[str, ...] = ()  # keys of ``hood rollout``
    motion: str | None = None  # of hood.assets.extremes; None: the nominal one
    fault: str | None = None  # of the garment, likewise
    fps: float = 30.0
    seconds: float = 2.0
    bad_input: str = ""  # to be refused by a sentence with this word; "": good input

    @property
    def num_frames(self) -> int:
        """Of its rollouts."""
        return int(np.clip(round(self.seconds * self.fps), *_FRAMES))

    @property
    def name(self) -> str:
        """Good for a folder."""
        return re.sub(r"[^A-Za-z0-9.]+", "-", f"{self.factor} {self.value}".replace("×", "x")).strip("-")


@dataclass(frozen=True)
class Criteria:
    """What a sound rollout is."""

    strain: float = 0.25  # 99th percentile in the worst frame, or
    strain_ratio: float = 1.5  # so many times that of the solver, whichever is more
    network_strain: float = 0.05  # difference of a network's to the solver's
    cut_share: float = 0.01  # of the cloth's triangles, in the worst measured frame
    depth: float = 0.01  # m, of a vertex in the body
    converged: float = 0.95  # share of the solver's steps
    climb: float = 0.005  # of the strain per 100 frames at rest


def cells() -> tuple[Cell, ...]:
    """The map: it is fixed, so that no run decides what it is judged by."""
    return tuple(_single()) + tuple(_pairs()) + tuple(_inputs())


def _single() -> Iterator[Cell]:
    """One factor at a time."""
    for fps in (480.0, 240.0, 120.0, 60.0, 15.0, 10.0, 5.0):
        yield Cell("dt", f"1/{fps:g}", (f"fps={fps:g}",), fps=fps)
    for factor in (1e-3, 1e-2, 0.1, 10.0, 100.0, 1e3, 1e4):
        yield Cell("stretching", f"×{factor:g}", _stiffness(factor))
    for factor in (0.0, 1e-2, 1e2, 1e4, 1e6):
        yield Cell("bending", f"×{factor:g}", (f"material.bending_stiffness={_times('bending_stiffness', factor)}",))
    for density in (1e-3, 1e-2, 0.05, 1.0, 5.0, 50.0):
        yield Cell("density", f"{density:g} kg/m²", (f"material.density={density:g}",))
    for g in (0.0, 0.1, 3.0, 10.0):
        yield Cell("gravity", f"{g:g} g", (f"gravity={g * _G:g}",))
    for coefficient in (0.0, 0.1, 1.0, 10.0):
        yield Cell("friction", f"{coefficient:g}", (f"losses.terms.friction.coefficient={coefficient:g}",))
    for speed in (0.5, 2.0, 4.0, 8.0):
        yield Cell("speed", f"×{speed:g}", (_speed(speed),))
    for kind, unit, amounts in (
        ("teleport", "m", (0.1, 0.3, 0.5, 1.0)),
        ("spin", "rev/s", (0.5, 1.0, 2.0, 4.0)),
        ("stop", "g", (1.0, 10.0)),
        ("offset", "m", (1e3, 1e4)),
    ):
        for amount in amounts:
            yield Cell(kind, f"{amount:g} {unit}", motion=f"{kind}:{amount:g}")
    yield Cell("rest", "still", motion="rest", seconds=10.0)
    for size in (0.5, 0.7, 0.85, 1.2, 1.5, 2.0):
        yield Cell("size", f"×{size:g}", fault=f"size:{size:g}")
    for ratio in (1e2, 1e4, 1e6):
        yield Cell("slivers", f"{ratio:g}", fault=f"slivers:{ratio:g}")
    for kind, count in (("duplicates", 20), ("isolated", 10), ("flipped", 30)):
        yield Cell(kind, f"{count}", fault=f"{kind}:{count}")


def _pairs() -> Iterator[Cell]:
    """Factors that interact."""
    for fps in (240.0, 10.0):
        for factor in (0.1, 100.0):
            yield Cell("dt × stretching", f"1/{fps:g} ×{factor:g}", (f"fps={fps:g}", *_stiffness(factor)), fps=fps)
    for density in (0.01, 5.0):
        for factor in (0.1, 100.0):
            settings = (f"material.density={density:g}", *_stiffness(factor))
            yield Cell("density × stretching", f"{density:g} ×{factor:g}", settings)
    for speed in (2.0, 4.0):
        for fps in (10.0, 60.0):
            yield Cell("speed × dt", f"×{speed:g} 1/{fps:g}", (_speed(speed), f"fps={fps:g}"), fps=fps)


def _inputs() -> Iterator[Cell]:
    """Input that cannot be used."""
    yield Cell("input", "motion not finite", motion="nan", bad_input="nan.npz")
    yield Cell("input", "garment not finite", fault="nan", bad_input="nan.npz")
    yield Cell("input", "no time", ("fps=0",), bad_input="fps")
    yield Cell("input", "no mass", ("material.density=0",), bad_input="density")
    yield Cell("input", "stiffness not finite", ("material.lame_mu=.nan",), bad_input="lame_mu")


def _times(name: str, factor: float) -> str:
    return f"{factor * float(getattr(Material(), name)):g}"


def _stiffness(factor: float) -> tuple[str, ...]:
    return tuple(f"material.{name}={_times(name, factor)}" for name in ("lame_mu", "lame_lambda"))


def _speed(factor: float) -> str:
    """The embedded motions are sampled 60 times a second."""
    return f"file_fps={60.0 * factor:g}"


@dataclass(frozen=True)
class Run:
    """How a rollout of a cell ended."""

    exit_code: int
    error: str  # the line that it ended with; empty without
    said: tuple[str, ...] = ()  # warnings and reasons that it is unsound
    metrics: Mapping[str, np.ndarray] | None = None  # (T,) each, and "finite"; None where there is no file


@dataclass(frozen=True)
class Judged:
    """The class of a run, and in sentences why it is no better."""

    kind: str
    reasons: tuple[str, ...]


def judge(cell: Cell, run: Run, solver: Mapping[str, np.ndarray] | None, network: bool, criteria: Criteria) -> Judged:
    """The class of a run.

    Args:
        solver: metrics of what its strain is held against: of the solver in the same cell, for the solver itself those of a
            quarter of the time step; None where there are none.
        network: whether a network alone took the steps.
    """
    if run.exit_code == 2 and run.error:
        refused = bool(cell.bad_input) and cell.bad_input in run.error
        return Judged(REFUSED if refused else FAILED, (run.error,))
    if run.exit_code not in (0, 3) or run.metrics is None:
        return Judged(SILENT, (f"ended with exit code {run.exit_code} and no sentence",))
    finite = run.metrics["finite"]
    if not finite.all():
        reason = f"not finite from frame {int(np.argmin(finite))} on"
        return Judged(FAILED if run.said or run.exit_code else SILENT, (reason,))
    reasons = tuple(_shortcomings(cell, run.metrics, solver, network, criteria))
    if cell.bad_input:
        reasons = (*reasons, "bad input was taken")
    if not reasons:
        return Judged(SOUND, ())
    return Judged(DEGRADED if run.said or run.exit_code else SILENT, reasons)


def _shortcomings(
    cell: Cell, metrics: Mapping[str, np.ndarray], solver: Mapping[str, np.ndarray] | None, network: bool, criteria: Criteria
) -> Iterator[str]:
    strain, reference = _worst(metrics, "strain_p99"), None if solver is None else _worst(solver, "strain_p99")
    limit = max(criteria.strain, criteria.strain_ratio * (reference or 0.0))
    if not strain <= limit:
        yield f"strain p99 {strain:.0%} in the worst frame, beyond {limit:.0%}"
    if network and reference is not None and abs(strain - reference) > criteria.network_strain:
        yield f"strain p99 {strain:.0%}, the solver's is {reference:.0%}"
    for key, most, form, what in (
        ("cut_face_share", criteria.cut_share, ".1%", "of the cloth's triangles cut by the skin"),
        ("penetration_depth", criteria.depth, ".3g", "m deep in the body"),
        ("self_crossings", 0.0, ".0f", "pairs of triangles of the garment through each other"),
        ("garment_crossings", 0.0, ".0f", "pairs of triangles of two garments through each other"),
    ):
        worst = _worst(metrics, key)
        if worst > most and not (network and key.endswith("crossings")):
            yield f"{worst:{form}} {what}"
    converged = metrics.get("solver_converged")
    if converged is not None and np.isfinite(converged).any():
        share = float(np.nanmean(converged))
        if share < criteria.converged:
            yield f"the solver met its target in {share:.0%} of the steps"
    if cell.factor == "rest":
        climb = _climb(metrics["strain_p99"])
        if climb > criteria.climb:
            yield f"strain climbs by {100 * climb:.1f} points per 100 frames at rest"


def _worst(metrics: Mapping[str, np.ndarray], key: str) -> float:
    """The largest finite entry; 0 where nothing was measured."""
    values = metrics.get(key, np.empty(0))
    values = values[np.isfinite(values)]
    return float(values.max()) if len(values) else 0.0


def _climb(strain: np.ndarray) -> float:
    """Slope per 100 frames of the second half, the first may settle."""
    half = strain[len(strain) // 2 :]
    half = half[np.isfinite(half)]
    return 100.0 * float(np.polyfit(np.arange(len(half)), half, 1)[0]) if len(half) > 2 else 0.0


def shares(kinds: Sequence[str]) -> dict[str, float]:
    """Shares of the classes among runs; refusals of bad input, right as they are, are left out."""
    counted = [kind for kind in kinds if kind != REFUSED]
    return {kind: counted.count(kind) / max(len(counted), 1) for kind in CLASSES if kind != REFUSED}


def table(rows: Sequence[Mapping[str, Any]], models: Sequence[str]) -> str:
    """Factor by method: how many cells are sound, and how many are worse."""
    lines = [f"{'':24}" + "".join(f"{model:>22}" for model in models)]
    for factor in dict.fromkeys(row["factor"] for row in rows):
        texts = []
        for model in models:
            kinds = [row["class"] for row in rows if row["factor"] == factor and row["model"] == model]
            worse = [f"{kinds.count(kind)} {kind.split()[0]}" for kind in CLASSES[1:] if kind in kinds]
            texts.append(", ".join([f"{kinds.count(SOUND)}/{len(kinds)}", *worse]) if kinds else "")
        lines.append(f"{factor:24}" + "".join(f"{text:>22}" for text in texts))
    return "\n".join(lines)
