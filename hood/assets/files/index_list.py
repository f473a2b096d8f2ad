"""Lists of numbers in text or JSON files."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from hood.assets.files.text import read_text

_LIST_LIMIT = 64 << 20


def read_indices(path: Path) -> np.ndarray:
    """Vertex numbers from a text file (any white space or commas between, # starts a comment) or a JSON list.

    Raises:
        ValueError: something else than whole numbers; names the file.
    """
    if path.stat().st_size > _LIST_LIMIT:
        raise ValueError(f"{path}: {path.stat().st_size} bytes are no list of vertices")
    text = read_text(path)
    try:
        if path.suffix.lower() == ".json":
            values = json.loads(text)
        else:
            values = [int(word) for line in text.splitlines() for word in line.split("#")[0].replace(",", " ").split()]
    except (ValueError, RecursionError):
        values = None
    if not isinstance(values, list) or not all(
        isinstance(v, int) and not isinstance(v, bool) and abs(v) < 2**62 for v in values
    ):
        raise ValueError(
            f"{path}: not a list of vertex numbers; write whole numbers, as in 12 13 14 (.txt) or [12, 13] (.json)"
        )
    return np.array(values, dtype=np.int64)
