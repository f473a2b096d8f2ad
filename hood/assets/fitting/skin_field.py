"""How closely points lie around a skin, for searches that ask thousands of times.

Symbols: N points of a garment, d signed distance to the skin [m], n the skin's outward direction there.

The misfit of a place is the mean of e² / (e² + σ²) (Geman and McClure), 0 to 1, with e = d − c. What hangs rests on skin that
faces up and hangs off skin that faces down: the clearance wanted is c = c₀ (1 − k n_up). An e below zero counts ``_TIGHT``
times. Loose parts are far beyond σ and say little; what lies close decides. Cuts differ: the sides of the embedded tank and
dress are 6 to 8 mm off the skin, those of the T-shirt and the trousers 13. So a place is settled with c₀ free but drawn to that
of a usual cut, the more the less lies close; where the size is asked for, c₀ is free. These constants are those that put the
embedded garments back where they came from, on bodies of seven shapes with arms at any angle.

Whether a garment in its place would lie around the body more closely if it were larger or smaller by up to a tenth.

Of a size only the shape of the gap to the skin tells: a wider cut has more room everywhere, a larger unit the more room the
farther it is from the middle. So the clearance is fitted along with the place at every factor. Measured on the embedded
garments over seven bodies the least misfit lies within 1.4% of the true size for tank, dress, shorts and trousers. Tops with
sleeves seem 1 to 5% too large, for they have more room over the chest: they get a range, no other size. Where the misfit is
flat, or where nothing lies close (skirts), the shape says nothing and the size stays.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import fft
from scipy.spatial import cKDTree

_CLEARANCE, _HANG = 0.0085, 0.45  # m, share
_USUAL_CUT, _DRAWN = 0.006, 0.6  # m, and the share of the points that the usual cut counts as
_CUTS = (0.004, 0.03)  # m, least and greatest c₀ of tight and of wide cuts
_TIGHT = 5.0
_SLEEVE_CLEARANCE, _SLEEVE_WIDTH = 0.015, 0.045  # m
#: Width σ [m] of the misfit; searches start wider.
WIDTH = 0.015
#: Voxel [m] of the search over all translations, room around the body, and width σ there.
_VOXEL, _ROOM, _WIDE = 0.05, 0.15, 0.06
#: Signed distance below which a voxel counts as inside the body [m], and what a point there costs.
_DEEP, _DEEP_COST = -0.01, 1.0
#: Nearer than this [m] the tangent plane of a sample is the skin.
_PLANE = 0.04


class _Measured(NamedTuple):
    """Signed distances to a skin and its outward directions."""

    dist: np.ndarray  # (N,) m, negative inside
    normal: np.ndarray  # (N, 3)
    sample: np.ndarray  # (N,) the nearest sample of the skin


class Skin:
    """A closed surface (W, 3) [m] of ``faces`` (G, 3), sampled at its vertices and the centres of its faces."""

    def __init__(self, surface: np.ndarray, faces: np.ndarray) -> None:
        corners = surface[faces]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal = np.zeros_like(surface)
        for k in range(3):
            np.add.at(normal, faces[:, k], cross)
        used = np.unique(faces)
        self.points = np.concatenate([surface[used], corners.mean(axis=1)])
        self.normals = _unit(np.concatenate([normal[used], cross]))
        self.surface, self.faces = surface, faces
        self._tree = cKDTree(self.points, leafsize=32, balanced_tree=False, compact_nodes=False)

    def measure(self, points: np.ndarray) -> _Measured:
        """Signed distances of ``points`` (N, 3), to a millimetre or two near the skin."""
        far, index = self._tree.query(points, workers=1)
        offset = points - self.points[index]
        along = (offset * self.normals[index]).sum(axis=1)
        near = far < _PLANE
        sign = np.where(along < 0, -1.0, 1.0)
        normal = np.where(near[:, None], self.normals[index], sign[:, None] * offset / np.maximum(far, 1e-9)[:, None])
        return _Measured(np.where(near, along, sign * far), normal, index)


def misfit(measured: _Measured, width: float = WIDTH, clearance: float = _CLEARANCE) -> float:
    """Mean cost of the points, 0: all of them at the clearance of worn cloth, 1: none near it or all inside."""
    return float(_cost(_error(measured, clearance), width).mean())


def sleeve_misfit(measured: _Measured) -> float:
    """The misfit of points on the arms: sleeves are wider than trunks, and turned with what they hang on."""
    return float(_cost(_tightened(measured.dist - _SLEEVE_CLEARANCE), _SLEEVE_WIDTH).mean())


def settle_field(points: np.ndarray, skin: Skin, width: float, rounds: int) -> np.ndarray:
    """Translation (3,) [m] of ``points`` that lowers their misfit for the cut that they seem to have.

    By reweighted Gauss–Newton steps.
    """
    offset, clearance = np.zeros(3), _USUAL_CUT
    for _ in range(rounds):
        step = _step(skin.measure(points + offset), width, clearance, drawn=_DRAWN)
        offset, clearance = offset + step[:3], float(np.clip(clearance + step[3], *_CUTS))
        if float(np.abs(step).max()) < 1e-4:
            break
    return offset


class _Cut(NamedTuple):
    """Where points fit best for the clearance that suits them best."""

    offset: np.ndarray  # (3,) m
    clearance: float  # m, c₀
    misfit: float


def settle_cut(points: np.ndarray, skin: Skin, start: _Cut | None, rounds: int) -> _Cut:
    """Translation of ``points`` and clearance, together, that lower their misfit at width ``WIDTH``, from ``start`` on."""
    offset, clearance = (np.zeros(3), _CLEARANCE) if start is None else (start.offset, start.clearance)
    for _ in range(rounds):
        step = _step(skin.measure(points + offset), WIDTH, clearance)
        offset, clearance = offset + step[:3], float(np.clip(clearance + step[3], *_CUTS))
        if float(np.abs(step).max()) < 1e-4:
            break
    return _Cut(offset, clearance, misfit(skin.measure(points + offset), WIDTH, clearance))


def _step(measured: _Measured, width: float, clearance: float, drawn: float = 0.0) -> np.ndarray:
    """A reweighted Gauss–Newton step (4,) [m] of the translation and the clearance, which is ``drawn`` to the usual cut."""
    error = _error(measured, clearance)
    slope = np.where(error < 0, _TIGHT, 1.0)
    weight = (width**2 / (error**2 + width**2)) ** 2 * slope**2
    rows = np.concatenate([measured.normal, -_hang(measured)[:, None]], axis=1)
    pull = rows * weight[:, None]
    matrix, slant = pull.T @ rows, pull.T @ (error / slope)
    matrix[3, 3] += drawn * len(error)
    slant[3] += drawn * len(error) * (clearance - _USUAL_CUT)
    damped = matrix + 1e-3 * (np.trace(matrix) + 1e-9) * np.eye(4)
    step = -np.linalg.solve(damped, slant)
    return np.asarray(step * min(1.0, 2 * width / max(float(np.linalg.norm(step)), 1e-12)))


class SkinField:
    """Closeness to a skin on a grid, correlated with a garment's points: the best of all translations at once."""

    def __init__(self, skin: Skin) -> None:
        self.low = skin.surface.min(axis=0) - _ROOM
        size = np.ceil((np.ptp(skin.surface, axis=0) + 2 * _ROOM) / _VOXEL).astype(int)
        axes = [self.low[k] + _VOXEL * (np.arange(size[k]) + 0.5) for k in range(3)]
        measured = skin.measure(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3))
        close = 1.0 - _cost(_error(measured), _WIDE)
        self.values = np.where(measured.dist < _DEEP, -_DEEP_COST, close).reshape(size).astype(np.float32)
        self._spectra: dict[tuple[int, ...], np.ndarray] = {}

    def peaks(self, points: np.ndarray, count: int) -> list[tuple[float, np.ndarray]]:
        """The ``count`` best translations (3,) [m] of ``points`` (N, 3), at least three voxels apart, best first."""
        start = points.min(axis=0)
        cells = np.floor((points - start) / _VOXEL).astype(int)
        shape = tuple(fft.next_fast_len(int(n), real=True) for n in np.array(self.values.shape) + cells.max(axis=0))
        histogram = np.zeros(shape, dtype=np.float32)
        np.add.at(histogram, tuple(cells.T), np.float32(1.0 / len(points)))
        if shape not in self._spectra:
            self._spectra[shape] = fft.rfftn(self.values, shape)
        score = fft.irfftn(self._spectra[shape] * fft.rfftn(histogram).conj(), shape)
        found = []
        for _ in range(count):
            best = np.unravel_index(int(score.argmax()), shape)
            value = float(score[best])
            index = np.array([i - n if i >= m else i for i, n, m in zip(best, shape, self.values.shape, strict=True)])
            found.append((value, self.low + _VOXEL * index - start))
            around = tuple(np.arange(i - 2, i + 3) % n for i, n in zip(best, shape, strict=True))
            score[np.ix_(*around)] = -np.inf
        return found


def _error(measured: _Measured, clearance: float = _CLEARANCE) -> np.ndarray:
    return _tightened(measured.dist - clearance * _hang(measured))


def _hang(measured: _Measured) -> np.ndarray:
    """(N,) shares of c₀ that are wanted: what hangs rests on skin that faces up, and hangs off skin that faces down."""
    return np.asarray(1 - _HANG * measured.normal[:, 1])


def _tightened(error: np.ndarray) -> np.ndarray:
    return np.where(error < 0, _TIGHT * error, error)


def _cost(error: np.ndarray, width: float) -> np.ndarray:
    return np.asarray(error**2 / (error**2 + width**2))


def _unit(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30))


#: Factors tried, in steps from 1 outward; the least misfit must lie inside of them.
_STEP, _NUM_STEPS = 0.02, 6
_ROUNDS_FIRST, _ROUNDS = 20, 8
#: Sizes whose misfit is at most this share of what lies close (one less the least misfit) above the least fit about alike:
#: loose parts are as far off in every size. Another size is proposed only beyond that, at least this far from the file's own
#: (a cut may well be 5% wider), and where the garment lies as close as this somewhere.
_ALIKE, _LEAST_CHANGE, _CLOSE = 0.03, 0.06, 0.65


@dataclass(frozen=True)
class Size:
    """What the shape of a garment says about its size."""

    factor: float  # by which it lies closest; 1 where it says nothing
    offset: np.ndarray  # (3,) m, added to the garment scaled by ``factor`` about the middle of its points
    misfit: float  # at ``factor``, with the clearance that suits it best
    gain: float  # misfit at its own size less that
    alike: tuple[float, float] | None  # factors that fit about alike, from the least to the greatest; None: it says nothing

    @property
    def clear(self) -> bool:
        """Whether ``factor`` explains the garment clearly better than 1."""
        return self.alike is not None and self.gain > _ALIKE * (1.0 - self.misfit) and abs(self.factor - 1.0) >= _LEAST_CHANGE

    def of(self, scaled: float, own: Size) -> Size:
        """The same as said of the garment before it was ``scaled``, where it lay with the misfit of ``own``."""
        alike = None if self.alike is None else (scaled * self.alike[0], scaled * self.alike[1])
        gain = own.misfit + own.gain - self.misfit
        return replace(self, factor=scaled * self.factor, gain=gain, alike=alike)


def find_size(points: np.ndarray, skin: Skin) -> Size:
    """The size of a garment that lies with its ``points`` (N, 3) [m] around ``skin``. Invariant to their order."""
    middle = points.mean(axis=0)
    factors = 1.0 + _STEP * np.arange(-_NUM_STEPS, _NUM_STEPS + 1)
    own = settle_cut(points, skin, None, _ROUNDS_FIRST)
    cuts: dict[int, _Cut] = {_NUM_STEPS: own}
    for direction in (1, -1):
        cut = own
        for row in range(_NUM_STEPS + direction, _NUM_STEPS + direction * (_NUM_STEPS + 1), direction):
            cut = settle_cut(middle + factors[row] * (points - middle), skin, cut, _ROUNDS)
            cuts[row] = cut
    misfits = np.array([cuts[row].misfit for row in range(len(factors))])
    best = int(misfits.argmin())
    if best in (0, len(factors) - 1) or misfits[best] > _CLOSE:
        return Size(1.0, own.offset, own.misfit, 0.0, None)
    factor = float(factors[best] + _STEP * _least(*misfits[best - 1 : best + 2]))
    cut = settle_cut(middle + factor * (points - middle), skin, cuts[best], _ROUNDS)
    alike = factors[misfits <= misfits[best] + _ALIKE * (1.0 - misfits[best])]
    return Size(factor, cut.offset, cut.misfit, own.misfit - cut.misfit, (float(alike[0]), float(alike[-1])))


def _least(before: float, here: float, after: float) -> float:
    """Where the parabola through three values at −1, 0 and 1, the middle one the least, is least."""
    return 0.5 * (before - after) / max(before - 2.0 * here + after, 1e-12)
