"""Bar charts: few figures side by side, drawn with Pillow alone."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hood.assets.atomic import write_atomically

#: Of the series, in their order; far apart in lightness too.
_COLOURS = ((52, 92, 142), (214, 132, 62), (96, 150, 104), (160, 84, 120), (120, 120, 126), (222, 190, 96))
_INK, _GRID = (60, 62, 66), (226, 226, 228)
_HEIGHT, _MARGIN, _BAR, _GAP = 260, 56, 22, 26

#: Values by category and series.
Panel = Mapping[str, Mapping[str, float]]


def write_bars(panels: Mapping[str, Panel], path: Path) -> None:
    """Draw a chart per panel, by its title, one below the other, into a PNG. Bars start at 0; values are not negative."""
    from PIL import Image, ImageDraw

    series = list(dict.fromkeys(name for panel in panels.values() for values in panel.values() for name in values))
    longest = max((len(panel) for panel in panels.values()), default=1)
    slot = max(len(series) * _BAR, 96) + _GAP
    canvas = Image.new("RGB", (2 * _MARGIN + longest * slot, max(1, len(panels)) * (_HEIGHT + 2 * _MARGIN)), "white")
    draw = ImageDraw.Draw(canvas)
    for row, (title, panel) in enumerate(panels.items()):
        _draw_panel(draw, title, panel, series, slot, row * (_HEIGHT + 2 * _MARGIN) + _MARGIN)
    content = io.BytesIO()
    canvas.save(content, "PNG")
    write_atomically(path, content.getvalue())


def _draw_panel(draw: Any, title: str, panel: Panel, series: list[str], slot: int, top: int) -> None:
    from PIL import ImageFont

    font, floor = ImageFont.load_default(12), top + _HEIGHT
    highest = max((value for values in panel.values() for value in values.values()), default=0.0) or 1.0
    draw.text((_MARGIN, top - 46), title, fill=_INK, font=ImageFont.load_default(15))
    for index, name in enumerate(series):
        left = _MARGIN + index * 130
        draw.rectangle((left, top - 22, left + 10, top - 12), fill=_COLOURS[index % len(_COLOURS)])
        draw.text((left + 15, top - 25), name, fill=_INK, font=font)
    for part in range(5):
        height = floor - round(part / 4 * _HEIGHT)
        draw.line((_MARGIN, height, _MARGIN + len(panel) * slot, height), fill=_GRID)
        draw.text((8, height - 7), f"{highest * part / 4:.3g}", fill=_INK, font=font)
    for place, (category, values) in enumerate(panel.items()):
        left = _MARGIN + place * slot + _GAP // 2
        for index, name in enumerate(series):
            if name in values:
                upper = floor - round(values[name] / highest * _HEIGHT)
                box = (left + index * _BAR, upper, left + (index + 1) * _BAR - 3, floor)
                draw.rectangle(box, fill=_COLOURS[index % len(_COLOURS)])
        draw.text((left, floor + 6), category, fill=_INK, font=font)
