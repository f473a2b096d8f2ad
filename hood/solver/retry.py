"""Minima that are found again with cloth held farther off, where they leave it in the skin (:mod:`hood.contact.further`)."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from hood.energies.potential import Potential
from hood.energies.problem import StepProblem
from hood.solver.newton import NewtonSettings, Report, minimize

#: So often is a step taken again that has led into skin which its contact did not show.
MOST_AGAIN = 3
#: So often is one taken again with cloth held farther off: by 3, 9, 21 and 45 mm.
MOST_RAISED = 4
#: That ends where so many minima of a scene have been missed.
MOST_MISSES = 2


class HeldOff(NamedTuple):
    """A step with cloth held as far off as it took."""

    problem: StepProblem
    pos: Tensor  # (V, 3) m, its minimum
    report: Report | None  # of that minimum; what was given where nothing is held off
    rounds: int  # so often it was taken again; 0 where few triangles are in the skin, or nothing can be held off
    iterations: int  # that were spent on that


def minimize_held_off(
    potential: Potential, problem: StepProblem, pos: Tensor, settings: NewtonSettings, report: Report | None = None
) -> HeldOff:
    """The problem with cloth held off as far as it took, and its minimum; the problem and ``pos`` themselves where these leave
    no more triangles in the skin than are allowed.

    Of the minima that are found on the way, that with the fewest triangles in the skin counts, scene by scene. What missed
    its minimum is not taken, and a scene that missed two is held off no farther: cloth that is caught between skin and skin
    finds no balance farther off.

    Args:
        problem: prepared by ``potential``.
        pos: (V, 3) m, its minimum.
        report: of ``pos``, which may have missed the minimum; None where it is known to be one.
    """
    best, least, rounds, spent = HeldOff(problem, pos, report, 0, 0), None, 0, 0
    misses = torch.zeros(problem.num_scenes, dtype=torch.int64, device=pos.device)
    if report is not None:
        misses += ~report.converged.to(misses.device)
    unsolved = misses > 0
    for _ in range(MOST_RAISED):
        again = problem.with_held_off(pos, misses < MOST_MISSES)
        if again is problem:
            break
        least = problem.num_in_skin(pos) if least is None else least
        problem = again
        pos, found = minimize(potential, problem, pos, settings)
        pos = torch.where(torch.isfinite(pos), pos, best.pos)  # what is no number is missed, and no place to go on from
        rounds, spent = rounds + 1, spent + found.iterations
        met = found.converged.to(misses.device) & (misses < MOST_MISSES)
        misses += ~met
        if bool((misses >= MOST_MISSES).all()):
            break
        count = problem.num_in_skin(pos)
        better = met & (unsolved | (count < least))
        unsolved = unsolved & ~better
        least = torch.where(better, count, least)
        best = _by_scene(better, HeldOff(problem, pos, found, 0, 0), best)
    return best._replace(rounds=rounds, iterations=spent)


def _by_scene(better: Tensor, new: HeldOff, old: HeldOff) -> HeldOff:
    """``new`` in the scenes (B,) that are ``better`` by it, ``old`` in the others."""
    if bool(better.all()):
        return new
    if not bool(better.any()):
        return old
    rows = better[new.problem.cloth.vertex_scene]
    known, held = old.problem.contact, new.problem.contact
    assert known is not None
    assert held is not None
    assert held.raised is not None
    before = torch.zeros_like(held.raised) if known.raised is None else known.raised
    contact = replace(held, raised=torch.where(rows, held.raised, before))
    pos = torch.where(rows.unsqueeze(1), new.pos, old.pos)
    report = new.report if old.report is None or new.report is None else _merged(better, rows, new.report, old.report)
    return HeldOff(replace(new.problem, contact=contact), pos, report, 0, 0)


def _merged(better: Tensor, rows: Tensor, new: Report, old: Report) -> Report:
    reason = tuple(one if taken else other for taken, one, other in zip(better.tolist(), new.reason, old.reason, strict=True))

    def chosen(one: Tensor, other: Tensor) -> Tensor:
        return torch.where(better, one, other)

    return replace(
        new,
        phi=chosen(new.phi, old.phi),
        relative_gradient=chosen(new.relative_gradient, old.relative_gradient),
        converged=chosen(new.converged, old.converged),
        reason=reason,
        acc=torch.where(rows.unsqueeze(1), new.acc, old.acc),
    )
