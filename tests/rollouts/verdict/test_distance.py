"""How far steps have to go: minima, offsets that are known, layers, and rollouts that do not notice."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.energies.potential import default_potential
from hood.energies.problem import StepProblem
from hood.energies.self_contact import LayerBarrier, SignedSelfContactPenalty
from hood.rollouts.frame import metric_names
from hood.rollouts.loop import simulate
from hood.rollouts.verdict.distance import DISTANCE_METRICS, distance_metrics, estimate
from hood.scene.scene import Scene
from hood.solver.newton import NewtonSettings, minimize
from hood.steppers.network import build_simulator
from hood.steppers.newton import NewtonStepper, Stepper
from hood.steppers.refined import GuessStepper, RefinedStepper
from hood.steppers.stopping import Count
from hood.testing import grid, make_problem

POTENTIAL = default_potential()
LAYERED = POTENTIAL.with_terms(layers=LayerBarrier())
TIGHT = NewtonSettings(target_rg=1e-8)


def sheet(held: int = 9, dtype: torch.dtype = torch.float64) -> StepProblem:
    """A sheet that begins to fall, the first ``held`` of its 81 vertices pinned where they are."""
    pos, faces = grid(9, 9, 0.3)
    cloth = build_cloth(pos, faces, Material(), pinned=np.arange(len(pos)) < held, dtype=dtype)
    problem = make_problem(cloth)
    return replace(problem, step=replace(problem.step, pin_target=problem.state.pos))


def closing_sheets() -> StepProblem:
    """Two sheets that fly through each other within the step, but for what keeps them apart."""
    pos, faces = grid(9, 9, 0.3)
    rest, both = np.concatenate([pos, pos]), np.concatenate([faces, faces + len(pos)])
    down = np.zeros_like(rest)
    down[len(pos) :, 1] = -0.9
    cloth = build_cloth(rest, both, Material(), dtype=torch.float64)
    return make_problem(cloth, np.concatenate([pos, pos + [0.013, 0.01, 0.008]]), down)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_minimum_has_no_way_to_go(dtype: torch.dtype) -> None:
    problem = POTENTIAL.prepare(sheet(dtype=dtype))
    pos, _ = minimize(POTENTIAL, problem, settings=TIGHT)
    found = distance_metrics(POTENTIAL, problem, pos)
    assert 0.0 <= found["distance_p99"] <= found["distance_max"] < 1e-6


@pytest.mark.parametrize("offset", [2e-4, 0.05])
def test_the_way_of_a_quadratic_potential_is_known(offset: float) -> None:
    """Inertia and weight alone: every vertex has to go back what it was moved, however far."""
    potential = POTENTIAL.only({name: POTENTIAL.terms[name] for name in ("inertia", "gravity")})
    problem = potential.prepare(sheet(held=0))
    pos, _ = minimize(potential, problem, settings=TIGHT)
    pos[:, 0] += offset
    pos[40, 0] += 2.0 * offset
    true = float((pos[:, 0] - problem.state.pos[:, 0]).quantile(0.99))
    found = distance_metrics(potential, problem, pos)
    assert found["distance_p99"] == pytest.approx(true, rel=0.05)
    assert found["distance_max"] == pytest.approx(3.0 * offset, rel=0.05)


def estimated(monkeypatch: pytest.MonkeyPatch, sizes: list[float], limit: float | None = None) -> tuple[float, int]:
    """The 99th percentile and the iterations where Newton's steps have these lengths [m], the search takes a tenth of each, and
    the force stays."""
    taken = iter(range(100))

    class Way:
        residual = 1.0

        def __init__(self, potential: object, problem: object, start: torch.Tensor) -> None:
            self.pos, self.direction = start.clone(), torch.zeros_like(start)

        def move(self) -> bool:
            self.direction = torch.zeros_like(self.pos)
            self.direction[:, 0] = sizes[min(next(taken), len(sizes) - 1)]
            self.pos = self.pos + 0.1 * self.direction
            return True

    monkeypatch.setattr("hood.rollouts.verdict.distance.Further", Way)
    problem = sheet()
    found = estimate(POTENTIAL, problem, problem.state.pos, limit)
    return found.p99, next(taken)


def test_a_step_of_a_model_without_a_minimum_tells_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    usual, _ = estimated(monkeypatch, [0.01, 0.01, 0.01, 0.01, 0.01])
    wild, _ = estimated(monkeypatch, [0.01, 0.01, 0.01, 1.0, 0.01])
    assert usual == pytest.approx(1.3 * math.sqrt(0.2) * 0.05)
    assert wild < 3.0 * usual


@pytest.mark.parametrize(("limit", "iterations"), [(None, 5), (0.010, 30), (0.060, 30), (0.5, 5), (0.002, 5)])
def test_near_the_limit_it_looks_again_by_the_estimate_or_by_newtons_steps(
    limit: float | None, iterations: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The estimate is 2.9 cm, the steps are 5 cm in all."""
    assert estimated(monkeypatch, [0.01], limit)[1] == iterations


def test_the_estimate_is_within_a_factor_of_two_for_a_sheet_that_was_pulled() -> None:
    problem = POTENTIAL.prepare(sheet())
    end, _ = minimize(POTENTIAL, problem, settings=TIGHT)
    there = end + 0.1 * torch.sin(10.0 * end[:, [1, 2, 0]])
    there = torch.where(problem.cloth.pinned.unsqueeze(1), end, there)
    star, _ = minimize(POTENTIAL, problem, there, TIGHT)
    true = float((star - there).norm(dim=1)[problem.cloth.free].quantile(0.99))
    assert true > 0.05
    assert true / 2 < distance_metrics(POTENTIAL, problem, there)["distance_p99"] < 2 * true


def test_vertices_that_are_held_do_not_count() -> None:
    problem = POTENTIAL.prepare(sheet(held=80))
    pos, _ = minimize(POTENTIAL, problem, settings=TIGHT)
    pos[80, 1] -= 0.02
    found = distance_metrics(POTENTIAL, problem, pos)
    assert found["distance_p99"] == found["distance_max"] == pytest.approx(0.02, rel=0.5)
    everything = POTENTIAL.prepare(sheet(held=81))
    assert distance_metrics(POTENTIAL, everything, everything.state.pos) == dict.fromkeys(DISTANCE_METRICS, 0.0)


@pytest.mark.usefixtures("compiled_layers")
def test_layers_are_kept_apart_from_where_the_step_ended() -> None:
    """The way there was bent around cloth; the straight one is blocked, and nothing of it has to be gone again."""
    problem = LAYERED.prepare(closing_sheets())
    pos, report = minimize(LAYERED, problem, settings=replace(TIGHT, target_rg=1e-5))
    assert bool(report.converged.all())
    known = problem.layers[0].layers.mesh.apart
    assert distance_metrics(LAYERED, problem, pos)["distance_max"] < 1e-5
    assert problem.layers[0].layers.mesh.apart is known
    upper = torch.arange(len(pos)).unsqueeze(1) >= len(pos) // 2
    lifted = torch.where(upper, pos + pos.new_tensor([0.0, 0.01, 0.0]), pos)
    assert 0.005 < distance_metrics(LAYERED, problem, lifted)["distance_p99"] < 0.02


class _Deceptive:
    """A potential whose slope leads nowhere: its force pulls sideways, its energy does not know of that."""

    def applies(self, problem: StepProblem) -> bool:
        return True

    def __call__(self, problem: StepProblem, next_pos: torch.Tensor, acc: torch.Tensor) -> torch.Tensor:
        return problem.sum_vertices(next_pos[:, 0] - next_pos[:, 0].detach())


def test_a_way_that_the_search_does_not_find_is_left() -> None:
    potential, problem = POTENTIAL.with_terms(odd=_Deceptive()), POTENTIAL.prepare(sheet())
    pos, _ = minimize(POTENTIAL, problem, settings=TIGHT)
    assert torch.equal(minimize(potential, problem, pos, TIGHT)[0], pos)
    assert distance_metrics(potential, problem, pos)["distance_p99"] > 1e-3


def test_nothing_is_known_of_steps_that_are_not_finite_and_of_potentials_for_training() -> None:
    problem = POTENTIAL.prepare(sheet())
    broken = problem.state.pos.clone()
    broken[40, 1] = math.inf
    training = POTENTIAL.with_terms(sides=SignedSelfContactPenalty())
    for potential, pos in ((POTENTIAL, broken), (training, problem.state.pos)):
        found = distance_metrics(potential, potential.prepare(problem), pos)
        assert list(found) == list(DISTANCE_METRICS)
        assert all(math.isnan(value) for value in found.values())


def stepper_of(kind: str) -> Stepper:
    if kind == "network":
        torch.manual_seed(0)
        return build_simulator(features="physical", output="velocity_base", latent_dim=8, schedule="1x(mesh+coarse0)").eval()
    if kind == "newton":
        return NewtonStepper(LAYERED, NewtonSettings(target_rg=1e-2))
    if kind == "guess":
        return RefinedStepper(GuessStepper(LAYERED), LAYERED, Count(2))
    return RefinedStepper(GuessStepper(POTENTIAL), POTENTIAL, Count(2), method="sweeps")


@pytest.mark.usefixtures("compiled_layers")
@pytest.mark.parametrize("kind", ["network", "newton", "guess", "sweeps"])
def test_rollouts_measure_at_twice_the_stride_and_last_and_do_not_notice(band_scene: Scene, kind: str) -> None:
    potential = LAYERED if kind in ("newton", "guess") else POTENTIAL
    both = [
        list(simulate(stepper_of(kind), band_scene, potential, 6, relaxing_steps=0, metrics=metrics, surface_stride=2))
        for metrics in ("all", "none")
    ]
    assert set(DISTANCE_METRICS) <= set(metric_names(potential, stepper_of(kind)))
    assert [set(DISTANCE_METRICS) <= set(frame.metrics) for frame in both[0]] == [False, False, False, False, True, True]
    assert not any("distance_p99" in frame.metrics for frame in both[1])
    assert all(torch.equal(a.world_pos, b.world_pos) for a, b in zip(*both, strict=True))
    way = [frame.metrics["distance_p99"] for frame in both[0] if "distance_p99" in frame.metrics]
    assert max(way) < 1e-3 if kind == "newton" else min(way) > 1e-5
