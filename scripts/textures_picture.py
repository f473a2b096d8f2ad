"""Three patterns as PNG files, and a picture of a garment in each.

``python scripts/textures_picture.py rollout.h5 FOLDER picture.png`` writes the patterns into the folder. The picture in
docs/gallery.md is of ``hood rollout garment=dress_4k sequence=dance_mixed stepper=newton num_frames=60``.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from hood.assets.formats.raw_mesh import read_texture
from hood.media.film import Film
from hood.media.pieces import pieces_of
from hood.media.video import save_png
from hood.rollouts.file.reader import read_rollout

_WIDTH, _HEIGHT, _FRAME = 230, 330, 59
_SIDE, _BANDS = 800, 20  # pixels of a pattern, bands of it along a side
_WHITE, _BLUE, _RED = np.array([[244, 240, 230], [38, 70, 120], [176, 40, 48]])


def patterns() -> dict[str, np.ndarray]:
    """Pictures (H, W, 3) uint8 that go on beyond their borders: bands, checks and a plaid, which is bands both ways."""
    place = np.arange(_SIDE) * _BANDS / _SIDE
    dark = place % 2 < 1
    thin = abs(place % 4 - 2.5) < 0.12
    both = 0.5 * (dark[:, None].astype(float) + dark[None, :])
    plaid = _mixed(both, _WHITE, _RED)
    plaid[thin[:, None] | thin[None, :]] = _BLUE
    return {
        "bands": np.tile(_mixed(dark[:, None], _WHITE, _BLUE), (1, _SIDE, 1)),
        "checks": _mixed(dark[:, None] ^ dark[None, :], _WHITE, _BLUE),
        "plaid": plaid,
    }


def _mixed(share: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.asarray((1.0 - share[..., None]) * first + share[..., None] * second).astype(np.uint8)


def draw(rollout: Path, folder: Path, picture: Path) -> None:
    """Write the patterns into ``folder``, and one frame of ``rollout`` in its own colour and in each of them."""
    data = read_rollout(rollout)
    names = [piece.name for piece in pieces_of(data)]
    files = [save_png(folder / f"{name}.png", pixels) for name, pixels in patterns().items()]
    films = [Film(data, _WIDTH, _HEIGHT)]
    films += [Film(data, _WIDTH, _HEIGHT, textures=dict.fromkeys(names, read_texture(file))) for file in files]
    page = Image.new("RGB", (_WIDTH * len(films), _HEIGHT))
    for place, film in enumerate(films):
        page.paste(Image.fromarray(film.frame(min(_FRAME, len(data.time) - 1))), (place * _WIDTH, 0))
    page.quantize(200).save(picture, optimize=True)


if __name__ == "__main__":
    if len(sys.argv) != 4:
        sys.exit("usage: python scripts/textures_picture.py rollout.h5 FOLDER picture.png")
    draw(*map(Path, sys.argv[1:]))
