"""Pictures to label the table by: every scene is run and drawn on one sheet, with its true body, from front, back and side.

    python -m tests.verdict.table.pictures output=outputs/table                        # all scenes: about an hour on one core
    python -m tests.verdict.table.pictures dress_handstand skirt_spin output=outputs/table
    python -m tests.verdict.table.pictures dress_handstand output=outputs/table again=true close=0.4

A sheet has a column a frame: the first, a third, two thirds, the one whose edges are stretched most, of every fourth the
one that the skin cuts most, and the last. Its rows are the views. The body is light, every connected part of the cloth has
a colour of its own, faces seen from inside are darker. Above each column stand counts of :mod:`tests.verdict.table.counts`:
stretch of the edges (99th percentile, most), pairs of triangles through each other, cloth vertices in the body, triangles
that the skin cuts. What the command says about its rollout is not shown: labels are given without it. ``close=0.4`` draws
what lies within 0.4 m of the middle of the cloth.
"""

from __future__ import annotations

import sys
from pathlib import Path

import h5py
import numpy as np
from PIL import Image

from hood.media.renderer.raster import Camera
from hood.media.renderer.render import RenderMesh, contact_sheet, render_frame
from tests.verdict.table import counts
from tests.verdict.table.scene import Scene, run_unread
from tests.verdict.table.scenes import REFUSED, SCENES, SECOND, THIRD

Array = np.ndarray
VIEWS = {"front": 8.0, "back": 188.0, "side": 98.0}
_SIZE = (310, 400)
_SKIN = (0.86, 0.72, 0.60)
#: Stretch beyond which nothing else is counted: every triangle meets every other.
_TORN = 8.0
_CLOTH = np.array([[0.16, 0.38, 0.72], [0.75, 0.22, 0.20], [0.20, 0.58, 0.28], [0.60, 0.30, 0.66], [0.85, 0.60, 0.12]])


def main(words: list[str]) -> None:
    keys = dict(word.split("=", 1) for word in words if "=" in word)
    names = [word for word in words if "=" not in word] or [*SCENES, *SECOND, *THIRD]
    folder = Path(keys.get("output", "outputs/table"))
    scenes = {**SCENES, **SECOND, **THIRD, **REFUSED}
    for name in names:
        refused = _made(scenes[name], folder / name, keys.get("again") == "true")
        if refused:
            print(f"{name}: refused: {refused}", flush=True)
            continue
        picture = sheet(folder / name / "rollout.h5", float(keys.get("close", 0)))
        path = folder / (f"{name}.png" if "close" not in keys else f"{name}_close.png")
        Image.fromarray(picture).save(path)
        print(path, flush=True)


def _made(scene: Scene, folder: Path, again: bool) -> str:
    refused = folder / "refused.txt"
    if refused.exists() and not again:
        return refused.read_text()
    if (folder / "rollout.h5").exists() and not again:
        return ""
    words = run_unread(scene, folder)
    if words:
        refused.write_text(words)
    return words


def sheet(path: Path, close: float = 0.0) -> Array:
    """(height, width, 3) uint8 of the rollout in ``path``."""
    with h5py.File(path) as file:
        done = int(file.attrs["num_frames"])
        cloth, faces, rest = file["cloth/pos"][:done].astype(float), file["cloth/faces"][:], file["cloth/rest_pos"][:]
        body = file["body/pos"][:done].astype(float) if "body" in file else np.zeros((done, 0, 3))
        body_faces = file["body/faces"][:] if "body" in file else np.zeros((0, 3), int)
    colours = _CLOTH[counts.parts(len(rest), faces) % len(_CLOTH)]
    cells: dict[str, list[Array]] = {view: [] for view in VIEWS}
    labels = []
    frames = _chosen(cloth, rest, faces, body, body_faces)
    for frame in frames:
        labels.append(_words(frame, cloth[frame], rest, faces, body[frame], body_faces))
        for view, azimuth in VIEWS.items():
            cells[view].append(_cell(cloth[frame], faces, colours, body[frame], body_faces, azimuth, close))
    images = [image for view in VIEWS for image in cells[view]]
    return contact_sheet(images, len(frames), [*labels, *[""] * (len(images) - len(labels))])


def _chosen(cloth: Array, rest: Array, faces: Array, body: Array, body_faces: Array) -> list[int]:
    """First, a third, two thirds and last, the most stretched one, and of every fourth the one that the skin cuts most."""
    fine = [frame for frame in range(len(cloth)) if np.isfinite(cloth[frame]).all()]
    stretch = [float(np.quantile(counts.stretch(cloth[frame], rest, faces), 0.99)) for frame in fine]
    last = fine[-1]
    chosen = {0, last // 3, 2 * last // 3, fine[int(np.argmax(stretch))], last}
    if body.shape[1] and max(stretch) < _TORN:
        chosen.add(max(fine[2::4], key=lambda frame: _num_cut(cloth[frame], faces, body[frame], body_faces), default=0))
    return sorted(chosen)


def _num_cut(cloth: Array, faces: Array, body: Array, body_faces: Array) -> int:
    return len(np.unique(counts.crossings(cloth, faces, body, body_faces)[:, 0]))


def _words(frame: int, cloth: Array, rest: Array, faces: Array, body: Array, body_faces: Array) -> str:
    long = counts.stretch(cloth, rest, faces)
    words = f"{frame}: stretch {np.quantile(long, 0.99):.2f} {long.max():.2f}"
    if np.quantile(long, 0.99) > _TORN:
        return words
    words += f"\nself {len(counts.crossings(cloth, faces))}"
    if not len(body):
        return words
    cut = _num_cut(cloth, faces, body, body_faces) / len(faces)
    return words + f" in {counts.inside(cloth, body, body_faces).mean():.1%} cut {cut:.1%}"


def _cell(cloth: Array, faces: Array, colours: Array, body: Array, body_faces: Array, azimuth: float, close: float) -> Array:
    seen = cloth
    if close:
        middle = np.median(cloth, axis=0)
        seen = middle + close * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    elif len(body):
        low, high = body.min(axis=0) - 0.35, body.max(axis=0) + 0.35
        seen = np.concatenate([body, np.clip(cloth, low, high)])
    camera = Camera.framing(seen, azimuth, 6.0, 30.0, _SIZE[0] / _SIZE[1], 1.03)
    meshes = [RenderMesh(cloth, faces, colours)]
    if len(body):
        meshes.append(RenderMesh(body, body_faces, _SKIN))
    floor = float(min(mesh.min() for mesh in (body[:, 1], cloth[:, 1]) if len(mesh)))
    return render_frame(meshes, camera, *_SIZE, floor=max(floor, float(seen[:, 1].min()) - 0.3))


if __name__ == "__main__":
    main(sys.argv[1:])
