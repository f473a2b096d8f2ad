"""Local descent, vertex by vertex: smooths what is wrong at short range, cheap enough to follow a network.

Groups of vertices that share no element and can move at the same time, and the elements around each.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from hood.cloth.cloth import Cloth
from hood.cloth.state import Attachments
from hood.energies.contact import Walls
from hood.energies.laws import contact_balance, contact_force
from hood.energies.potential import Potential, relative_gradient
from hood.energies.problem import StepProblem
from hood.energies.self_contact import has_layers
from hood.solver.derivatives import elements
from hood.solver.derivatives.elements import Corners, FaceConstants, HingeConstants
from hood.solver.derivatives.step_terms import PointForces, StepTerms
from hood.solver.derivatives.vertices import VertexForces
from hood.solver.step_figures import MOST_ITERATIONS, NO_PROGRESS, NOT_FINITE, STOPPED
from hood.solver.system.iterate import Iterate, Proceed, Progress, Unknowns, first_iterate, in_double, rounded
from hood.solver.system.linear import invert_blocks
from hood.solver.system.plan import SolverPlan, plan_for
from hood.solver.system.sparsity import BlockPattern, Scatter, upper_pairs


@dataclass(frozen=True)
class _Incidence:
    """Elements that touch the n vertices of a colour; each touches one of them, its *own* corner, and only that."""

    element: Tensor  # (M,) rows of the element table
    own: Tensor  # (M,) position of the own corner in its row
    gradient_sum: Scatter  # (3, M) → (n, 3)
    matrix_sum: Scatter  # upper triangles (6, M) → (n, 3, 3)


@dataclass(frozen=True)
class Colour:
    """One group of free vertices and what acts on them."""

    vertices: Tensor  # (n,)
    faces: _Incidence
    hinges: _Incidence
    attachments: _Incidence | None


def greedy_colours(pattern: BlockPattern) -> np.ndarray:
    """Colour (N,) of every block row, none shared between coupled rows; rows with most couplings choose first."""
    colour = np.full(pattern.size, -1, dtype=np.int64)
    starts, cols = pattern.starts.tolist(), pattern.cols
    for row in np.argsort(-np.diff(pattern.starts), kind="stable").tolist():
        taken = set(colour[cols[starts[row] : starts[row + 1]]].tolist())
        choice = 0
        while choice in taken:
            choice += 1
        colour[row] = choice
    return colour


def colours_of(plan: SolverPlan, cloth: Cloth, attachments: Attachments | None) -> list[Colour]:
    """The colours of a plan's free vertices, computed on first use."""
    if "colours" not in plan.cache:
        plan.cache["colours"] = _build(plan, cloth, attachments)
    colours = plan.cache["colours"]
    assert isinstance(colours, list)
    return colours


def _build(plan: SolverPlan, cloth: Cloth, attachments: Attachments | None) -> list[Colour]:
    colour = greedy_colours(plan.pattern)
    vertices = plan.vertices.cpu().numpy()
    tables = [cloth.faces, cloth.hinges] + ([] if attachments is None else [attachments.edges])
    numpy_tables = [table.cpu().numpy() for table in tables]
    device = cloth.faces.device
    colours = []
    for index in range(int(colour.max(initial=-1)) + 1):
        group = vertices[colour == index]
        place = np.full(cloth.num_vertices, -1, dtype=np.int64)
        place[group] = np.arange(len(group))
        around = [_incidence(table, place, len(group), device) for table in numpy_tables]
        group_index = torch.as_tensor(group, device=device)
        colours.append(Colour(group_index, around[0], around[1], around[2] if len(around) > 2 else None))
    return colours


def _incidence(table: np.ndarray, place: np.ndarray, size: int, device: torch.device) -> _Incidence:
    element, own = np.nonzero(place[table] >= 0)
    target = place[table[element, own]]
    axis, count = np.arange(3)[:, None], len(target)
    mirrored = sorted({(k, *pair) for k, (p, q) in enumerate(upper_pairs(3)) for pair in ((p, q), (q, p))})
    source, row, col = (np.array(part)[:, None] for part in zip(*mirrored, strict=True))
    return _Incidence(
        torch.as_tensor(element, device=device),
        torch.as_tensor(own, device=device),
        Scatter(3 * target + axis, axis * count + np.arange(count), 3 * size, 3 * count),
        Scatter(9 * target + 3 * row + col, source * count + np.arange(count), 9 * size, 6 * count),
    )


#: Shares of a sweep's displacement that are tried, in this order.
_SHARES = (1.0, 0.5, 0.25)


@dataclass(frozen=True)
class SweepReport:
    """What :func:`sweep` reached, scene by scene."""

    kept: Tensor  # (B,) sweeps that lowered the potential and were kept
    phi: Tensor  # (B,) J
    relative_gradient: Tensor  # (B,)
    reason: tuple[str, ...]  # (B) of :mod:`hood.solver.step_figures`
    acc: Tensor  # (V, 3) m/s² that leads to the positions
    history: list[Progress] = field(default_factory=list)  # before every sweep, and at the end


@torch.no_grad()
def sweep(
    potential: Potential,
    problem: StepProblem,
    start: Tensor | None,
    count: int = 1,
    double: bool = True,
    proceed: Proceed | None = None,
    residuals: bool = False,
) -> tuple[Tensor, SweepReport]:
    """``start`` (V, 3) after up to ``count`` sweeps of block descent (Chen et al., "Vertex Block Descent", 2024).

    A sweep gives every free vertex one Newton step of its own 3 × 3 system with its neighbours held, colour by colour.
    It is kept, whole or shortened, only in scenes where the potential falls; a scene without progress is left alone.
    Errors of wavelength L need some (L / edge length)² sweeps: for long ones use :func:`hood.solver.newton.minimize`.

    Args:
        start: (V, 3) m; None for :func:`hood.solver.system.iterate.first_iterate`.
        double: compute in float64 whatever the problem's type.
        proceed: asked before every sweep; default always.
        residuals: compute the relative gradient before every sweep; otherwise ``history`` has it at the end alone.

    Raises:
        ValueError: ``count`` is negative, or the potential keeps layers of cloth apart.
    """
    began = time.perf_counter()
    if count < 0:
        raise ValueError(f"sweep: count is {count}; give 0 or more sweeps")
    if has_layers(potential):
        raise ValueError("sweep: vertices that move one by one may cross cloth; leave out the term of layers, or use minimize")
    problem = potential.prepare(problem)
    work = in_double(problem) if double else problem
    unknowns = Unknowns(potential, work)
    groups = neighbourhoods(unknowns.terms)
    now = first_iterate(unknowns) if start is None else unknowns.at(start.detach().to(work.state.pos.dtype))
    active = torch.isfinite(now.phi)
    kept = torch.zeros_like(active, dtype=torch.int64)
    history: list[Progress] = []

    def record(known: bool) -> Progress:
        residual = relative_gradient(work, potential.gradient(work, now.pos, now.acc)[0]) if known else unknown
        history.append(Progress(time.perf_counter() - began, now.phi, residual))
        return history[-1]

    unknown, why = torch.full_like(now.phi, torch.nan), MOST_ITERATIONS
    for _ in range(count):
        progress = record(residuals)
        if not bool(active.any()) or (proceed is not None and not proceed(progress, now.pos)):
            history.pop()
            why = STOPPED
            break
        now, active = _improve(unknowns, now, _sweep(unknowns, groups, now), active)
        kept += active
    last = record(True)
    finite = torch.isfinite(now.phi)
    reason = tuple(
        NOT_FINITE if not sound else why if moves else NO_PROGRESS
        for sound, moves in zip(finite.tolist(), active.tolist(), strict=True)
    )
    report = SweepReport(kept, now.phi, last.relative_gradient, reason, now.acc.to(problem.state.pos.dtype), history)
    return rounded(problem, now.pos), report


def _improve(unknowns: Unknowns, now: Iterate, acc: Tensor, active: Tensor) -> tuple[Iterate, Tensor]:
    """The best admissible share of the way to ``acc``, and the scenes (B,) in which there is one."""
    result, improved = now, torch.zeros_like(active)
    for share in _SHARES:
        trial = unknowns.evaluate(now.acc + share * (acc - now.acc))
        better = active & ~improved & (trial.phi < now.phi)
        result, improved = unknowns.select(better, trial, result), improved | better
        if bool((improved | ~active).all()):
            break
    return result, improved


@dataclass(frozen=True)
class Neighbourhood:
    """A colour with everything constant in a step gathered: what its vertices' energies read."""

    colour: Colour
    forces: VertexForces
    face_corners: Corners  # own corner first
    face_constants: FaceConstants
    hinge_corners: Corners
    hinge_constants: HingeConstants
    points: tuple[PointForces, ...]  # those that have a vertex of the colour
    springs: tuple[Tensor, Tensor, Tensor | None] | None  # stiffness (M,), ends (M, 2), own one first, and targets (3, M)


def neighbourhoods(terms: StepTerms) -> list[Neighbourhood]:
    """The colours of the free vertices of a step."""
    problem, cloth, attachments = terms.problem, terms.problem.cloth, terms.problem.step.attachments
    groups = []
    for colour in colours_of(plan_for(problem), cloth, attachments):
        faces, hinges, springs = colour.faces, colour.hinges, None
        turned = (faces.own[:, None] + torch.arange(3, device=faces.own.device)) % 3
        if attachments is not None and terms.springs and colour.attachments is not None:
            around = colour.attachments
            ends = attachments.edges[around.element]
            second = around.own == 1
            ends, targets = torch.where(second[:, None], ends.flip(1), ends), terms.spring_targets
            if targets is not None:
                targets = torch.where(second, -targets[:, around.element], targets[:, around.element])
            springs = terms.spring_stiffness()[around.element], ends, targets
        groups.append(
            Neighbourhood(
                colour,
                terms.vertices.take(colour.vertices),
                Corners(cloth.faces[faces.element].gather(1, turned)),
                terms.face_constants.take(faces.element, faces.own),
                Corners(cloth.hinges[hinges.element]),
                terms.hinge_constants.take(hinges.element),
                tuple(
                    points.take(torch.isin(points.vertices, colour.vertices).any(dim=1).argwhere().squeeze(1))
                    for points in terms.points
                ),
                springs,
            )
        )
    return groups


def _sweep(unknowns: Unknowns, groups: list[Neighbourhood], now: Iterate) -> Tensor:
    """Accelerations (V, 3) after one step of every vertex."""
    acc, pos = now.acc.clone(), now.pos.clone()
    for group in groups:
        rows, walls = group.colour.vertices, group.forces.walls
        gradient, matrix = vertex_systems(unknowns.terms, group, pos, acc, contact=False)
        inverse = invert_blocks(matrix)
        move = -_apply(inverse, gradient)
        for wall in walls:
            move = move + _push(wall, pos[rows] + move, inverse)
        acc[rows] += move / unknowns.dt_sq[rows]
        pos[rows] = unknowns.place_free(rows, acc[rows])
    return acc


def _push(wall: Walls, pos: Tensor, inverse: Tensor) -> Tensor:
    """Displacement (n, 3) that the contact adds to where the other energies would take the vertices.

    Its force λ = 3 w p² meets the compliance a = n·M⁻¹n of the rest, p = s - a λ with s the depth without it: a
    quadratic equation. A step with the contact's own curvature would do badly, as the penalty sets in without any.
    """
    depth = wall.depth(pos).clamp_min(0.0)
    give = _apply(inverse, wall.normal)
    left = contact_balance(wall.weight, depth, (give * wall.normal).sum(1))
    return contact_force(wall.weight, left)[:, None] * give


def _apply(matrix: Tensor, vector: Tensor) -> Tensor:
    return torch.bmm(matrix, vector.unsqueeze(2)).squeeze(2)


def vertex_systems(
    terms: StepTerms, group: Neighbourhood, pos: Tensor, acc: Tensor, contact: bool = True
) -> tuple[Tensor, Tensor]:
    """Gradient (n, 3) and positive matrix (n, 3, 3) of the potential by each vertex of a colour.

    Those of :func:`hood.solver.system.plan.quadratic_model`, of which the matrices are the diagonal blocks.
    """
    colour = group.colour
    rows = colour.vertices
    forces = group.forces if contact else group.forces.without_walls()
    model = forces.model(pos[rows], acc[rows])
    gradient, matrix = model.gradient, model.matrix
    for form in terms.blocks:
        slope, bound = form.derivatives(pos)
        gradient, matrix = gradient + slope[rows], matrix + bound[rows]
    other = terms.other_gradient(pos, acc)
    if other is not None:
        gradient = gradient + other[rows]
    for points in group.points:
        inside = points.model(pos)
        gradient = gradient + points.spread(inside.gradient, pos)[rows]
        matrix = matrix + points.spread_blocks(inside.matrix, len(pos))[rows]
    for around, force, block in _around(terms, group, pos):
        gradient = gradient + around.gradient_sum(force).view(-1, 3)
        matrix = matrix + around.matrix_sum(block).view(-1, 3, 3)
    return gradient, matrix


def _around(terms: StepTerms, group: Neighbourhood, pos: Tensor) -> Iterator[tuple[_Incidence, Tensor, Tensor]]:
    """Gradients (3, M) and upper triangles (6, M) of the elements around a colour's vertices, by their own corners."""
    colour = group.colour
    if terms.has_membrane:
        faces = elements.face_model(group.face_corners(pos), group.face_constants, num_corners=1)
        yield colour.faces, faces.gradient[0], faces.matrix
    if terms.bendings:
        x, own = group.hinge_corners(pos), colour.hinges.own
        each = torch.arange(len(own), device=own.device)
        for form in terms.bendings:
            slope, row = elements.hinge_model(form, x, group.hinge_constants)
            row = row[own, :, each].t()
            block = row.new_empty(6, len(own))
            elements.outer_upper(row, block)
            yield colour.hinges, slope[own, :, each].t(), block
    if group.springs is not None and colour.attachments is not None:
        stiffness, ends, targets = group.springs
        slope, matrix = elements.spring_model(stiffness, Corners(ends)(pos), targets)
        yield colour.attachments, slope[0], matrix[[0, 1, 2, 6, 7, 11]]
