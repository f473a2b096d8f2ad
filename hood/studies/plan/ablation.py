"""What a rollout loses where a part of its model is left out: measured on states of the full model.

A *variant* is the same scene with other settings. From every state it takes the same steps as the full model. Its first
step is judged under the full potential: γ = (Φ_full(x) − Φ*_full) / e0 as in :mod:`hood.evaluation.gap`. Its positions are
compared with those of the full model when the window is over.

Moments of a motion that a short look should not miss, found from the body alone.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from hood.cloth.state import State, StepInput
from hood.energies.potential import Potential, relative_gradient, scale
from hood.energies.problem import StepProblem
from hood.evaluation.gap import REFERENCE
from hood.mesh.closest_point.tree import forget_searches
from hood.rollouts.loop import own_start, rest_state, simulate
from hood.scene.scene import Scene, recentre
from hood.solver.newton import minimize
from hood.solver.system.iterate import in_double
from hood.steppers.network import Prediction
from hood.steppers.refined import prepare_stepper

if TYPE_CHECKING:
    from hood.scene.body_motion.motion import Motion
    from hood.steppers.newton import Stepper

#: The body is posed in at most so many frames, and every so many of its vertices are looked at.
_MOST_POSES, _VERTEX_STRIDE = 60, 16


@dataclass(frozen=True)
class AblationWindow:
    """A stretch of a motion that begins at frame ``first``, and why it was taken."""

    first: int
    reason: str


def choose_windows(motion: Motion, num_frames: int, count: int, length: int) -> list[AblationWindow]:
    """At most ``count`` windows of ``length`` steps within the first ``num_frames`` frames, none of them twice.

    In this order: the start; the body's vertices fastest (m/s, root mean square); the body most bent, which is where its
    vertices are nearest to their centre; the median speed; the highest acceleration.

    Raises:
        ValueError: the frames are too few for one window.
    """
    last = num_frames - 1 - length
    if last < 0:
        raise ValueError(f"{num_frames} frames are too few for a window of {length + 1}")
    frames = np.unique(np.linspace(0, last, min(last + 1, _MOST_POSES)).round().astype(int))
    if motion.num_vertices == 0 or len(frames) < 4:
        even = np.linspace(0, last, min(count, last + 1)).round().astype(int)
        return [AblationWindow(int(frame), "the start" if frame == 0 else "evenly spread") for frame in even]
    speed, spread = _course(motion, frames)
    change = np.abs(np.gradient(speed, frames))
    picked = {
        "the start": 0,
        "fastest": int(speed.argmax()),
        "most bent": int(spread.argmin()),
        "median speed": int(np.argsort(speed)[len(speed) // 2]),
        "highest acceleration": int(change.argmax()),
    }
    windows: list[AblationWindow] = []
    for reason, index in picked.items():
        first = int(frames[index])
        if all(abs(first - known.first) >= length for known in windows) and len(windows) < count:
            windows.append(AblationWindow(first, reason))
    return windows


def _course(motion: Motion, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Speed [m/s] and mean distance from the centre [m] of the body's vertices in ``frames``."""
    here, there = (motion.some_points(at, _VERTEX_STRIDE) for at in (frames, frames + 1))
    speed = np.sqrt(((there - here) ** 2).sum(axis=2).mean(axis=1)) * motion.fps
    return speed, np.linalg.norm(here - here.mean(axis=1, keepdims=True), axis=2).mean(axis=1)


#: Frames of the full model before a window's first state: the start is at rest on a still body.
LEAD = 2
#: Positions differ by the 95th percentile of this over the vertices: one vertex that flips says little.
_QUANTILE = 0.95


@dataclass(frozen=True)
class Variant:
    """Settings that can be compared: what takes the steps, the energy that it moves by, and the scene."""

    stepper: Stepper
    potential: Potential
    scene: Scene


@dataclass
class Effect:
    """What a variant did in every window, or in the first ones; the full model's own entry has γ of its own steps and 0 mm."""

    gamma: list[float] = field(default_factory=list)
    mm: list[float] = field(default_factory=list)
    ms: list[float] = field(default_factory=list)  # of every frame
    last: list[Tensor] = field(default_factory=list)  # (V, 3) m, world, float64, at the windows' ends
    exact: list[bool] = field(default_factory=list)  # the window's minimum was reached; where not, γ is a lower bound
    half_mm: list[float] = field(default_factory=list)  # as ``mm``, the median of the vertices

    def gamma_at(self, share: float) -> float:
        """Quantile of γ over the windows."""
        return float(np.quantile(self.gamma, share))

    @property
    def worst_mm(self) -> float:
        """Of all windows."""
        return max(self.mm)

    def saving(self, full: Effect) -> float:
        """Share of a frame's time that the full model takes longer: the median over pairs of the same steps, as far as this was
        measured."""
        return 1.0 - float(np.median(np.divide(self.ms, full.ms[: len(self.ms)])))

    @property
    def median_ms(self) -> float:
        """Of a frame."""
        return float(np.median(self.ms))


@dataclass(frozen=True)
class Begun:
    """A window of the full model: its first state, and the first step as it should be solved."""

    window: AblationWindow
    frame: int  # of the first state
    state: State
    step: StepProblem  # prepared by the full potential
    solved: Tensor  # (V, 3) m, where the full model's step from there leads, in the state's frame
    rest: State  # at rest in the window's own first frame
    times: dict[str, float] = field(default_factory=dict)  # ms of the parts of the last frame before, by name


def begin(
    full: Variant, windows: Sequence[AblationWindow], settle: str, lead: int = LEAD, most_steps: int | None = None
) -> list[Begun]:
    """The full model's state ``lead`` frames into every window, from rest on the still body of the window's first frame.

    Args:
        most_steps: a rough rest after so many steps of settling is enough, where ``settle`` settles; None: to rest.
    """
    found = []
    for window in windows:
        kept: dict[int, tuple[StepProblem, Tensor]] = {}

        def keep(
            frame: int, problem: StepProblem, prediction: Prediction, kept: dict[int, tuple[StepProblem, Tensor]] = kept
        ) -> None:
            kept[frame] = problem, prediction.next_pos

        frames = simulate(
            full.stepper,
            full.scene,
            full.potential,
            lead + 2,
            start_frame=window.first,
            observe=keep,
            metrics="none",
            settle=settle,
            start=None if most_steps is None else rest_at(full, window.first, settle, most_steps),
        )
        rest = next(frames).state
        *_, last = frames
        times = {name[3:]: value for name, value in last.metrics.items() if name.startswith("ms_")}
        step, solved = kept[max(kept)]
        prepared = full.potential.prepare(step)
        found.append(Begun(window, window.first + max(kept) - 1, step.state, prepared, solved, rest, times))
    return found


def rest_at(variant: Variant, frame: int, settle: str, most_steps: int | None = None) -> State:
    """The first state of a rollout that begins at ``frame``; ``most_steps`` as in :func:`begin`."""
    stepper, scene, potential = variant.stepper, variant.scene, variant.potential
    if most_steps is not None and settle == "equilibrium" and own_start(stepper, scene, frame) is None:
        return rest_state(stepper, scene, potential, 1, frame, most_steps=most_steps)[0]
    frames = simulate(stepper, scene, potential, 1, start_frame=frame, metrics="none", settle=settle)
    return next(frames).state


@torch.no_grad()
def advance(
    variant: Variant, state: State, frame: int, num_steps: int, ms: list[float], first: StepInput | None = None
) -> Iterator[tuple[Tensor, State]]:
    """Positions (V, 3) [m] after every step, in the frame of the state before it, and the state there. Times [ms], without
    that of posing the body, go to ``ms``.

    Args:
        state, frame: where it begins.
        first: what is prescribed for the first step, where that is known.
    """
    stepper, scene = variant.stepper, variant.scene
    prepared, dtype = prepare_stepper(stepper, scene), scene.cloth.rest_pos.dtype
    if state.pos.dtype != dtype:  # networks take their steps in float32
        state, first = State(state.pos.to(dtype), state.vel.to(dtype), state.origin), None
    # On one thread what other processes take is no time of a frame's.
    clock = time.process_time if torch.get_num_threads() == 1 and state.pos.device.type == "cpu" else time.perf_counter
    forget_searches()  # those of the variant before were of the same state
    for index in range(num_steps):
        # The body is posed a few frames at once, and kept: whoever comes first would pay for all others.
        scene.motion.surface(frame + index + 1, state.origin[0].numpy())
        began = clock()
        step = scene.step_input(frame + index, state) if first is None or index > 0 else first
        problem = stepper.search(StepProblem(scene.cloth, state, step, gravity=stepper.gravity.to(state.pos)))
        prediction = stepper.predict(problem, prepared, None)
        velocity = stepper.next_velocity(problem, prediction)
        ms.append(1e3 * (clock() - began))
        state = recentre(State(prediction.next_pos, velocity, state.origin), scene.cloth.vertex_scene)
        yield prediction.next_pos, state


def take_steps(variant: Variant, begun: Begun, num_frames: int, effect: Effect) -> tuple[Tensor, Tensor]:
    """Steps of a variant from the window's first state: positions (V, 3) [m] after the first step, in that state's frame, and
    after all of them, world. Its times [ms] go to ``effect``."""
    steps = advance(variant, begun.state, begun.frame, num_frames, effect.ms, begun.step.step)
    first, state = next(steps)
    for _, last in steps:
        state = last
    return first, world(state)


def world(state: State) -> Tensor:
    """Positions (V, 3) [m] in the world, float64, on the CPU."""
    return state.pos.cpu().double() + state.origin[0]


def measure_ablation(
    full: Variant,
    variants: dict[str, Variant],
    begun: Sequence[Begun],
    num_frames: int,
    enough: Callable[[str, Effect, Effect], bool] = lambda name, effect, of_full: False,
) -> dict[str, Effect]:
    """Effects by name, of all ``variants`` and of the full model, whose name is empty. They take turns window by window.

    Args:
        enough: says after every window, of a name, its effect so far and that of the full model, whether that will do.
    """
    everything = {"": full, **variants}
    for variant in everything.values() if num_frames == 1 else ():
        take_steps(variant, begun[0], 1, Effect())  # what a stepper makes at its first step is not a frame's time
    effects, going = {name: Effect() for name in everything}, list(everything)
    for one in begun:
        firsts: dict[str, Tensor] = {}
        lasts: dict[str, Tensor] = {}
        for name, variant in ((name, everything[name]) for name in going):
            firsts[name], lasts[name] = take_steps(variant, one, num_frames, effects[name])
            if one is begun[0] and num_frames > 1:
                del effects[name].ms[0]  # nor is it here
        e0, values = float(scale(in_double(one.step)).sum()), [_phi(full.potential, one, pos) for pos in firsts.values()]
        lowest, exact = _minimum(full.potential, one, list(firsts.values()), values)
        for phi, name in zip(values, going, strict=True):
            effect = effects[name]
            effect.gamma.append((phi - lowest) / e0)
            effect.exact.append(exact)
            effect.last.append(lasts[name])
            half, most = vertex_distances(lasts[name], lasts[""])
            effect.half_mm.append(half)
            effect.mm.append(most)
        going = [name for name in going if not name or not enough(name, effects[name], effects[""])]
    return effects


def vertex_distances(one: Tensor, other: Tensor) -> tuple[float, float]:
    """Median and 95th percentile [mm] of the distances between points (N, 3) [m]; infinite where one is not finite."""
    apart = (one - other).norm(dim=1)
    if not bool(torch.isfinite(apart).all()):
        return float("inf"), float("inf")
    return 1e3 * float(apart.median()), 1e3 * float(apart.quantile(_QUANTILE))


def active_terms(full: Variant, begun: Sequence[Begun]) -> set[str]:
    """Names of the full potential's terms that can be anything but a constant zero in one of the windows."""
    return {name for one in begun for name in full.potential.active(one.step)}


def prices(full: Variant, begun: Sequence[Begun]) -> dict[str, float]:
    """By term, the largest ‖∇E‖ / ‖M g‖ where the full model's first steps lead: a force in units of the weight."""
    found: dict[str, float] = {}
    for one in begun:
        problem = in_double(one.step)
        for name, term in full.potential.active(one.step).items():
            gradient, _ = full.potential.only({name: term}).gradient(problem, one.solved.detach().double())
            found[name] = max(found.get(name, 0.0), float(relative_gradient(problem, gradient).max()))
    return found


def _phi(potential: Potential, one: Begun, pos: Tensor) -> float:
    value = float(potential.total(in_double(one.step), pos.detach().double()).sum())
    return value if np.isfinite(value) else float("inf")


def _minimum(potential: Potential, one: Begun, known: Sequence[Tensor], values: Sequence[float]) -> tuple[float, bool]:
    """The lowest potential [J] of a tight minimisation from the best of ``known`` positions (V, 3) [m] and of their own
    ``values`` [J]; whether the minimisation reached its accuracy."""
    best = known[int(np.argmin(values))].detach().double()
    _, report = minimize(potential, in_double(one.step), best, REFERENCE)
    return min(float(report.phi.sum()), *values), bool(report.converged.all())
