"""Schedules as functions of the iteration: horizon, learning rate, collision weight. Stateless, so a resume is exact."""

from __future__ import annotations

import copy
import inspect
import math
from dataclasses import dataclass, replace
from typing import cast

from torch import Tensor

from hood.energies.contact import Collision
from hood.energies.friction import Friction
from hood.energies.potential import Potential
from hood.energies.term import Term, WeightedTerm, named


@dataclass(frozen=True)
class Horizon:
    """Predicted steps per training rollout: ``start`` at first, one more every ``every`` iterations, at most ``maximum``.

    The paper (section 3.4): every 5000 iterations, at most 5.

    ``with_relaxing``: the relaxing step, with which every rollout begins, is one of them, as in the released code; otherwise it
    comes before them. Where ``every`` counts rollouts, :meth:`rollout` says which one an update belongs to.
    """

    every: int = 5000
    maximum: int = 5
    start: int = 1
    with_relaxing: bool = False

    def __post_init__(self) -> None:
        _require_least("horizon", self, every=0, maximum=1, start=1)
        if self.start > self.maximum:
            raise ValueError(f"trainer.horizon.start is {self.start}, maximum {self.maximum}; a start is at most the maximum")

    def __call__(self, iteration: int) -> int:
        return min(self.start + iteration // max(self.every, 1), self.maximum)

    def after_relaxing(self, iteration: int) -> int:
        """Steps of a rollout that follow the relaxing one."""
        return self(iteration) - self.with_relaxing

    def rollout(self, update: int) -> int:
        """Number of the rollout that an update belongs to, from 0, where every rollout is as long as the ``horizon`` of its
        number says and has one update a step."""
        done, left = 0, update
        for _ in range(self.start, self.maximum):
            steps = self.after_relaxing(done) + 1
            if left < max(self.every, 1) * steps:
                break
            done, left = done + max(self.every, 1), left - max(self.every, 1) * steps
        return done + left // (self.after_relaxing(done) + 1)

    def updates(self, rollouts: int) -> int:
        """Updates of the first ``rollouts`` of these rollouts."""
        made, done = 0, 0
        for _ in range(self.start, self.maximum):
            several = min(max(self.every, 1), rollouts - done)
            made, done = made + several * (self.after_relaxing(done) + 1), done + several
        return made + (rollouts - done) * (self.after_relaxing(done) + 1)

    def scaled(self, factor: float) -> Horizon:
        """The same curriculum, ``factor`` times as long."""
        return replace(self, every=scaled_count("trainer.horizon.every", self.every, factor))


@dataclass(frozen=True)
class StepDecay:
    """Learning-rate factor 0.5^⌊iteration / every⌋ + 0.01, the reference's."""

    every: int = 50000
    floor: float = 0.01

    def __post_init__(self) -> None:
        _require_least("schedule", self, every=1, floor=0)
        _require_share(self.floor)

    def __call__(self, iteration: int, num_iterations: int) -> float:
        return 0.5 ** (iteration // self.every) + self.floor

    def scaled(self, factor: float) -> StepDecay:
        """The same decay, ``factor`` times as long."""
        return replace(self, every=scaled_count("trainer.schedule.every", self.every, factor))


@dataclass(frozen=True)
class WarmupCosine:
    """Learning-rate factor: linear over ``warmup`` iterations, then half a cosine down to ``floor``."""

    warmup: int = 50
    floor: float = 0.01

    def __post_init__(self) -> None:
        _require_least("schedule", self, warmup=0, floor=0)
        _require_share(self.floor)

    def __call__(self, iteration: int, num_iterations: int) -> float:
        if iteration < self.warmup:
            return (iteration + 1) / self.warmup
        progress = (iteration - self.warmup) / max(num_iterations - self.warmup, 1)
        return self.floor + (1 - self.floor) * 0.5 * (1 + math.cos(math.pi * min(progress, 1.0)))

    def scaled(self, factor: float) -> WarmupCosine:
        """The same with a warm-up ``factor`` times as long; the cosine fills what remains of the run in any case."""
        return replace(self, warmup=scaled_count("trainer.schedule.warmup", self.warmup, factor))


@dataclass(frozen=True)
class InverseRoot:
    """Learning-rate factor: linear over ``warmup`` iterations, 1 until iteration ``steady``, then √(steady / iteration).

    It does not ask how long the run will be: the first n updates of a long run are the run of n updates.
    """

    warmup: int = 50
    steady: int = 100

    def __post_init__(self) -> None:
        _require_least("schedule", self, warmup=0, steady=0)

    def __call__(self, iteration: int, num_iterations: int) -> float:
        return min((iteration + 1) / max(self.warmup, 1), math.sqrt(max(self.steady, 1) / max(iteration, 1)), 1.0)

    def scaled(self, factor: float) -> InverseRoot:
        """The same with warm-up and steady part ``factor`` times as long."""
        warmup, steady = (
            scaled_count(f"trainer.schedule.{name}", getattr(self, name), factor) for name in ("warmup", "steady")
        )
        return replace(self, warmup=warmup, steady=steady)


@dataclass(frozen=True)
class CollisionRamp:
    """Collision weight [J/m³] rising linearly from ``start`` to ``end`` between two iterations."""

    start: float = 5e5
    end: float = 5e5
    begin_iteration: int = 0
    end_iteration: int = 0

    def __post_init__(self) -> None:
        _require_least("collision", self, start=0, end=0, begin_iteration=0, end_iteration=0)

    def __call__(self, iteration: int) -> float:
        if iteration >= self.end_iteration:
            return self.end
        span = max(self.end_iteration - self.begin_iteration, 1)
        progress = min(max((iteration - self.begin_iteration) / span, 0.0), 1.0)
        return self.start + (self.end - self.start) * progress

    def scaled(self, factor: float) -> CollisionRamp:
        """The same ramp with its two ends ``factor`` times as late."""
        begin, end = (
            scaled_count(f"trainer.collision.{name}", getattr(self, name), factor)
            for name in ("begin_iteration", "end_iteration")
        )
        return replace(self, begin_iteration=begin, end_iteration=end)

    def apply(self, potential: Potential, iteration: int) -> Potential:
        """The potential with this iteration's weight in collision and friction.

        Raises:
            ValueError: such a term cannot be given a weight.
        """
        return _with_weight(potential, self(iteration))

    def at_end(self, potential: Potential) -> Potential:
        """The potential with the weight to which the ramp leads."""
        return _with_weight(potential, self.end)

    def require_its_weight(self, potential: Potential) -> None:
        """Raise ValueError where a term has a weight of its own, which the ramp would overwrite unsaid."""
        for name, term in weighted_terms(potential).items():
            given = getattr(term, "weight", None)
            usual = inspect.signature(type(term)).parameters.get("weight")
            if given is None or given == self.end or (usual is not None and given == usual.default):
                continue
            key, level = f"losses.terms.{name}.weight={given:.9g}", self.start == self.end
            fix = f"trainer.collision.end={given:.9g}" + f" and trainer.collision.start={given:.9g}" * level
            rise = "" if level else f" (it rises from trainer.collision.start={self.start:.9g})"
            raise ValueError(
                f"{key}: a training takes this weight from trainer.collision.end={self.end:.9g}; give {fix} instead{rise}"
            )


def weighted_terms(potential: Potential) -> dict[str, WeightedTerm]:
    """Terms that have the weight of contact, by name.

    Raises:
        ValueError: a term under these names cannot be given one.
    """
    found: dict[str, WeightedTerm] = {}
    for name in ("collision", "friction"):
        term = potential.terms.get(name)
        if term is None:
            continue
        if not isinstance(term, WeightedTerm):
            raise ValueError(
                f"{named(name, term)}: training ramps the weight of this term, which has no method with_weight; add one "
                "that returns the term with another weight, or the term itself, or give the term another name"
            )
        found[name] = term
    return found


def _with_weight(potential: Potential, weight: float) -> Potential:
    changed = {name: cast(Term, term.with_weight(weight)) for name, term in weighted_terms(potential).items()}
    return potential.with_terms(**changed)


def contact_weight(potential: Potential) -> float:
    """Of the terms that have it; 0 where there are none."""
    return float(next((getattr(term, "weight", 0.0) for term in weighted_terms(potential).values()), 0.0))


def with_weight_on_device(potential: Potential, weight: Tensor) -> Potential:
    """The potential with a weight of contact () that is read on the device.

    Raises:
        ValueError: a term takes more from its weight than the factor that it is; the message says what to use.
    """
    changed: dict[str, Term] = {}
    for name, term in weighted_terms(potential).items():
        if term.with_weight(0.0) is term:
            continue
        if type(term).with_weight not in (Collision.with_weight, Friction.with_weight):
            raise ValueError(
                f"{named(name, cast(Term, term))} has no weight that a recorded update could change: use trainer.step=plain"
            )
        changed[name] = cast(Term, copy.copy(term))
        changed[name].weight = weight  # type: ignore[attr-defined]
    return potential.only({**potential.terms, **changed})


def _require_least(part: str, settings: object, **least: int) -> None:
    """Raise ValueError where a number is below its least value; names the key."""
    for name, lowest in least.items():
        value = getattr(settings, name)
        if not value >= lowest:
            raise ValueError(f"trainer.{part}.{name} is {value}; it must be at least {lowest}")


def _require_share(floor: float) -> None:
    if not floor <= 1:
        raise ValueError(f"trainer.schedule.floor is {floor}; it is a share of the learning rate, at most 1")


def scaled_count(name: str, count: int, factor: float) -> int:
    """``count`` iterations times ``factor``, rounded; 0 stays 0, and nothing else becomes it.

    Raises:
        ValueError: ``factor`` is not a finite number > 0, or so small that nothing is left of ``name``.
    """
    if not (math.isfinite(factor) and factor > 0):
        raise ValueError(f"trainer.time_scale is {factor}; it must be a finite number > 0")
    scaled = round(count * factor)
    if count > 0 and scaled == 0:
        raise ValueError(f"trainer.time_scale={factor:g} leaves nothing of {name}={count}; raise it")
    return scaled
