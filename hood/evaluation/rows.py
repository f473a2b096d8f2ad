"""Tables as files: the same rows as CSV and as JSON."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hood.assets.files.atomic import write_atomically


def write_rows(rows: Sequence[Mapping[str, Any]], columns: Sequence[str], folder: Path, name: str) -> tuple[Path, Path]:
    """Write ``name.csv``, of these columns, and ``name.json``, of all keys, atomically; returns their paths.

    A column that a row lacks is empty.

    Raises:
        OSError: a file cannot be written; names it.
    """
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, columns, extrasaction="ignore")
    writer.writeheader()
    writer.writerows(rows)
    csv_path, json_path = folder / f"{name}.csv", folder / f"{name}.json"
    write_atomically(csv_path, text.getvalue().encode())
    write_atomically(json_path, json.dumps(list(rows), indent=1).encode())
    return csv_path, json_path
