"""What an evaluation prints and writes when all its rollouts are done."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hood.assets.files.atomic import write_atomically
from hood.evaluation.report import columns, describe, format_table
from hood.evaluation.rows import write_rows
from hood.evaluation.spectrum import COLUMNS as SPECTRUM_COLUMNS
from hood.evaluation.spectrum import bar_panels, format_spectrum
from hood.evaluation.table_one import TableConditions, page


def report_table(rows: Sequence[Mapping[str, Any]], about: TableConditions, folder: Path) -> None:
    """Print the table; write it as ``table.csv``, ``table.json`` and, beside the paper's, ``table1.md``."""
    print(format_table(rows))
    print(f"\n{describe(rows)}")
    csv_path, json_path = write_rows(rows, columns(rows), folder, "table")
    page_path = folder / "table1.md"
    write_atomically(page_path, page(rows, about).encode())
    print(f"tables in {csv_path}, {json_path} and, beside the paper's, {page_path}")


def report_spectrum(rows: Sequence[Mapping[str, Any]], folder: Path, picture: bool) -> None:
    """Print in which wavelengths the errors are; write it as ``spectrum.csv``, ``spectrum.json`` and, as ``picture``,
    ``spectrum.png``."""
    print(f"\n{format_spectrum(rows)}")
    paths = [str(path) for path in write_rows(rows, SPECTRUM_COLUMNS, folder, "spectrum")]
    if picture:
        from hood.media.bars import write_bars

        write_bars(bar_panels(rows), folder / "spectrum.png")
        paths.append(str(folder / "spectrum.png"))
    print(f"spectrum in {', '.join(paths)}")
