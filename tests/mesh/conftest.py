"""What tests of meshes share."""

from __future__ import annotations

import pytest

from hood.mesh.penetration import compiled


@pytest.fixture(params=["compiled", "numpy"])
def form(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Crossing and depth in both forms, one after the other."""
    if request.param == "numpy":
        monkeypatch.setattr(compiled, "library", lambda: None)
    elif compiled.library() is None:
        pytest.skip("no C++ compiler")
