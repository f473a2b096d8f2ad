"""Lines about work that takes long, on the error stream: none in its first seconds, then one now and then."""

from __future__ import annotations

import sys
import time

#: Seconds before the first line, and between two.
_FIRST, _BETWEEN = 5.0, 10.0


class Progress:
    """Tells how far a piece of work is.

    Args:
        what: the work, in words that a colon follows, such as "settling the cloth".
    """

    def __init__(self, what: str) -> None:
        self._what, self._next = what, time.monotonic() + _FIRST

    def tell(self, sentence: str) -> None:
        """Print how far it is, unless that was done a moment ago."""
        now = time.monotonic()
        if now >= self._next:
            self._next = now + _BETWEEN
            print(f"hood: {self._what}: {sentence}", file=sys.stderr, flush=True)
