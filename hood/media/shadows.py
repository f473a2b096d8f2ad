"""The picture of the drape test: the shadow of every sample, with the disc it lies on and the circle it was cut to."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

from hood.evaluation.drape import DISC, PIXEL, SAMPLE, Rest
from hood.media.bars import write_png

#: Panels in a row at most, and inches of one.
_COLUMNS, _INCHES = 5, 2.2
_CLOTH = "#345c8e"


def write_shadows(states: Mapping[str, Rest], path: Path) -> None:
    """Draw a panel per fabric, by its name, into a PNG."""
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle

    columns = min(len(states), _COLUMNS)
    rows = math.ceil(len(states) / columns)
    figure = Figure(figsize=(_INCHES * columns, (_INCHES + 0.4) * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).reshape(-1)
    for axes in panels:
        axes.set_axis_off()
    for axes, (name, state) in zip(panels, states.items(), strict=False):
        half = 0.5 * PIXEL * len(state.shadow)
        axes.imshow(state.shadow, cmap=ListedColormap(["#ffffff", _CLOTH]), extent=(-half, half, half, -half))
        axes.add_patch(Circle((0, 0), DISC, fill=False, color="#ffffff", linewidth=1.0))
        axes.add_patch(Circle((0, 0), SAMPLE, fill=False, color="#999999", linewidth=0.8, linestyle="--"))
        axes.set_title(f"{name}\n{100 * state.coefficient:.0f}%, {state.folds} folds", fontsize=9)
    write_png(figure, path, dpi=100)
