"""Which parts of a model a scene can do without, for an accuracy that was asked for.

Which combination of simplifications a rollout is done with: the cheapest for an accuracy, the most accurate for a time.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from hood.studies.plan.ablation import Effect

#: A part that saves a smaller share of a frame's time stays: the time cannot be told from noise.
LEAST_SAVING = 0.03
#: A part whose error is so many times what is accepted is not looked at in further windows.
HOPELESS = 10.0
#: How far below what is accepted a part's γ has to be: windows are few, and other frames go beyond them.
HEADROOM = 10.0
#: Quantile over the windows that γ is judged by.
QUANTILE = 0.95


@dataclass(frozen=True)
class Tolerance:
    """The largest error that is accepted: of γ, or a distance in mm."""

    value: float
    unit: str  # "gamma" or "mm"

    @classmethod
    def read(cls, text: str, key: str = "accuracy") -> Tolerance:
        """``0.01`` is of γ, ``5mm`` a distance; ``key`` is what was given it.

        Raises:
            ValueError: neither; a γ above 1, which is a distance without its unit.
        """
        match = re.fullmatch(r"([0-9.]+(?:e-?[0-9]+)?)\s*(mm)?", str(text).strip())
        value = float(match.group(1)) if match and match.group(1).count(".") < 2 and match.group(1) != "." else 0.0
        if match is None or not 0.0 < value < math.inf:
            raise ValueError(f"{key}={text}: give a γ above 0 (0.01), or a distance (5mm)")
        if match.group(2) is None and value > 1.0:  # γ = 1 is the weight itself
            raise ValueError(f"{key}={text}: give {key}=0.01 (a γ) or {key}={text}mm (a distance)")
        return cls(value, "mm" if match.group(2) else "gamma")

    @property
    def text(self) -> str:
        """As :meth:`read` reads it."""
        return f"{self.value:g}{'mm' if self.unit == 'mm' else ''}"

    def error(self, effect: Effect, full: Effect) -> float:
        """What is held against the tolerance: the distance, or how much more γ is left than by the full model's own steps.

        Those of a network have a γ of their own.
        """
        if self.unit == "mm":
            return effect.worst_mm if math.isfinite(effect.worst_mm) else math.inf
        own = full.gamma[: len(effect.gamma)]  # of what is hopeless not all windows were looked at
        rises = [max(one - other, 0.0) for one, other in zip(effect.gamma, own, strict=True)]
        return float(np.quantile(rises, QUANTILE)) if all(map(math.isfinite, rises)) else math.inf

    def hopeless(self, effect: Effect, full: Effect) -> bool:
        """Whether the windows so far say enough: the error is :data:`HOPELESS` times what is accepted."""
        return not self.error(effect, full) <= HOPELESS * self.value

    def say(self, value: float) -> str:
        """The error in words."""
        return f"{value:.2g} mm" if self.unit == "mm" else f"γ = {value:.2g} more"


@dataclass(frozen=True)
class PlanVerdict:
    """What becomes of a part: ``absent`` (nothing in this scene uses it), ``kept`` or ``left out``, and why."""

    decision: str
    reason: str


@dataclass(frozen=True)
class Decision:
    """Verdicts by part, and what was measured of all that is left out together; None where nothing is."""

    verdicts: dict[str, PlanVerdict]
    left_out: tuple[str, ...]
    together: Effect | None


def why_kept(
    name: str, effect: Effect, full: Effect, tolerance: Tolerance, stay: Mapping[str, str], priced: Collection[str]
) -> str:
    """Why a part stays, by what was measured of it alone; "" where it may go."""
    error, saving = tolerance.error(effect, full), effect.saving(full)
    if error > tolerance.value:
        return f"without it {tolerance.say(error)}"
    if saving < LEAST_SAVING:
        return f"it costs no time that can be measured ({100 * saving:+.0f}% of a frame)"
    if name in stay:
        return f"{tolerance.say(error)} without it here, but {stay[name]}"
    if tolerance.unit == "gamma" and error * HEADROOM > tolerance.value:
        elsewhere = "it would come back often" if name in priced else "other frames would be beyond it"
        return f"without it {tolerance.say(error)}, so near to the limit that {elsewhere}"
    return ""


def decide(
    effects: Mapping[str, Effect],
    absent: Mapping[str, str],
    rivals: Sequence[Sequence[str]],
    tolerance: Tolerance,
    measure_together: Callable[[Sequence[str]], tuple[Effect, Effect]],
    stay: Mapping[str, str] = MappingProxyType({}),
    priced: Collection[str] = (),
) -> Decision:
    """The cheapest combination whose error stays within the tolerance, as far as one search from the top finds it.

    Parts that pass alone and save time are tried together. While the combination misses the tolerance, the part with the
    largest error of its own stays in.

    Args:
        effects: by part; the full model's own entry is named "".
        absent: parts that nothing in the scene uses, with the reason.
        rivals: parts of which at most one can be left out.
        stay: parts that are never left out, and why.
        priced: parts that come back where they are worth more than is accepted. By γ, parts are left out only where they are
            worth :data:`HEADROOM` times less: of these since a step that is taken twice costs more than any part saves, of the
            others since nothing brings them back.
        measure_together: the full model's and the combination's effect, measured side by side.
    """
    full = effects[""]
    verdicts = {name: PlanVerdict("absent", reason) for name, reason in absent.items()}
    passing: dict[str, float] = {}
    for name, effect in effects.items():
        if not name or name in absent:
            continue
        reason = why_kept(name, effect, full, tolerance, stay, priced)
        if reason:
            verdicts[name] = PlanVerdict("kept", reason)
        else:
            passing[name] = effect.saving(full)
    for group in rivals:
        ranked = sorted((name for name in group if name in passing), key=lambda name: -passing[name])
        for name in ranked[1:]:
            verdicts[name] = PlanVerdict("kept", f"{ranked[0]!r} saves more and passes as well")
            del passing[name]
    together: Effect | None = None
    while passing:
        reference, together = measure_together(tuple(passing))
        error, saving = tolerance.error(together, reference), together.saving(reference)
        if error <= tolerance.value and saving >= LEAST_SAVING:
            break
        worst = max(passing, key=lambda name: tolerance.error(effects[name], full))
        why = (
            f"with the others left out {tolerance.say(error)}" if error > tolerance.value else "saves nothing beside the others"
        )
        verdicts[worst] = PlanVerdict("kept", why)
        del passing[worst]
        together = None
    for name, saving in passing.items():
        said = tolerance.say(tolerance.error(effects[name], full))
        verdicts[name] = PlanVerdict("left out", f"without it {said}, {100 * saving:.0f}% of a frame saved")
    return Decision(verdicts, tuple(passing), together)


#: Combinations that are run against the full model at most; each costs two windows.
MOST_TRIED = 4


@dataclass(frozen=True)
class Option:
    """A simplification, as measured alone.

    Args:
        axis: of options with the same one at most one is taken; "" where it goes with all.
        mm: from the full model.
        cost: its time as a share of the full model's.
    """

    name: str
    axis: str
    mm: float
    cost: float


@dataclass(frozen=True)
class Combination:
    """Options taken together: what is expected of them, or was measured; no options are the full model.

    Args:
        half_mm, mm: median and 95th percentile of the points, from the full model; expected: the sum.
        ms: of a frame; expected: the product of the shares.
    """

    names: tuple[str, ...]
    mm: float
    ms: float
    half_mm: float = 0.0


@dataclass(frozen=True)
class Search:
    """What a search found.

    Args:
        chosen: as measured.
        fits: whether it meets what was asked for; where not, nothing does, and it is the nearest.
        tried: every combination that was measured.
    """

    chosen: Combination
    fits: bool
    tried: tuple[Combination, ...]


def combinations(options: Sequence[Option], full_ms: float) -> list[Combination]:
    """All of them, the full model first, with what is expected of each."""
    axes = [[None, *(one for one in options if one.axis == axis)] for axis in sorted({one.axis for one in options} - {""})]
    axes += [[None, one] for one in options if not one.axis]
    found = []
    for picked in itertools.product(*axes):
        taken = [one for one in picked if one is not None]
        mm, share = math.fsum(one.mm for one in taken), math.prod(one.cost for one in taken)
        found.append(Combination(tuple(sorted(one.name for one in taken)), mm, share * full_ms))
    return sorted(found, key=lambda one: len(one.names))


def cheapest(known: Sequence[Combination], limit_mm: float, measure: Callable[[tuple[str, ...]], Combination]) -> Search:
    """The cheapest combination that is at most ``limit_mm`` from the full model, by what is expected of them, and measured.

    The full model, which is always among them, meets every limit. What is run as a whole has to save as much as a part has to.
    """
    full = known[0]
    order = sorted((one for one in known if one.mm <= limit_mm and one.ms <= full.ms), key=lambda one: (one.ms, one.mm))
    tried: list[Combination] = []
    for expected in order:
        if not expected.names or len(tried) == MOST_TRIED:
            break
        tried.append(measure(expected.names))
        if tried[-1].mm <= limit_mm and tried[-1].ms <= (1.0 - LEAST_SAVING) * full.ms:
            return Search(tried[-1], True, tuple(tried))
    return Search(full, True, tuple(tried))


def most_accurate(known: Sequence[Combination], budget_ms: float, measure: Callable[[tuple[str, ...]], Combination]) -> Search:
    """The combination nearest to the full model whose measured time is at most ``budget_ms``; the fastest where none is.

    Where one turns out slower than expected, all that are not measured yet are expected to be slower by as much.
    """
    full = known[0]
    if full.ms <= budget_ms:
        return Search(full, True, ())
    tried: list[Combination] = []
    left, slower = list(known[1:]), 1.0
    while left and len(tried) < MOST_TRIED:
        fitting = [one for one in left if slower * one.ms <= budget_ms]
        if fitting and len(tried) + 1 < MOST_TRIED:
            expected = min(fitting, key=lambda one: (one.mm, one.ms))
        else:
            expected = min(left, key=lambda one: (one.ms, one.mm))
        left.remove(expected)
        tried.append(measure(expected.names))
        if tried[-1].ms <= budget_ms:
            return Search(tried[-1], True, tuple(tried))
        if not fitting and tried[-1].ms < full.ms:
            break
        slower = max(slower, tried[-1].ms / expected.ms)
    return Search(min([full, *tried], key=lambda one: one.ms), False, tuple(tried))
