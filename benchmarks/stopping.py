"""How far the solver has to go for an accuracy: iterations, and the γ that is left where different rules stop.

    python benchmarks/stopping.py
    python benchmarks/stopping.py --scenes dress_dance trousers_walk --states 40

States are those of the solver's own rollouts of scenes of ``benchmarks/plan.py``. From each, Newton's method goes on to rg
1e-4; γ of an iteration is what its potential is above the end, over e0. Then the rules are applied to what was written down of
the way: the relative gradient at most so large (``solver.target_rg``), the last iteration gained at most so much γ, so many
iterations. An oracle stops as soon as γ is 0.01, which no rule can know: none needs fewer. A line has the mean of the
iterations, γ (median, 95th and 99th percentile, most), and the share of the states with γ of at most 0.01. A rule that is
never met stops at the end of the way.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple
from unittest import mock

import numpy as np
from plan import LONGEST, SCENES, words_of

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))  # the tests' own files of bodies and motions
import workshop

import hood
from hood.energies.potential import scale
from hood.energies.problem import StepProblem
from hood.evaluation.gap import StepSample
from hood.rollouts.loop import simulate
from hood.solver.newton import NewtonSettings, minimize

FINE = NewtonSettings(target_rg=1e-4)
#: The γ that is asked for.
ENOUGH = 0.01
USUAL = (
    "tank_plie tshirt_walk tshirt_dance trousers_walk trousers_silk shorts_squats dress_dance dress_jumps skirt_silk "
    "dress_denim skirt_dance longsleeve_walk"
).split()


class Way(NamedTuple):
    """A step from its start to its end: entries before the first iteration and after each."""

    gamma: np.ndarray  # above the end
    rg: np.ndarray


#: Whether a way stops after ``n`` iterations.
Rule = Callable[[Way, int], bool]
RULES: dict[str, Rule] = {
    "an oracle": lambda way, n: bool(way.gamma[n] <= ENOUGH),
    **{f"rg {limit:g}": lambda way, n, limit=limit: bool(way.rg[n] <= limit) for limit in (0.01, 0.03, 0.05, 0.1, 0.3)},
    **{
        f"γ gained {limit:g}": lambda way, n, limit=limit: n > 0 and bool(way.gamma[n - 1] - way.gamma[n] <= limit)
        for limit in (1e-3, 3e-3, 0.01, 0.03)
    },
    **{f"{count} iterations": lambda way, n, count=count: n == count for count in (3, 5, 8)},
}


def ways(scene: str, files: workshop.Workshop, frames: int, states: int) -> list[Way]:
    """Ways from states of a scene's rollout."""
    simulation = hood.simulate(**words_of(scene, files, frames))
    sample = StepSample(range(1, frames), states)
    for _ in simulate(
        simulation.stepper, simulation.scene, simulation.potential, frames, observe=sample, metrics="none", settle="equilibrium"
    ):
        pass
    found = []
    for problem, _ in sample.steps:
        fresh = StepProblem(problem.cloth, problem.state, problem.step, gravity=problem.gravity)
        known = simulation.potential.prepare(fresh)
        history = minimize(simulation.potential, known, settings=FINE)[1].history
        phi = np.array([float(entry.phi.sum()) for entry in history])
        rg = np.array([float(entry.relative_gradient.max()) for entry in history])
        found.append(Way((phi - phi[-1]) / float(scale(known).sum()), rg))
    return found


def line(name: str, rule: Rule, found: list[Way]) -> str:
    """What a rule leaves of the ways."""
    stops = [next((n for n in range(len(way.rg)) if rule(way, n)), len(way.rg) - 1) for way in found]
    gamma = np.array([way.gamma[stop] for way, stop in zip(found, stops, strict=True)])
    parts = [np.median(gamma), *np.quantile(gamma, (0.95, 0.99)), gamma.max()]
    return f"{name:16}{np.mean(stops):11.1f}" + "".join(f"{part:10.1e}" for part in parts) + f"{np.mean(gamma <= ENOUGH):10.1%}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--scenes", nargs="+", default=USUAL, choices=list(SCENES), metavar="SCENE", help="of benchmarks/plan.py"
    )
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--states", type=int, default=20, help="of every scene")
    arguments = parser.parse_args()
    found: list[Way] = []
    with tempfile.TemporaryDirectory() as folder, mock.patch.object(workshop, "COUNT", LONGEST), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what scenes say of themselves
        files = workshop.Workshop(Path(folder))
        for scene in arguments.scenes:
            found += ways(scene, files, arguments.frames, arguments.states)
    print(f"{len(found)} states of {', '.join(arguments.scenes)}\n{'rule':16}{'iterations':>11}", end="")
    print("".join(f"{head:>10}" for head in ("γ median", "95%", "99%", "most", "≤ 0.01")))
    for name, rule in RULES.items():
        print(line(name, rule, found))


if __name__ == "__main__":
    main()
