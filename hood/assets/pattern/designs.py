"""Own sewing patterns by name, made to measure: each is drawn from the blocks with its options; CC0."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hood.assets.files.library import nearest, unknown
from hood.assets.pattern.blocks import Table
from hood.assets.pattern.bottoms import BOTTOMS
from hood.assets.pattern.measures import Measures
from hood.assets.pattern.options import MEANINGS, Design, Options
from hood.assets.pattern.pattern import MOST_GATHERED, Pattern, check_pattern
from hood.assets.pattern.tops import TOPS

#: Every design by name.
DESIGNS: dict[str, Design] = TOPS | BOTTOMS


def draft(name: str, measures: Measures, options: Mapping[str, Any] | None = None) -> Pattern:
    """A design for a body of those measures.

    Args:
        options: those that are not at their defaults, see ``DESIGNS[name].options``.

    Raises:
        ValueError: an unknown design or option, or a value out of its range; the sentence names what there is.

    Examples:
        >>> import hood
        >>> from hood.assets.pattern.designs import draft
        >>> from hood.assets.pattern.measures import measure_body
        >>> body = hood.load_body()
        >>> vertices, joints = body.shaped([0.0])
        >>> pattern = draft("skirt", measure_body(vertices, body.faces, joints), {"flare": 0.5})
        >>> sorted(pattern.panels)
        ['band_back', 'band_front', 'skirt_back', 'skirt_front']
    """
    if name not in DESIGNS:
        raise ValueError(unknown("design", name, DESIGNS))
    design = DESIGNS[name]
    chosen: dict[str, float | str] = {key: own[0] for key, own in design.options.items()}
    for key, value in (options or {}).items():
        if key not in chosen:
            meant = nearest(key, chosen)
            known = [ranged(name, one) for one in chosen]
            raise ValueError(f"design:{name}: {unknown('option', key, known, meant and ranged(name, meant))}")
        chosen[key] = _checked(name, key, value)
    table = Table()
    design.draw(table, measures, Options(**chosen))
    pattern = Pattern(name, table.panels, tuple(table.stitches), measures.height)
    check_pattern(f"design:{name}", pattern, MOST_GATHERED)
    return pattern


def ranged(name: str, key: str) -> str:
    """An option of a design with what it may be."""
    known = DESIGNS[name].options[key]
    return (
        f"{key} ({known[1]:g} to {known[2]:g})"
        if len(known) == 3 and not isinstance(known[0], str)
        else (f"{key} ({', '.join(map(str, known))})")
    )


def _checked(name: str, key: str, value: Any) -> float | str:
    known = DESIGNS[name].options[key]
    if isinstance(known[0], str):
        if value not in known:
            raise ValueError(f"design:{name}: {key} is {value!r}; give one of {', '.join(map(str, known))}")
        return str(value)
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not number or not known[1] <= value <= known[2]:  # type: ignore[operator]
        raise ValueError(f"design:{name}: {key} is {value!r}; give a number from {known[1]:g} to {known[2]:g}: {MEANINGS[key]}")
    return float(value)
