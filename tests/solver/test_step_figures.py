"""What is measured of a step is what the potential says, whichever form computes it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.cloth.state import Attachments
from hood.contact.contact import SecondContact
from hood.energies import compiled_elements
from hood.energies.mass_points import Attachment, Gravity
from hood.energies.potential import Potential, default_potential, relative_gradient, scale
from hood.energies.problem import StepProblem, inertial_guess
from hood.solver.derivatives import compiled_vertices
from hood.solver.step_figures import StepFigures
from hood.testing import grid, make_problem, plane_contact


def sliding(pinned: bool, dtype: torch.dtype = torch.float64) -> tuple[StepProblem, Tensor]:
    """A sheet about a plane that slides, some of it held where asked for and one vertex on a spring; positions a step later."""
    rng = np.random.default_rng(1)
    pos, faces = grid(6, 5, 0.4)
    cloth = build_cloth(pos, faces, Material(), np.arange(len(pos)) % 7 == 0 if pinned else None, dtype=dtype)
    noise = torch.as_tensor(rng.normal(size=pos.shape))
    start = torch.as_tensor(pos) * torch.tensor([1.0, 0.0, 1.0]) + 1e-3 * noise
    problem = make_problem(cloth, start, 0.1 * noise.numpy(), 1 / 30, plane_contact(start.to(dtype)))
    target = start.to(dtype) + 0.01 if pinned else None
    ends = torch.tensor([[3, 20]])
    spring = Attachments(ends, torch.tensor([True]))
    step = replace(problem.step, pin_target=target, attachments=spring)
    moved = start + 5e-4 * torch.as_tensor(rng.normal(size=pos.shape))
    return replace(problem, step=step), moved.to(dtype)


def in_a_fold(problem: StepProblem) -> StepProblem:
    """The same sheet between the plane and another one, 3 mm above it."""
    pos = problem.state.pos
    return replace(problem, second_contact=SecondContact(plane_contact(pos, torch.tensor([0.0, -1.0, 0.0]), -3e-3)))


def expected(potential: Potential, problem: StepProblem, pos: Tensor, acc: Tensor) -> dict[str, float]:
    gradient, energies = potential.gradient(problem, pos, acc)
    free = problem.cloth.free
    guess = inertial_guess(problem.state, problem.step)
    if problem.step.pin_target is not None:
        guess = torch.where(problem.cloth.pinned[:, None], problem.step.pin_target, guess)
    return {
        **{f"energy_{name}": float(value) for name, value in energies.items()},
        "energy_total": float(sum(energies.values())),
        "energy_inertial_guess": float(potential.total(problem, guess)),
        "gradient_norm": float(gradient[free].norm(dim=1).mean()),
        "relative_gradient": float(relative_gradient(problem, gradient)),
        "e0": float(scale(problem)),
    }


@pytest.mark.parametrize("form", ["compiled", "torch"])
@pytest.mark.parametrize("pinned", [False, True])
@pytest.mark.parametrize("fold", [False, True])
@pytest.mark.parametrize(
    "potential",
    [
        default_potential(),
        default_potential(contact="edges"),
        default_potential().with_terms(wind=Gravity()),
        Potential({"attachment": Attachment()}),
    ],
    ids=["default", "points", "two of a kind", "springs alone"],
)
def test_figures_are_those_of_the_potential(
    potential: Potential, fold: bool, pinned: bool, form: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if form == "torch":
        for module in (compiled_elements, compiled_vertices):
            monkeypatch.setattr(module, "library", lambda: None)
    elif compiled_elements.library() is None:
        pytest.skip("no C++ compiler")
    problem, pos = sliding(pinned)
    problem = potential.prepare(in_a_fold(problem) if fold else problem)
    acc = problem.acceleration(pos)
    if fold and "collision" in potential.terms:
        (below, above), term = problem.contacts, potential.terms["collision"]
        assert min(float(term.depth(problem, one, pos)[0].max()) for one in (below, above)) > 0  # both press
    figures, wanted = StepFigures(potential, problem, pos, acc), expected(potential, problem, pos, acc)
    assert list(figures.metrics()) == list(wanted)
    assert figures.metrics() == pytest.approx(wanted, rel=1e-10, abs=1e-15)
    gradient = potential.gradient(problem, pos, acc)[0]
    torch.testing.assert_close(figures.gradient.to(gradient), gradient, rtol=1e-9, atol=1e-11 * float(gradient.abs().max()))


def test_the_acceleration_that_is_given_counts() -> None:
    problem, pos = sliding(False)
    potential, acc = default_potential(), torch.ones_like(pos)
    problem = potential.prepare(problem)
    figures = StepFigures(potential, problem, pos, acc)
    assert figures.metrics() == pytest.approx(expected(potential, problem, pos, acc), rel=1e-10)


def test_single_precision_is_measured_in_double() -> None:
    problem, pos = sliding(True, torch.float32)
    potential = default_potential()
    problem = potential.prepare(problem)
    acc = problem.acceleration(pos)
    wanted = expected(potential, problem, pos, acc)
    assert StepFigures(potential, problem, pos, acc).metrics() == pytest.approx(wanted, rel=1e-3)


def test_nothing_free_and_nowhere() -> None:
    pos, faces = grid(3, 3)
    held = make_problem(build_cloth(pos, faces, Material(), np.ones(len(pos), bool), dtype=torch.float64))
    potential = default_potential()
    values = StepFigures(potential, held, held.state.pos, torch.zeros_like(held.state.pos)).metrics()
    assert values["gradient_norm"] == values["relative_gradient"] == 0.0
    problem, place = sliding(False)
    problem = potential.prepare(problem)
    lost = torch.full_like(place, torch.inf)
    assert not np.isfinite(StepFigures(potential, problem, lost, lost).metrics()["relative_gradient"])
