"""What pip calls this package and its extras: one place for every message that says what to install."""

from __future__ import annotations

#: The package that pip installs; ``hood`` on the public index is somebody else's.
DISTRIBUTION = "hood-cloth"


def install(extra: str) -> str:
    """The command that adds an extra of ``pyproject.toml`` to this installation."""
    return f'pip install "{DISTRIBUTION}[{extra}]"'
