"""Traced functions: the same values, constants computed once, memory that is written to made anew."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from hood.steppers.static_shapes.cuda_graph import count_operations, trace

WEIGHT = torch.linspace(-1, 1, 12).view(4, 3)


def layer(x: Tensor) -> Tensor:
    """The weight's cast and its product depend on no input; the sums are written to."""
    weight = (WEIGHT @ WEIGHT.t()).to(x.dtype)
    sums = x.new_zeros(3, 4)
    sums[:2] += x[:2] @ weight
    table = torch.ones(5, 4)
    first, _ = table.split([2, 3])
    first.mul_(x[0])
    return torch.cat([sums, table])


def test_a_traced_function_gives_what_the_function_gives_every_time() -> None:
    x = torch.arange(8.0).view(2, 4)
    traced, plain = trace(layer, [x]), trace(layer, [x], fold=False)
    for scale in (1.0, 2.0, -3.0):
        assert torch.equal(plain(scale * x), layer(scale * x))
        assert torch.equal(traced(scale * x), layer(scale * x))


def test_what_depends_on_no_input_is_computed_once() -> None:
    x = torch.zeros(2, 4)
    counts = [count_operations(trace(layer, [x], fold)) for fold in (False, True)]
    assert counts[1] == counts[0] - 1  # the product; the views before it count as nothing, the arrays are written to
    assert count_operations(trace(lambda x: (WEIGHT * 2).exp() + x, [torch.zeros(4, 3)])) == 1


def test_constants_and_inputs_may_be_results() -> None:
    x = torch.ones(2)
    traced = trace(lambda x: (x, WEIGHT + 1, WEIGHT, x + 1), [x])
    for got, expected in zip(traced(x), (x, WEIGHT + 1, WEIGHT, x + 1), strict=True):
        assert torch.equal(got, expected)


@pytest.mark.parametrize(
    "function",
    [
        lambda x: x * 2 if bool((x > 0).any()) else x,
        lambda x: x[x > 0],
        lambda x: x.nonzero(),
        lambda x: torch.bincount(x.long()),
        lambda x: x.unique(),
        lambda x: x * float(x[0]),
        lambda x: torch.as_tensor(x.tolist()),
    ],
)
def test_whoever_asks_for_a_value_is_refused(function) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(RuntimeError):
        trace(function, [torch.ones(3)])
