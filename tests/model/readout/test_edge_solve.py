"""Positions from edges: against a dense solve, with its derivative, scene by scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional

from hood.mesh.topology import unique_edges
from hood.model.graph.builder import edge_set
from hood.model.readout.edges import EdgeSystem, Firm, compiled_gradients, conjugate_gradients, fit_edges
from hood.native import features as native
from hood.testing import grid


def make_system(n: int = 4, stiffness: float = 40.0, dtype: torch.dtype = torch.float64) -> tuple[EdgeSystem, Tensor]:
    """A square sheet of n² vertices, all free, and its positions."""
    pos, faces = grid(n, n, 0.3)
    edges = edge_set(torch.as_tensor(unique_edges(np.asarray(faces)).astype(np.int64)))
    count = len(pos)
    free, scene = torch.ones(count, dtype=torch.bool), torch.zeros(count, dtype=torch.int64)
    return EdgeSystem(edges, free, scene, (count,), stiffness), torch.as_tensor(pos).to(dtype)


def without(system: EdgeSystem, *held: int) -> EdgeSystem:
    free = system.free.clone()
    free[list(held)] = False
    return replace(system, free=free)


def draw(system: EdgeSystem, start: Tensor, low: float = 1.0) -> tuple[Tensor, Tensor, Tensor]:
    """Edges that are alike in both directions, anchors and weights."""
    vector = 0.1 * torch.randn(len(system.edges.senders), 3, dtype=start.dtype)
    vector = system.vectors(start) + vector - vector[system.edges.reverse]
    return vector, start + 0.1 * torch.randn_like(start), low + low * torch.rand(len(start), dtype=start.dtype)


def draw_firm(start: Tensor, most: float = 30.0) -> Firm:
    return Firm(most * torch.rand(len(start), dtype=start.dtype), functional.normalize(torch.randn_like(start), dim=1))


def dense(
    system: EdgeSystem, start: Tensor, vector: Tensor, anchor: Tensor, weight: Tensor, firm: Firm | None = None
) -> Tensor:
    """The minimum of the energy by its normal equations, edge by edge."""
    if firm is not None:
        return dense_in_three(system, start, vector, anchor, weight, firm)
    count, edges = len(start), system.edges
    rows = [(i, j, p) for i, j, p in zip(edges.receivers.tolist(), edges.senders.tolist(), vector, strict=True) if i < j]
    matrix, rhs = torch.diag(weight), weight.unsqueeze(1) * anchor
    for i, j, p in rows:
        difference = torch.zeros(count, dtype=start.dtype)
        difference[i], difference[j] = 1.0, -1.0
        matrix = matrix + system.stiffness * torch.outer(difference, difference)
        rhs = rhs + system.stiffness * torch.outer(difference, p)
    free, held = system.free, ~system.free
    pos = start.clone()
    pos[free] = torch.linalg.solve(matrix[free][:, free], rhs[free] - matrix[free][:, held] @ start[held])
    return pos


def dense_in_three(system: EdgeSystem, start: Tensor, vector: Tensor, anchor: Tensor, weight: Tensor, firm: Firm) -> Tensor:
    """Where coordinates hang together: the minimum by the energy's own second derivative."""

    def energy(flat: Tensor) -> Tensor:
        pos = torch.where(system.free.unsqueeze(1), flat.view(-1, 3), start)
        away = pos - anchor
        held = weight * away.square().sum(dim=1) + firm.weight * (away * firm.normal).sum(dim=1).square()
        # Every edge is listed in both directions.
        return 0.5 * held.sum() + 0.25 * system.stiffness * (system.vectors(pos) - vector).square().sum()

    flat = start.flatten()
    slope, curvature = torch.func.grad(energy)(flat), torch.func.hessian(energy)(flat)
    free = system.free.repeat_interleave(3)
    pos = flat.clone()
    pos[free] -= torch.linalg.solve(curvature[free][:, free], slope[free])
    return pos.view(-1, 3)


@pytest.mark.parametrize("held", [(), (0, 3)])
@pytest.mark.parametrize("firm", [False, True])
def test_the_positions_are_those_of_a_dense_solve(held: tuple[int, ...], firm: bool) -> None:
    system, start = make_system()
    system = without(system, *held)
    given = (*draw(system, start), draw_firm(start) if firm else None)
    system = replace(system, scene_sizes=(900,))  # as many steps as a larger sheet takes
    found, expected = fit_edges(system, start, *given), dense(system, start, *given)
    assert float((expected - start).abs().max()) > 0.05
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-7)
    assert torch.equal(found[list(held)], start[list(held)])


def test_the_derivative_is_that_of_the_positions() -> None:
    system, start = make_system(3)
    system = replace(without(system, 4), scene_sizes=(900,))
    vector, anchor, weight = draw(system, start, low=20.0)
    half = [row for row in range(len(vector)) if system.edges.receivers[row] < system.edges.senders[row]]

    firm = draw_firm(start)

    def positions(part: Tensor, anchor: Tensor, weight: Tensor, along: Tensor) -> Tensor:
        whole = torch.zeros_like(vector).index_copy(0, torch.tensor(half), part)
        return fit_edges(system, start, whole - whole[system.edges.reverse], anchor, weight, firm._replace(weight=along))

    given = [value.clone().requires_grad_(True) for value in (vector[half], anchor, weight, firm.weight)]
    assert torch.autograd.gradcheck(positions, given)


@pytest.mark.parametrize("n", [12, 33])
def test_a_sheet_that_hangs_from_one_side_is_left_with_a_thousandth_of_the_energy(n: int) -> None:
    """The hardest of what garments do; at every resolution, as the number of steps grows with it."""
    system, start = make_system(n)
    shape = torch.stack([start[:, 0], 0.2 * torch.sin(5 * start[:, 0]), start[:, 2]], dim=1)
    weight = torch.where(start[:, 2] < 1e-6, 20.0, 0.0)
    assert int((weight > 0).sum()) == n

    def energy(pos: Tensor) -> float:
        edges = system.stiffness * (system.vectors(pos) - system.vectors(shape)).square().sum() / 2
        return float(edges + (weight * (pos - shape).square().sum(dim=1)).sum())

    found = fit_edges(system, start, system.vectors(shape), shape, weight)
    assert energy(found) < 2e-3 * energy(start)


def test_where_nothing_is_predicted_nothing_moves() -> None:
    system, start = make_system(8, dtype=torch.float32)
    assert torch.equal(fit_edges(system, start, system.vectors(start), start, torch.ones(len(start))), start)


def join(systems: list[EdgeSystem], dtype: torch.dtype) -> EdgeSystem:
    pairs, scene, shift = [], [], 0
    for number, system in enumerate(systems):
        forward = system.edges.receivers < system.edges.senders
        pairs.append(torch.stack([system.edges.receivers, system.edges.senders], dim=1)[forward] + shift)
        scene.append(torch.full_like(system.scene, number))
        shift += len(system.free)
    sizes = tuple(size for system in systems for size in system.scene_sizes)
    free = torch.cat([system.free for system in systems])
    return EdgeSystem(edge_set(torch.cat(pairs)), free, torch.cat(scene), sizes, systems[0].stiffness)


@pytest.mark.parametrize("solve", [conjugate_gradients, compiled_gradients])
def test_partners_in_a_batch_change_nothing(solve) -> None:
    """Each scene has its own step lengths and as many steps as alone."""
    if solve is compiled_gradients and native.library() is None:
        pytest.skip("no C++ compiler")
    systems = [without(make_system(n)[0], 1) for n in (30, 4, 12)]
    counts = [len(system.free) for system in systems]
    weights = [0.01 * (1.0 + torch.rand(count)) for count in counts]
    forces = [torch.randn(count, 3) for count in counts]
    together = solve(join(systems, torch.float32), torch.cat(weights), torch.cat(forces)).split(counts)
    for system, weight, force, found in zip(systems, weights, forces, together, strict=True):
        alone = solve(system, weight, force)
        assert float((found - alone).abs().max()) < 1e-3 * float(alone.abs().max())
    # Its own number of steps: with those of the largest the smallest would go on.
    longer = solve(replace(systems[1], scene_sizes=(900,)), weights[1], forces[1])
    assert float(longer.abs().max()) > 0


@pytest.mark.skipif(native.library() is None, reason="no C++ compiler")
@pytest.mark.parametrize("held_firmly", [False, True])
def test_the_compiled_solve_is_that_of_torch(held_firmly: bool) -> None:
    system, start = make_system(30, dtype=torch.float32)
    system = without(system, 0, 17)
    weight, force = 0.1 + torch.rand(len(start)), torch.randn_like(start)
    firm = draw_firm(start) if held_firmly else None
    found, expected = (solve(system, weight, force, firm) for solve in (compiled_gradients, conjugate_gradients))
    assert float((found - expected).abs().max()) < 1e-5 * float(expected.abs().max())
    assert bool((found[~system.free] == 0).all())
    with torch.no_grad():
        given = draw(system, start)
        inside = fit_edges(system, start, *given, firm)
        with native.in_torch():
            torch.testing.assert_close(inside, fit_edges(system, start, *given, firm), rtol=0, atol=1e-5)


def test_vertices_without_edges_are_held_by_their_anchors_alone() -> None:
    system, start = make_system()
    start = torch.cat([start, torch.tensor([[1.0, 2.0, 3.0]]).double()])
    count = len(start)
    system = replace(system, free=torch.ones(count, dtype=torch.bool), scene=torch.zeros(count).long(), scene_sizes=(count,))
    vector, anchor, weight = draw(system, start)
    found = fit_edges(system, start, vector, anchor, weight)
    torch.testing.assert_close(found[-1], anchor[-1], rtol=0, atol=1e-7)
