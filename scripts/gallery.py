"""The picture of docs/gallery.md, all garments in three fabrics: ``python scripts/gallery.py docs/images/gallery.png``.

Each is simulated by the solver at 4,000 vertices, and shown where it has come in the same moment of the same dance.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from PIL import Image

import hood
from hood.media.renderer.render import BODY_COLOR, Camera, RenderMesh, contact_sheet, hem_distance, render_frame

GARMENTS = ("tshirt", "longsleeve", "tank", "dress", "skirt", "shorts", "trousers")
#: Fabrics and the colour that each is drawn in, sRGB.
FABRICS = {"jersey": (0.80, 0.45, 0.22), "denim": (0.20, 0.30, 0.52), "silk": (0.62, 0.28, 0.42)}
SEQUENCE, NUM_FRAMES = "dance_mixed", 60
_WIDTH, _HEIGHT = 230, 330  # pixels of one still
_AZIMUTH = 25.0  # degrees
_LEVEL = 3  # channels are multiples of it, which no eye sees and makes the file a third smaller


def still(garment: str, fabric: str) -> np.ndarray:
    """The last frame (H, W, 3) uint8 of a garment in a fabric."""
    simulation = hood.simulate(
        f"{garment}_4k", SEQUENCE, material=fabric, stepper="newton", num_frames=NUM_FRAMES, metrics="none", guard="off"
    )
    *_, last = simulation
    body, cloth = last.body_pos.numpy(), last.world_pos.numpy()
    camera = Camera.framing(body[None], _AZIMUTH, 8.0, aspect=_WIDTH / _HEIGHT)
    worn = simulation.scene.garment
    meshes = [
        RenderMesh(body, simulation.scene.motion.faces, BODY_COLOR, behind=1e-3),
        RenderMesh(cloth, worn.faces, FABRICS[fabric], hem_distance(worn.rest_pos, worn.faces)),
    ]
    return render_frame(meshes, camera, width=_WIDTH, height=_HEIGHT)


def draw(picture: Path) -> None:
    """Write the sheet: a row for every fabric, a column for every garment."""
    pages, names = [], []
    for fabric in FABRICS:
        for garment in GARMENTS:
            print(f"{garment}, {fabric}", flush=True)
            pages.append(still(garment, fabric))
            names.append(f"{garment}, {fabric}")
    sheet = contact_sheet(pages, len(GARMENTS), names).astype(np.int64)
    fewer = np.minimum((sheet + _LEVEL // 2) // _LEVEL * _LEVEL, 255).astype(np.uint8)
    Image.fromarray(fewer).save(picture, optimize=True)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python scripts/gallery.py picture.png")
    draw(Path(sys.argv[1]))
