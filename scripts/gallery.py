"""The picture of docs/gallery.md, the wardrobe, a fabric each: ``python scripts/gallery.py docs/images/gallery.png``.

Each is simulated by the solver at 4,000 vertices, and shown where it has come in the same moment of the same dance.
"""

from __future__ import annotations

import contextlib
import io
import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

from hood.cli.main import main as run_hood
from hood.media.film import Film
from hood.media.renderer.render import contact_sheet
from hood.rollouts.file.reader import read_rollout

#: Garments and their fabrics.
WORN = (
    ("blouse", "cotton_poplin"),
    ("blazer", "wool_suiting"),
    ("bomber", "coated_nylon"),
    ("gilet", "nappa_leather"),
    ("hoodie", "double_knit"),
    ("poncho", "wool_felt"),
    ("apron", "linen"),
    ("jeans", "denim_12oz"),
    ("leggings", "cotton_jersey"),
    ("jumpsuit", "cotton_canvas"),
    ("swing", "silk_crepe"),
    ("wrap", "jersey"),
    ("tiered", "chiffon"),
    ("circle", "silk_habotai"),
    ("circle", "denim_12oz"),
    ("pleated", "wool_suiting"),
    ("pleated", "silk"),
)
SEQUENCE, NUM_FRAMES = "dance_mixed", 60
_COLUMNS = 6
_WIDTH, _HEIGHT = 230, 330  # pixels of one still
_AZIMUTH = 25.0  # degrees
_LEVEL = 6  # channels are multiples of it, which the eye hardly sees and halves the file


def still(garment: str, fabric: str) -> np.ndarray:
    """The last frame (H, W, 3) uint8 of a garment in a fabric, with its pockets and buttons."""
    words = f"garment={garment}_4k sequence={SEQUENCE} material={fabric} stepper=newton num_frames={NUM_FRAMES} fail_on=nothing"
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        target = Path(folder, "rollout")
        if run_hood(["rollout", *words.split(), "metrics=none", "video=none", "sheet=false", f"output={target}"]):
            raise RuntimeError(f"no rollout of {garment}_4k in {fabric}")
        data = read_rollout(target / "rollout.h5")
    return Film(data, _WIDTH, _HEIGHT, azimuth_deg=_AZIMUTH).picture(NUM_FRAMES - 1)


def draw(picture: Path) -> None:
    """Write the sheet."""
    pages, names = [], []
    for garment, fabric in WORN:
        names.append(f"{garment}, {fabric}")
        print(names[-1], flush=True)
        pages.append(still(garment, fabric))
    sheet = contact_sheet(pages, _COLUMNS, names).astype(np.int64)
    fewer = np.minimum((sheet + _LEVEL // 2) // _LEVEL * _LEVEL, 255).astype(np.uint8)
    Image.fromarray(fewer).save(picture, optimize=True)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python scripts/gallery.py picture.png")
    draw(Path(sys.argv[1]))
