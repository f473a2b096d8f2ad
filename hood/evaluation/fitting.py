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
from scipy.spatial import cKDTree

from hood.assets.formats.vertex_files import read_points_folder
from hood.mesh.closest_point.search import search_surface
from hood.rollouts.file.reader import RolloutData, read_rollout

Misfit = Callable[[Mapping[str, float]], np.ndarray]

#: Forward differences in the logarithm of an unknown, or in an unknown of a linear scale, and the longest, along an axis of the
#: Gauss-Newton matrix that the data tell little of: what jumps, as contact does, would hide the little.
_STEP, _LONGEST_STEP = 0.01, 0.1
#: Central differences at the minimum.
_LONG_STEP = 0.03
#: Farthest move of an unknown in one step.
_FARTHEST = 1.2
#: Damping at first, its factors after a step that was taken and one that was not, and where the search gives up.
_DAMPING, _EASIER, _HARDER, _MOST_DAMPING = 1e-2, 0.2, 6.0, 1e4
#: The minimum is reached where the Gauss-Newton step is shorter than this many standard deviations, promises or brings no more
#: than this share, or is smaller than the third number: a simulation is not smooth to any digit.
_SHORT, _SHARE, _SMALL = 0.2, 1e-5, 5e-4
#: The share in a search that only finds where another one begins.
_ROUGH_SHARE = 1e-3
#: Half the width of a 95% interval in standard deviations.
_WIDTH = 1.96
#: An unknown is seen where its interval is narrower than by this factor up and down.
SEEN = 2.0
#: The share of points that have their next one within the gap.
_GAP = 0.98
#: Patches of the cloth, and stretches of time: what is off in one goes together. An estimate from so few needs a wider
#: interval, by Student's t of 7 and the factor for a mean that was taken off.
_GROUPS, _FEW = 8, 2.365 / 1.96 * math.sqrt(8 / 7)
#: Steps of differences that bounds have made more alike than this tell no Jacobian.
_MOST_CONDITION = 1e4


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
    groups: np.ndarray | None = None,
) -> Iterator[Minimum]:
    """Steps of the search: the guess, the place after every step, and at last the minimum with its covariance.

    Args:
        residual: (N,) or (N, D) by the values of all unknowns; what is not finite is no place to go to.
        noise: standard deviation of a residual; None: from the residual at hand.
        least_noise: it is no smaller.
        most_steps: the search ends after so many; then the last one has not converged.
        free: directions of a row in which it may be off: fewer than D where the others are 0 by themselves.
        intervals: False: the last one is left out, with its two evaluations an unknown, and the search is rougher.
        groups: (K, N) numbers from 0: rows of the same one are off together, in any of K ways; None: each row by itself.

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
    share = _SHARE if intervals else _ROUGH_SHARE
    return _Search(residual, list(unknowns), (noise, least_noise), free, share, groups).run(most_steps, intervals)


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
        whole: whether points show all of the cloth, so that none lies where there are no points.
        huber: [m] points farther away count by their distance instead of its square (Huber, 1964): they may be no cloth.
    """

    frames: Sequence[np.ndarray]
    points: bool
    whole: bool = False
    huber: float = math.inf

    def apart(self, number: int, cloth: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """(N, 3) m, from what was seen in a frame to the cloth (V, 3): to the vertex, or the nearest point of the surface; of
        ``whole`` frames also from the nearest points to the vertices, as far as that is more than points are apart."""
        seen = self.frames[number]
        if not self.points:
            return (cloth - seen)[np.isfinite(seen).all(axis=1)]
        there, vertices, tri = torch.as_tensor(seen), torch.as_tensor(cloth), torch.as_tensor(faces)
        none = [torch.zeros(len(rows), dtype=torch.int64) for rows in (there, vertices, tri)]
        hit = search_surface(there, none[0], vertices, tri, none[1], none[2])
        rows = ((vertices[tri[hit.face]] * hit.bary.unsqueeze(2)).sum(dim=1) - there).numpy()
        far = np.linalg.norm(rows, axis=1, keepdims=True)
        if math.isfinite(self.huber):  # the square of a row is twice the loss of Huber
            least = np.maximum(far, self.huber)
            rows = rows * np.sqrt(self.huber * (2.0 * least - self.huber)) / least
        return np.concatenate([rows, self._bare(seen, cloth)]) if self.whole else rows

    def _bare(self, seen: np.ndarray, cloth: np.ndarray) -> np.ndarray:
        """(V, 3) m, from the nearest of the points ``seen`` to the ``cloth``, less the largest gap of a point to its next: on
        cloth that is seen evenly, points are no farther from anywhere."""
        tree = cKDTree(seen)
        gap = np.quantile(tree.query(seen, k=2)[0][:, 1], _GAP) if len(seen) > 1 else 0.0
        far, nearest = tree.query(cloth)
        bare: np.ndarray = (cloth - seen[nearest]) * np.maximum(1.0 - gap / np.maximum(far, 1e-12), 0.0)[:, None]
        return bare

    def groups(self, first: int, count: int, vertices: int) -> np.ndarray:
        """(2, N): the patch of the cloth, of eight, and the stretch of time, of eight, that each row of the frames ``first`` to
        ``count`` lies in; rows of the ``vertices`` of ``whole`` frames are in one more patch."""
        begun, parts = self.frames[0], list[np.ndarray]()
        known = begun[np.isfinite(begun).all(axis=1)]
        centres = known[np.linspace(0, len(known) - 1, _GROUPS).astype(int)]
        for number, frame in enumerate(self.frames[first:count]):
            places = frame if self.points else np.where(np.isfinite(begun), begun, frame)
            places = places[np.isfinite(frame).all(axis=1)]
            patch = np.linalg.norm(places[:, None] - centres, axis=2).argmin(axis=1)
            patch = np.append(patch, np.full(vertices if self.whole else 0, _GROUPS))
            parts.append(np.stack([patch, np.full(len(patch), number * _GROUPS // (count - first))]))
        return np.concatenate(parts, axis=1)

    def drawn(self, beside: RolloutData) -> RolloutData:
        """As a rollout in the place of another one; a point is drawn as a triangle of 8 mm."""
        if not self.points:
            return replace(beside, cloth_pos=np.where(np.isnan(self.frames), beside.cloth_pos, self.frames))
        count = max(map(len, self.frames))
        corners = 4e-3 * np.array([[-1.0, -0.6, 0.4], [1.0, -0.6, -0.4], [0.0, 1.1, 0.0]])
        pos = np.stack([(np.resize(seen, (count, 3))[:, None] + corners).reshape(-1, 3) for seen in self.frames])
        return replace(beside, cloth_pos=pos, cloth_faces=np.arange(3 * count).reshape(-1, 3), rest_pos=pos[0], still={})


def observed_frames(given: Any, points: bool, most: int, whole: bool = False, huber: float = math.inf) -> Observed:
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
        if not np.isfinite(frames[number]).all(axis=1).any():
            raise ValueError(f"observed: frame {number} holds no point that is finite; leave out the frames from there on")
    return Observed(frames, points, points and whole, huber)


class _Search:
    def __init__(
        self, residual: Misfit, unknowns: list[Unknown], noise: tuple[float | None, float], free: int, share: float, groups: Any
    ) -> None:
        self._residual, self._unknowns, self._free, self._share, self._groups = residual, unknowns, free, share, groups
        self._noise, self._least = noise
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
        if self._free * self._rows < len(r):  # points: some are of other things, and rows of cloth among points are 0
            far = np.linalg.norm(r.reshape(self._rows, -1), axis=1)
            return float(max(1.4826 * np.median(far[far > 0]) if far.any() else 0.0, self._least) ** 2)
        return max(float(r @ r) / (self._rows * self._free - len(self._unknowns)), self._least**2)

    def _rms(self, r: np.ndarray) -> float:
        return math.sqrt(float(r @ r) / self._rows)

    def _jacobian(self, z: np.ndarray, r: np.ndarray, before: np.ndarray | None) -> np.ndarray:
        """(N, P), along the axes of the Jacobian ``before``, where there was one; along what cannot be measured it is 0, as
        for an unknown that changes nothing."""
        ways = _STEP * np.eye(len(z)) if before is None else self._ways(before, _STEP)
        moved = np.stack([self._within(z, way) for way in ways])
        if np.linalg.cond(moved) > _MOST_CONDITION:  # at bounds
            moved = np.stack([self._within(z, way) for way in _STEP * np.eye(len(z))])
        ends = [self._at(z + way) for way in moved]
        apart = np.stack([end - r if np.isfinite(end).all() else np.zeros_like(r) for end in ends], axis=1)
        jacobian: np.ndarray = apart @ np.linalg.inv(moved.T)
        return jacobian

    @staticmethod
    def _ways(jacobian: np.ndarray, step: float) -> np.ndarray:
        """(P, P): in rows, steps along the axes of the Gauss-Newton matrix, of ``step`` along the best told, longer ones along
        others. What the data do not tell is mostly a direction, as of unknowns that scale together: differences in each
        unknown alone leave their truncation along it."""
        told, axes = np.linalg.eigh(jacobian.T @ jacobian)
        lengths = step * np.sqrt(max(told[-1], 1e-300) / np.maximum(told, 1e-12 * max(told[-1], 1e-300)))
        found: np.ndarray = np.minimum(lengths, max(step, _LONGEST_STEP))[:, None] * axes.T
        return found

    def _within(self, z: np.ndarray, way: np.ndarray) -> np.ndarray:
        """The step ``way`` from ``z`` or its opposite, whichever the bounds shorten less."""
        both = [np.clip(z + sign * way, self._low, self._high) - z for sign in (1.0, -1.0)]
        return max(both, key=lambda one: float(np.abs(one).sum()) + 1e-12 * float(one @ way > 0))

    def _cost(self, z: np.ndarray, r: np.ndarray, variance: float) -> float:
        cost = float(r @ r) / variance + float(self._weight @ (z - self._mean) ** 2)
        return cost if math.isfinite(cost) else math.inf

    def run(self, most_steps: int, intervals: bool) -> Iterator[Minimum]:
        z = np.array([one.place(one.guess) for one in self._unknowns])
        r = self._at(z)
        if not np.isfinite(r).all():
            raise ValueError("the simulation of the guess is not finite; give another guess")
        if self._rows * self._free <= len(z):
            few = f"{self._rows * self._free} observed numbers cannot tell {len(z)} parameters"
            raise ValueError(f"{few}; give more frames, or fit fewer")
        history = [self._rms(r)]
        now = Minimum(self._values(z), history[0], self._evaluations, history=tuple(history))
        yield now
        jacobian: np.ndarray | None = None
        damping, done, told = _DAMPING, False, jacobian
        for _ in range(most_steps):
            jacobian, variance, told = self._jacobian(z, r, jacobian), self._variance(r), None
            step, there, damping, done = self._step(z, r, jacobian, variance, damping)
            if intervals and (done or step is None):
                z, r = (z, r) if step is None else (z + step, there)
                told, step, there = self._along_axes(z, r, jacobian)
                done, damping = step is None, _DAMPING
            if step is not None:
                z, r = z + step, there
            elif told is None:
                break
            history.append(self._rms(r))
            now = replace(now, values=self._values(z), rms=history[-1], evaluations=self._evaluations, history=tuple(history))
            yield now
            if step is None or (done and not intervals):
                break
        if not intervals:
            return
        assert jacobian is not None
        told = self._along_axes(z, r, jacobian)[0] if told is None else told
        covariance = self._covariance(told, r)
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
        little = max(_SHORT**2, self._share * cost)
        done = promised < little or float(np.abs(best).max()) < _SMALL
        while damping < _MOST_DAMPING:
            step = self._damped(matrix, slope, free, damping)
            step *= min(1.0, _FARTHEST / max(float(np.abs(step).max()), 1e-300))
            step = np.clip(z + step, self._low, self._high) - z
            there = self._at(z + step)
            gain = cost - self._cost(z + step, there, variance)
            if gain > 0:
                return step, there, damping * _EASIER, done or gain < little
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

    def _along_axes(self, z: np.ndarray, r: np.ndarray, jacobian: np.ndarray) -> tuple[np.ndarray, Any, np.ndarray]:
        """The Jacobian (N, P) by central differences along the axes of the Gauss-Newton matrix, and a step from there that is
        better, with its residual; None where there is none."""
        variance, better, there, moved, apart = self._variance(r), None, r, list[np.ndarray](), list[np.ndarray]()
        least = self._cost(z, r, variance) - max(_SHORT**2, self._share * self._cost(z, r, variance))
        for way in self._ways(jacobian, _LONG_STEP):
            ends = [np.clip(z + sign * way, self._low, self._high) for sign in (1.0, -1.0)]
            found = [self._at(end) for end in ends]
            for end, after in zip(ends, found, strict=True):
                if self._cost(end, after, variance) < least:
                    least, better, there = self._cost(end, after, variance), end - z, after
            moved.append(ends[0] - ends[1])
            measured = np.isfinite(found[0]).all() and np.isfinite(found[1]).all()
            apart.append(found[0] - found[1] if measured else jacobian @ moved[-1])
        if np.linalg.cond(moved) > _MOST_CONDITION:  # at bounds
            return jacobian, better, there
        return np.stack(apart, axis=1) @ np.linalg.inv(np.transpose(moved)), better, there

    def _covariance(self, jacobian: np.ndarray, r: np.ndarray) -> np.ndarray:
        """(P, P). Wider than by the noise where residuals go together in ``groups``, as those of a model that is not quite that
        of the cloth do (sandwich estimate: White, 1980; of several groupings: Cameron, Gelbach and Miller, 2011)."""
        matrix = jacobian.T @ jacobian / self._variance(r) + np.diag(self._weight)
        covariance: np.ndarray = np.linalg.inv(matrix + 1e-6 * np.eye(len(matrix)))
        if self._groups is None:
            return covariance
        pulls = (r[:, None] * jacobian).reshape(self._rows, -1, len(matrix)).sum(axis=1) @ covariance / self._variance(r)
        sums = [np.stack([np.bincount(rows, pull) for pull in pulls.T]) for rows in self._groups]
        found = np.sum([((_FEW * each) ** 2).sum(axis=1) for each in sums], axis=0)
        wider = np.sqrt(np.maximum(found / np.diag(covariance), 1.0))
        return covariance * np.outer(wider, wider)
