"""Local descent, vertex by vertex: smooths what is wrong at short range, cheap enough to follow a network."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from hood.losses.attachment import Attachment
from hood.losses.bending import Bending
from hood.losses.collision import Collision
from hood.losses.potential import Potential, relative_gradient
from hood.losses.problem import StepProblem
from hood.losses.stretching import Stretching
from hood.solver import elements
from hood.solver.colouring import Colour, Incidence, colours_of
from hood.solver.iterate import Iterate, Unknowns, in_double, rounded
from hood.solver.linear import invert_blocks
from hood.solver.plan import plan_for

#: Shares of a sweep's displacement that are tried, in this order.
_SHARES = (1.0, 0.5, 0.25)


@dataclass(frozen=True)
class SweepReport:
    """What :func:`sweep` reached, scene by scene."""

    kept: Tensor  # (B,) sweeps that lowered the potential and were kept
    phi: Tensor  # (B,) J
    relative_gradient: Tensor  # (B,)
    acc: Tensor  # (V, 3) m/s² that leads to the positions


@torch.no_grad()
def sweep(
    potential: Potential, problem: StepProblem, start: Tensor, count: int = 1, double: bool = True
) -> tuple[Tensor, SweepReport]:
    """``start`` (V, 3) after up to ``count`` sweeps of block descent (Chen et al., "Vertex Block Descent", 2024).

    A sweep gives every free vertex one Newton step of its own 3 × 3 system with its neighbours held, colour by colour.
    It is kept, whole or shortened, only in scenes where the potential falls; a scene without progress is left alone.
    Errors of wavelength L need some (L / edge length)² sweeps: for long ones use :func:`hood.solver.newton.minimize`.

    Raises:
        ValueError: ``count`` is negative.
    """
    if count < 0:
        raise ValueError(f"sweep: count is {count}; give 0 or more sweeps")
    work = in_double(problem) if double else problem
    groups = neighbourhoods(work)
    unknowns = Unknowns(potential, work)
    now = unknowns.at(start.detach().to(work.state.pos.dtype))
    active = torch.isfinite(now.phi)
    kept = torch.zeros_like(active, dtype=torch.int64)
    for _ in range(count):
        if not bool(active.any()):
            break
        now, active = _improve(unknowns, now, _sweep(unknowns, groups, now), active)
        kept += active
    gradient, _ = potential.gradient(work, now.pos, now.acc)
    report = SweepReport(kept, now.phi, relative_gradient(work, gradient), now.acc.to(problem.state.pos.dtype))
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
    vertices: StepProblem  # of the colour's vertices alone
    faces: Tensor  # (M, 3)
    face_constants: tuple[Tensor, ...]  # of face_model
    hinges: Tensor  # (M, 4)
    hinge_constants: tuple[Tensor, ...]  # of hinge_model


def neighbourhoods(problem: StepProblem) -> list[Neighbourhood]:
    """The colours of the problem's free vertices."""
    cloth = problem.cloth
    shape, area, bending = (
        elements.face_shape(cloth.rest_inverse),
        cloth.rest_area * cloth.thickness,
        elements.hinge_weight(problem),
    )
    return [
        Neighbourhood(
            colour,
            elements.only_vertices(problem, colour.vertices),
            cloth.faces[colour.faces.element],
            tuple(table[colour.faces.element] for table in (shape, area, cloth.lame_mu, cloth.lame_lambda)),
            cloth.hinges[colour.hinges.element],
            tuple(table[colour.hinges.element] for table in (cloth.rest_angle, bending)),
        )
        for colour in colours_of(plan_for(problem), cloth, problem.step.attachments)
    ]


def _sweep(unknowns: Unknowns, groups: list[Neighbourhood], now: Iterate) -> Tensor:
    """Accelerations (V, 3) after one step of every vertex."""
    problem, terms = unknowns.problem, dict(unknowns.potential.terms)
    name = next((name for name, term in terms.items() if type(term) is Collision and term.applies(problem)), None)
    collision = None if name is None else terms.pop(name)
    smooth = Potential(terms)
    acc, pos = now.acc.clone(), now.pos.clone()
    for group in groups:
        rows = group.colour.vertices
        gradient, matrix = vertex_systems(smooth, problem, group, pos, acc)
        inverse = invert_blocks(matrix)
        move = -_apply(inverse, gradient)
        if isinstance(collision, Collision):
            move = move + _push(collision, group.vertices, pos[rows] + move, inverse)
        acc[rows] += move / unknowns.dt_sq[rows]
        pos[rows] = unknowns.place(acc)[rows]
    return acc


def _push(term: Collision, problem: StepProblem, pos: Tensor, inverse: Tensor) -> Tensor:
    """Displacement (n, 3) that the contact adds to where the other energies would take the vertices.

    Its force λ = 3 w p² meets the compliance a = n·M⁻¹n of the rest, p = s - a λ with s the depth without it: a
    quadratic equation. A step with the contact's own curvature would do badly, as the penalty sets in without any.
    """
    depth, normal = elements.signed_depth(term, problem, pos)
    depth = depth.clamp_min(0.0)
    give = _apply(inverse, normal)
    left = 2.0 * depth / (1.0 + (1.0 + 12.0 * term.weight * (give * normal).sum(1) * depth).sqrt())
    return (3.0 * term.weight * left * left)[:, None] * give


def _apply(matrix: Tensor, vector: Tensor) -> Tensor:
    return torch.bmm(matrix, vector.unsqueeze(2)).squeeze(2)


def vertex_systems(
    potential: Potential, problem: StepProblem, group: Neighbourhood, pos: Tensor, acc: Tensor
) -> tuple[Tensor, Tensor]:
    """Gradient (n, 3) and positive matrix (n, 3, 3) of the potential by each vertex of a colour.

    Those of :func:`hood.solver.plan.quadratic_model`, of which the matrices are the diagonal blocks.
    """
    colour = group.colour
    rows = colour.vertices
    gradient, matrix = elements.vertex_model(potential, group.vertices, pos[rows], acc[rows])
    other = elements.other_gradient(potential, problem, pos, acc)
    if other is not None:
        gradient = gradient + other[rows]
    for term in potential.terms.values():
        if type(term) is Stretching:
            around, (force, block) = colour.faces, _faces(group, pos)
        elif type(term) is Bending:
            around, (force, block) = colour.hinges, _hinges(group, pos)
        elif type(term) is Attachment and colour.attachments is not None:
            around, (force, block) = colour.attachments, _springs(term, problem, colour.attachments, pos)
        else:
            continue
        gradient = gradient + around.gradient_sum(force)
        matrix = matrix + around.matrix_sum(block.reshape(-1, 3)).view(-1, 3, 3)
    return gradient, matrix


def _faces(group: Neighbourhood, pos: Tensor) -> tuple[Tensor, Tensor]:
    own = group.colour.faces.own
    model = elements.face_model(pos[group.faces], *group.face_constants)
    each = torch.arange(len(own), device=own.device)
    root = model.root[each, :, own]
    block = torch.bmm(root.transpose(1, 2), root)
    block.diagonal(dim1=1, dim2=2).add_(model.axial[each, own, own][:, None])
    return model.gradient[each, own], block


def _hinges(group: Neighbourhood, pos: Tensor) -> tuple[Tensor, Tensor]:
    own = group.colour.hinges.own
    slope, root = elements.hinge_model(pos[group.hinges], *group.hinge_constants)
    each = torch.arange(len(own), device=own.device)
    row = root[each, own]
    return slope[each, own], row[:, :, None] * row[:, None, :]


def _springs(term: Attachment, problem: StepProblem, around: Incidence, pos: Tensor) -> tuple[Tensor, Tensor]:
    attachments = problem.step.attachments
    assert attachments is not None
    edges = attachments.edges[around.element]
    each = torch.arange(len(edges), device=edges.device)
    stiffness = elements.attachment_stiffness(term, problem)[around.element]
    gap = pos[edges[each, around.own]] - pos[edges[each, 1 - around.own]]
    return stiffness[:, None] * gap, stiffness[:, None, None] * torch.eye(3, dtype=pos.dtype, device=pos.device)
