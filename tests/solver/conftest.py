"""What tests of the compiled solver share."""

from __future__ import annotations

import pytest

from hood.native.build import BuildError
from hood.solver.compiled import newton


@pytest.fixture(scope="session")
def compiled_solver() -> None:
    """Skips where there is no compiler: these tests are of the compiled form alone."""
    try:
        newton.library()
    except BuildError as error:
        pytest.skip(str(error))
