"""Pieces of the finest garments, as large in vertices as garments of 4,400, to train on.

    python scripts/cut_pieces.py outputs/pieces

Writes ``dress_side.npz``, ``dress_side_right.npz`` and ``skirt_front.npz``: bands of the meshes of 12,000 vertices from top to
bottom, held at their upper rims. Long waves cross as many edges in them as in the whole garment. ``dress_front_fine.npz``,
``dress_back_fine.npz`` and ``skirt_front_fine.npz`` are narrower ones with every face cut into four, edges of 4 to 5 mm.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from hood.assets.fitting.alterations import piece_of
from hood.assets.garment.garment import Garment, load_garment, save_garment
from hood.studies.envelope.extreme_garments import FAULTS

#: Bands of the dress lie beyond this share of its half width at every height, which is measured in so many steps.
_SHARE, _HEIGHTS = 0.42, 40
#: Held are vertices this far [m] below the top: of the dress at the shoulder, of the skirt at its waistband.
_SHOULDER, _WAIST = 0.05, 0.02
#: Fine bands: garment, depth [m] of what is held at least, and the angles [rad] about the vertical axis between which they lie,
#: 0 in front.
_FINE = {
    "dress_front_fine": ("dress_12k", _SHOULDER, 0.05, 0.62),
    "dress_back_fine": ("dress_12k", _SHOULDER, -3.0, -2.45),
    "skirt_front_fine": ("skirt_12k", 3.7e-3, -0.4, 0.2),
}


def beyond(centres: np.ndarray, sign: float) -> np.ndarray:
    """(F,) bool: face centres (F, 3) that lie farther out to a side than the share of the half width at their height."""
    height = centres[:, 1]
    step = np.digitize(height, np.linspace(height.min(), height.max(), _HEIGHTS))
    width = np.zeros(_HEIGHTS + 2)
    np.maximum.at(width, step, np.abs(centres[:, 0]))
    return np.asarray(sign * centres[:, 0] > _SHARE * width[step])


def held(name: str, piece: Garment, top: float, depth: float) -> Garment:
    """The piece with a name, held where it is no farther than ``depth`` [m] below ``top`` [m]."""
    return replace(piece, name=name, pinned=piece.pinned | (piece.worn_pos[:, 1] > top - depth))


def pieces() -> list[Garment]:
    dress, skirt = load_garment("dress_12k"), load_garment("skirt_12k")
    centres, shoulder = dress.worn_pos[dress.faces].mean(axis=1), dress.worn_pos[:, 1].max()
    found = [
        held(name, piece_of(dress, beyond(centres, sign)), shoulder, _SHOULDER)
        for name, sign in (("dress_side", 1.0), ("dress_side_right", -1.0))
    ]
    centres = skirt.worn_pos[skirt.faces].mean(axis=1)
    front = (centres[:, 2] > 0.0) & (np.abs(centres[:, 0]) < 0.7 * np.abs(centres[:, 0]).max())
    piece = piece_of(skirt, front)
    return [*found, held("skirt_front", piece, piece.worn_pos[:, 1].max(), _WAIST)]


def fine_pieces() -> list[Garment]:
    found = []
    for name, (garment, depth, least, most) in _FINE.items():
        whole = FAULTS["subdivide"](load_garment(garment), 1.0, np.random.default_rng(0))
        centres = whole.worn_pos[whole.faces].mean(axis=1)
        angle = np.arctan2(centres[:, 0], centres[:, 2])
        piece = piece_of(whole, (angle > least) & (angle < most))
        found.append(held(name, piece, piece.worn_pos[:, 1].max(), depth))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    for piece in [*pieces(), *fine_pieces()]:
        save_garment(folder / f"{piece.name}.npz", piece)
        print(f"{folder / piece.name}.npz: {len(piece.rest_pos)} vertices, {int(piece.pinned.sum())} held")


if __name__ == "__main__":
    main()
