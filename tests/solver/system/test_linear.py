"""Sums into sparse matrices, conjugate gradients, band factorisation."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import build_cloth
from hood.energies.potential import default_potential
from hood.solver.system import linear
from hood.solver.system.plan import plan_for, quadratic_model
from hood.solver.system.sparsity import BlockPattern, Scatter, upper_pairs
from hood.testing import cylinder, make_problem

F64 = torch.float64


def system(seed=0):
    """Hessian and right-hand side of a crumpled tube."""
    pos, faces = cylinder(7, 5, 0.1, 0.3)
    rng = np.random.default_rng(seed)
    problem = make_problem(build_cloth(pos, faces, Material(), np.arange(35) < 7, dtype=F64))
    crumpled = problem.cloth.rest_pos + 0.01 * torch.as_tensor(rng.normal(size=pos.shape))
    plan = plan_for(problem)
    model = quadratic_model(default_potential(), problem, plan, crumpled, problem.acceleration(crumpled))
    return plan, model.triples, torch.as_tensor(rng.normal(size=(plan.pattern.size, 3)))


def dense(plan, triples):
    size = plan.pattern.size
    matrix = torch.zeros(3 * size, size, 3, dtype=triples.dtype)
    matrix[torch.as_tensor(plan.pattern.triple_rows), torch.as_tensor(plan.pattern.triple_cols)] = triples
    return matrix.reshape(3 * size, 3 * size)


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_scatter(dtype):
    values = torch.as_tensor(np.random.default_rng(0).normal(size=6)).to(dtype)
    scatter = Scatter(np.array([2, 0, -1, 2, 2, 0, 3]), np.array([0, 1, 2, 3, 4, 5, 0]), 4, 6)
    expected = torch.stack([values[1] + values[5], 0 * values[0], values[0] + values[3] + values[4], values[0]])
    torch.testing.assert_close(scatter(values), expected)
    torch.testing.assert_close(scatter.by_index(values), expected)


def test_pattern_holds_every_pair_once_in_both_directions():
    pattern = BlockPattern(4, np.array([[0, 2], [2, 0], [0, 2], [3, 1]]))
    assert list(zip(pattern.rows.tolist(), pattern.cols.tolist(), strict=True)) == [
        (0, 0), (0, 2), (1, 1), (1, 3), (2, 0), (2, 2), (3, 1), (3, 3)
    ]  # fmt: skip
    assert pattern.triples(np.array([1]), np.array([3])).tolist() == [[7, 9, 11]]  # rows of scalars, two blocks in each
    assert (pattern.triple_rows[[7, 9, 11]].tolist(), pattern.triple_cols[[7, 9, 11]].tolist()) == ([3, 4, 5], [3, 3, 3])
    assert pattern.triples(np.array([-1]), np.array([3])).tolist() == [[-1, -1, -1]]


def test_products_agree_with_the_dense_matrix():
    plan, triples, x = system()
    expected = (dense(plan, triples) @ x.reshape(-1)).view(-1, 3)
    for product in (linear.product, linear.block_product):
        torch.testing.assert_close(product(plan.pattern, triples)(x), expected, rtol=1e-11, atol=1e-11)


def test_solvers_agree_with_the_dense_solution():
    plan, triples, rhs = system()
    expected = torch.linalg.solve(dense(plan, triples), rhs.reshape(-1)).view(-1, 3)
    direct, broken = linear.solve_direct(plan, triples, rhs)
    assert broken is None
    torch.testing.assert_close(direct, expected, rtol=1e-9, atol=1e-12)
    solution, iterations, indefinite = linear.conjugate_gradients(
        linear.product(plan.pattern, triples),
        linear.by_blocks(linear.diagonal_inverse(plan.pattern, triples)),
        rhs,
        plan.scene,
        1,
        torch.tensor([1e-11], dtype=F64),
        500,
    )
    assert iterations < 500
    assert not indefinite.any()
    torch.testing.assert_close(solution, expected, rtol=0, atol=1e-9 * float(expected.abs().max()))


def test_truncated_conjugate_gradients_descend():
    plan, triples, rhs = system()
    precondition = linear.by_blocks(linear.diagonal_inverse(plan.pattern, triples))
    for cap in (1, 3, 10):
        solution, used, _ = linear.conjugate_gradients(
            linear.product(plan.pattern, triples), precondition, rhs, plan.scene, 1, torch.tensor([1e-9], dtype=F64), cap
        )
        assert used == cap
        assert float((solution * rhs).sum()) > 0


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_inverse_of_blocks(dtype):
    rng = np.random.default_rng(0)
    root = torch.as_tensor(rng.normal(size=(20, 3, 3)))
    scale = torch.as_tensor(10.0 ** rng.uniform(-12, 6, size=(20, 1, 1)))
    blocks = (scale * (root @ root.transpose(1, 2) + 0.1 * torch.eye(3))).to(dtype)
    identity = linear.invert_blocks(blocks) @ blocks
    torch.testing.assert_close(identity, torch.eye(3, dtype=dtype).expand(20, 3, 3), rtol=0, atol=1e3 * torch.finfo(dtype).eps)


def test_band_is_narrow():
    plan, triples, _ = system()
    layout = linear.band_layout(plan)
    assert layout.num_below < 3 * plan.pattern.size - 1
    matrix = dense(plan, triples).numpy()[np.ix_(layout.order, layout.order)]
    assert not np.triu(matrix, layout.num_below + 1).any()


def test_negative_curvature_is_seen_by_both_solvers():
    plan, triples, rhs = system()
    diagonal = plan.pattern.diagonal[5].clone()
    shifted = triples.clone()
    shifted[diagonal] -= 2.0 * float(triples.abs().max()) * torch.eye(3, dtype=F64)
    _, broken = linear.solve_direct(plan, shifted, rhs)
    assert broken is not None
    precondition = linear.by_blocks(linear.diagonal_inverse(plan.pattern, triples))
    solution, _, indefinite = linear.conjugate_gradients(
        linear.product(plan.pattern, shifted), precondition, rhs, plan.scene, 1, torch.tensor([1e-9], dtype=F64), 200
    )
    assert indefinite.tolist() == [True]
    assert torch.isfinite(solution).all()
    assert float((solution * rhs).sum()) >= 0


def test_scenes_side_by_side_are_what_each_is_alone():
    """Two scenes, one of which is indefinite and stops, against each alone."""
    plan, triples, rhs = system()
    bad = triples.clone()
    bad[plan.pattern.diagonal[5]] -= 2.0 * float(triples.abs().max()) * torch.eye(3, dtype=F64)
    precondition = linear.by_blocks(linear.diagonal_inverse(plan.pattern, triples))
    good, broken = linear.product(plan.pattern, triples), linear.product(plan.pattern, bad)
    size, tolerance = plan.pattern.size, torch.tensor([1e-6], dtype=F64)
    alone = [linear.conjugate_gradients(a, precondition, rhs, plan.scene, 1, tolerance, 60) for a in (good, broken)]
    together, _, indefinite = linear.conjugate_gradients(
        lambda x: torch.cat([good(x[:size]), broken(x[size:])]),
        lambda r: torch.cat([precondition(r[:size]), precondition(r[size:])]),
        torch.cat([rhs, rhs]),
        torch.cat([plan.scene, plan.scene + 1]),
        2,
        tolerance.expand(2),
        60,
    )
    assert indefinite.tolist() == [False, True]
    for part, (single, _, _) in zip(together.split(size), alone, strict=True):
        torch.testing.assert_close(part, single, rtol=0, atol=1e-9 * float(single.abs().max()))


def test_upper_triangle_is_ordered_by_rows():
    assert upper_pairs(3) == [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
