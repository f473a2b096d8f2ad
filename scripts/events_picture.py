"""The picture of docs/events.md, from a rollout: ``python scripts/events_picture.py rollout.h5 docs/images/events.png``.

The one there is of ``hood rollout garment=shirt stepper=newton 'events=[{time: 1.0, open: front_buttons}, {time: 2.5, close:
front_buttons}]'``.
"""

from __future__ import annotations

import sys
from pathlib import Path

from PIL import Image

from hood.media.film import Film
from hood.rollouts.file.reader import read_rollout

_WIDTH, _HEIGHT = 260, 340  # pixels of one frame
_FRAMES = (30, 45, 65, 80, 91)  # closed, open, open, closing, closed


def draw(rollout: Path, picture: Path) -> None:
    """Write a few frames of ``rollout`` side by side."""
    film = Film(read_rollout(rollout), _WIDTH, _HEIGHT)
    page = Image.new("RGB", (_WIDTH * len(_FRAMES), _HEIGHT))
    for place, frame in enumerate(_FRAMES):
        page.paste(Image.fromarray(film.frame(frame)), (place * _WIDTH, 0))
    page.save(picture, optimize=True)


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("usage: python scripts/events_picture.py rollout.h5 picture.png")
    draw(Path(sys.argv[1]), Path(sys.argv[2]))
