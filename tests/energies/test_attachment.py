"""What closed attachments are drawn to."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.cloth.state import Attachments, StepInput, concatenate_step_inputs
from hood.energies.mass_points import Attachment, attachment_targets
from hood.energies.problem import StepProblem
from hood.testing import grid, make_problem

F64 = torch.float64
DT = 1 / 30


def fastened(length: float | None, speed: float | None, factor: float = 1.0) -> StepProblem:
    """A sheet of 0.3 m with two pairs across it, 0.3 m times ``factor`` apart."""
    cloth = build_cloth(*grid(4, 3, 0.3), Material(), dtype=F64)
    problem = make_problem(cloth, factor * cloth.rest_pos, dt=DT)
    edges = torch.tensor([[0, 9], [2, 11]])
    given = [None if value is None else torch.full((2,), value, dtype=F64) for value in (length, speed)]
    return replace(problem, step=replace(problem.step, attachments=Attachments(edges, torch.tensor([True, True]), *given)))


def gaps(problem: StepProblem) -> torch.Tensor:
    a, b = problem.step.attachments.edges.unbind(dim=1)
    return problem.state.pos[a] - problem.state.pos[b]


@pytest.mark.parametrize(("length", "goal"), [(0.004, 0.29), (0.295, 0.295), (0.3, 0.3), (0.5, 0.31)])
def test_a_pair_comes_to_its_distance_by_no_more_than_its_speed(length: float, goal: float) -> None:
    problem = fastened(length, 0.3)
    target, gap = attachment_targets(problem), gaps(problem)
    torch.testing.assert_close(target.norm(dim=1), torch.full((2,), goal, dtype=F64))
    torch.testing.assert_close(target / target.norm(dim=1, keepdim=True), gap / gap.norm(dim=1, keepdim=True))


def test_without_a_speed_a_pair_is_there_at_once_and_without_both_the_target_is_zero() -> None:
    torch.testing.assert_close(attachment_targets(fastened(0.05, None)).norm(dim=1), torch.full((2,), 0.05, dtype=F64))
    assert attachment_targets(fastened(None, None)) is None
    torch.testing.assert_close(attachment_targets(fastened(None, 0.3)).norm(dim=1), torch.full((2,), 0.29, dtype=F64))


def test_vertices_that_lie_on_each_other_have_no_direction_to_part_in() -> None:
    problem = fastened(0.004, 0.3, factor=0.0)
    assert torch.equal(attachment_targets(problem), torch.zeros(2, 3, dtype=F64))


def test_the_energy_is_that_of_a_spring_about_the_target() -> None:
    problem, term = fastened(0.004, 0.3), Attachment(1e3)
    a, b = problem.step.attachments.edges.unbind(dim=1)
    there = problem.state.pos.clone()
    there[a] = there[b] + attachment_targets(problem)
    assert float(term(problem, there, there)) == 0.0
    there[a[0], 1] += 2e-3
    assert float(term(problem, there, there)) == pytest.approx(0.5 * 1e3 * 4e-6)
    opened = replace(problem.step.attachments, active=torch.tensor([False, True]))
    assert float(term(replace(problem, step=replace(problem.step, attachments=opened)), there, there)) == 0.0


def test_a_length_of_zero_is_none_to_the_bit() -> None:
    plain, zero = fastened(None, None), fastened(0.0, None)
    pos = plain.state.pos + 0.01 * torch.randn(plain.state.pos.shape, dtype=F64)
    assert torch.equal(Attachment()(plain, pos, pos), Attachment()(zero, pos, pos))


def test_in_a_batch_each_pair_has_its_own_numbers() -> None:
    steps = [fastened(None, None).step, fastened(0.004, 0.3).step, StepInput(torch.tensor([DT], dtype=F64))]
    batched = concatenate_step_inputs(steps, [12, 12, 12]).attachments
    assert batched is not None
    assert batched.length.tolist() == [0.0, 0.0, 0.004, 0.004]
    assert batched.speed.tolist() == [torch.inf, torch.inf, 0.3, 0.3]
    assert concatenate_step_inputs([steps[0], steps[0]], [12, 12]).attachments.length is None
