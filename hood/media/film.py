"""Pictures of a rollout: a video whose camera walks along, and a contact sheet of evenly spaced frames.

Views: from where a film shows the body, side by side, and cameras that have all of it in the picture in every frame.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from hood.assets.formats.raw_mesh import Texture
from hood.media.colouring import colouring_of
from hood.media.pieces import between_hems, layer_distances, looks_of, pieces_of
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
    render_views,
)
from hood.media.renderer.shading import CLEAR, Background
from hood.media.video import drawn, save_png, smaller, video_writer
from hood.mesh.editing.subdivision import Extrusion
from hood.mesh.topology import connected_components, counted_edges
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
_SMOOTHING = 15  # frames over which the camera averages the walker's path
#: Decimals of places [m] on its path and of where it stands: what positions are rounded by does not move it.
_DIGITS, _COARSE = 4, 3
#: By its name, the direction [degrees] from which a view shows the body in the first frame; front and back from a little aside.
AZIMUTHS = {"front": 20.0, "side": 90.0, "back": 200.0}
#: The view that goes round.
TURNTABLE = "turntable"
_ELEVATION = 8.0  # degrees
#: Room around the body as a share of it, and directions of the circles that stand for it where the camera goes round.
_WHOLE_MARGIN, _ROUND = 1.06, 24
_FULL = 0.98  # share of half a picture that cloth may take beside the body
#: Height of a cell of a sheet of several views [pixels], and width as a share of its height at least.
_CELL, _NARROW = 420, 0.42
_DIVIDER = 2  # pixels between views
_Clouds = Sequence[tuple[int, np.ndarray]]  # frames and points (N, 3) in them


@dataclass(frozen=True)
class Shots:
    """How a film shows all of the body.

    Args:
        views: side by side, from the left: names of :data:`AZIMUTHS`, :data:`TURNTABLE`, or degrees (0: from the front, 90:
            from the body's left).
        camera: ``follow`` walks along, ``fixed`` stands still and sees all of the way, ``orbit`` walks along and goes round
            once, in every view.
        background: of :data:`hood.media.renderer.shading.Background`.
        fabric_looks: whether cloth has the colours and the shine of its fabrics, else a colour for each garment.
    """

    views: tuple[str | float, ...] = ("front", "back")
    camera: str = "follow"
    background: Background = None
    fabric_looks: bool = True

    @classmethod
    def of(cls, views: Sequence[str | float], camera: str, background: str | Sequence[int] | None, fabric_looks: bool) -> Shots:
        """From the words of a command: a background is ``studio``, ``transparent``, or three numbers from 0 to 255."""
        behind: Background = CLEAR if background == CLEAR else None
        if background is not None and not isinstance(background, str):
            red, green, blue = (channel / 255 for channel in background)
            behind = (red, green, blue)
        return cls(tuple(views), camera, behind, fabric_looks)


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
        shots: several views of the whole body, in place of ``azimuth_deg``. None: one view of the garment.
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
        shots: Shots | None = None,
    ) -> None:
        if len(data.cloth_pos) == 0:
            raise ValueError("the rollout has no frames to draw")
        self.data, self.width, self.height = data, width, height
        self.thinner = thinner
        self.colouring = colouring_of(data, colour, beside)
        self.shots = shots
        looks, number = looks_of(data, fabrics=shots is None or shots.fabric_looks)
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
        self._unsewn = None if self.colouring else between_hems(data.cloth_faces)
        self._closed = _is_closed(data.body_pos[0], data.body_faces)
        self._floor = round(float(shown[..., 1].min()), _DIGITS)
        if shots is not None:
            self._takes = _takes(shots, [data, *beside], self._path, self._panel / height)
        else:
            framed = _framed([data, *beside], self._path) if data.body_pos.shape[1] else shown - self._path[:, None]
            camera = Camera.framing(framed, azimuth_deg, _ELEVATION, aspect=width / height, margin=_MARGIN)
            self._takes = [_Take(camera, follows=True, turns=False, half_width=1.0)]
        self._layers, self._shell = layer_distances(data), None
        away = float(np.linalg.norm(np.subtract(self._camera.position, self._camera.target)))
        if self._layers.sum(axis=1).max(initial=0.0) * self._camera.focal(SUPERSAMPLING * height) > away:
            solid = (self._layers[data.cloth_faces] == 0.0).all(axis=(1, 2))
            self._shell = Extrusion(data.cloth_faces, data.cloth_pos.shape[1], kept=solid)
            self._prints = [one.on(self._shell) for one in self._prints]
            if self._unsewn is not None:
                self._unsewn = np.flatnonzero(np.isin(self._shell.source[:, 0] // 3, self._unsewn))

    @property
    def _camera(self) -> Camera:
        """Of the first view, at the origin of the path."""
        return self._takes[0].camera

    @property
    def _panel(self) -> int:
        """Width of the picture of a view [pixels]."""
        return -(-self.width // (1 if self.shots is None else len(self.shots.views)))

    def sees_as(self, other: Film) -> bool:
        """Whether cameras and floor are those of another film of as many frames: both draw a frame in the same way. How wide
        the cloth is, which cells of the sheet have to know, is then taken from there."""
        mine, theirs = ([(take.camera, take.follows, take.turns) for take in film._takes] for film in (self, other))
        same = mine == theirs and self._floor == other._floor and np.array_equal(self._path, other._path)
        self._takes = other._takes if same else self._takes
        return same

    def frame(self, index: int) -> np.ndarray:
        """Picture (H, W, 3) uint8 of frame ``index``, with the bar of its colours."""
        picture = self.picture(index)
        return picture if self.colouring is None else self.colouring.with_bar(picture)

    def picture(self, index: int) -> np.ndarray:
        """Picture (H, W, 3) uint8 of frame ``index`` alone."""
        body, cloth = self.data.body_pos[index], self.data.cloth_pos[index]
        dressed = bool(np.isfinite(cloth).all())
        meshes = []
        if len(body):
            thin = dressed and self.thinner > 0
            shown_body = _beneath(body, self.data.body_faces, cloth, self.thinner) if thin else body
            meshes.append(RenderMesh(shown_body, self.data.body_faces, BODY_COLOR, behind=_BEHIND, closed=self._closed))
        if dressed:
            meshes.append(self._drawn_cloth(index))
        background = None if self.shots is None else self.shots.background
        part = index / len(self.data.cloth_pos)
        cameras = [take.at(self._path[index], part) for take in self._takes]
        views = render_views(meshes, cameras, self._panel, self.height, floor=self._floor, background=background)
        for number in range(1, len(cameras)):
            views[:, number * self._panel :][:, :_DIVIDER, :3] = 255
        picture = np.ascontiguousarray(views[:, : self.width])
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
        return RenderMesh(pos, faces, colour, hem, 0.0, self._prints, shine, unsewn=self._unsewn)

    def sheet(self, count: int = _SHEET_FRAMES, columns: int = 6, known: Mapping[int, np.ndarray] | None = None) -> np.ndarray:
        """Contact sheet of ``count`` evenly spaced frames, of several views a row each; ``known`` are pictures that are there
        already, by their frames."""
        chosen, known = sheet_frames(len(self.data.cloth_pos), count), known or {}
        missing = [index for index in chosen if index not in known]
        pictures = {**known, **dict(drawn(self.frame, missing))}
        times = [f"{self.data.time[i]:.2f} s" for i in chosen]
        if self.shots is None:
            return contact_sheet([pictures[i] for i in chosen], columns, times)
        cells, labels = list[np.ndarray](), list[str]()
        for first in range(0, len(chosen), columns):
            for number, view in enumerate(self.shots.views):
                row = [self._cell(pictures[i], number) for i in chosen[first : first + columns]]
                blank = [np.full_like(row[0], 255)] * (columns - len(row) if len(chosen) > columns else 0)
                cells += row + blank
                name = view if isinstance(view, str) else f"{view:g}°"
                labels += [f"{time} {name}" for time in times[first : first + columns]] + [""] * len(blank)
        return contact_sheet(cells, min(columns, len(chosen)), labels)

    def _cell(self, picture: np.ndarray, number: int) -> np.ndarray:
        """A view of the picture of a frame, as wide as the body needs it, in the size of a sheet's cell."""
        height, panel = picture.shape[0], self._panel
        half = max(_NARROW * height, panel * max(take.half_width for take in self._takes)) / 2
        middle = number * panel + panel / 2
        left, right = max(round(middle - half), number * panel), min(round(middle + half), (number + 1) * panel, self.width)
        return smaller(picture[:, left:right], round((right - left) * min(_CELL / height, 1.0)), min(_CELL, height))


def sheet_frames(num_frames: int, count: int = _SHEET_FRAMES) -> list[int]:
    """Evenly spaced frame numbers, first and last included."""
    return sorted({int(i) for i in np.linspace(0, num_frames - 1, min(count, num_frames)).round()})


def write_sheet(film: Film, path: Path, known: Mapping[int, np.ndarray] | None = None) -> Path:
    """Contact sheet of a film as PNG; ``known`` as in :meth:`Film.sheet`."""
    return save_png(path, film.sheet(known=known))


def write_video(
    film: Film,
    path: Path,
    frames: Iterable[int] | None = None,
    stride: int = 1,
    kept: Sequence[int] = (),
    busy: Callable[[], bool] = bool,
) -> tuple[Path, dict[int, np.ndarray]]:
    """Video at the rollout's own speed; every ``stride``-th frame is drawn. A path without a suffix is a folder of PNG files.

    Args:
        frames: the iterable that drives the loop (a progress bar, say); all frames by default.
        busy: as of :func:`hood.media.video.drawn`.

    Returns:
        The file written, and the pictures of the frames ``kept`` that it holds.
    """
    chosen = range(0, len(film.data.cloth_pos), stride) if frames is None else frames
    pictures: dict[int, np.ndarray] = {}
    with video_writer(path, fps=1.0 / (seconds_per_frame(film.data) * stride)) as writer:
        for index, picture in drawn(film.frame, chosen, busy):
            writer.append(picture)
            if index in kept:
                pictures[index] = picture
    return writer.path, pictures


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
    centre = body_pos.mean(axis=1, dtype=np.float64)
    centre[:, 1] = 0.0
    window = min(_SMOOTHING, len(centre))
    padded = np.concatenate([np.repeat(centre[:1], window, 0), centre, np.repeat(centre[-1:], window, 0)])
    kernel = np.hanning(2 * window + 1)[1:-1] if window > 1 else np.ones(1)
    kernel /= kernel.sum()
    smooth = np.stack([np.convolve(padded[:, axis], kernel, mode="same") for axis in range(3)], axis=1)
    return np.asarray(smooth[window : window + len(centre)].round(_DIGITS))


@dataclass(frozen=True)
class _Take:
    """A camera in time.

    Args:
        camera: about the path, or where it stands.
        follows: whether it walks along the path.
        turns: whether it goes round once.
        half_width: share of the picture's width, from its middle, that what it frames takes at most.
    """

    camera: Camera
    follows: bool
    turns: bool
    half_width: float

    def at(self, shift: np.ndarray, part: float) -> Camera:
        """The camera at this place (3,) [m] of the path, when this part of the film is over."""
        angle = 2.0 * np.pi * part if self.turns else 0.0
        turn = np.array([[np.cos(angle), 0.0, np.sin(angle)], [0.0, 1.0, 0.0], [-np.sin(angle), 0.0, np.cos(angle)]])
        shift = shift if self.follows else np.zeros(3)
        position, target = (tuple((turn @ place + shift).tolist()) for place in (self.camera.position, self.camera.target))
        return replace(self.camera, position=position, target=target)


def _takes(shots: Shots, rollouts: Sequence[RolloutData], path: np.ndarray, aspect: float) -> list[_Take]:
    """A take for every view, all equally far: as near as it can be with all of the bodies in every frame, and with the cloth
    where that is not in such a picture as well."""
    bodies, cloths = _clouds(rollouts)
    found = list[tuple[_Take, np.ndarray]]()
    for view in shots.views:
        turns, name = shots.camera == "orbit" or view == TURNTABLE, "front" if view == TURNTABLE else view
        azimuth = AZIMUTHS[name] if isinstance(name, str) else float(name)
        follows = turns or shots.camera == "follow"
        lens = {"azimuth_deg": azimuth, "elevation_deg": _ELEVATION, "aspect": aspect, "margin": _WHOLE_MARGIN}
        about = path if follows else np.zeros_like(path)
        ahead = Camera.framing(np.zeros((1, 3)), **lens)
        points, worn = (_round(some, about) if turns else _outermost(some, about, ahead, aspect) for some in (bodies, cloths))
        camera = Camera.framing(points, **lens)
        if max(_shares(camera, worn, aspect)) > _FULL:
            camera = Camera.framing(np.concatenate([points, worn]), **lens)
        found.append((_Take(camera, follows, turns, 1.0), np.concatenate([points, worn])))
    far = max(float(np.linalg.norm(np.subtract(take.camera.position, take.camera.target))) for take, _ in found)
    return [_moved_back(take, far, points, aspect) for take, points in found]


def _moved_back(take: _Take, far: float, points: np.ndarray, aspect: float) -> _Take:
    target = np.round(take.camera.target, _COARSE)
    position = np.round(target - round(far, _COARSE) * take.camera.axes()[2], 2 * _COARSE)
    (x, y, z), (u, v, w) = position.tolist(), target.tolist()
    camera = replace(take.camera, position=(x, y, z), target=(u, v, w))
    return replace(take, camera=camera, half_width=min(1.1 * _shares(camera, points, aspect)[0], 1.0))


def _shares(camera: Camera, points: np.ndarray, aspect: float) -> tuple[float, float]:
    """Shares of half a picture that points (N, 3) take from its middle, across and up, at most; vast behind the camera."""
    seen = (points - camera.position) @ camera.axes().T
    ahead = np.maximum(seen[:, 2:], 1e-9)
    wide, high = (np.abs(seen[:, :2]) / ahead).max(axis=0, initial=0.0) / np.tan(np.radians(camera.fov) / 2)
    return float(wide / aspect), float(high)


def _clouds(rollouts: Sequence[RolloutData]) -> tuple[_Clouds, _Clouds]:
    """Frames and the points (N, 3) in them: of bodies, and of cloth that is not astray; without a body of the cloth, twice."""
    bodies, cloths = list[tuple[int, np.ndarray]](), list[tuple[int, np.ndarray]]()
    for data in rollouts:
        for frame, (body, cloth) in enumerate(zip(data.body_pos, data.cloth_pos, strict=True)):
            near = np.isfinite(cloth).all(axis=1)
            if len(body):
                low, high = body.min(axis=0) - _ASTRAY, body.max(axis=0) + _ASTRAY
                near = ((cloth >= low) & (cloth <= high)).all(axis=1)  # false for NaN
                bodies.append((frame, body))
            if near.any():
                cloths.append((frame, cloth if near.all() else cloth[near]))
    if not bodies and not cloths:
        raise ValueError("the rollout has no finite positions to draw")
    return bodies or cloths, cloths


def _outermost(clouds: _Clouds, path: np.ndarray, camera: Camera, aspect: float) -> np.ndarray:
    """Points (N, 3) about the path (T, 3) that a picture holds which holds all: those beyond which no edge of it is moved."""
    right, up, forward = camera.axes()
    tan = np.tan(np.radians(camera.fov) / 2) / _WHOLE_MARGIN
    edges = np.array([sign * side - slope * forward for side, slope in ((right, tan * aspect), (up, tan)) for sign in (1, -1)])
    rows = [cloud[np.argmax(edges.astype(cloud.dtype) @ cloud.T, axis=1)] - path[frame] for frame, cloud in clouds]
    return np.concatenate([np.zeros((0, 3)), *rows])


def _round(clouds: _Clouds, path: np.ndarray) -> np.ndarray:
    """The same for a camera that goes round: circles (N, 3) of the points farthest from the axis, above and below."""
    slopes = np.linspace(0.0, 2.0 * np.pi, _ROUND, endpoint=False)
    rows = []
    for frame, cloud in clouds:
        away = cloud - path[frame]
        flat = np.stack([np.hypot(away[:, 0], away[:, 2]), away[:, 1]])
        ends = np.unique(np.argmax(np.stack([np.cos(slopes), np.sin(slopes)], axis=1) @ flat, axis=1))
        rows.append(flat[:, ends])
    radius, high = np.concatenate([np.zeros((2, 0)), *rows], axis=1)[..., None]
    return np.stack([radius * np.sin(slopes), high + 0.0 * slopes, radius * np.cos(slopes)], axis=-1).reshape(-1, 3)


def _is_closed(pos: np.ndarray, faces: np.ndarray) -> bool:
    """Whether each part of a mesh is a closed surface whose faces go round counterclockwise from outside."""
    edges, count = counted_edges(faces)
    ways = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]) @ np.array([len(pos) + 1, 1])
    if not len(faces) or (count != 2).any() or len(np.unique(ways)) < len(ways):
        return False
    a, b, c = (pos[faces[:, k]].astype(np.float64) for k in range(3))
    part = connected_components(len(pos), edges)[faces[:, 0]]
    volume = np.bincount(part, np.einsum("fi,fi->f", a, np.cross(b, c)))
    return bool((volume[np.unique(part)] > 0).all())
