"""The measurements of ``hood plan``: parts left out, other meshes and time steps, and what is chosen among them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hood.app.settings.compose import ConfigError
from hood.app.setup import Setup, start_of
from hood.steppers.watched import WatchedStepper, lacking
from hood.studies.plan.ablation import (
    LEAD,
    AblationWindow,
    Begun,
    Effect,
    Variant,
    active_terms,
    begin,
    choose_windows,
    measure_ablation,
    prices,
)
from hood.studies.plan.choices import MESH, PartChoice, Variants, choices_of, choose_choices
from hood.studies.plan.decide import (
    LEAST_SAVING,
    QUANTILE,
    Combination,
    Option,
    PlanVerdict,
    Search,
    Tolerance,
    cheapest,
    combinations,
    decide,
    most_accurate,
)
from hood.studies.plan.discretisation import Apart, Elsewhere, Reference, common_points, measure_elsewhere
from hood.studies.plan.page import broken, of_choice, of_parts, with_it
from hood.studies.plan.parts import Part, choose_parts

#: With a length, γ may be so many times that of the windows, and this at least, before left-out energies come back.
_TIMES_PROBED, _LEAST_LIMIT = 3.0, 1e-3
#: Steps of settling where windows need no rest, since nothing but single steps from one state is compared.
_ROUGH = 4
#: Why parts whose absence nobody would notice are kept.
_UNSEEN = "a rollout would not notice where it is more"
#: Steps for which left-out energies stay where they came back.
HOLD = 15


@dataclass(frozen=True)
class AskedOf:
    """What a plan is made for.

    Args:
        tolerance: what is accepted.
        budget_ms: of a frame; None where only the tolerance counts.
        parts: names of rows; empty: all.
        windows, frames: how many windows, and steps of each.
        evidence: whether other meshes and time steps are looked at, and parts that are kept whatever they are worth.
    """

    tolerance: Tolerance
    budget_ms: float | None
    parts: list[str]
    windows: int
    frames: int
    evidence: bool = True

    @property
    def decides(self) -> bool:
        """Whether other meshes, time steps and steppers can be chosen: they are judged in mm."""
        return self.evidence and (self.budget_ms is not None or self.tolerance.unit == "mm")


@dataclass(frozen=True)
class Probed:
    """What was measured and decided.

    Args:
        effects: by part; that of the full model is named "".
        apart: by choice.
        full_ms: of a frame of the full model in the windows of ``apart``.
        price: by energy, see :func:`hood.studies.plan.ablation.prices`.
        verdicts: by part and choice.
        names: of what is chosen.
        words: the settings of that.
        together: what was measured of it, by γ; None where nothing is left out, and of a ``search``.
        search: on combinations, by mm; None where parts are left out by γ.
        limit: γ above which left-out energies come back; None where none is left out.
    """

    parts: list[Part]
    choices: list[PartChoice]
    begun: list[Begun]
    effects: dict[str, Effect]
    apart: dict[str, Apart]
    full_ms: float
    price: dict[str, float]
    verdicts: dict[str, PlanVerdict]
    names: tuple[str, ...]
    words: list[str]
    together: Effect | None
    search: Search | None
    limit: float | None


def probe(ready: Setup, asked: AskedOf) -> Probed:
    """Everything that is measured, and what is chosen by it.

    Raises:
        ConfigError: rows that this rollout does not have, or windows longer than the motion.
    """
    return _Probe(ready, asked).run()


class _Probe:
    """One probing: the full model, its windows, and what is measured in them."""

    def __init__(self, ready: Setup, asked: AskedOf) -> None:
        self.ready, self.asked, self.config = ready, asked, ready.config
        others = [one.name for one in choices_of(self.config)] if asked.evidence else []
        self.parts = choose_parts(self.config, asked.parts, asked.decides, others)
        self.choices = choose_choices(self.config, asked.parts) if asked.evidence else []
        if not asked.evidence:
            self.parts = [part for part in self.parts if part.watched and not part.stays]
        if not self.parts and not self.choices:
            raise ConfigError("parts: this rollout has none that could be left out")
        self.made = Variants(ready)
        self.full = self.made.full
        self.settle, _ = start_of(self.config)
        self.begun = begin(self.full, self._windows(), self.settle, most_steps=None if asked.decides else _ROUGH)

    def run(self) -> Probed:
        active, price = active_terms(self.full, self.begun), prices(self.full, self.begun)
        absent = {part.name: self._why_absent(part) for part in self.parts if part.term and part.term not in active}
        there = [part for part in self.parts if part.name not in absent]
        stay = {part.name: part.stays or _UNSEEN for part in there if part.stays or not part.watched}
        self.variants = self._variants(there, absent)
        tolerance = self.asked.tolerance

        def enough(name: str, effect: Effect, of_full: Effect) -> bool:
            far = self.asked.budget_ms is None and tolerance.hopeless(effect, of_full)
            return name in stay or far or (self.asked.decides and broken(effect, of_full))

        self.effects = measure_ablation(self.full, self.variants, self.begun, self.asked.frames, enough)
        apart = {one.name: self._compare(one) for one in self.choices}
        verdicts = {name: PlanVerdict("absent", reason) for name, reason in absent.items()}
        together, search = None, None
        if self.asked.decides:
            search = self._search(self._options(apart, stay))
            names = search.chosen.names
            verdicts |= of_parts(there, self.effects, stay, tolerance, names)
        else:
            rivals = [[p.name for p in there if p.rivals == name] for name in sorted({p.rivals for p in there} - {""})]
            priced = {part.name for part in there if part.term}
            decision = decide(self.effects, absent, rivals, tolerance, self._together, stay, priced)
            names, together = decision.left_out, decision.together
            verdicts |= decision.verdicts
            verdicts |= {part.name: with_it(verdicts[part.name]) for part in there if part.instead}
        taken = names if self.asked.decides else None
        full_ms = self._full_ms() if apart or search else float("nan")
        verdicts |= {one.name: of_choice(one, apart[one.name], full_ms, taken) for one in self.choices}
        limit = self._limit(names) if self._lacking(names) else None
        return Probed(
            self.parts, self.choices, self.begun, self.effects, apart, full_ms, price,
            verdicts, names, self._words_of(names), together, search, limit,
        )  # fmt: skip

    def _windows(self) -> list[AblationWindow]:
        count = min(int(self.config.num_frames), self.ready.scene.num_frames)
        try:
            return choose_windows(self.ready.scene.motion, count, self.asked.windows, LEAD + self.asked.frames + 1)
        except ValueError as error:
            fix = "give more frames (num_frames, or a longer motion), fewer frames=… of hood plan, or no accuracy=…"
            raise ConfigError(f"a plan: {error}; {fix}") from error

    def _why_absent(self, part: Part) -> str:
        if part.term in ("collision", "friction") and self.ready.scene.motion.num_vertices == 0:
            return "there is no body"
        return "nothing in these windows comes near enough" if part.term == "layers" else "nothing in this scene uses it"

    def _variants(self, there: Sequence[Part], absent: dict[str, str]) -> dict[str, Variant]:
        """Of every part; a way to take the steps that this scene or machine does not allow is ``absent``."""
        found = {}
        for part in there:
            try:
                found[part.name] = self.made.make(part.words, part.words if part.refitted else ())
            except ValueError as error:
                if not part.instead:
                    raise
                absent[part.name] = str(error)
        return found

    def _words_of(self, names: Iterable[str]) -> list[str]:
        rows: list[Part | PartChoice] = [*self.choices, *self.parts]
        return list(dict.fromkeys(word for row in rows if row.name in names for word in row.words))

    def _limit(self, names: Iterable[str]) -> float:
        """The γ above which left-out energies come back; judged by a length, some more than they had in the windows."""
        if not self.asked.decides:
            return self.asked.tolerance.value
        left = [self.effects[name] for name in names if name in self.effects]
        return max(_TIMES_PROBED * sum(effect.gamma_at(QUANTILE) for effect in left), _LEAST_LIMIT)

    def _lacking(self, names: Iterable[str]) -> bool:
        """Whether energies are left out with these parts."""
        return any(lacking(self.variants[name].potential, self.full.potential) for name in names if name in self.variants)

    def _watched(self, names: Sequence[str], other: tuple[str, ...] = ()) -> Variant:
        """The model of a combination as a rollout takes its steps, with the price of what is left out, in the scene with the
        words of ``other`` choices."""
        words = list(dict.fromkeys(word for part in self.parts if part.name in names for word in part.words))
        if not other and not words:
            return self.full
        reduced = self.variants[names[0]] if not other and len(names) == 1 else self.made.make(words, other)
        if not self._lacking(names):
            return reduced
        full = self.made.full_in(reduced.scene)
        potentials = reduced.potential, full.potential
        watched = WatchedStepper(reduced.stepper, full.stepper, potentials, reduced.scene, self._limit(names), HOLD)
        return replace(reduced, stepper=watched)

    def _together(self, names: Sequence[str]) -> tuple[Effect, Effect]:
        """The full model and the parts' combination, side by side."""
        if len(names) == 1 and not self._lacking(names):
            return self.effects[""], self.effects[names[0]]
        found = measure_ablation(self.full, {"all": self._watched(names)}, self.begun, self.asked.frames)
        return found[""], found["all"]

    @cached_property
    def _reference(self) -> Reference:
        # Of meshes the rest itself is compared, so it has to be one.
        rough = not self.asked.decides and any(one.kind == MESH for one in self.choices)
        return Reference(self.full, self.settle, {} if rough else {one.window.first: one.rest for one in self.begun})

    def _full_ms(self) -> float:
        return float(np.median(self._reference.ms))

    def _firsts(self, few: bool) -> list[int]:
        """First frames of the windows that combinations and choices are held against: the start and the fastest moment."""
        firsts = [one.window.first for one in self.begun[:2]]
        return firsts[-1:] if few else firsts

    def _apart(self, names: tuple[str, ...], few: bool = False) -> Apart:
        """How far a combination is from the full model; in one window where ``few`` will do."""
        return measure_elsewhere(self._reference, self._elsewhere(names), self._firsts(few), LEAD + self.asked.frames)

    def _compare(self, one: PartChoice) -> Apart:
        """How far a choice is from the full model; one that only informs, in one window."""
        return self._apart((one.name,), few=one.finer or not self.asked.decides)

    def _elsewhere(self, names: tuple[str, ...]) -> Elsewhere:
        chosen = [one for one in self.choices if one.name in names]
        words = tuple(word for one in chosen for word in one.words)
        moved = self._watched([name for name in names if name in self.effects], words)
        points = common_points(self.ready.scene, moved.scene) if any(one.kind == MESH for one in chosen) else None
        return Elsewhere(moved, points, float(np.prod([one.pace for one in chosen])))

    def _options(self, apart: dict[str, Apart], stay: dict[str, str]) -> list[Option]:
        """What can be combined: rows that save time and leave a model of the scene."""
        found, full = [], self.effects[""]
        for part in self.parts:
            effect = self.effects.get(part.name)
            if effect is None or part.name in stay or effect.saving(full) < LEAST_SAVING:
                continue
            if not broken(effect, full):
                found.append(Option(part.name, part.rivals, effect.worst_mm, 1.0 - effect.saving(full)))
        for one in self.choices:
            share = apart[one.name].frame_ms(one.pace) / self._full_ms()
            if not one.finer and share <= 1.0 - LEAST_SAVING:
                found.append(Option(one.name, one.kind, max(apart[one.name].mm), share))
        return [one for one in found if np.isfinite(one.mm)]

    def _search(self, options: list[Option]) -> Search:
        def together(names: tuple[str, ...]) -> Combination:
            found, other = self._apart(names), self._elsewhere(names)
            return Combination(names, max(found.mm), found.frame_ms(other.pace), max(found.half_mm))

        self._reference.end(self._firsts(False)[0], LEAD + self.asked.frames)
        known = combinations(options, self._full_ms())
        if self.asked.budget_ms is not None:
            return most_accurate(known, self.asked.budget_ms, together)
        return cheapest(known, self.asked.tolerance.value, together)
