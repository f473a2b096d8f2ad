"""Updates that were skipped, since a loss or a gradient was no number: how many, how many in a row, and why."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any


class Skipped:
    """Counts the updates of a training; what it says is about the whole run, what was rolled back included.

    Attributes:
        count: updates that were skipped.
        in_row: of these, those since the last one that was made.
        made: updates that were made, and not rolled back.
        reason: why the last one was skipped; empty where another process saw it.
    """

    def __init__(self) -> None:
        self.count, self.in_row, self.made = 0, 0, 0
        self.reason = ""

    def skip(self, iteration: int, energies: Mapping[str, float], norm: float) -> None:
        """An update that is not made, with the means of its energies and the length of its gradient."""
        self.count, self.in_row = self.count + 1, self.in_row + 1
        lost = [name for name, value in energies.items() if not math.isfinite(value)]
        if lost:
            self.reason = f"iteration {iteration}: energy {lost[0]} is {energies[lost[0]]}"
        else:
            self.reason = "" if math.isfinite(norm) else f"iteration {iteration}: the length of the gradient is {norm}"

    def make(self) -> None:
        """An update that is made."""
        self.made, self.in_row = self.made + 1, 0

    def state_dict(self) -> dict[str, Any]:
        """What a resumed run goes on with."""
        return {"skipped": self.count, "skipped_in_row": self.in_row, "made": self.made, "skip_reason": self.reason}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Back to what :meth:`state_dict` gave; older checkpoints do not say how many were made."""
        self.count, self.in_row = int(state["skipped"]), int(state["skipped_in_row"])
        self.made = made_behind(state)
        self.reason = str(state.get("skip_reason", ""))


def made_behind(state: Mapping[str, Any]) -> int:
    """Updates that were made behind a checkpoint."""
    return int(state.get("made", state["iteration"]))


def told(reasons: list[str]) -> str:
    """The reason of the first process that has one, in brackets."""
    reason = next((reason for reason in reasons if reason), "")
    return f" ({reason})" if reason else ""
