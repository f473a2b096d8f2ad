"""Selection by a mask into a fixed number of rows, as captured graphs need it."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional


def gather_true(mask: Tensor, size: int) -> Tensor:
    """Indices of the first ``size`` − 1 true entries of ``mask`` (N,) in places 0 …, N in the others: (size,)."""
    count = mask.shape[0]
    place = torch.where(mask, mask.cumsum(0) - 1, size - 1).clamp_max(size - 1)
    index = torch.arange(count, device=mask.device)
    found = torch.full((size,), count, dtype=torch.int64, device=mask.device).scatter(0, place, index)
    # Whatever had no place of its own went to the last one.
    return functional.pad(found[: size - 1], (0, 1), value=count)
