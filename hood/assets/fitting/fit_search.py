"""Where an unbound garment belongs: units, up axis, facing, place and arm angle of its body, searched together.

Every combination of unit, up axis and quarter turn is tried at all translations at once around a few poses (correlation with a
:class:`~hood.assets.fitting.skin_field.SkinField`); the best are settled by reweighted least squares, then over the angle of
the arms. The winner is named only if it is close, surrounds the body, and no different placement is about as close.
Deterministic.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import product
from typing import NamedTuple

import numpy as np

from hood.assets.fitting.placement import UPWARD, Placement, Surrounding, find_scale, possible, size_ratio, surrounds, used
from hood.assets.fitting.skin_field import WIDTH, Size, Skin, SkinField, find_size, misfit, settle_field, sleeve_misfit
from hood.assets.fitting.suspicions import lies_in_place

#: Angles [degrees] of the arms around which all translations are tried, the steps of the finer search, and the greatest.
ARM_ANGLES = (0.0, 30.0, 60.0)
_ANGLE_STEPS, _LOWEST = ((15.0, 7.5), (5.0, 2.5)), 80.0
#: What another arm angle than that of the T-pose must gain in the misfit of the sleeves, and the least that is told from it.
_ANGLE_GAIN, _LEAST_ANGLE = 0.03, 7.5
#: A garment with this share of its samples within this distance [m] of the upper arms has sleeves. Upper arms are the skin that
#: moves so far [m] when the arms are lowered by so many degrees: no shoulders, and no hands, which hang beside skirts.
_SLEEVES, _SLEEVE_REACH = 0.03, 0.1
_UPPER_ARM, _LOWERED = (0.05, 0.22), 45.0
#: Arms halfway down [degrees]: without sleeves nothing tells their angle, but shoulders sink by 1 cm as arms are lowered.
_HALFWAY = 30.0
#: Samples of the garment: for the search, for the decision, and for the size.
_FEW, _MANY, _MOST = 200, 600, 1200
#: Peaks of one orientation and pose; candidates that are settled, of usual size for each unit and of other size; those whose
#: angle is searched, beside the best of each unit.
_PEAKS, _USUAL, _ODD, _REFINED = 4, 20, 3, 4
#: A garment that is too small passes through the body where it belongs: it is looked for larger as well, in so many places.
_LARGER, _LARGER_PLACES = 1.09, 2
#: A garment that lies so close in its place, for the clearance of its cut, or is there of its own size as far as its shape
#: tells, is looked for nowhere else; nor is one that lies around the body where its file has it.
_SURE, _OWN_SIZE = 0.25, 0.03
#: A coordinate of the offset smaller than this [m] is within the accuracy of the search: it stays 0.
_ACCURACY = 0.01
#: A file that is at most this much worse as it is, stays as it is.
_STAY = 0.02
#: A file that lies around the body leaves its place only for one where it fits as closely as this: a loose garment fits about
#: alike in many places, a cape before the face too.
CLOSE = 0.4
#: Beyond this misfit a garment fits nowhere; a different placement within this margin makes the answer ambiguous.
_LIMIT, _MARGIN = 0.78, 0.015
#: Placements whose points lie nearer than this [m] are the same one.
_SAME = 0.03
#: Garments of fewer body heights, or whose middle is farther from the body's [m, horizontally], count only where no other
#: answer fits: a shirt of a quarter of its size fits a hand.
_SMALL, _ASIDE = 0.3, 0.15


@dataclass(frozen=True)
class AskedFit:
    """What the user fixed; None: to be found."""

    scale: float | None = None
    up: str | None = None
    turn: float | None = None
    offset: np.ndarray | None = None


class Resized(NamedTuple):
    """The placement of a garment in another size, which explains it clearly better than its own."""

    factor: float  # times its own size
    placement: Placement  # ``scale`` is unit times factor
    gain: float  # of the misfit, both at the clearance that suits them best


class FoundFit(NamedTuple):
    """The answer of a search."""

    placement: Placement
    misfit: float  # 0 to 1, see hood.assets.fitting.skin_field
    margin: float  # by how much the best different placement is worse
    refusal: str | None = None  # why the placement is not to be trusted
    sizes: tuple[float, float] | None = None  # factors that fit about alike; None: its shape says nothing, or scale was given
    resized: Resized | None = None  # never taken unasked: a looser cut is no larger unit
    worn: bool = False  # it lies around the body where its file has it, and stays there


_NOWHERE = Placement(1.0, "y", 0.0, np.zeros(3))


class Wearer:
    """A body in its T-pose and with lowered arms, posed and sampled when first asked for.

    Args:
        surface_at: surface (W, 3) [m] with the arms so many degrees below the T-pose's.
        faces: (G, 3).
        angles: where the search over the angle starts; one angle for a body in one pose.
    """

    def __init__(
        self, surface_at: Callable[[float], np.ndarray], faces: np.ndarray, angles: tuple[float, ...] = ARM_ANGLES
    ) -> None:
        self.faces, self.angles = faces, angles
        self.skin = lru_cache(maxsize=None)(lambda angle: Skin(surface_at(angle), faces))
        self.field = lru_cache(maxsize=None)(lambda angle: SkinField(self.skin(angle)))

    @cached_property
    def upper_arms(self) -> np.ndarray:
        """(M,) bool: samples of the skin."""
        return np.asarray((_UPPER_ARM[0] < self._lowered) & (self._lowered < _UPPER_ARM[1]))

    @cached_property
    def arms(self) -> np.ndarray:
        """(M,) bool: samples of the skin; none of a body in one pose."""
        return np.asarray(self._lowered > _UPPER_ARM[0])

    @cached_property
    def _lowered(self) -> np.ndarray:
        """(M,) m: how far each sample moves when the arms are lowered."""
        if len(self.angles) == 1:
            return np.zeros(len(self.skin(self.angles[0]).points))
        return np.asarray(np.linalg.norm(self.skin(_LOWERED).points - self.skin(0.0).points, axis=1))


def find_placement(pos: np.ndarray, faces: np.ndarray, wearer: Wearer, asked: AskedFit | None = None) -> FoundFit:
    """The placement of the garment ``pos`` (V, 3), in units of its file, with ``faces`` (F, 3), on ``wearer``.

    A file that fits as it is, stays as it is. So does one that lies around the body, unless it fits closely elsewhere; with
    its unit alone asked for, it stays there in any case. Where no answer can be trusted, ``refusal`` says why.
    """
    search = _Search(pos, faces, wearer, asked or AskedFit())
    if len(search.many) == 0:
        return FoundFit(_NOWHERE, 1.0, 0.0, "no face has an area; nothing is left of the garment")
    if not search.scales:
        what = f"it is {search.ratio:.3g} times the body's height, which fits no unit; give scale=FACTOR, metres per unit"
        return FoundFit(_NOWHERE, 1.0, 0.0, what)
    candidates = _distinct([search.settled(start) for start in search.starts()], search.many)
    bests = [next((c for c in candidates if c.placement.scale == scale), None) for scale in search.scales]
    chosen = [c for i, c in enumerate(candidates) if i < _REFINED or any(c is best for best in bests)]
    candidates = [search.with_angle(candidate) for candidate in chosen]
    ranked = _distinct([search.polished(candidate) for candidate in candidates], search.many)
    ranked = _distinct([*ranked, *search.turned(ranked[0])], search.many)
    return search.with_size(search.decided(ranked, search.as_it_is(ranked[0])), ranked)


class _Candidate(NamedTuple):
    odd: bool  # by its size or its side
    misfit: float
    placement: Placement
    sleeved: bool = True  # as far as is known


@dataclass
class _Search:
    """One garment, one wearer, one question."""

    pos: np.ndarray
    faces: np.ndarray
    wearer: Wearer
    asked: AskedFit

    def __post_init__(self) -> None:
        self.few, self.many, self.most = (_samples(self.pos, self.faces, count) for count in (_FEW, _MANY, _MOST))
        self.body = self.wearer.skin(self.wearer.angles[0]).surface
        self.ratio = size_ratio(used(self.pos, self.faces), self.body)
        usable = possible(used(self.pos, self.faces), self.body)
        self.scales = usable if self.asked.scale is None else [self.asked.scale]

    def starts(self) -> list[Placement]:
        """The best placements by correlation, those of usual size first."""
        ups = list(UPWARD) if self.asked.up is None else [self.asked.up]
        turns = [0.0, 90.0, 180.0, 270.0] if self.asked.turn is None else [self.asked.turn]
        found = []
        for scale, up, turn, angle in product(self.scales, ups, turns, self.wearer.angles):
            start = Placement(scale, up, turn, np.zeros(3), angle)
            found += [(value, replace(start, offset=offset)) for value, offset in self._places(start)]
        found.sort(key=lambda item: -item[0])
        usual = []
        for scale in self.scales:  # small garments fit in more places, and would leave the others none
            usual += [placement for _, placement in found if placement.scale == scale and not self._odd(placement)][:_USUAL]
        odd = [placement for _, placement in found if self._odd(placement)]
        return usual + odd[:_ODD]

    def settled(self, start: Placement) -> _Candidate:
        """``start`` moved to where it fits best."""
        return self._judged(self._moved(start, self.few, (4 * WIDTH, 2 * WIDTH, WIDTH), 6))

    def with_angle(self, start: _Candidate) -> _Candidate:
        """``start`` with the arm angle that its sleeves fit best; T-pose without sleeves, or where it fits about as well."""
        if len(self.wearer.angles) == 1:
            return start
        placement = start.placement
        sleeves = self._on_arms(placement)
        if sleeves.mean() < _SLEEVES:
            return self._judged(self._at_angle(placement, 0.0))._replace(sleeved=False)
        for steps in _ANGLE_STEPS:  # what is near the arms is chosen again where they are known better
            placement = self._best_angle(placement, sleeves, steps)
            again = self._on_arms(placement)
            sleeves = again if again.any() else sleeves
        return self._judged(placement)

    def _best_angle(self, start: Placement, sleeves: np.ndarray, steps: tuple[float, ...]) -> Placement:
        tried: dict[float, tuple[float, Placement]] = {}

        def attempt(angle: float) -> tuple[float, float]:
            if angle not in tried:
                placement = self._at_angle(start, angle)
                measured = self.wearer.skin(angle).measure(placement.apply(self.many[sleeves]))
                tried[angle] = sleeve_misfit(measured), placement
            return tried[angle][0], angle

        best = attempt(start.angle)
        for step in steps:
            around = (best[1] - step, best[1] + step)
            best = min([best, *(attempt(angle) for angle in around if 0.0 <= angle <= _LOWEST)])
        straight = attempt(0.0)
        lowered = best[0] < straight[0] - _ANGLE_GAIN and best[1] >= _LEAST_ANGLE
        return tried[best[1] if lowered else 0.0][1]

    def _at_angle(self, start: Placement, angle: float) -> Placement:
        return self._moved(replace(start, angle=angle), self.few, (2 * WIDTH, WIDTH), 4)

    def _on_arms(self, placement: Placement) -> np.ndarray:
        """(N,) bool: samples of the garment whose nearest skin is that of the upper arms, and not far."""
        measured = self.wearer.skin(placement.angle).measure(placement.apply(self.many))
        return np.asarray(self.wearer.upper_arms[measured.sample] & (np.abs(measured.dist) < _SLEEVE_REACH))

    def polished(self, start: _Candidate) -> _Candidate:
        """``start`` by all samples, without sleeves around arms halfway down; coordinates within the accuracy are 0."""
        angle = start.placement.angle
        around = start.placement if start.sleeved else replace(start.placement, angle=_HALFWAY)
        placement = replace(self._moved(around, self.many, (WIDTH,), 12), angle=angle)
        if self.asked.offset is None:
            placement = replace(placement, offset=np.where(np.abs(placement.offset) < _ACCURACY, 0.0, placement.offset))
        return self._judged(placement)

    def turned(self, best: _Candidate) -> list[_Candidate]:
        """``best`` turned about the middle of the garment to its other sides: one that is round has no front."""
        if self.asked.turn is not None or self.asked.offset is not None:
            return []
        middle, found = best.placement.apply(self.many).mean(axis=0), []
        for quarter in (90.0, 180.0, 270.0):
            start = replace(best.placement, turn=(best.placement.turn + quarter) % 360.0)
            start = replace(start, offset=start.offset + middle - start.apply(self.many).mean(axis=0))
            found.append(self.polished(best._replace(placement=self._at_angle(start, start.angle))))
        return found

    def as_it_is(self, best: _Candidate) -> _Candidate | None:
        """The garment as its file has it, but for what is asked; None where it cannot be in metres. One that is larger than
        usual can where it lies around the body.

        The angle of its arms is looked for from the T-pose, and from that of ``best`` where that is close.
        """
        asked = self.asked
        usual = asked.scale is not None or 1.0 in self.scales
        if not usual and find_scale(used(self.pos, self.faces), self.body) != 1.0:
            return None
        offset = np.zeros(3) if asked.offset is None else asked.offset
        start = Placement(asked.scale or 1.0, asked.up or "y", asked.turn or 0.0, offset, self.wearer.angles[0])
        search = _Search(self.pos, self.faces, self.wearer, AskedFit(start.scale, start.up, start.turn, offset))
        stay = search.with_angle(search._judged(start))
        if best.misfit <= CLOSE and best.placement.angle != stay.placement.angle:
            stay = min(stay, search._judged(replace(start, angle=best.placement.angle)), key=lambda c: c.misfit)
        return stay if usual or self._worn(stay) else None

    def decided(self, ranked: list[_Candidate], stay: _Candidate | None) -> FoundFit:
        """The best candidate, or the file as it is; and whether that can be trusted."""
        best = ranked[0]
        if stay is not None and _same(stay, best, self.many, 10 * _SAME) and stay.misfit <= best.misfit + _STAY:
            best = stay
        rivals = [c for c in ranked[1:] if c.odd <= best.odd and not _same(c, best, self.many, _SAME)]
        rival = min(rivals, key=lambda c: c.misfit, default=None)
        found = FoundFit(best.placement, best.misfit, 1.0 - best.misfit if rival is None else rival.misfit - best.misfit)
        refusal = self._doubt(best, rival, best is stay) or self._too_small(best, ranked)
        if stay is not None and (best is stay or refusal is not None or self._may_stay(best)) and self._worn(stay):
            margin = found.margin if best is stay else 0.0
            return FoundFit(stay.placement, stay.misfit, margin, worn=True)
        return found._replace(refusal=refusal)

    def _may_stay(self, best: _Candidate) -> bool:
        """Whether a garment that lies around the body stays there, though it fits better at ``best``: that is not close, or
        the unit of the file is all that is asked for."""
        asked = self.asked
        unit_alone = asked.scale is not None and asked.up is None and asked.turn is None and asked.offset is None
        return unit_alone or best.misfit > CLOSE

    def with_size(self, found: FoundFit, ranked: list[_Candidate]) -> FoundFit:
        """``found`` with the sizes that fit, and the place in another size where that explains the garment clearly better."""
        if self.asked.scale is not None:
            return found
        ambiguous = found.refusal is not None and found.margin < _MARGIN
        here = best = self._judged(found.placement)
        own = size = self._size(best, self.many)
        own_size = size.alike is not None and abs(size.factor - 1.0) <= _OWN_SIZE
        sure = not ambiguous and (found.worn or own_size or size.misfit <= _SURE)
        others = [] if sure else [*ranked, *self._larger()]
        others = [c for c in others if c.odd <= here.odd and not _same(c, here, self.many, _SAME)]
        sizes = [(c, self._size(c, self.many)) for c in others]
        for other, other_size in sizes:
            if other_size.alike is not None and other_size.misfit < size.misfit - _MARGIN * (best is here):
                best, size = other, other_size
        if ambiguous and self._rivalled(best, size, sizes):
            return found
        own, size = self._size(here, self.most), self._size(best, self.most)
        found = found._replace(sizes=size.alike)
        if best is not here:
            unit = min(self.scales, key=lambda scale: abs(np.log(scale / best.placement.scale)))
            size = size.of(best.placement.scale / unit, own)
            refusal = f"it fits more closely elsewhere, at {size.factor:.3g} times its size"
            found = found._replace(refusal=refusal, sizes=size.alike, placement=replace(found.placement, scale=unit))
        if not size.clear:
            return found
        if self._on_arms(best.placement).mean() < _SLEEVES:
            return found._replace(resized=self._resized(best.placement, found.placement.scale, size))
        # Sleeved tops have more room over the chest, which looks like a size too large: see hood.assets.fitting.skin_field.
        if size.factor < 1.0 or size.alike is None:
            return found
        least, greatest = size.alike
        small = f"it is too small: it fits at {least:.2f} to {greatest:.2f} times its size, and sleeves tell no closer which"
        return found._replace(refusal=found.refusal or small)

    def _rivalled(self, best: _Candidate, size: Size, others: list[tuple[_Candidate, Size]]) -> bool:
        """Whether one of ``others``, in its size, is elsewhere and about as close as ``best`` in its ``size``."""
        place = self._in_size(best.placement, size)
        close = [self._in_size(c.placement, s) for c, s in others if s.misfit < size.misfit + _MARGIN]
        return any(_apart(place, other, self.many) >= 3 * _SAME for other in close)

    def _in_size(self, placement: Placement, size: Size) -> Placement:
        """``placement`` with the garment in ``size``, about the middle of its trunk."""
        _, middle = self._trunk(placement, self.many)
        offset = size.factor * placement.offset + (1.0 - size.factor) * middle + size.offset
        return replace(placement, scale=size.factor * placement.scale, offset=offset)

    def _larger(self) -> list[_Candidate]:
        """The best places of the garment if it is larger than its file has it."""
        search = replace(self)
        search.scales = [_LARGER * scale for scale in self.scales]
        return _distinct([search.settled(start) for start in search.starts()], search.many)[:_LARGER_PLACES]

    def _size(self, candidate: _Candidate, samples: np.ndarray) -> Size:
        points, _ = self._trunk(candidate.placement, samples)
        return find_size(points, self.wearer.skin(candidate.placement.angle))

    def _trunk(self, placement: Placement, samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """``samples`` (N, 3) on the body [m] and off its arms, whose sleeves are wider than trunks; and their middle (3,)."""
        points, skin = placement.apply(samples), self.wearer.skin(placement.angle)
        trunk = points[~self.wearer.arms[skin.measure(points).sample]]
        points = trunk if len(trunk) >= _FEW else points
        return points, points.mean(axis=0)

    def _resized(self, start: Placement, unit: float, size: Size) -> Resized | None:
        """The place in the size that explains the garment clearly better; None where it does not surround the body there."""
        scale = float(f"{unit * size.factor:.3g}")
        if self.asked.offset is None:
            factor, (_, middle) = scale / start.scale, self._trunk(start, self.most)
            start = replace(start, offset=factor * start.offset + (1.0 - factor) * middle + size.offset)
        search = _Search(self.pos, self.faces, self.wearer, replace(self.asked, scale=scale))
        best = search.polished(search.with_angle(search._judged(replace(start, scale=scale))))
        return None if search._doubt(best, None, False) else Resized(size.factor, best.placement, size.gain)

    def _doubt(self, best: _Candidate, rival: _Candidate | None, stays: bool) -> str | None:
        if self.asked.offset is not None:  # who names the place has decided
            return None
        problem = self._surrounding(best).problem
        if problem is not None:
            return f"where it fits best, it {problem}"
        if best.misfit > _LIMIT:
            return f"it fits the body closely nowhere (misfit {best.misfit:.2f} of at most {_LIMIT:g} where it fits best)"
        if rival is not None and not stays and rival.misfit < best.misfit + _MARGIN:
            one, other = " ".join(best.placement.keys()), " ".join(rival.placement.keys())
            return (
                f"two places fit alike ({one}, misfit {best.misfit:.3f}; {other}, misfit {rival.misfit:.3f}); give one of them"
            )
        return None

    def _too_small(self, best: _Candidate, ranked: list[_Candidate]) -> str | None:
        """Why an odd answer does not count: in a larger unit the garment fits with a wider cut."""
        larger = [c for c in ranked if best.odd and not c.odd and c.placement.scale > best.placement.scale]
        if self.asked.offset is not None or all(self._size(c, self.many).misfit > _LIMIT for c in larger):
            return None
        one, other = (f"scale={c.placement.scale:g}" for c in (best, larger[0]))
        return f"it fits a small part of the body ({one}), and loosely around the trunk ({other}); give one of them"

    def _worn(self, stay: _Candidate) -> bool:
        """Whether the file as it is lies around the body: nothing then asks for another place."""
        surface = self.wearer.skin(stay.placement.angle).surface
        return lies_in_place(stay.placement.apply(self.pos), self.faces, surface, self.wearer.faces)

    def _surrounding(self, candidate: _Candidate) -> Surrounding:
        points = candidate.placement.apply(used(self.pos, self.faces))
        return surrounds(points, self.wearer.skin(candidate.placement.angle).surface, self.wearer.faces)

    def _places(self, start: Placement) -> list[tuple[float, np.ndarray]]:
        if self.asked.offset is None:
            return self.wearer.field(start.angle).peaks(start.apply(self.few), _PEAKS)
        points = replace(start, offset=self.asked.offset).apply(self.few)
        return [(1.0 - misfit(self.wearer.skin(start.angle).measure(points), 4 * WIDTH), self.asked.offset)]

    def _moved(self, start: Placement, points: np.ndarray, widths: tuple[float, ...], rounds: int) -> Placement:
        if self.asked.offset is not None:
            return start
        for width in widths:
            step = settle_field(start.apply(points), self.wearer.skin(start.angle), width, rounds)
            start = replace(start, offset=start.offset + step)
        return start

    def _judged(self, placement: Placement) -> _Candidate:
        measured = self.wearer.skin(placement.angle).measure(placement.apply(self.many))
        return _Candidate(self._odd(placement), misfit(measured), placement)

    def _odd(self, placement: Placement) -> bool:
        aside = placement.apply(self.few).mean(axis=0) - self.body.mean(axis=0)
        return bool(self.ratio * placement.scale < _SMALL or np.hypot(aside[0], aside[2]) > _ASIDE)


def _distinct(candidates: list[_Candidate], points: np.ndarray) -> list[_Candidate]:
    """Best first, without those that repeat a better one."""
    kept: list[_Candidate] = []
    for candidate in sorted(candidates, key=_rank):
        if not any(_same(candidate, other, points, _SAME) for other in kept):
            kept.append(candidate)
    return kept


def _rank(candidate: _Candidate) -> tuple[bool, bool, float]:
    """Usual ones that fit, then odd ones that fit, then the rest."""
    return candidate.misfit > _LIMIT, candidate.odd, candidate.misfit


def _same(one: _Candidate, other: _Candidate, points: np.ndarray, within: float) -> bool:
    """Whether the same points lie within so many metres of each other on average."""
    return _apart(one.placement, other.placement, points) < within


def _apart(one: Placement, other: Placement, points: np.ndarray) -> float:
    """Mean distance [m] of the same points at two placements."""
    return float(np.linalg.norm(one.apply(points) - other.apply(points), axis=1).mean())


def _samples(pos: np.ndarray, faces: np.ndarray, count: int) -> np.ndarray:
    """Centres (count, 3) of faces at equal steps of area; none where no face has an area."""
    corners = pos[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).cumsum()
    if not area[-1] > 0:
        return np.zeros((0, 3))
    chosen = np.searchsorted(area, (np.arange(count) + 0.5) / count * area[-1])
    return np.asarray(corners[np.minimum(chosen, len(faces) - 1)].mean(axis=1))
