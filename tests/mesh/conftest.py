"""What tests of meshes share."""

from __future__ import annotations

import pytest

from hood.mesh import compiled_crossing


@pytest.fixture(params=["compiled", "numpy"])
def form(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Crossing and depth in both forms, one after the other."""
    if request.param == "numpy":
        monkeypatch.setattr(compiled_crossing, "library", lambda: None)
    elif compiled_crossing.library() is None:
        pytest.skip("no C++ compiler")
