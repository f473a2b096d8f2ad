"""Muon for matrices between latents, Adam for the rest."""

from copy import deepcopy

import torch

from hood.steppers.network import build_simulator
from hood.training.optimiser import MuonAdam, make_optimizer, orthogonal


def test_updates_of_matrices_are_nearly_orthogonal():
    torch.manual_seed(0)
    blocks = torch.randn(3, 16, 16) @ torch.diag(torch.logspace(-2, 1, 16))
    values = torch.linalg.svdvals(orthogonal(blocks))
    assert float(values.max()) < 1.3
    assert float(values.median()) > 0.6
    # Directions stay: the result is aligned with what went in.
    assert (torch.einsum("kij,kij->k", orthogonal(blocks), blocks) > 0).all()


def test_the_other_part_is_adam():
    torch.manual_seed(0)
    start, target = torch.randn(5), torch.randn(5)
    ours, theirs = start.clone().requires_grad_(), start.clone().requires_grad_()
    optimizers = [MuonAdam([{"params": [ours], "matrices": False}], 0.01), torch.optim.Adam([theirs], 0.01)]
    for _ in range(20):
        for parameter, optimizer in zip((ours, theirs), optimizers, strict=True):
            optimizer.zero_grad()
            (parameter - target).square().sum().backward()
            optimizer.step()
    assert torch.allclose(ours, theirs, atol=1e-6)
    assert not torch.allclose(ours, start)


def test_every_parameter_is_in_one_group_and_goes_on_from_its_state():
    torch.manual_seed(0)
    simulator = build_simulator("physical", "velocity_base", "1x(mesh+coarse0)", latent_dim=8)
    optimizer = make_optimizer("muon", simulator, 0.01)
    groups = {group["matrices"]: group["params"] for group in optimizer.param_groups}
    assert sum(map(len, groups.values())) == len(list(simulator.parameters()))
    assert all(p.shape[0] == 8 and p.shape[1] % 8 == 0 for p in groups[True])
    assert any(p.shape[1] == 24 for p in groups[True])

    def update(to, count):
        for index in range(count):
            for p in to.parameters():
                p.grad = torch.full_like(p, 0.1 * index) + torch.arange(p.numel()).view_as(p).sin()
            optimizer.step()

    update(simulator, 2)
    kept = deepcopy((optimizer.state_dict(), simulator.state_dict()))
    update(simulator, 3)
    expected = [p.clone() for p in simulator.parameters()]
    simulator.load_state_dict(kept[1])
    optimizer.load_state_dict(kept[0])
    update(simulator, 3)
    assert all(torch.equal(p, e) for p, e in zip(simulator.parameters(), expected, strict=True))
