"""The number of threads of compiled loops; see ``threads.h``."""

from __future__ import annotations

from pathlib import Path

import torch

SOURCE = Path(__file__).with_name("threads.h")
#: As in ``threads.h``.
MOST_PARTS = 64


def num_parts(count: int, least: int) -> int:
    """Parts of a loop over ``count`` things, each of ``least`` or more: as many as torch has threads (``OMP_NUM_THREADS``)."""
    return max(min(torch.get_num_threads(), count // least, MOST_PARTS), 1)
