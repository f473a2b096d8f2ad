"""Whether a rollout can be trusted: one rule, for what makes rollouts and for what reads them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hood.dynamics.recorder import RolloutData
from hood.mesh.topology import unique_edges

#: The first frames may settle; they are judged only where there are no others.
SETTLING = 5
#: Bad frames are suffered up to this share.
TOLERATED = 0.02
#: A frame is bad where the 99th percentile of its edge strain is beyond the first, or the force left unbalanced beyond so
#: many times the weight.
STRAIN_LIMIT, GRADIENT_LIMIT = 0.5, 100.0
#: Runs of frames that a sentence names.
_MOST_RUNS = 4


@dataclass(frozen=True)
class Criteria:
    """What a sound rollout is where there is a reference, as in the stability map: the solver's rollout of the same scene.

    A single rollout has none, and light or soft cloth may stretch far beyond ``strain`` as it should. :func:`judge`
    therefore has the wider limits above.
    """

    strain: float = 0.25  # 99th percentile in the worst frame, or
    strain_ratio: float = 1.5  # so many times that of the solver, whichever is more
    network_strain: float = 0.05  # difference of a network's to the solver's
    cut_share: float = 0.01  # of the cloth's triangles, in the worst measured frame
    depth: float = 0.01  # m, of a vertex in the body
    converged: float = 0.95  # share of the solver's steps
    climb: float = 0.005  # of the strain per 100 frames at rest


@dataclass(frozen=True)
class Verdict:
    """Sound, unsound, or, with None, not known."""

    sound: bool | None
    reasons: tuple[str, ...] = ()  # sentences: why unsound, or what is missing


@dataclass(frozen=True)
class _Cause:
    text: str  # what is so in the frames
    bad: np.ndarray  # (T,) bool
    values: np.ndarray | None = None  # (T,) of which the largest is named
    form: str = ""


def judge_rollout(data: RolloutData) -> Verdict:
    """:func:`judge` for the simulated frames of a rollout that was read back; strain that was not measured is computed from the
    positions, where these are stored."""
    finite = data.step_finite
    metrics = {name: values for name, values in data.step_metrics.items() if values.shape == finite.shape}
    strain = metrics.get("strain_p99")
    if strain is not None or data.steps is None:
        return judge(finite, _strain_p99(data, finite) if strain is None else strain, metrics)
    verdict = judge(finite, np.zeros(len(finite)), metrics)
    if not verdict.sound:
        return verdict
    return Verdict(None, ("the strain of simulated frames that are not stored was not measured; metrics=strain measures it",))


def judge(finite: np.ndarray, strain_p99: np.ndarray, metrics: Mapping[str, np.ndarray]) -> Verdict:
    """The rule.

    Unsound is a rollout with a non-finite frame, or with bad ones among more than 2% of those after the fifth; of five
    frames or fewer, all after the start must be bad. A frame is bad with a strain p99 beyond 50%; where a solver took the
    step, if it missed its target; and where a solver or a refinement took it, with a relative gradient beyond 100. A network
    alone is not held to the latter: its steps are no minima.

    Args:
        finite: (T,) bool, frames whose positions are all finite.
        strain_p99: (T,) 99th percentile of the absolute edge strain.
        metrics: (T,) each. ``solver_converged`` is there for solvers, ``refine_rg`` for refined steps; ``relative_gradient``
            may be. Entries of frame 0, to which no step led, are NaN.
    """
    if len(finite) == 0:
        return Verdict(None, ("it holds no frame",))
    reasons = []
    if not finite.all():
        reasons.append(f"{(~finite).sum()} of {len(finite)} frames are not finite: {name_frames(~finite)}")
    causes = [_strain_cause(finite, strain_p99)]
    converged, gradient = metrics.get("solver_converged"), _gradient(metrics)
    if converged is not None:
        causes.append(_Cause("the solver missed its target", converged == 0))
    if gradient is not None:
        causes.append(_gradient_cause(gradient, "relative_gradient" in metrics))
    judged = _judged(len(finite))
    bad = np.any([cause.bad for cause in causes], axis=0) & judged
    few = len(finite) <= SETTLING
    if bad.sum() > (judged.sum() - 1 if few else TOLERATED * judged.sum()):
        reasons += [_sentence(cause, judged, few) for cause in causes if (cause.bad & judged).any()]
    if reasons:
        return Verdict(False, tuple(reasons))
    return _known(gradient, converged, judged)


def name_frames(chosen: np.ndarray) -> str:
    """Where ``chosen`` (T,) bool holds, in words: ``frames 3, 7–9 and 12``; the first few runs of many."""
    frames = np.flatnonzero(chosen)
    runs = np.split(frames, np.flatnonzero(np.diff(frames) > 1) + 1)
    texts = [f"{run[0]}" if len(run) == 1 else f"{run[0]}–{run[-1]}" for run in runs]
    if len(texts) > _MOST_RUNS:
        texts = [*texts[: _MOST_RUNS - 1], f"{sum(map(len, runs[_MOST_RUNS - 1 :]))} more"]
    text = texts[0] if len(texts) == 1 else ", ".join(texts[:-1]) + f" and {texts[-1]}"
    return ("frame " if len(frames) == 1 else "frames ") + text


def worst_frame(values: np.ndarray) -> tuple[float, int] | None:
    """The largest finite entry of ``values`` (T,) and its frame; None where there is none."""
    known = np.where(np.isfinite(values), values, -np.inf)
    if len(values) == 0 or not np.isfinite(known).any():
        return None
    frame = int(known.argmax())
    return float(values[frame]), frame


def _judged(count: int) -> np.ndarray:
    """(T,) bool: the frames after the fifth; of few all after the start, or the start alone."""
    first = SETTLING if count > SETTLING else min(1, count - 1)
    return np.arange(count) >= first


def _strain_cause(finite: np.ndarray, strain: np.ndarray) -> _Cause:
    # Not finite is said of the frame itself.
    return _Cause(f"strain p99 is beyond {STRAIN_LIMIT:.0%}", finite & ~(strain <= STRAIN_LIMIT), strain, ".0%")


def _gradient(metrics: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """(T,) relative gradient where steps are held to it, NaN where it was not computed; None for a network alone."""
    reached = metrics.get("refine_rg")
    if reached is None and "solver_converged" not in metrics:
        return None
    measured = metrics.get("relative_gradient")
    if measured is not None:
        return measured
    return np.full_like(metrics["solver_converged"], np.nan) if reached is None else reached


def _gradient_cause(gradient: np.ndarray, measured: bool) -> _Cause:
    """``measured``: NaN is a gradient that is not finite, except at frame 0, and not one that nobody computed."""
    bad = gradient > GRADIENT_LIMIT
    if measured:
        bad = bad | (np.isnan(gradient) & (np.arange(len(gradient)) > 0))
    return _Cause(f"the relative gradient is beyond {GRADIENT_LIMIT:g}", bad, gradient, ".3g")


def _known(gradient: np.ndarray | None, converged: np.ndarray | None, judged: np.ndarray) -> Verdict:
    """Sound, unless too little is known of the relative gradient for that: a step that met its target has a small one."""
    if gradient is None:
        return Verdict(True)
    unknown = judged & ~np.isfinite(gradient) & (np.arange(len(judged)) > 0)
    if converged is not None:
        unknown &= ~(converged == 1)
    if unknown.sum() <= TOLERATED * judged.sum():
        return Verdict(True)
    return Verdict(
        None,
        (f"the relative gradient of {name_frames(unknown)} was not measured, so it cannot be judged; metrics=all measures it",),
    )


def _sentence(cause: _Cause, judged: np.ndarray, few: bool) -> str:
    which = cause.bad & judged
    worst = None if cause.values is None else worst_frame(np.where(which, cause.values, np.nan))
    among = "frames" if few else "frames after the fifth"
    text = f"{cause.text} in {which.sum()} of {judged.sum()} {among}: {name_frames(which)}"
    return text if worst is None else f"{text}, worst {format(worst[0], cause.form)} in frame {worst[1]}"


def _strain_p99(data: RolloutData, finite: np.ndarray) -> np.ndarray:
    """(T,) 99th percentile of the absolute edge strain, NaN in frames that are not finite."""
    faces = data.cloth_faces[: len(data.cloth_faces) - data.riding[1]] if data.refined is None else data.refined.faces
    start, end = unique_edges(faces.astype(np.int64)).T
    strain = np.full(len(finite), np.nan)
    if len(start) == 0:
        return np.where(finite, 0.0, strain)
    rest = np.linalg.norm(data.rest_pos[end].astype(np.float64) - data.rest_pos[start], axis=1)
    for frame in np.flatnonzero(finite):
        pos = data.cloth_pos[frame].astype(np.float64)
        length = np.linalg.norm(pos[end] - pos[start], axis=1)
        strain[frame] = np.quantile(np.abs(length / rest - 1.0), 0.99)
    return strain
