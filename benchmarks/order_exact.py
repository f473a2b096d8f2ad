"""What exact steps say about how far a load is felt: measured with the solver, no network involved."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import sparse
from scipy.sparse.csgraph import dijkstra
from torch import Tensor

from hood.assets.body.load import load_body
from hood.assets.garment.garment import load_garment
from hood.assets.motion.load import load_sequence
from hood.cloth.cloth import Cloth
from hood.cloth.state import State
from hood.energies.potential import default_potential, scale
from hood.energies.problem import StepProblem, inertial_guess
from hood.evaluation.gap import REFERENCE, StepSample
from hood.evaluation.table import Candidate, GapSettings, evaluate
from hood.model.features.physical import GRAVITY
from hood.model.readout.output import LocalStepOutput
from hood.rollouts.equilibrium import find_equilibrium
from hood.rollouts.loop import simulate
from hood.scene.scene import Scene, build_scene
from hood.solver.newton import NewtonSettings, minimize
from hood.solver.system.iterate import in_double
from hood.steppers.network import Prediction
from hood.steppers.newton import NewtonStepper, Stepper
from hood.steppers.protocol import Stopwatch

POTENTIAL = default_potential()
#: How far [m] pins are pulled up in :func:`felt`: little beside what gravity stretches.
PULL = 1e-3
#: Where the decay is measured: from the pins down to this share of what they moved.
LEAST = 0.05
PRECISE = NewtonSettings(target_rg=1e-7, max_iterations=300)


@dataclass(frozen=True)
class Felt:
    """How far cloth moves in one step in which its pins are pulled up by :data:`PULL`."""

    distance: np.ndarray  # (V,) m from the pins along the mesh, at rest
    share: np.ndarray  # (V,) of the pull
    decay: float  # m over which the share falls by e


class PatchStepper(NewtonStepper):
    """Steps that are exact as far as a radius allows: nothing to train, and nothing known of what is farther away.

    Cloth so many edges from the pins takes the place that it has in the minimum where cloth that is more than ``radius`` edges
    nearer to the pins, or farther from them, goes on as it came.
    """

    def __init__(self, radius: int) -> None:
        super().__init__(POTENTIAL)
        self.radius = radius

    def predict(self, problem: StepProblem, prepared: None, watch: Stopwatch | None = None) -> Prediction:
        """Positions from one minimisation for every number of edges from the pins."""
        work = in_double(POTENTIAL.prepare(problem))
        hops = torch.as_tensor(from_pins(problem.cloth)[1])
        pos, farthest = goal(work, ahead(work)).clone(), int(hops.max())
        solved: dict[bytes, Tensor] = {}  # rings that see the whole cloth share a minimum
        for ring in range(1, farthest + 1):
            held = (hops - ring).abs() > self.radius
            key = held.numpy().tobytes()
            if key not in solved:
                solved = {key: with_held(work, held & (hops > 0))}
            pos[hops == ring] = solved[key][hops == ring]
        pos = pos.to(problem.state.pos.dtype)
        return Prediction(pos, problem.acceleration(pos))


def ahead(problem: StepProblem) -> Tensor:
    """Where cloth is (V, 3) [m] that goes on as it came."""
    return inertial_guess(problem.state, problem.step, problem.cloth.vertex_scene)


def goal(problem: StepProblem, pos: Tensor) -> Tensor:
    """``pos`` (V, 3) with the pins at their targets."""
    assert problem.step.pin_target is not None
    return torch.where(problem.cloth.pinned.unsqueeze(1), problem.step.pin_target, pos)


def with_held(problem: StepProblem, held: Tensor, at: Tensor | None = None) -> Tensor:
    """The minimum (V, 3) where vertices ``held`` (V,) are held ``at`` (V, 3), by default where they go as they came."""
    at = ahead(problem) if at is None else at
    cloth = replace(problem.cloth, pinned=problem.cloth.pinned | held)
    inner = replace(problem, cloth=cloth, step=replace(problem.step, pin_target=goal(problem, at)))
    return minimize(POTENTIAL, inner, at, REFERENCE)[0]


def make_scene(garment: Path, body: Path, motion: Path, fps: int) -> Scene:
    return build_scene(load_garment(garment), load_body(body), load_sequence(motion, fps))


def felt(scene: Scene) -> Felt:
    """One step from rest with pins that stay, and one with pins that are pulled up; the difference by distance."""
    cloth = scene.cloth
    start = scene.start(0, relaxed=False)
    rest = find_equilibrium(scene, POTENTIAL, start, 0, NewtonStepper(POTENTIAL).gravity)
    still = State(rest.pos, torch.zeros_like(rest.pos), start.origin)
    step = scene.step_input(0, still)
    ends = []
    for pull in (0.0, PULL):
        target = still.pos.double() + torch.tensor([0.0, pull, 0.0], dtype=torch.float64)
        problem = in_double(POTENTIAL.prepare(StepProblem(cloth, still, step)))
        problem = replace(problem, step=replace(problem.step, pin_target=target))
        ends.append(minimize(POTENTIAL, problem, still.pos, PRECISE)[0])
    share = ((ends[1] - ends[0])[:, 1] / PULL).numpy()
    distance, _ = from_pins(cloth)
    near = (share > LEAST) & (distance > 0)
    # Through what the pins themselves do, e⁰ at 0, with every vertex counted alike.
    slope = float((distance[near] * np.log(share[near])).sum() / (distance[near] ** 2).sum())
    return Felt(distance, share, -1.0 / slope)


def from_pins(cloth: Cloth) -> tuple[np.ndarray, np.ndarray]:
    """Distance [m] at rest and number of edges from the nearest pin along the mesh, (V,) each."""
    edges, pos = cloth.edges.numpy(), cloth.rest_pos.numpy()
    lengths = np.linalg.norm(pos[edges[:, 0]] - pos[edges[:, 1]], axis=1)
    graph = sparse.csr_matrix((lengths, (edges[:, 0], edges[:, 1])), shape=(len(pos), len(pos)))
    pins = np.flatnonzero(cloth.pinned.numpy())
    metres, hops = (dijkstra(graph, False, pins, unweighted=one, min_only=True) for one in (False, True))
    return np.asarray(metres), np.asarray(hops)


def steps(scene: Scene, states: int, frames: int) -> Iterator[StepProblem]:
    """Steps of the solver's own rollout, spread evenly over it."""
    sample = StepSample(range(3, frames), states)
    for _ in simulate(NewtonStepper(POTENTIAL), scene, POTENTIAL, frames, observe=sample, metrics="none"):
        pass
    for problem, _ in sample.steps:
        yield problem


def own_rollout(stepper: Stepper, scenes: Sequence[Scene], frames: int, states: int) -> dict[str, float]:
    """The columns of ``hood evaluate`` of rollouts of a stepper."""
    candidate, settings = Candidate("", "none", stepper), GapSettings(states, replace(REFERENCE, max_iterations=100))
    row = evaluate([candidate], {"cloth": scenes}, POTENTIAL, frames, settings)[-1]
    return {name: float(row[name]) for name in ("gap", "gap_p95", "L_total", "gradient_norm", "strain_p99", "rg")}


def about(scenes: Sequence[Scene], radii: Sequence[int], frames: int, states: int) -> dict[str, Any]:
    """Everything that is said about a scene without a network, as plain numbers; ``scenes`` differ in their motion."""
    first, pull = scenes[0], felt(scenes[0])
    found = [floors(problem, list(radii)) for scene in scenes for problem in steps(scene, states, frames)]
    problem = next(steps(first, 1, frames))
    return {
        "decay": pull.decay,
        "distance": pull.distance.tolist(),
        "share": pull.share.tolist(),
        "floors": {name: [floor[name] for floor in found] for name in found[0]},
        "e0": float(scale(in_double(problem))),
        "vertex_weight": float(first.cloth.mass.double().mean()) * GRAVITY,
        "newton": own_rollout(NewtonStepper(POTENTIAL), scenes, frames, states),
    }


def floors(problem: StepProblem, radii: list[int]) -> dict[str, float]:
    """γ of steps in which what the pins do is felt up to so many edges away, by their number, and of steps without a network.

    Cloth farther away moves as it would if the pins went on as they came: what a network knows there at best that is told
    nothing of the pins. Cloth that is nearer takes the best places that are left. ``base`` is where the network's corrections
    start from, ``inertia`` free flight.
    """
    problem = POTENTIAL.prepare(problem.with_contact())
    work, cloth = in_double(problem), problem.cloth
    unaware, _ = minimize(POTENTIAL, replace(work, step=replace(work.step, pin_target=ahead(work))), None, REFERENCE)
    exact = minimize(POTENTIAL, work, None, REFERENCE)[1], minimize(POTENTIAL, work, unaware, REFERENCE)[1]
    least, e0 = min(float(report.phi) for report in exact), float(scale(work))

    def gamma(pos: Tensor) -> float:
        return (float(POTENTIAL.total(work, goal(work, pos.double()))) - least) / e0

    _, hops = from_pins(cloth)
    found = {"base": gamma(LocalStepOutput().base(problem)), "inertia": gamma(ahead(work))}
    for radius in radii:
        found[str(radius)] = gamma(with_held(work, torch.as_tensor(hops > radius), unaware))
    return found
