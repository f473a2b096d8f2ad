"""What the exit codes mean: one table, for the commands and for the help."""

from __future__ import annotations

#: A rollout that ran to its end and cannot be trusted.
UNSOUND = 3
#: Where several hold, 130 comes before 2, and 2 before 3.
EXIT_CODES = {
    0: "done",
    1: "inspect: something needs repair; tradeoff: points failed, the page is without them",
    2: "an error, told in one line; rollout: a motion of many could not be used, the others are there",
    UNSOUND: "rollout: a result is unsound, or doubtful with doubts=refuse, or guard=strict ended it; see summary.json",
    130: "interrupted; what is done is kept",
}


def exit_code_lines() -> list[str]:
    """The table for a terminal."""
    return [
        "exit codes (where several hold: 130, then 2, then 3):",
        *(f"  {code:<6}{text}" for code, text in EXIT_CODES.items()),
    ]
