"""The add-on inside Blender (``inside/case_*.py``), in a Python that has bpy: ``make test-blender`` makes one.

Needs the environment variable HOOD_BLENDER_PYTHON; bpy is too large to be a dependency of the tests.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

INSIDE = Path(__file__).parent / "inside"
PYTHON = os.environ.get("HOOD_BLENDER_PYTHON")


@pytest.mark.slow
@pytest.mark.skipif(PYTHON is None, reason="HOOD_BLENDER_PYTHON names no Python that has bpy; make test-blender makes one")
@pytest.mark.parametrize("cases", sorted(path.name for path in INSIDE.glob("case_*.py")))
def test_inside_blender(cases: str) -> None:
    command = [str(PYTHON), "-m", "pytest", "-q", "-c", os.devnull, "-p", "no:cacheprovider", "-o", "python_files=case_*.py"]
    command += ["--rootdir", str(INSIDE), "--confcutdir", str(INSIDE), str(INSIDE / cases)]
    environment = os.environ | {"HOOD_PYTHON": sys.executable}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=1800)
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]
