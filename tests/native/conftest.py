"""What tests of compiled libraries share."""

from __future__ import annotations

from pathlib import Path

import pytest

from hood.native.build import BuildError, find_compiler


@pytest.fixture
def compiler() -> str:
    """A C++ compiler; tests that need one are skipped without."""
    try:
        return find_compiler()
    except BuildError as error:
        pytest.skip(str(error))


@pytest.fixture
def source(compiler: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A small source, with an empty folder for what is made of it."""
    monkeypatch.setenv("HOOD_CACHE", str(tmp_path / "kept"))
    path = tmp_path / "answer.cpp"
    path.write_text('extern "C" int answer() { return 42; }\n')
    return path
