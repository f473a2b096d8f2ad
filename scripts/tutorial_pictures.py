"""Pictures of docs/tutorial.md: ``python scripts/tutorial_pictures.py skirt_prepared.npz solver.h5 network.h5 docs/images``.

The rollouts are those of the tutorial: ``stepper=newton`` and ``refine=0`` of the same garment and motion.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from hood import Garment, load_body, load_garment, read_rollout
from hood.media.film import Film
from hood.media.pieces import part_colour
from hood.media.renderer.render import BODY_COLOR, Camera, RenderMesh, contact_sheet, hem_distance, render_frame

_WIDTH, _HEIGHT = 310, 390  # pixels of one view
_COLUMNS = 4
_LEVEL = 2


def draw(garment: Path, solver: Path, network: Path, folder: Path) -> None:
    """Write the three pictures into ``folder``: the garment as it is made, the rollout, and the network beside the solver."""
    _save(_made(load_garment(garment)), folder / "tutorial_place.png")
    films = [Film(read_rollout(rollout), _WIDTH, _HEIGHT) for rollout in (solver, network)]
    _save(films[0].sheet(2 * _COLUMNS, _COLUMNS), folder / "tutorial_rollout.png")
    frames = (32, 44, 70, 96)
    pages = [film.frame(frame) for film in films for frame in frames]
    names = [f"{name}, {films[0].data.time[frame]:.2f} s" for name in ("solver", "network alone") for frame in frames]
    _save(contact_sheet(pages, len(frames), names), folder / "tutorial_network.png")


def _made(garment: Garment) -> np.ndarray:
    """The garment around the body in T-pose, from three sides."""
    body = load_body()
    surface = body.shaped(np.zeros(0))[0]
    # as it starts: outside of the body
    cloth = garment.worn_pos
    meshes = [
        RenderMesh(surface, body.faces, BODY_COLOR, behind=1e-3),
        RenderMesh(cloth, garment.faces, part_colour(0), hem_distance(garment.rest_pos, garment.faces)),
    ]
    floor = float(surface[:, 1].min())
    views = (0.0, 45.0, 90.0)
    cameras = [Camera.framing(surface[None], azimuth, 8.0, aspect=1.0) for azimuth in views]
    pages = [render_frame(meshes, camera, width=_HEIGHT, height=_HEIGHT, floor=floor) for camera in cameras]
    return contact_sheet(pages, len(views), [f"{azimuth:g} degrees" for azimuth in views])


def _save(picture: np.ndarray, path: Path) -> None:
    """Channels are multiples of a few levels, which no eye sees and makes the file a third smaller."""
    levels = (picture.astype(np.int64) + _LEVEL // 2) // _LEVEL * _LEVEL
    Image.fromarray(np.minimum(levels, 255).astype(np.uint8)).save(path, optimize=True)


if __name__ == "__main__":
    if len(sys.argv) != 5:
        sys.exit("usage: python scripts/tutorial_pictures.py skirt_prepared.npz solver.h5 network.h5 folder")
    draw(*map(Path, sys.argv[1:]))
