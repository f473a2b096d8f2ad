"""What processes share; alone, every function is the plain thing."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from hood.model.features.normalizer import RunningNormalizer
from hood.training import distributed


def test_alone_nothing_is_shared() -> None:
    assert (distributed.rank(), distributed.world_size()) == (0, 1)
    assert distributed.gather("x") == ["x"]
    assert distributed.any_rank(True)
    assert not distributed.any_rank(False)
    assert distributed.mean({"total": 2.0}) == {"total": 2.0}
    assert distributed.on_main(lambda: 7) == 7
    with pytest.raises(OSError, match="full") as error:
        distributed.on_main(lambda: (_ for _ in ()).throw(OSError(28, "full")))
    assert not distributed.is_told(error.value)


def test_energies_that_a_process_lacks_count_as_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(distributed, "gather", lambda value: [value, {"total": 3.0, "friction": 1.0}])
    assert distributed.mean({"total": 1.0, "collision": 4.0}) == {"total": 2.0, "collision": 2.0, "friction": 0.5}


def test_buffers_are_left_alone_by_the_key_that_torch_has(monkeypatch: pytest.MonkeyPatch) -> None:
    """2.13 has a new one, and warns about the former at length."""

    class Former:
        def __init__(self, module: torch.nn.Module, broadcast_buffers: bool = True) -> None:
            self.given = "broadcast_buffers", broadcast_buffers

    class Present:
        def __init__(
            self, module: torch.nn.Module, broadcast_buffers: object = None, forward_sync_buffers: object = None
        ) -> None:
            assert broadcast_buffers is None
            self.given = "forward_sync_buffers", forward_sync_buffers

    for kind, key in ((Former, "broadcast_buffers"), (Present, "forward_sync_buffers")):
        monkeypatch.setattr(distributed, "DistributedDataParallel", kind)
        assert distributed.averaging(torch.nn.Identity()).given == (key, False)


def moments(rows: Tensor) -> Tensor:
    return torch.cat([torch.tensor([float(len(rows))]).double(), rows.double().sum(0), rows.double().square().sum(0)])


@pytest.mark.parametrize("sizes", [(5, 7), (5, 0), (0, 3)])
def test_statistics_are_those_of_the_whole_batch(sizes: tuple[int, int]) -> None:
    """Each process counts its own rows, also none at all; both end with what one process has that sees all of them."""
    generator = torch.Generator().manual_seed(0)
    shares = [RunningNormalizer(3, decay=0.9) for _ in sizes]
    alone = RunningNormalizer(3, decay=0.9)
    for _ in range(4):
        rows = [torch.randn(size, 3, generator=generator) * 3 + 1 for size in sizes]
        alone.update(torch.cat(rows))
        for share, mine, other in zip(shares, rows, rows[::-1], strict=True):
            share.shared_sum = lambda sums, other=other: sums + moments(other)
            share.update(mine)
    for share in shares:
        assert int(share.num_updates) == int(alone.num_updates) == 4
        for ours, reference in zip(share.statistics(torch.float64), alone.statistics(torch.float64), strict=True):
            torch.testing.assert_close(ours, reference, rtol=1e-12, atol=0)
