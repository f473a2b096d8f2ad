"""The picture of docs/gallery.md, the wardrobe, a fabric each: ``python scripts/gallery.py docs/images/gallery.png``.

Each is simulated by the solver at 4,000 vertices, and shown where it has come in the same moment of the same dance; the last
row is one of them in three fabrics more.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from PIL import Image

import hood
from hood.media.film import Film
from hood.media.renderer.render import contact_sheet
from hood.rollouts.file.reader import RolloutData

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
    """The last frame (H, W, 3) uint8 of a garment in a fabric."""
    simulation = hood.simulate(
        f"{garment}_4k", SEQUENCE, material=fabric, stepper="newton", num_frames=NUM_FRAMES, metrics="none", guard="off"
    )
    *_, last = simulation
    body, cloth = last.body_pos.numpy(), last.world_pos.numpy()
    worn = simulation.scene.garment
    said = {"garment": worn.name, "fabric_names": fabric}
    data = RolloutData(cloth[None], worn.faces, worn.rest_pos, body[None], simulation.scene.motion.faces, np.zeros(1), {}, said)
    return Film(data, _WIDTH, _HEIGHT, azimuth_deg=_AZIMUTH).picture(0)


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
