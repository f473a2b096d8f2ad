"""The add-on registered once in a Blender without a display; hood is the Python that HOOD_PYTHON names."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
sys.path[:0] = [str(ROOT / "blender"), str(Path(__file__).parent)]


@pytest.fixture(scope="session", autouse=True)
def _registered() -> Iterator[None]:
    import hood_blender
    from hood_blender import planning, preferences

    hood_blender.register()
    named = {"program": os.environ["HOOD_PYTHON"]}
    planning.preference = lambda name: named.get(name, "")  # the preferences of an add-on that Blender has installed
    assert preferences.preference("program") == ""
    yield
    hood_blender.unregister()


@pytest.fixture(autouse=True)
def _saved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Caches go beside a .blend of the test's own."""
    from hood_blender import folders, planning

    def there(name: str) -> Path:
        return tmp_path / "hood_cache" / name.lower()

    monkeypatch.setattr(planning, "bake_folder", there)
    monkeypatch.setattr(folders, "bake_folder", there)
