"""Runs the notebooks of ``notebooks/`` and keeps in them what they print and draw.

    make notebooks                  # all of them, one after the other
    python -m tools.notebooks 07    # those whose names begin so

Pages of the viewer are shown when a reader runs a cell, and left out of the file, as are times and numbers of runs.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient

FOLDER = Path(__file__).resolve().parents[1] / "notebooks"
#: Characters of an output in one form; longer ones, of pages, are left out.
_MOST_HTML = 20_000
_TIMEOUT = 600


def main(*names: str) -> None:
    """Run the notebooks whose file names begin with one of ``names``; all of them without any."""
    for path in sorted(FOLDER.glob("*.ipynb")):
        if not names or path.name.startswith(names):
            run(path)
            print(f"{path.name}: {path.stat().st_size / 1e3:.0f} kB")


def run(path: Path) -> None:
    """Run one notebook in a folder of its own, and write it with its outputs."""
    book = nbformat.read(path, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        NotebookClient(book, timeout=_TIMEOUT, resources={"metadata": {"path": folder}}, record_timing=False).execute()
    for cell in book.cells:
        for output in cell.get("outputs", ()):
            data = output.get("data", {})
            if len(data.get("text/html", "")) > _MOST_HTML:
                del data["text/html"]
        if cell.get("outputs"):
            cell.outputs = [output for output in cell.outputs if output.get("name") != "stderr"]
        if cell.cell_type == "code":
            cell.execution_count = None
            for output in cell.outputs:
                if "execution_count" in output:
                    output["execution_count"] = None
    book.metadata.get("language_info", {}).pop("version", None)
    nbformat.write(book, path)


if __name__ == "__main__":
    main(*sys.argv[1:])
