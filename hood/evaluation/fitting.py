"""Parameters from observations: how far cloth is from what was seen, least squares of few unknowns within bounds and priors,
and what the data tell of each of them.

Levenberg-Marquardt (Nocedal and Wright, "Numerical Optimization", 2006, chapter 10) with a Jacobian by forward differences:
one more evaluation an unknown, whatever an evaluation is. Intervals are those of the Gauss-Newton matrix at the minimum.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from hood.assets.formats.vertex_files import read_points_folder
from hood.mesh.closest_point.search import search_surface
from hood.rollouts.file.reader import RolloutData, read_rollout

Misfit = Callable[[Mapping[str, float]], np.ndarray]

#: Forward differences in the logarithm of an unknown, or in an unknown of a linear scale.
_STEP = 0.01
#: Central differences at the minimum.
_LONG_STEP = 0.03
#: Farthest move of an unknown in one step.
_FARTHEST = 1.2
#: Damping at first, its factors after a step that was taken and one that was not, and where the search gives up.
_DAMPING, _EASIER, _HARDER, _MOST_DAMPING = 1e-2, 0.2, 6.0, 1e6
#: The minimum is reached where the Gauss-Newton step is shorter than this many standard deviations, promises no more than this
#: share, or is smaller than the third number: a simulation is not smooth to any digit.
_SHORT, _SHARE, _SMALL = 0.2, 1e-5, 5e-4
#: Half the width of a 95% interval in standard deviations.
_WIDTH = 1.96
#: An unknown is seen where its interval is narrower than by this factor up and down.
SEEN = 2.0


@dataclass(frozen=True)
class Unknown:
    """What is searched for.

    Args:
        guess: where the search begins, within the bounds.
        lower, upper: bounds.
        log: whether its logarithm is searched; then all are positive.
        prior: what is known of it already and the standard deviation of that, of a logarithmic one as a share.
    """

    name: str
    guess: float
    lower: float
    upper: float
    log: bool = True
    prior: tuple[float, float] | None = None

    def place(self, value: float) -> float:
        """On the scale of the search."""
        return math.log(value) if self.log else value

    def value(self, place: float) -> float:
        """The number at a place on the scale of the search."""
        return float(min(max(math.exp(place) if self.log else place, self.lower), self.upper))


@dataclass(frozen=True)
class Told:
    """An unknown as it was found: its value, the 95% interval, whether the data tell it, and whether it is at a bound."""

    value: float
    low: float
    high: float
    seen: bool
    at_bound: bool


@dataclass(frozen=True)
class Minimum:
    """How far a search is.

    Args:
        values: by name.
        rms: root mean square of the rows of the residual.
        evaluations: so many have been made.
        converged: whether this is a minimum.
        covariance: (P, P) on the scale of the search; None before the end.
        history: rms after every step, the first one at the guess.
    """

    values: dict[str, float]
    rms: float
    evaluations: int
    converged: bool = False
    covariance: np.ndarray | None = None
    history: tuple[float, ...] = ()


def fit_steps(
    residual: Misfit,
    unknowns: Sequence[Unknown],
    noise: float | None,
    least_noise: float,
    most_steps: int,
    free: int = 1,
    intervals: bool = True,
) -> Iterator[Minimum]:
    """Steps of the search: the guess, the place after every step, and at last the minimum with its covariance.

    Args:
        residual: (N,) or (N, D) by the values of all unknowns; what is not finite is no place to go to.
        noise: standard deviation of a residual; None: from the residual at hand.
        least_noise: it is no smaller.
        most_steps: the search ends after so many; then the last one has not converged.
        free: directions of a row in which it may be off: fewer than D where the others are 0 by themselves.
        intervals: False: the last one is left out, with its two evaluations an unknown.

    Raises:
        ValueError: the residual at the guess is not finite, or no longer than there are unknowns.

    Examples:
        >>> import numpy as np
        >>> t = np.linspace(0.0, 1.0, 20)
        >>> unknowns = [Unknown("height", 1.0, 0.1, 10.0), Unknown("rate", 1.0, 0.1, 10.0)]
        >>> seen = 2.0 * np.exp(-3.0 * t)
        >>> *_, last = fit_steps(lambda of: of["height"] * np.exp(-of["rate"] * t) - seen, unknowns, None, 1e-6, 20)
        >>> last.converged, round(last.values["rate"], 3)
        (True, 3.0)
    """
    return _Search(residual, list(unknowns), noise, least_noise, free).run(most_steps, intervals)


def estimates(minimum: Minimum, unknowns: Sequence[Unknown]) -> dict[str, Told]:
    """What a minimum with its covariance says of every unknown."""
    assert minimum.covariance is not None
    found = {}
    for unknown, variance in zip(unknowns, np.diag(minimum.covariance), strict=True):
        value, half = minimum.values[unknown.name], _WIDTH * math.sqrt(variance)
        place = unknown.place(value)
        low, high = _bounded(unknown, place - half), _bounded(unknown, place + half)
        at_bound = min(place - unknown.place(unknown.lower), unknown.place(unknown.upper) - place) < 1e-6
        seen = half < (math.log(SEEN) if unknown.log else max(abs(value), 1.0))
        found[unknown.name] = Told(value, low, high, bool(seen), bool(at_bound))
    return found


def _bounded(unknown: Unknown, place: float) -> float:
    low, high = unknown.place(unknown.lower), unknown.place(unknown.upper)
    return unknown.value(min(max(place, low), high))


def seen_ratios(minimum: Minimum, unknowns: Sequence[Unknown], found: Mapping[str, Told]) -> dict[tuple[str, str], float]:
    """Pairs of logarithmic unknowns of which the data tell only the ratio, with the share to which it is told: each alone is
    not seen."""
    assert minimum.covariance is not None
    cov, ratios = minimum.covariance, {}
    open_ones = [i for i, one in enumerate(unknowns) if one.log and not found[one.name].seen]
    for place, i in enumerate(open_ones):
        for j in open_ones[place + 1 :]:
            half = _WIDTH * math.sqrt(max(cov[i, i] + cov[j, j] - 2.0 * cov[i, j], 0.0))
            if half < 0.5 * math.log(SEEN):
                ratios[unknowns[i].name, unknowns[j].name] = math.expm1(half)
    return ratios


@dataclass(frozen=True)
class Observed:
    """What was seen.

    Args:
        frames: (P, 3) m, each; vertices of the garment, rows of NaN where one was not seen, or with ``points`` any points.
        points: whether they belong to no vertices.
    """

    frames: Sequence[np.ndarray]
    points: bool

    def apart(self, number: int, cloth: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """(N, 3) m, from what was seen in a frame to the cloth (V, 3): to the vertex, or the nearest point of the surface."""
        seen = self.frames[number]
        if not self.points:
            return (cloth - seen)[np.isfinite(seen).all(axis=1)]
        there, vertices, tri = torch.as_tensor(seen), torch.as_tensor(cloth), torch.as_tensor(faces)
        none = [torch.zeros(len(rows), dtype=torch.int64) for rows in (there, vertices, tri)]
        hit = search_surface(there, none[0], vertices, tri, none[1], none[2])
        return ((vertices[tri[hit.face]] * hit.bary.unsqueeze(2)).sum(dim=1) - there).numpy()

    def drawn(self, beside: RolloutData) -> RolloutData:
        """As a rollout in the place of another one; a point is drawn as a triangle of 8 mm."""
        if not self.points:
            return replace(beside, cloth_pos=np.where(np.isnan(self.frames), beside.cloth_pos, self.frames))
        count = max(map(len, self.frames))
        corners = 4e-3 * np.array([[-1.0, -0.6, 0.4], [1.0, -0.6, -0.4], [0.0, 1.1, 0.0]])
        pos = np.stack([(np.resize(seen, (count, 3))[:, None] + corners).reshape(-1, 3) for seen in self.frames])
        return replace(beside, cloth_pos=pos, cloth_faces=np.arange(3 * count).reshape(-1, 3), rest_pos=pos[0], still={})


def observed_frames(given: Any, points: bool, most: int) -> Observed:
    """What was seen, from a file, a folder or arrays; of points at most so many of a frame, evenly picked.

    Raises:
        ValueError: frames that cannot be used; names the first one.
    """
    if isinstance(given, str):
        path = Path(given).expanduser()
        if path.is_dir() and not (path / "rollout.h5").exists():
            found: Any = read_points_folder(path)
        else:
            data = read_rollout(path)
            found = data.cloth_pos[:, : data.cloth_pos.shape[1] - data.riding[0]]
    else:
        found = given
    frames = [np.asarray(frame, dtype=np.float64) for frame in found]
    if not frames:
        raise ValueError("observed: there are no frames")
    for number, frame in enumerate(frames):
        if frame.ndim != 2 or frame.shape[1] != 3 or len(frame) == 0:
            raise ValueError(f"observed: frame {number} has the shape {frame.shape}; give points (P, 3) in metres")
        if points:
            frames[number] = frame = frame[np.isfinite(frame).all(axis=1)]
            frames[number] = frame[:: -(-len(frame) // most)] if len(frame) else frame
        elif len(frame) != len(frames[0]):
            raise ValueError(
                f"observed: frame {number} has {len(frame)} vertices, frame 0 has {len(frames[0])}; give the same mesh "
                "in every frame, or points=true where points belong to no vertices"
            )
        if not np.isfinite(frames[number]).any():
            raise ValueError(f"observed: frame {number} holds no point that is finite; leave out the frames from there on")
    return Observed(frames, points)


class _Search:
    def __init__(self, residual: Misfit, unknowns: list[Unknown], noise: float | None, least: float, free: int) -> None:
        self._residual, self._unknowns, self._noise, self._least, self._free = residual, unknowns, noise, least, free
        self._rows = 0
        self._low = np.array([one.place(one.lower) for one in unknowns])
        self._high = np.array([one.place(one.upper) for one in unknowns])
        self._mean, self._weight = np.zeros(len(unknowns)), np.zeros(len(unknowns))
        for index, one in enumerate(unknowns):
            if one.prior is not None:
                self._mean[index], self._weight[index] = one.place(one.prior[0]), one.prior[1] ** -2
        self._evaluations = 0

    def _values(self, z: np.ndarray) -> dict[str, float]:
        return {one.name: one.value(place) for one, place in zip(self._unknowns, z, strict=True)}

    def _at(self, z: np.ndarray) -> np.ndarray:
        """(N · D,), of a place that cannot be reached NaN."""
        self._evaluations += 1
        found = np.asarray(self._residual(self._values(z)), dtype=np.float64)
        self._rows = self._rows or len(found)
        return found.ravel() if len(found) == self._rows else np.full(1, np.nan)

    def _variance(self, r: np.ndarray) -> float:
        if self._noise is not None:
            return max(self._noise, self._least) ** 2
        return max(float(r @ r) / (self._rows * self._free - len(self._unknowns)), self._least**2)

    def _rms(self, r: np.ndarray) -> float:
        return math.sqrt(float(r @ r) / self._rows)

    def _jacobian(self, z: np.ndarray, r: np.ndarray) -> np.ndarray:
        """(N, P); a column that cannot be measured is 0, as that of an unknown that changes nothing."""
        columns = []
        for index in range(len(z)):
            step = -_STEP if z[index] + _STEP > self._high[index] else _STEP
            there = z.copy()
            there[index] += step
            after = self._at(there)
            columns.append((after - r) / step if np.isfinite(after).all() else np.zeros_like(r))
        return np.stack(columns, axis=1)

    def _cost(self, z: np.ndarray, r: np.ndarray, variance: float) -> float:
        cost = float(r @ r) / variance + float(self._weight @ (z - self._mean) ** 2)
        return cost if math.isfinite(cost) else math.inf

    def run(self, most_steps: int, intervals: bool) -> Iterator[Minimum]:
        z = np.array([one.place(one.guess) for one in self._unknowns])
        r = self._at(z)
        if not np.isfinite(r).all():
            raise ValueError("the simulation of the guess is not finite; give another guess")
        if self._rows * self._free <= len(z):
            told = f"{self._rows * self._free} observed numbers cannot tell {len(z)} parameters"
            raise ValueError(f"{told}; give more frames, or fit fewer")
        history = [self._rms(r)]
        now = Minimum(self._values(z), history[0], self._evaluations, history=tuple(history))
        yield now
        damping, done = _DAMPING, False
        for _ in range(most_steps):
            jacobian, variance = self._jacobian(z, r), self._variance(r)
            step, r_next, damping, done = self._step(z, r, jacobian, variance, damping)
            if step is None:
                break
            z, r = z + step, r_next
            history.append(self._rms(r))
            now = replace(now, values=self._values(z), rms=history[-1], evaluations=self._evaluations, history=tuple(history))
            yield now
            if done:
                break
        if not intervals:
            return
        covariance = self._covariance(self._along_axes(z, jacobian), self._variance(r))
        yield replace(now, evaluations=self._evaluations, converged=done, covariance=covariance)

    def _step(
        self, z: np.ndarray, r: np.ndarray, jacobian: np.ndarray, variance: float, damping: float
    ) -> tuple[np.ndarray | None, np.ndarray, float, bool]:
        """The next step, None where there is none that is better, the residual there, the damping, and whether the minimum is
        reached."""
        matrix = jacobian.T @ jacobian / variance + np.diag(self._weight)
        slope = jacobian.T @ r / variance + self._weight * (z - self._mean)
        cost = self._cost(z, r, variance)
        free = ~(((z <= self._low) & (slope > 0)) | ((z >= self._high) & (slope < 0)))
        if not free.any():
            return None, r, damping, True
        best = self._damped(matrix, slope, free, 1e-9)
        promised = -float(slope @ best) - 0.5 * float(best @ matrix @ best)
        done = promised < max(_SHORT**2, _SHARE * cost) or float(np.abs(best).max()) < _SMALL
        while damping < _MOST_DAMPING:
            step = self._damped(matrix, slope, free, damping)
            step *= min(1.0, _FARTHEST / max(float(np.abs(step).max()), 1e-300))
            step = np.clip(z + step, self._low, self._high) - z
            there = self._at(z + step)
            if self._cost(z + step, there, variance) < cost:
                return step, there, damping * _EASIER, done
            if done:
                return None, r, damping, True
            damping *= _HARDER
        return None, r, damping, False

    @staticmethod
    def _damped(matrix: np.ndarray, slope: np.ndarray, free: np.ndarray, damping: float) -> np.ndarray:
        """A step of Levenberg-Marquardt; what the data do not tell is damped as if they told it to a factor of e."""
        part = matrix[np.ix_(free, free)]
        step = np.zeros(len(slope))
        step[free] = -np.linalg.solve(part + damping * np.diag(np.diag(part) + 1.0), slope[free])
        return step

    def _along_axes(self, z: np.ndarray, jacobian: np.ndarray) -> np.ndarray:
        """The Jacobian (N, P) by central differences along the axes of the Gauss-Newton matrix. What the data do not tell is
        mostly a direction, as of unknowns that scale together: along it nothing changes, while differences in each unknown
        alone leave their truncation."""
        axes = np.linalg.eigh(jacobian.T @ jacobian)[1]
        columns = []
        for axis in axes.T:
            ends = [np.clip(z + sign * _LONG_STEP * axis, self._low, self._high) for sign in (1.0, -1.0)]
            above, below = (self._at(end) for end in ends)
            if not (np.isfinite(above).all() and np.isfinite(below).all()):
                return jacobian
            moved = ends[0] - ends[1]
            # At a bound the ends are not on the axis: what they miss of it is left to the one-sided differences.
            share = float(moved @ axis)
            rest = axis * share - moved
            columns.append((above - below + jacobian @ rest) / share if share > 0 else jacobian @ axis)
        return np.stack(columns, axis=1) @ axes.T

    def _covariance(self, jacobian: np.ndarray, variance: float) -> np.ndarray:
        matrix = jacobian.T @ jacobian / variance + np.diag(self._weight)
        covariance: np.ndarray = np.linalg.inv(matrix + 1e-6 * np.eye(len(matrix)))
        return covariance
