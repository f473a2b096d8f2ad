"""Diffusion over a mesh: sums stay, values spread."""

import torch

from hood.model.features.local import Diffusion

CHAIN = torch.tensor([[0, 1], [1, 2], [2, 3], [3, 4]])


def test_sums_stay_and_a_peak_spreads():
    peak = torch.zeros(5, 2, dtype=torch.float64)
    peak[2] = torch.tensor([3.0, -1.0])
    diffusion = Diffusion(CHAIN, 5)
    once = diffusion.spread(peak, 1)
    assert torch.allclose(once[:, 0], torch.tensor([0, 0.75, 1.5, 0.75, 0], dtype=torch.float64))
    many = diffusion.spread(peak, 400)
    assert torch.allclose(many.sum(dim=0), peak.sum(dim=0))
    # What is left is in proportion to the number of neighbours.
    assert torch.allclose(many[:, 0], 3 * torch.tensor([1, 2, 2, 2, 1], dtype=torch.float64) / 8)
    assert torch.equal(diffusion.spread(peak, 0), peak)


def test_rounds_add_up():
    values = torch.rand(5, 3)
    diffusion = Diffusion(CHAIN, 5)
    assert torch.equal(diffusion.spread(diffusion.spread(values, 2), 3), diffusion.spread(values, 5))
