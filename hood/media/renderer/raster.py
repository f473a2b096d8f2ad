"""Triangle rasteriser in numpy; compiled where there is a compiler.

Triangles are expanded twice into flat arrays, first into (triangle, row) pairs and then into the pixels
of each row, whose first and last column follow from the three edge functions in closed form. So no pixel
outside a triangle is ever visited, and the work is proportional to the drawn area.

Drawing in C++ (``hood/native/picture.cpp`` and its headers): the pictures of the numpy form, several times as fast.

Perspective cameras that frame what they look at.
"""

from __future__ import annotations

import ctypes
import threading
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hood import native
from hood.native.arguments import COUNT, POINTER, REAL, fields
from hood.native.build import optional

SOURCE = Path(native.__file__).with_name("picture.cpp")
_Array = NDArray[np.float64]
_TRIPLE = REAL * 3
FloatArray = NDArray[np.floating]
IntArray = NDArray[np.integer]
#: Nothing closer to the camera than this is drawn [m].
NEAR = 0.05


@dataclass(frozen=True)
class Camera:
    """A perspective camera at `position` that looks at `target` ([m]); `fov` is vertical [degrees]."""

    position: tuple[float, float, float]
    target: tuple[float, float, float]
    fov: float = 30.0

    @staticmethod
    def framing(
        points: ArrayLike,
        azimuth_deg: float = 20.0,
        elevation_deg: float = 8.0,
        fov: float = 30.0,
        aspect: float = 480 / 640,
        margin: float = 1.10,
    ) -> Camera:
        """The nearest camera in the given direction that sees all `points` (..., 3).

        Azimuth 0 looks at the front (from +z), 90 at the left side (from +x). Pass the points of a whole film
        to get one camera that holds them all. `aspect` is width / height; `margin` leaves a border.
        """
        cloud = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        if len(cloud) == 0 or not np.isfinite(cloud).all():
            raise ValueError("Camera.framing: needs at least one point and finite coordinates")
        azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
        toward = np.array([np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)])
        view = view_axes(-toward)
        x, y, depth = (cloud @ view.T).T
        tan_y = np.tan(np.radians(fov) / 2) / margin
        tan_x = tan_y * aspect
        # A point is seen when |x - centre| <= tan (distance + depth): the nearest camera has a closed form.
        center_x, distance_x = _fit(x, depth, tan_x)
        center_y, distance_y = _fit(y, depth, tan_y)
        distance = max(distance_x, distance_y, NEAR - depth.min() + 0.1)
        middle = 0.5 * (depth.min() + depth.max())
        target = center_x * view[0] + center_y * view[1] + middle * view[2]
        position = target - (distance + middle) * view[2]
        (x, y, z), (u, v, w) = position.tolist(), target.tolist()
        return Camera((x, y, z), (u, v, w), fov)

    def focal(self, height: int) -> float:
        """Pixels of a picture of this height that 1 m takes at a distance of 1 m."""
        return float(0.5 * height / np.tan(np.radians(self.fov) / 2))

    def axes(self) -> _Array:
        """Rows right, up, forward, shape (3, 3)."""
        return view_axes(np.subtract(self.target, self.position))


def view_axes(forward: ArrayLike) -> _Array:
    """Rows right, up and forward (3, 3) of a view along `forward` (3,), upright where that is possible."""
    forward = unit(np.asarray(forward, dtype=np.float64))
    up = np.array([0.0, 1.0, 0.0]) if abs(forward[1]) < 0.999 else np.array([0.0, 0.0, -1.0])
    right = unit(_cross(forward, up))
    return np.stack([right, _cross(right, forward), forward])


def _cross(one: _Array, other: _Array) -> _Array:
    """Of two vectors (3,); numpy's takes a hundred times as long for so few."""
    (x, y, z), (u, v, w) = one.tolist(), other.tolist()
    return np.array([y * w - z * v, z * u - x * w, x * v - y * u])


def _fit(x: _Array, depth: _Array, tan: float) -> tuple[float, float]:
    """Centre and distance of the narrowest wedge of the given slope around all points."""
    high, low = float((x - tan * depth).max()), float((x + tan * depth).min())
    return 0.5 * (high + low), (high - low) / (2.0 * tan)


def unit(vectors: _Array) -> _Array:
    """Vectors (..., 3) of length one; zero stays zero."""
    length_sq = np.einsum("...i,...i->...", vectors, vectors)[..., None]
    return vectors / np.sqrt(np.maximum(length_sq, 1e-24))


def ends_of(points: FloatArray) -> tuple[_Array, _Array]:
    """Lower and upper end (D,) of points (N, D)."""
    columns = np.ascontiguousarray(points.T)  # numpy takes ten times as long along the other axis
    return columns.min(axis=1), columns.max(axis=1)


class LightValues(ctypes.Structure):
    """``Light`` of ``picture_light.h``."""

    _fields_ = [
        *fields("map most probes axes", POINTER),
        *fields("size num_probes tiles", COUNT),
        ("low", REAL * 2),
        *fields("scale texel", REAL),
        *fields("key fill key_color fill_color sky_color bounce_color", _TRIPLE),
    ]


class SeenValues(ctypes.Structure):
    """``Seen`` of ``picture_surface.h``."""

    _fields_ = [
        *fields("pos color normal shine screen depth hem faces face nearness around axes own", POINTER),
        *fields("width height num_around left top", COUNT),
        ("eye", _TRIPLE),
        ("middle", REAL * 2),
        *fields("focal reach", REAL),
    ]


class FloorValues(ctypes.Structure):
    """``Floor`` of ``picture_background.h``."""

    _fields_ = [
        ("dark", POINTER),
        *fields("width height cells", COUNT),
        *fields("eye right up forward center", _TRIPLE),
        ("kind", COUNT),
        *fields("tan_y floor cell", REAL),
        *fields("ground horizon zenith plain", _TRIPLE),
    ]


@cache
def library() -> ctypes.CDLL | None:
    """The compiled drawing; None without a compiler."""
    lib = optional(SOURCE)
    if lib is None:
        return None
    lib.picture_rasterise.argtypes = [*[POINTER] * 3, *[COUNT] * 4, REAL, REAL, *[POINTER] * 2]
    lib.picture_lit.argtypes = [POINTER, POINTER, COUNT, REAL, POINTER]
    lib.picture_draw.argtypes = [*[POINTER] * 3, *[COUNT] * 2, POINTER]
    lib.picture_normals.argtypes = [*[POINTER] * 2, *[COUNT] * 2, POINTER]
    lib.picture_low.argtypes = [*[POINTER] * 2, COUNT, POINTER, REAL, REAL, COUNT, POINTER]
    lib.picture_most.argtypes = [POINTER, COUNT, POINTER]
    lib.picture_creased.argtypes = [*[POINTER] * 2, *[COUNT] * 2, REAL, *[POINTER] * 3]
    lib.picture_creased.restype = COUNT
    for name in ("picture_rasterise", "picture_lit", "picture_draw", "picture_normals", "picture_low", "picture_most"):
        getattr(lib, name).restype = None
    return lib


def packed(values: Any, kind: type = np.float64) -> NDArray[Any]:
    """``values`` without gaps, as C++ takes them."""
    return np.ascontiguousarray(values, dtype=kind)


def address(values: NDArray[Any]) -> int:
    """Of an array that :func:`packed` made and that outlives the call."""
    return int(values.ctypes.data)


_MEMORY = threading.local()


def room(size: int, kind: type, place: str | None = None) -> NDArray[Any]:
    """(size,) not yet filled; with a ``place`` in memory that this thread keeps for it, and gives again the next time."""
    if place is None:
        return np.empty(size, dtype=kind)
    memory = vars(_MEMORY).get(place)
    if memory is None or memory.size < size:
        memory = np.empty(size + size // 2, dtype=kind)
        setattr(_MEMORY, place, memory)
    found: NDArray[Any] = memory[:size]
    return found


# Columns this close to an edge [pixels] count as inside: shared edges leave no pinholes after rounding.
_EDGE_TOLERANCE = 2e-3
_MIN_AREA_PIXELS_SQ = 1e-9
_ROOM = 16  # values behind a map that the compiled form may touch


@dataclass(frozen=True)
class VisibilityBuffer:
    """What each pixel sees. `face` (H, W) is -1 where nothing is drawn; `nearness` (H, W) is -inf there."""

    face: IntArray
    nearness: FloatArray


def rasterise(
    screen: FloatArray,
    nearness: FloatArray,
    faces: IntArray,
    width: int,
    height: int,
    chunk_faces: int = 32768,
    place: str | None = None,
    closed: int = 0,
    whose: bool = True,
) -> VisibilityBuffer:
    """Nearest face of every pixel.

    Args:
        screen: pixel coordinates (V, 2), x right, y down; pixel (i, j) has its centre at (j + 0.5, i + 0.5).
        nearness: (V,), affine on screen within a face and larger for nearer points (1/depth under
            perspective, minus the distance under a parallel projection).
        faces: (F, 3) vertex indices; degenerate faces are not drawn.
        chunk_faces: faces expanded at once, a bound on memory.
        place: of :func:`room`: what was found there last is overwritten. None: in memory of its own.
        closed: so many faces at the beginning are those of a closed surface: those seen from outside are drawn.
        whose: whether ``face`` is needed; where it is not, nothing may be in it.
    """
    lib, count = library(), width * height
    if lib is not None:
        best = room(count + _ROOM, np.float32, place and f"{place} nearness")
        owner = room(count + _ROOM if whose else 0, np.int32, place and f"{place} face")
        points, near, corners = packed(screen), packed(nearness), packed(faces, np.int64)
        inputs = address(points), address(near), address(corners), len(corners), closed, width, height
        outputs = address(best), address(owner) if whose else None
        lib.picture_rasterise(*inputs, _EDGE_TOLERANCE, _MIN_AREA_PIXELS_SQ, *outputs)
        return VisibilityBuffer(owner[:count].reshape(height if whose else 0, width), best[:count].reshape(height, width))
    best, owner = np.full(count, -np.inf), np.full(count, -1, dtype=np.int32)
    drawn = np.arange(len(faces))
    if closed:
        drawn = np.concatenate([np.flatnonzero(~from_behind(screen, faces[:closed])), drawn[closed:]])
    for start in range(0, len(drawn), chunk_faces):
        some = drawn[start : start + chunk_faces]
        pixel, value, face = _expand(screen, nearness, faces[some], width, height)
        np.maximum.at(best, pixel, value)
        wins = value == best[pixel]
        owner[pixel[wins]] = some[face[wins]]
    return VisibilityBuffer(owner.reshape(height, width), best.reshape(height, width))


def from_behind(screen: FloatArray, faces: IntArray) -> NDArray[np.bool_]:
    """(F,) whether a face is seen from behind: its corners go round clockwise there."""
    a, b, c = (screen[faces[:, k]] for k in range(3))
    turned: NDArray[np.bool_] = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) > (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    return turned


def barycentric(screen: FloatArray, corners: IntArray, points: FloatArray) -> FloatArray:
    """Barycentric coordinates (P, 3) of the screen points (P, 2) in the triangles `corners` (P, 3)."""
    a, b, c = (screen[corners[:, k]] for k in range(3))
    ab, ac, ap = b - a, c - a, points - a
    area = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    second = (ap[:, 0] * ac[:, 1] - ap[:, 1] * ac[:, 0]) / area
    third = (ab[:, 0] * ap[:, 1] - ab[:, 1] * ap[:, 0]) / area
    return np.stack([1.0 - second - third, second, third], axis=1)


def _expand(
    screen: FloatArray, nearness: FloatArray, faces: IntArray, width: int, height: int
) -> tuple[IntArray, FloatArray, IntArray]:
    """Covered pixels: flat pixel index, nearness and face index, one entry per (pixel, face)."""
    corners = screen[faces].astype(np.float64)
    x, y = corners[..., 0], corners[..., 1]
    area = (x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0]) - (y[:, 1] - y[:, 0]) * (x[:, 2] - x[:, 0])
    top = np.maximum(np.ceil(y.min(axis=1) - 0.5), 0.0)
    bottom = np.minimum(np.floor(y.max(axis=1) - 0.5), height - 1.0)
    on_screen = (x.max(axis=1) > 0) & (x.min(axis=1) < width) & (bottom >= top)
    keep = np.flatnonzero((np.abs(area) > _MIN_AREA_PIXELS_SQ) & on_screen)

    x, y, area, top = x[keep], y[keep], area[keep], top[keep]
    slope_x, slope_y, constant = _edge_functions(x, y, area)
    near = nearness[faces[keep]].astype(np.float64)

    row_count = (bottom[keep] - top + 1).astype(np.int64)
    tri, step = _ragged(row_count)
    row = step + top[tri].astype(np.int64)
    at_row = slope_y[tri] * (row[:, None] + 0.5) + constant[tri]
    first, last = _row_span(slope_x[tri], at_row, width)
    tri_near = (slope_x * near).sum(axis=1)
    row_near = (at_row * near[tri]).sum(axis=1)

    pixel_count = np.maximum(last - first + 1, 0).astype(np.int64)
    span, column = _ragged(pixel_count)
    column = column + first[span].astype(np.int64)
    pixel = row[span] * width + column
    owner = tri[span]
    value = row_near[span] + tri_near[owner] * (column + 0.5)
    return pixel, value, keep[owner].astype(np.int32)


def _edge_functions(x: FloatArray, y: FloatArray, area: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Barycentric coordinate k of a screen point is slope_x[:, k] px + slope_y[:, k] py + constant[:, k]."""
    nxt, prv = [1, 2, 0], [2, 0, 1]
    slope_x = (y[:, nxt] - y[:, prv]) / area[:, None]
    slope_y = (x[:, prv] - x[:, nxt]) / area[:, None]
    constant = (x[:, nxt] * y[:, prv] - x[:, prv] * y[:, nxt]) / area[:, None]
    return slope_x, slope_y, constant


def _row_span(slope: FloatArray, at_row: FloatArray, width: int) -> tuple[FloatArray, FloatArray]:
    """First and last column whose centre has three non-negative barycentric coordinates."""
    safe = np.where(np.abs(slope) < 1e-12, 1e-12, slope)
    root = -at_row / safe
    lower = np.where(safe > 0, root, -np.inf).max(axis=1)
    upper = np.where(safe < 0, root, np.inf).min(axis=1)
    first = np.maximum(np.ceil(lower - 0.5 - _EDGE_TOLERANCE), 0.0)
    last = np.minimum(np.floor(upper - 0.5 + _EDGE_TOLERANCE), width - 1.0)
    return first, last


def _ragged(counts: IntArray) -> tuple[IntArray, IntArray]:
    """Flat (group, position in group) of groups with the given sizes."""
    group = np.repeat(np.arange(len(counts)), counts)
    start = np.cumsum(counts) - counts
    return group, np.arange(len(group)) - start[group]


#: A face whose normal has less than this [cosine] in common with the mean at a vertex is beyond a fold there.
_CREASE = 0.5


def mean_normals(pos: _Array, faces: NDArray[np.int64]) -> _Array:
    """Area-weighted unit normals (V, 3)."""
    lib = library()
    if lib is not None:
        points, corners, found = packed(pos), packed(faces, np.int64), np.zeros_like(pos)
        lib.picture_normals(address(points), address(corners), len(corners), len(points), address(found))
        return found
    a, b, c = (pos[faces[:, k]] for k in range(3))
    face_normal = np.cross(b - a, c - a)
    total = [
        sum(np.bincount(faces[:, k], weights=face_normal[:, axis], minlength=len(pos)) for k in range(3)) for axis in range(3)
    ]
    return unit(np.stack(total, axis=1))


def creased(pos: _Array, faces: NDArray[np.int64], normal: _Array) -> tuple[NDArray[np.int64], NDArray[np.int64], _Array]:
    """Faces with their own vertices where the mean normal (V, 3) of a vertex is not theirs, as in a pleat; the vertex (V + N,)
    that each stands for, and the normals (N, 3) of the new ones."""
    lib = library()
    if lib is not None:
        points, means, faces = packed(pos), packed(normal), np.array(faces, dtype=np.int64, order="C")
        vertex, found = np.empty(faces.size, dtype=np.int64), np.empty((faces.size, 3))
        places = (address(values) for values in (faces, vertex, found))
        count = lib.picture_creased(address(points), address(means), len(faces), len(pos), _CREASE, *places)
        return faces, np.concatenate([np.arange(len(pos)), vertex[:count]]), found[:count]
    a, b, c = (pos[faces[:, k]] for k in range(3))
    flat = unit(np.cross(b - a, c - a))
    off = np.einsum("fx,fkx->fk", flat, normal[faces]) < _CREASE
    off &= np.abs(flat).sum(axis=1, keepdims=True) > 0.5
    own = np.argwhere(off)
    if not len(own):
        return faces, np.arange(len(pos)), np.zeros((0, 3))
    vertex = faces[off]
    order = np.argsort(faces, axis=None, kind="stable")
    ends = np.searchsorted(faces.reshape(-1)[order], [vertex, vertex + 1])
    count = ends[1] - ends[0]
    row = np.repeat(np.arange(len(own)), count)
    around = order[np.arange(len(row)) - np.repeat(np.cumsum(count) - count - ends[0], count)] // 3
    # Of the faces around the vertex those on this side of the fold share its normal.
    alike = (flat[around] * flat[own[row, 0]]).sum(axis=1) > 0.5
    sums = [np.bincount(row, np.where(alike, flat[around, axis], 0.0), len(own)) for axis in range(3)]
    faces = faces.copy()
    faces[off] = len(pos) + np.arange(len(own))
    return faces, np.concatenate([np.arange(len(pos)), vertex]), unit(np.stack(sums, axis=1, dtype=np.float64))
