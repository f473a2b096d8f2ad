"""The add-on registered once in a Blender without a display; hood is the Python that HOOD_PYTHON names."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
sys.path[:0] = [str(ROOT / "blender"), str(Path(__file__).parent)]


#: Preferences of the add-on, which has none here because Blender has not installed it.
PREFERENCES = {"program": ""}
_ENDED: list[int] = []


def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    _ENDED.append(int(exitstatus))


@pytest.hookimpl(trylast=True)
def pytest_unconfigure(config: pytest.Config) -> None:
    """End at once: bpy's own threads sometimes wait for each other while the process is taken down."""
    sys.stdout.flush()
    sys.stderr.flush()
    if _ENDED:
        os._exit(_ENDED[-1])


@pytest.fixture(scope="session", autouse=True)
def _registered() -> Iterator[None]:
    import hood_blender
    from hood_blender import operators, planning, preferences

    hood_blender.register()
    assert preferences.preference("program") == ""
    planning.preference = operators.preference = lambda name: PREFERENCES.get(name, "")
    yield
    hood_blender.unregister()


@pytest.fixture(autouse=True)
def _places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Caches of files that are not saved go into the test's own folder; hood is the one that HOOD_PYTHON has."""
    import bpy
    from hood_blender import folders

    monkeypatch.setattr(folders, "temporary_folder", lambda: tmp_path)
    monkeypatch.setitem(PREFERENCES, "program", os.environ["HOOD_PYTHON"])
    assert bpy.app.background


@pytest.fixture
def quick(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A hood that starts at once (``quick_hood.py``), in the place of the real one."""
    program = tmp_path / "hood"
    program.write_text(f'#!/bin/sh\nexec {sys.executable} {Path(__file__).with_name("quick_hood.py")} "$@"\n')
    program.chmod(0o755)
    monkeypatch.setitem(PREFERENCES, "program", str(program))
    return program
