"""``stepper=auto`` and ``refine=auto``: what they become for a scene on this device, and sentences that say why.

On a CPU nothing is measured, so that one command gives one result: the solver takes the steps. A command that gives a key
of the network, as ``checkpoint`` or ``refine``, has chosen it (:func:`hood.app.settings.compose.with_network`).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from hood.app.settings.compose import plain
from hood.app.settings.rollout_settings import RolloutSettings, refinement, with_value
from hood.app.stepping.cloth_contact import potential_of
from hood.app.stepping.refinement import AUTO, refined
from hood.app.stepping.steppers import losses_of, make_solver, option_of, with_air, with_stepper
from hood.energies.potential import Potential, default_potential
from hood.rollouts.loop import simulate
from hood.scene.scene import NotWornError, Scene
from hood.steppers.newton import Stepper
from hood.steppers.ranges import scene_conditions
from hood.steppers.static_shapes.simulator import network_of

#: Iterations after a network on a garment larger than those it was trained on: γ about 0.01 from 1,000 to 12,000 vertices
#: (hood/studies/notes/accuracy.md).
ITERATIONS = 5
#: A garment has more vertices than the weights know where it has this many times the most of their training.
_LARGER = 1.1
#: Frames that tell how long one takes, the start and a first one to warm up included; a shorter rollout gets no advice.
_TIMED_FRAMES = 4
_LEAST_FRAMES = 10


@dataclass
class Choice:
    """What the keys became.

    Args:
        stepper, refine: their values; ``refine`` is None where another key, or no network, says how far a step is taken.
        ms: of a frame, as measured, by stepper.
        why: sentences for the user.
    """

    stepper: str
    refine: int | None = None
    ms: dict[str, float] = field(default_factory=dict)
    why: list[str] = field(default_factory=list)

    def settle(self, config: RolloutSettings) -> RolloutSettings:
        """The config with these values in the place of ``auto``."""
        settled = with_stepper(config, self.stepper)
        if self.refine is None:
            return settled
        return settled.with_values(refine=with_value(plain(config.refine), "goal", self.refine))


def decided(config: RolloutSettings) -> tuple[RolloutSettings, list[str]]:
    """The config with the air and the stepper that need no measurement, and why; what has to be measured stays ``auto``."""
    config, air = with_air(config)
    if str(config.stepper) != AUTO or str(config.device) != "cpu":
        return config, air
    why = "stepper=newton: the solver, the default on a CPU; checkpoint=… or refine=… takes a network"
    return with_stepper(config, "newton"), [why, *air]


def choose(config: RolloutSettings, stepper: Stepper, scene: Scene) -> Choice:
    """What ``auto`` means for this scene, whose steps a network takes (``stepper``) unless the config names a solver."""
    asked = str(config.stepper)
    choice = Choice("network" if asked == AUTO else asked)
    if refinement(config).goal == AUTO:
        choice.refine = _iterations(config, stepper, scene, choice)
    if asked == AUTO:
        _compare(config, stepper, scene, choice)
    return choice


def advice(config: RolloutSettings, scene: Scene, summary: dict[str, Any], start: np.ndarray) -> list[str]:
    """After a rollout with a network: a sentence where the solver alone is faster here, and goes further down the potential.

    The solver is measured from the rollout's own ``start`` (V, 3) [m], world.
    """
    total = summary["ms_per_frame"].get("total") or {}
    reached, target = summary["relative_gradient_median"], float(config.solver.target_rg)
    if str(config.stepper) != "network" or int(summary["num_frames"]) < _LEAST_FRAMES or not total.get("median"):
        return []
    alone = _measure(solver(config), replace(scene, start_pos=start), losses_of(config), metrics="none")
    if alone is None or alone.ms >= total["median"] or (reached is not None and reached <= target):
        return []
    here = "" if reached is None else f", {reached:.2g} with the network"
    return [
        f"the solver alone takes {alone.ms:.0f} ms a frame here, the network {total['median']:.0f}, and leaves less unbalanced "
        f"force (relative gradient {target:g}{here}): stepper=newton"
    ]


def solver(config: RolloutSettings) -> Stepper:
    """The stepper of ``stepper=newton``."""
    alone = with_stepper(config, "newton")
    return make_solver(option_of(alone), alone, potential_of(alone))


def _iterations(config: RolloutSettings, stepper: Stepper, scene: Scene, choice: Choice) -> int:
    """Refinement that the garment's size needs: none where the weights know it, or do not say what they know."""
    network = network_of(stepper)
    if network is None or network.trained_for is None:
        return 0
    asked = scene_conditions(scene.garment, scene.cloth, scene.dt, default_potential())
    (_, vertices), (_, known) = asked.spans["vertices"], network.trained_for.spans.get("vertices", (0.0, float("inf")))
    if vertices <= _LARGER * known:
        return 0
    choice.why.append(
        f"refine={ITERATIONS}: {scene.garment.name} has {vertices:,.0f} vertices, {config.checkpoint} was trained on "
        f"{known:,.0f} at most (refine=0 leaves it to the network alone)"
    )
    return ITERATIONS


def _compare(config: RolloutSettings, stepper: Stepper, scene: Scene, choice: Choice) -> None:
    """The network where a frame of it takes less time than one of the solver and leaves no more force; both are measured."""
    potential, size, scene = losses_of(config), scene.cloth.num_vertices, _put_on(scene)
    with_network = _measure(refined(stepper, choice.settle(config), size), scene, potential)
    alone = _measure(solver(config), scene, potential)
    accurate = max(float(config.solver.target_rg), 0.0 if alone is None else alone.rg)
    if with_network is None or alone is None or alone.ms < with_network.ms or not with_network.rg <= accurate:
        choice.stepper, choice.refine = "newton", 0 if refinement(config).goal == AUTO else None
        choice.why = []
    if with_network is None or alone is None:
        choice.why.append(f"stepper={choice.stepper}: the motion is too short to measure which is faster")
        return
    choice.ms = {"network": with_network.ms, "newton": alone.ms}
    times = f"a frame of the solver takes {alone.ms:.0f} ms here, one of the network {with_network.ms:.0f} ms"
    forces = f"the relative gradient is {alone.rg:.2g} with the solver, {with_network.rg:.2g} with the network"
    choice.why.append(f"stepper={choice.stepper}: {times}; {forces}")


def _put_on(scene: Scene) -> Scene:
    """The scene with the garment settled in its first frame, once for all that is measured there; itself where it cannot be."""
    try:
        start = scene.start(0, relaxed=False, thorough=True)
    except NotWornError:
        return scene
    return replace(scene, start_pos=(start.pos.double().cpu() + start.origin[0]).numpy())


class Measured(NamedTuple):
    """Of a few frames: milliseconds of the shortest, and the median of the unbalanced force [relative gradient]."""

    ms: float
    rg: float


def _measure(stepper: Stepper, scene: Scene, potential: Potential, metrics: str = "all") -> Measured | None:
    """Of the first frames of a scene; None where the motion has too few. What is measured counts for no time."""
    frames = simulate(stepper, scene, potential, _TIMED_FRAMES, metrics=metrics)
    rows = [frame.metrics for frame in frames if frame.index > 1]
    forces = [row.get("relative_gradient", float("nan")) for row in rows]
    return Measured(min(row["ms_total"] for row in rows), float(np.median(forces))) if rows else None
