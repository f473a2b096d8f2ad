"""Pictures of a rollout: a video whose camera walks along, and a contact sheet of evenly spaced frames."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from hood.assets.formats.image import Texture
from hood.media.colouring import colouring_of
from hood.media.pieces import layer_distances, looks_of, pieces_of
from hood.media.renderer.render import (
    BODY_COLOR,
    FAR,
    FUZZ,
    SHEEN,
    SUPERSAMPLING,
    Camera,
    Print,
    RenderMesh,
    captioned,
    contact_sheet,
    hem_distance,
    pixels_of,
    render_frame,
)
from hood.media.video import VideoWriter, save_png
from hood.mesh.editing.subdivision import Extrusion
from hood.rollouts.file.reader import RolloutData

_SHEET_FRAMES = 12
#: Where the body is to be drawn thinner, it is where cloth is this near [m].
_REACH = 0.04
#: The body is drawn this much [m] farther away, so that cloth on the skin is not cut by rounding.
_BEHIND = 1e-3
#: Room around what the picture holds, as a share of it.
_MARGIN = 1.18
#: Head and feet are in the picture where the garment comes this near [m] to them.
_ENDS = 0.4
#: Cloth farther than this [m] from the body's box does not widen the picture: it blew up.
_ASTRAY = 0.6
#: Frames that are drawn at once at most; each takes some 30 MB.
_THREADS = 8
_SMOOTHING = 15  # frames over which the camera averages the walker's path


class Film:
    """Draws frames of one rollout with one camera distance and angle; the camera follows the body, or the cloth without one.

    Cloth that is thicker than what a drawn pixel spans is drawn as a closed shell: its thickness shows at hems.

    Args:
        data: the rollout.
        width, height: pixels.
        azimuth_deg: viewing direction, 0 is the front of the first frame.
        colour: what the garment's colour shows, with a bar that says so: ``strain``, ``rg``, ``contact``, or ``none``, its own.
        thinner: [m] by which the body is drawn thinner near the cloth, which hides skin that sticks out through it; the picture
            says so. 0: as it is.
        beside: rollouts whose films are shown next to this one: a colour means the same in all of them, and without a body
            the camera sees the cloth of all of them.
        textures: images of garments in their own colour, by the names of :func:`hood.media.pieces.pieces_of`.
    """

    def __init__(
        self,
        data: RolloutData,
        width: int = 400,
        height: int = 560,
        azimuth_deg: float = 25.0,
        colour: str = "none",
        beside: Sequence[RolloutData] = (),
        thinner: float = 0.0,
        textures: Mapping[str, Texture] | None = None,
    ) -> None:
        if len(data.cloth_pos) == 0:
            raise ValueError("the rollout has no frames to draw")
        self.data, self.width, self.height = data, width, height
        self.thinner = thinner
        self.colouring = colouring_of(data, colour, beside)
        looks, number = looks_of(data)
        self._own_colour = np.array([look.colour for look in looks])[number]
        shine = [(SHEEN, 0.0, FUZZ) if self.colouring else (look.sheen, look.glint, look.fuzz) for look in looks]
        self._shine = np.array(shine)[number]
        self._prints = () if self.colouring else _prints(data, textures or {})
        # Without a body the camera looks at the cloth, as far as that is finite.
        shown = data.body_pos
        if not data.body_pos.shape[1]:
            cloths = [data.cloth_pos, *(other.cloth_pos for other in beside)]
            shown = np.nan_to_num(np.concatenate(cloths, axis=1), posinf=0.0, neginf=0.0)
        self._path = _smooth_path(shown)
        self._hem = np.full(len(number), FAR) if self.colouring else hem_distance(data.rest_pos, data.cloth_faces)
        self._floor = float(shown[..., 1].min())
        framed = _framed([data, *beside], self._path) if data.body_pos.shape[1] else shown - self._path[:, None]
        self._camera = Camera.framing(framed, azimuth_deg, 8.0, aspect=width / height, margin=_MARGIN)
        self._layers, self._shell = layer_distances(data), None
        away = float(np.linalg.norm(np.subtract(self._camera.position, self._camera.target)))
        if self._layers.sum(axis=1).max(initial=0.0) * self._camera.focal(SUPERSAMPLING * height) > away:
            solid = (self._layers[data.cloth_faces] == 0.0).all(axis=(1, 2))
            self._shell = Extrusion(data.cloth_faces, data.cloth_pos.shape[1], kept=solid)
            self._prints = [one.on(self._shell) for one in self._prints]

    def frame(self, index: int) -> np.ndarray:
        """Picture (H, W, 3) uint8 of frame ``index``, with the bar of its colours."""
        picture = self.picture(index)
        return picture if self.colouring is None else self.colouring.with_bar(picture)

    def picture(self, index: int) -> np.ndarray:
        """Picture (H, W, 3) uint8 of frame ``index`` alone."""
        shift = self._path[index]
        camera = replace(self._camera, position=_add(self._camera.position, shift), target=_add(self._camera.target, shift))
        body, cloth = self.data.body_pos[index], self.data.cloth_pos[index]
        dressed = bool(np.isfinite(cloth).all())
        meshes = []
        if len(body):
            thin = dressed and self.thinner > 0
            shown_body = _beneath(body, self.data.body_faces, cloth, self.thinner) if thin else body
            meshes.append(RenderMesh(shown_body, self.data.body_faces, BODY_COLOR, behind=_BEHIND))
        if dressed:
            meshes.append(self._drawn_cloth(index))
        picture = render_frame(meshes, camera, width=self.width, height=self.height, floor=self._floor)
        told = f"body drawn {1e3 * self.thinner:g} mm thinner" if self.thinner > 0 and len(body) else ""
        return captioned(picture, told) if told else picture

    def _drawn_cloth(self, index: int) -> RenderMesh:
        pos, faces, shell = self.data.cloth_pos[index], self.data.cloth_faces, self._shell
        colour, hem, shine = self._own_colour, self._hem, self._shine
        if self.colouring is not None:
            colour = self.colouring.colours(index)
        if shell is not None:
            pos, faces = shell.positions(pos, self._layers), shell.faces
            colour, hem, shine = (values[shell.vertex] for values in (colour, hem, shine))
        return RenderMesh(pos, faces, colour, hem, 0.0, self._prints, shine)

    def sheet(self, count: int = _SHEET_FRAMES, columns: int = 6, known: Mapping[int, np.ndarray] | None = None) -> np.ndarray:
        """Contact sheet of ``count`` evenly spaced frames; ``known`` are pictures that are there already, by their frames."""
        chosen, known = sheet_frames(len(self.data.cloth_pos), count), known or {}
        missing = [index for index in chosen if index not in known]
        pictures = {**known, **dict(drawn(self, missing))}
        return contact_sheet([pictures[i] for i in chosen], columns, [f"{self.data.time[i]:.2f} s" for i in chosen])


def sheet_frames(num_frames: int, count: int = _SHEET_FRAMES) -> list[int]:
    """Evenly spaced frame numbers, first and last included."""
    return sorted({int(i) for i in np.linspace(0, num_frames - 1, min(count, num_frames)).round()})


def write_sheet(film: Film, path: Path, known: Mapping[int, np.ndarray] | None = None) -> Path:
    """Contact sheet of a film as PNG; ``known`` as in :meth:`Film.sheet`."""
    return save_png(path, film.sheet(known=known))


def write_video(
    film: Film, path: Path, frames: Iterable[int] | None = None, stride: int = 1, kept: Sequence[int] = ()
) -> tuple[Path, dict[int, np.ndarray]]:
    """Video at the rollout's own speed; every ``stride``-th frame is drawn.

    Args:
        frames: the iterable that drives the loop (a progress bar, say); all frames by default.

    Returns:
        The file written, and the pictures of the frames ``kept`` that it holds.
    """
    chosen = range(0, len(film.data.cloth_pos), stride) if frames is None else frames
    pictures: dict[int, np.ndarray] = {}
    with VideoWriter(path, fps=1.0 / (seconds_per_frame(film.data) * stride)) as writer:
        for index, picture in drawn(film, chosen):
            writer.append(picture)
            if index in kept:
                pictures[index] = picture
    return writer.path, pictures


def drawn(film: Film, frames: Iterable[int]) -> Iterator[tuple[int, np.ndarray]]:
    """Frames and their pictures (H, W, 3) uint8, in their order; drawn some frames ahead, by as many threads as this process
    may use processors, up to :data:`_THREADS`: no picture depends on their number."""
    threads = min(_THREADS, _processors())
    if threads == 1:
        yield from ((index, film.frame(index)) for index in frames)
        return
    with ThreadPoolExecutor(threads) as pool:
        ahead: deque[tuple[int, Future[np.ndarray]]] = deque()
        for index in frames:
            ahead.append((index, pool.submit(film.frame, index)))
            if len(ahead) > threads:
                first, picture = ahead.popleft()
                yield first, picture.result()
        for first, picture in ahead:
            yield first, picture.result()


def _processors() -> int:
    affinity = getattr(os, "sched_getaffinity", None)  # not every system has it
    return len(affinity(0)) if affinity is not None else os.cpu_count() or 1


def _prints(data: RolloutData, textures: Mapping[str, Texture]) -> list[Print]:
    found = []
    for piece in pieces_of(data):
        texture = textures.get(piece.name)
        if texture is not None and piece.uv is not None and piece.uv_faces is not None:
            found.append(Print(pixels_of(texture), piece.faces, piece.uv[piece.uv_faces].astype(np.float64)))
    return found


def seconds_per_frame(data: RolloutData) -> float:
    """Time [s] from one frame to the next; of a single frame 1/30."""
    return float(data.time[1] - data.time[0]) if len(data.time) > 1 else 1.0 / 30.0


def _beneath(body: np.ndarray, faces: np.ndarray, cloth: np.ndarray, thinner: float) -> np.ndarray:
    """Body vertices (W, 3) moved inwards by ``thinner`` [m] under cloth (V, 3), fading out over the reach."""
    corners = body[faces]
    face_normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = np.zeros_like(body)
    for corner in range(3):
        np.add.at(normal, faces[:, corner], face_normal)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    dist, _ = cKDTree(cloth).query(body, distance_upper_bound=_REACH)
    share = np.clip(2.0 * (1.0 - np.where(np.isfinite(dist), dist, _REACH) / _REACH), 0.0, 1.0)
    return body - thinner * share[:, None] * normal


def _framed(rollouts: Sequence[RolloutData], path: np.ndarray) -> np.ndarray:
    """Points (N, 3) that the picture is to hold, about the camera's ``path`` (T, 3): the cloth of a few frames, and the
    body's ends near it."""
    points = []
    for data in rollouts:
        body, cloth = data.body_pos, data.cloth_pos
        for frame in range(0, min(len(body), len(path)), max(len(body) // 20, 1)):
            low, high = body[frame].min(axis=0) - _ASTRAY, body[frame].max(axis=0) + _ASTRAY
            inside = ((cloth[frame] >= low) & (cloth[frame] <= high)).all(axis=1)  # false for NaN
            chosen = cloth[frame][inside] if inside.any() else body[frame]
            middle, low, high = chosen.mean(axis=0), body[frame][:, 1].min(), body[frame][:, 1].max()
            near = [
                end
                for end, cloth_end in ((low, chosen[:, 1].min()), (high, chosen[:, 1].max()))
                if abs(end - cloth_end) < _ENDS
            ]
            ends = np.array([[middle[0], end, middle[2]] for end in near]).reshape(-1, 3)
            points.append(np.concatenate([chosen, ends]) - path[frame])
    return np.concatenate(points)


def _smooth_path(body_pos: np.ndarray) -> np.ndarray:
    """(T, 3): the body's centre seen from above, averaged over time; height is left alone so that jumps are seen."""
    centre = body_pos.mean(axis=1)
    centre[:, 1] = 0.0
    window = min(_SMOOTHING, len(centre))
    padded = np.concatenate([np.repeat(centre[:1], window, 0), centre, np.repeat(centre[-1:], window, 0)])
    kernel = np.hanning(2 * window + 1)[1:-1] if window > 1 else np.ones(1)
    kernel /= kernel.sum()
    smooth = np.stack([np.convolve(padded[:, axis], kernel, mode="same") for axis in range(3)], axis=1)
    return smooth[window : window + len(centre)]


def _add(position: tuple[float, float, float], shift: np.ndarray) -> tuple[float, float, float]:
    moved = np.asarray(position) + shift
    return (float(moved[0]), float(moved[1]), float(moved[2]))
