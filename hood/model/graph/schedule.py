"""Which edge sets every processor step works on, written as a string such as ``3x(mesh+coarse0) 3x(coarse0)``; ``|`` ends a
pass, whose prediction is decoded before the next one begins."""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence

from hood.model.graph.builder import MESH, set_level

Step = tuple[str, ...]

#: The architectures of the paper (section 4.2 and Table 1) by name.
SCHEDULES: dict[str, str] = {
    "ours": "3x(mesh+coarse0) 3x(coarse0+coarse1) 3x(coarse1) 3x(coarse0+coarse1) 3x(mesh+coarse0)",
    "fine15": "15x(mesh)",
    "fine48": "48x(mesh)",
}
#: Steps of a schedule at most: twenty times the longest published one.
_MOST_STEPS = 1000
_BLOCK = re.compile(r"\s*(?:(\d+)\s*x\s*)?\(([^()]*)\)\s*")
_COARSE = re.compile(r"coarse(\d+)")


def parse_schedule(text: str) -> tuple[Step, ...]:
    """Steps of a schedule, each a tuple of cloth edge sets in the order of the node network's input: coarse sets
    ascending, then the mesh. Body edges belong to every step and are not written.

    ``text`` is a name from :data:`SCHEDULES` or blocks ``Nx(set+set)``, with ``|`` between passes (:func:`parse_passes`).
    Raises ValueError for anything misspelt.
    """
    source = SCHEDULES.get(text.strip(), text).replace("|", " ")
    if "(" not in source:
        hint = difflib.get_close_matches(text, SCHEDULES, n=1)
        guess = f"; did you mean {hint[0]!r}?" if hint else ""
        raise ValueError(f"unknown schedule {text!r}{guess} (known: {', '.join(SCHEDULES)}, or 'Nx(mesh+coarse0) …')")
    steps: list[Step] = []
    position = 0
    while position < len(source):
        block = _BLOCK.match(source, position)
        if block is None:
            raise ValueError(f"schedule {source!r}: cannot read {source[position:]!r}; write '3x(mesh+coarse0)'")
        repeats = int(block[1] or 1)
        if repeats < 1:
            raise ValueError(f"schedule {source!r}: {block[0].strip()!r} repeats 0 times; remove it")
        if len(steps) + repeats > _MOST_STEPS:
            raise ValueError(f"schedule {source[:80]!r}: more than {_MOST_STEPS} steps; the longest published one has 48")
        steps += [_parse_sets(block[2], source)] * repeats
        position = block.end()
    return tuple(steps)


def parse_passes(text: str) -> tuple[int, ...]:
    """Number of steps in each pass of a schedule, at least one pass. Raises ValueError for a pass without steps."""
    parts = SCHEDULES.get(text.strip(), text).split("|")
    for index, part in enumerate(parts):
        if len(parts) > 1 and not part.strip():
            raise ValueError(f"schedule {text!r}: pass {index} of {len(parts)} has no steps; remove a '|'")
    return tuple(len(parse_schedule(part)) for part in parts)


def edge_set_names(schedule: Sequence[Step]) -> tuple[str, ...]:
    """Cloth edge sets that some step uses: the mesh first, then the coarse sets ascending."""
    return tuple(sorted({name for step in schedule for name in step}, key=set_level))


def finest_level(step: Step) -> int:
    """Finest level of a step; body edges of nodes that exist only on finer levels do not take part in it."""
    return min(set_level(name) for name in step)


def radius(schedule: Sequence[Step], passed_over: int = 0) -> int:
    """Propagation radius in mesh edges: the sum over the steps of the longest edge processed (paper, Table 1).

    Where levels are passed over (:func:`hood.model.graph.hierarchy.num_passed_over`), coarse edges are so many times twice as
    long.
    """
    levels = [max(map(set_level, step)) for step in schedule]
    return sum(2 ** (level + passed_over) if level else 1 for level in levels)


def _parse_sets(text: str, source: str) -> Step:
    names = [name.strip() for name in text.split("+")]
    for name in names:
        if name != MESH and not _COARSE.fullmatch(name):
            hint = difflib.get_close_matches(name, ["mesh", "coarse0", "coarse1", "coarse2", "coarse3"], n=1)
            guess = f"; did you mean {hint[0]!r}?" if hint else ""
            raise ValueError(f"schedule {source!r}: unknown edge set {name!r}{guess} (mesh, coarse0, coarse1, …)")
    if len(set(names)) < len(names):
        raise ValueError(f"schedule {source!r}: ({text}) names a set twice")
    return tuple(sorted(names, key=lambda name: (name == MESH, set_level(name))))
