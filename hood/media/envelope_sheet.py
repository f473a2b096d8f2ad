"""A picture of a rollout that is small enough to stand in a page with a thousand others."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from hood.assets.files.atomic import write_atomically
from hood.dynamics.recorder import RolloutData, read_rollout
from hood.media.film import Film, sheet_frames
from hood.media.render import contact_sheet

#: Pixels of a frame, frames, and bytes of the picture at most.
_WIDTH, _HEIGHT, _FRAMES, _MOST = 130, 180, 5, 25_000
_QUALITIES = (80, 70, 60, 45, 30)


def small_sheet(folder: Path) -> bytes | None:
    """JPEG of ``folder/rollout/rollout.h5``: five frames spread over it and the one with the largest strain p99.

    It is kept as ``folder/sheet.jpg`` and drawn again for a newer rollout. None without Pillow.
    """
    path, source = folder / "sheet.jpg", folder / "rollout" / "rollout.h5"
    if path.exists() and path.stat().st_mtime >= source.stat().st_mtime:
        return path.read_bytes()
    try:
        content = _jpeg(_sheet(read_rollout(source)))
    except ImportError:
        return None
    write_atomically(path, content)
    return content


def _sheet(data: RolloutData) -> np.ndarray:
    film, strain = Film(data, _WIDTH, _HEIGHT), data.metrics.get("strain_p99")
    chosen = sheet_frames(len(data.cloth_pos), _FRAMES)
    if strain is not None and np.isfinite(strain).any():
        chosen = sorted({*chosen, int(np.nanargmax(strain))})
    return contact_sheet(
        [film.frame(index) for index in chosen], len(chosen), [f"{data.time[index]:.2f} s" for index in chosen]
    )


def _jpeg(picture: np.ndarray) -> bytes:
    """As good as it gets within the limit."""
    from PIL import Image

    for quality in _QUALITIES:
        content = io.BytesIO()
        Image.fromarray(picture).save(content, format="JPEG", quality=quality, optimize=True)
        if len(content.getvalue()) <= _MOST:
            break
    return content.getvalue()
