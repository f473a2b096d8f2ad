"""The moving picture of the README, from a rollout: ``python scripts/readme_picture.py rollout.h5 docs/images/dress.gif``.

The one in the README is of
``hood rollout garment=swing_4k material=silk_crepe sequence=dance_mixed num_frames=75 stepper=newton metrics=none``.
"""

from __future__ import annotations

import sys
from pathlib import Path

from PIL import Image

from hood.media.film import Film
from hood.rollouts.file.reader import read_rollout

_WIDTH, _HEIGHT = 300, 420  # pixels of one view
_VIEWS = (25.0, 115.0)  # degrees, side by side
_STRIDE = 2  # every second frame: 15 pictures a second of 30


def draw(rollout: Path, picture: Path) -> None:
    """Write every second frame of ``rollout`` from two sides as a GIF that repeats."""
    data = read_rollout(rollout)
    films = [Film(data, _WIDTH, _HEIGHT, view) for view in _VIEWS]
    pictures = []
    for frame in range(0, len(data.cloth_pos), _STRIDE):
        page = Image.new("RGB", (_WIDTH * len(films), _HEIGHT))
        for place, film in enumerate(films):
            page.paste(Image.fromarray(film.frame(frame)), (place * _WIDTH, 0))
        pictures.append(page)
    shown = pictures[:: max(len(pictures) // 6, 1)]
    together = Image.new("RGB", (pictures[0].width, _HEIGHT * len(shown)))
    for place, page in enumerate(shown):
        together.paste(page, (0, place * _HEIGHT))
    palette = together.quantize(256, method=Image.Quantize.MEDIANCUT)  # one for all, of frames all along
    flat = [page.quantize(palette=palette, dither=Image.Dither.NONE) for page in pictures]
    flat[0].save(picture, save_all=True, append_images=flat[1:], duration=1000 * _STRIDE // 30, loop=0, optimize=True)


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("usage: python scripts/readme_picture.py rollout.h5 picture.gif")
    draw(Path(sys.argv[1]), Path(sys.argv[2]))
