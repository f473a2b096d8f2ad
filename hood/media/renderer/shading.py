"""Light on surfaces and on the floor. Colours are linear here; gamma comes at the very end.

Shade where surfaces are near each other: what of the light from all sides reaches the pixels of a picture.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray

from hood.media.renderer.raster import (
    Camera,
    FloatArray,
    FloorValues,
    LightValues,
    VisibilityBuffer,
    address,
    ends_of,
    library,
    packed,
    rasterise,
    unit,
    view_axes,
)

_Array = NDArray[np.float64]

#: Distance [m] within which one surface shades another.
REACH = 0.09
_COUNT = 6
#: Sine of the angle above the tangent plane from which a surface shades: flat faces of a round surface do not.
_LEAST = 0.1
_STRENGTH, _DARKEST = 2.2, 0.2


def _around() -> _Array:
    """Places (4, 6, 2) on the unit disc where a pixel looks, turned by a quarter of their angle among four pixels."""
    turn, index = np.arange(4)[:, None], np.arange(_COUNT)
    angle = 2.0 * np.pi * (2.0 * index / _COUNT * 1.5 + turn / 4.0 / _COUNT * 2.0 + index * 0.08)
    radius = np.sqrt((index + (turn + 0.5) / 4.0) / _COUNT)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)


AROUND = np.ascontiguousarray(_around())


def openness(
    buffer: VisibilityBuffer,
    focal: float,
    row: NDArray[np.integer],
    column: NDArray[np.integer],
    normal: _Array,
    middle: tuple[float, float] | None = None,
    place: NDArray[np.integer] | None = None,
) -> _Array:
    """Share (P,) of the light from all sides that reaches pixels: 1 in the open, less in creases and gaps.

    Every pixel looks at a dozen others within :data:`REACH`, and counts how far what they see stands above its own tangent
    plane, less the farther it is (ambient occlusion in screen space, as Mittring, "Finding next gen", 2007, and McGuire et
    al., "The Alchemy screen-space ambient obscurance algorithm", 2011). What no pixel sees keeps no light off.

    Args:
        buffer: what is seen; its nearness is 1/depth [1/m].
        focal: pixels that 1 m takes at a distance of 1 m.
        row, column: (P,) of the pixels, all of them covered.
        normal: (P, 3) towards the eye; right, up and forward.
        middle: where the camera looks, across and down [pixels]; None: the middle of what is seen.
        place: (P,) which of :data:`AROUND` a pixel looks at; None: by its place in its 2 x 2.
    """
    height, width = buffer.face.shape
    middle = (0.5 * width, 0.5 * height) if middle is None else middle
    pos = _positions(buffer, focal, row, column, middle)
    place = 2 * (row % 2) + column % 2 if place is None else place
    offset = np.concatenate([AROUND[place], AROUND[3 - place]], axis=1)
    reach = focal * REACH / pos[:, 2]
    kept = np.zeros(len(row))
    for k in range(2 * _COUNT):
        c = np.floor(column + 0.5 + reach * offset[:, k, 0]).astype(np.int64)
        r = np.floor(row + 0.5 + reach * offset[:, k, 1]).astype(np.int64)
        at = np.flatnonzero((c >= 0) & (r >= 0) & (c < width) & (r < height))
        at = at[buffer.face[r[at], c[at]] >= 0]
        away = _positions(buffer, focal, r[at], c[at], middle) - pos[at]
        dist_sq = np.einsum("pi,pi->p", away, away)
        share = np.maximum(1.0 - dist_sq / REACH**2, 0.0)
        above = np.einsum("pi,pi->p", normal[at], away) / np.sqrt(np.maximum(dist_sq, 1e-300))
        kept[at] += np.where(dist_sq > 0, np.maximum(above - _LEAST, 0.0) * share, 0.0)
    return np.clip(1.0 - _STRENGTH * kept / (2 * _COUNT), _DARKEST, 1.0)


@dataclass(frozen=True)
class Nodes:
    """What light arrives, computed once for every block of 2 x 2 pixels, and interpolated between blocks of one surface.

    Args:
        there: (R, C) whether a block sees anything at its node; what else there is of those that do not is not read.
        light: (R, C, 2) shares of the light from all sides and of the key light.
        nearness: (R, C) 1/m, and unit ``normal`` (R, C, 3).
    """

    there: NDArray[np.bool_]
    light: _Array
    nearness: _Array
    normal: _Array

    def at(self, row: NDArray[np.integer], column: NDArray[np.integer], nearness: _Array, normal: _Array) -> _Array:
        """(P, 2) at samples, of which a pixel has 2 x 2, with their nearness and normal (P, 3)."""
        r, c = row // 2, column // 2
        total, found = np.zeros(len(row)), np.zeros((len(row), 2))
        for down in (0, 1):
            for across in (0, 1):
                i = r // 2 + down * np.where(r % 2 == 1, 1, -1)
                j = c // 2 + across * np.where(c % 2 == 1, 1, -1)
                inside = (i >= 0) & (j >= 0) & (i < self.there.shape[0]) & (j < self.there.shape[1])
                i, j = np.where(inside, i, 0), np.where(inside, j, 0)
                other = (np.abs(self.nearness[i, j] - nearness) > 0.005 * nearness) | (_dot(self.normal[i, j], normal) < 0.5)
                share = (0.25 if down else 0.75) * (0.25 if across else 0.75) * np.where(other, 1e-3, 1.0)
                share = np.where(inside & self.there[i, j], share, 0.0)
                found += share[:, None] * self.light[i, j]
                total += share
        return np.where(total[:, None] > 0, found / np.maximum(total, 1e-12)[:, None], 1.0)


def node_pixels(face: NDArray[np.integer]) -> tuple[NDArray[np.bool_], NDArray[np.int64], NDArray[np.int64]]:
    """Of faces (H, W) that the first samples of pixels see: which blocks (R, C) have a node, and row and column (R, C) of the
    pixel where it is, the first of the block that sees anything."""
    rows, columns = -(-face.shape[0] // 2), -(-face.shape[1] // 2)
    seen = np.zeros((2 * rows, 2 * columns), dtype=bool)
    seen[: face.shape[0], : face.shape[1]] = face >= 0
    four = seen.reshape(rows, 2, columns, 2).swapaxes(1, 2).reshape(rows, columns, 4)
    first = four.argmax(axis=2)
    return np.asarray(four.any(axis=2)), 2 * np.arange(rows)[:, None] + first // 2, 2 * np.arange(columns)[None] + first % 2


def _positions(
    buffer: VisibilityBuffer,
    focal: float,
    row: NDArray[np.integer],
    column: NDArray[np.integer],
    middle: tuple[float, float],
) -> _Array:
    """Seen points (P, 3) [m] right, up and forward of the eye."""
    depth = 1.0 / buffer.nearness[row, column]
    return np.stack([(column + 0.5 - middle[0]) / focal * depth, (middle[1] - row - 0.5) / focal * depth, depth], axis=1)


_Faces = NDArray[np.int64]

_DARK_SIZE, _CELL = 128, 0.03  # cells of the map of shade on the floor along a side, and the side of one [m]
_SHADOW_SIZE, _TILE = 640, 16  # pixels of the shadow map, and of a tile of it, as in picture_light.h
# Where the shadow map is probed around a point, in texels: two rings, turned against each other.
_PROBES = (
    (0.0, 0.0), (1.7, 0.6), (-0.6, 1.7), (-1.7, -0.6), (0.6, -1.7), (3.0, -2.4), (2.4, 3.0), (-3.0, 2.4),
    (-2.4, -3.0),
)  # fmt: skip
_PROBE_TEXELS = packed(_PROBES)
_GROUND = np.array([0.80, 0.81, 0.82])
_HORIZON = np.array([0.93, 0.935, 0.94])
_ZENITH = np.array([0.80, 0.82, 0.85])
_KEY = 1.14 * np.array([1.0, 0.97, 0.92])
_FILL = 0.22 * np.array([0.86, 0.92, 1.0])
_SKY = 0.43 * np.array([0.95, 0.98, 1.0])
_BOUNCE = 0.18 * np.array([1.0, 0.97, 0.94])


@dataclass(frozen=True)
class Surface:
    """Everything drawn as one mesh, whose first `closed` faces are those of closed surfaces: `pos` (V, 3), `faces` (F, 3),
    linear `color` and unit `normal` (V, 3), distance from the next `hem` and how far the vertices are drawn `behind` where
    they are (V,) [m], and how they `shine` (V, 3), as a :class:`hood.media.renderer.render.RenderMesh`."""

    pos: _Array
    faces: _Faces
    color: _Array
    normal: _Array
    hem: _Array
    behind: _Array
    shine: _Array
    closed: int = 0

    @cached_property
    def ends(self) -> tuple[_Array, _Array]:
        """Of its box (3,)."""
        return ends_of(self.pos)


def _most_near(nearness: FloatArray) -> _Array:
    """(H / 16, W / 16), the most of a map (H, W) in every tile and those around it."""
    tiles, lib, count = np.full([len(nearness) // _TILE + 2] * 2, -np.inf), library(), len(nearness) // _TILE
    if lib is not None:
        most = np.full((count, count), -np.inf)
        lib.picture_most(address(nearness), len(nearness), address(most))
        tiles[1:-1, 1:-1] = most
    else:
        rows = nearness.reshape(-1, _TILE, len(nearness)).max(axis=1)
        tiles[1:-1, 1:-1] = rows.reshape(count, count, _TILE).max(axis=2)
    rows = np.maximum(np.maximum(tiles[:-2], tiles[1:-1]), tiles[2:])
    return packed(np.maximum(np.maximum(rows[:, :-2], rows[:, 1:-1]), rows[:, 2:]))


class Light:
    """A key light with a shadow map, a fill light, a hemisphere of sky and bounce light, and a rim.

    Args:
        pos: (V, 3) m of the surface that throws shadows; ``faces`` (F, 3), ``closed`` as for
            :func:`hood.media.renderer.raster.rasterise`.
        place: of :func:`hood.media.renderer.raster.room`, for the shadow map; the next light of that place overwrites it.
    """

    def __init__(self, camera: Camera, pos: _Array, faces: NDArray[np.int64], place: str | None = None, closed: int = 0):
        right, _, forward = camera.axes()
        flat_forward = unit(np.array([forward[0], 0.0, forward[2]]) + 1e-9)
        self.key = unit(-0.55 * right + 1.0 * np.array([0.0, 1.0, 0.0]) - 0.75 * flat_forward)
        self.fill = unit(0.9 * right + 0.25 * np.array([0.0, 1.0, 0.0]) - 0.6 * flat_forward)
        self._axes = packed(view_axes(-self.key) * [[1.0], [-1.0], [1.0]])  # the map's rows go down, as those of pictures
        seen = pos @ self._axes.T
        self._low, high = ends_of(seen[:, :2])
        extent = float((high - self._low).max()) + 1e-6
        self._scale = (_SHADOW_SIZE - 8) / extent
        screen = (seen[:, :2] - self._low) * self._scale + 4.0
        size = _SHADOW_SIZE, _SHADOW_SIZE
        self._map = rasterise(screen, -seen[:, 2], faces, *size, place=place, closed=closed, whose=False).nearness
        self._texel = 1.0 / self._scale
        self._most = _most_near(self._map)

    def values(self) -> LightValues:
        """For the compiled drawing; valid as long as this light is."""
        size, low, count = _SHADOW_SIZE, (float(self._low[0]), float(self._low[1])), len(_PROBES)
        colors = (tuple(value) for value in (self.key, self.fill, _KEY, _FILL, _SKY, _BOUNCE))
        at = (address(value) for value in (self._map, self._most, _PROBE_TEXELS, self._axes))
        return LightValues(*at, size, count, len(self._most), low, self._scale, self._texel, *colors)

    def lit(self, pos: _Array, spread: float = 1.0) -> _Array:
        """Share of the key light that reaches `pos` (P, 3): percentage-closer filtering of the shadow map."""
        lib = library()
        if lib is not None:
            points, out = packed(pos), np.empty(len(pos))
            lib.picture_lit(ctypes.byref(self.values()), address(points), len(points), spread, address(out))
            return out
        seen = pos @ self._axes.T
        at = (seen[:, :2] - self._low) * self._scale + 4.0
        bias = 0.004 + 1.5 * spread * self._texel
        shade = np.zeros(len(pos))
        for dx, dy in _PROBES:
            column = np.clip(at[:, 0] + spread * dx, 0, _SHADOW_SIZE - 1).astype(np.int64)
            row = np.clip(at[:, 1] + spread * dy, 0, _SHADOW_SIZE - 1).astype(np.int64)
            shade += self._map[row, column] > bias - seen[:, 2]
        return 1.0 - shade / len(_PROBES)

    def shade(self, normal: _Array, view: _Array, color: _Array, shine: _Array, openness: _Array, lit: _Array) -> _Array:
        """Linear colours (P, 3) of points with these unit normals, directions to the eye and colours.

        Args:
            shine: (P, 3) shares of the light in a broad and in a narrow highlight, and scattered at a grazing angle.
            openness: (P,) share of the light from all sides that is not kept off by what is near.
            lit: (P,) share of the key light that is not in shadow.
        """
        key = normal @ self.key
        # Wrapped diffuse light: soft terminators, as under a large lamp.
        diffuse = np.clip((key + 0.25) / 1.25, 0.0, 1.0)
        shadow = (0.25 + 0.75 * lit) * (0.5 + 0.5 * openness)
        fill = np.clip(normal @ self.fill, 0.0, 1.0)
        up = 0.5 + 0.5 * normal[:, 1]
        facing = np.clip(_dot(normal, view), 0.0, 1.0)
        half = unit(view + self.key)
        broad = np.clip(_dot(normal, half), 0.0, 1.0) ** 24
        gloss = (shine[:, 0] * broad + shine[:, 1] * broad**4) * shadow
        rim = shine[:, 2] * (1.0 - facing) ** 3 * up
        around = fill[:, None] * _FILL + up[:, None] * _SKY + (1.0 - up)[:, None] * _BOUNCE
        received = (diffuse * shadow)[:, None] * _KEY + openness[:, None] * around
        return color * received * (0.72 + 0.28 * facing[:, None]) + (gloss + rim)[:, None]


#: What is behind a surface: None for the floor and the sky of a studio, a colour (sRGB, 0 to 1) with the shade on the floor, or
#: :data:`CLEAR` for nothing, seen through.
Background = tuple[float, float, float] | str | None
CLEAR = "transparent"


def floor_values(
    camera: Camera, surface: Surface, floor: float, size: tuple[int, int], dark: _Array, background: Background
) -> FloorValues:
    """What :func:`backdrop` needs, for the compiled drawing of pictures of this ``size`` (width, height); ``dark`` is
    :func:`dark_map`, and lives as long."""
    where = (tuple(value) for value in (camera.position, *camera.axes(), _middle(surface)))
    colors = (tuple(value) for value in (_GROUND**2.2, _HORIZON, _ZENITH, _plain(background)))
    tan_y, kind = float(np.tan(np.radians(camera.fov) / 2)), 0 if background is None else 2 if background == CLEAR else 1
    return FloorValues(address(dark), *size, len(dark), *where, kind, tan_y, floor, _CELL, *colors)


def _plain(background: Background) -> _Array:
    """Linear (3,)."""
    return np.array(background if isinstance(background, tuple) else (0.0, 0.0, 0.0), dtype=np.float64) ** 2.2


#: Rows and columns of pixels from a node of the background to the next one, as in picture_background.h.
_DOWN, _ACROSS = 2, 4


def backdrop(
    camera: Camera,
    light: Light,
    surface: Surface,
    floor: float,
    width: int,
    height: int,
    dark: _Array,
    background: Background = None,
) -> _Array:
    """Linear colours (height, width, 3) of the floor, which fades into a plain background.

    All but the lines on the floor is computed at nodes, and interpolated between them.
    """
    rows, columns = np.arange(0, height + _DOWN, _DOWN), np.arange(0, width + _ACROSS, _ACROSS)
    rays, _ = _rays(camera, rows, columns, width, height)
    image = np.broadcast_to(_plain(background), rays.shape).copy()
    if background is None:
        slope = rays[..., 1] / np.linalg.norm(rays, axis=-1)
        image = (_HORIZON + (_ZENITH - _HORIZON) * np.clip(1.6 * slope, 0.0, 1.0)[..., None]) ** 2.2
    lines, eye = np.zeros(image.shape[:2]), np.asarray(camera.position)
    drop = eye[1] - floor
    if drop >= 1e-3:
        row, column = np.nonzero(rays[..., 1] < -1e-4)
        pos = eye + (drop / -rays[row, column, 1])[:, None] * rays[row, column]
        center = _middle(surface)
        away = np.hypot(pos[:, 0] - center[0], pos[:, 2] - center[2])
        left = _floor_shadow(light, surface, pos, dark, away)
        fade = np.exp(-((away / 3.2) ** 2))
        if background is None:
            image[row, column] = (fade * left)[:, None] * _GROUND**2.2 + (1.0 - fade)[:, None] * image[row, column]
            lines[row, column] = 0.16 * fade**2 * left
        else:
            image[row, column] *= left[:, None]
    bare = np.clip(image, 0.0, 1.0) ** (1 / 2.2)  # between nodes as it is shown
    lined = np.clip(image - lines[..., None] * _GROUND**2.2, 0.0, 1.0) ** (1 / 2.2)
    shown = _between(bare, width, height)
    if background is None and drop >= 1e-3:
        shown += _grid_lines(camera, drop, width, height)[..., None] * _between(lined - bare, width, height)
    result: _Array = shown**2.2
    return result


def _rays(
    camera: Camera, rows: NDArray[np.integer], columns: NDArray[np.integer], width: int, height: int
) -> tuple[_Array, float]:
    """Rays (R, C, 3) through pixels, and how far apart they are."""
    right, up, forward = camera.axes()
    per_pixel = float(np.tan(np.radians(camera.fov) / 2)) / (0.5 * height)
    x, y = (columns + 0.5 - 0.5 * width) * per_pixel, (0.5 * height - rows - 0.5) * per_pixel
    return forward + x[None, :, None] * right + y[:, None, None] * up, per_pixel


def _between(nodes: _Array, width: int, height: int) -> _Array:
    """Values (height, width, N) of pixels from those of nodes, linear between them."""
    row, down = np.divmod(np.arange(height), _DOWN)
    column, across = np.divmod(np.arange(width), _ACROSS)
    part = (down / _DOWN)[:, None, None]
    rows = nodes[row] + part * (nodes[row + 1] - nodes[row])
    share = (across / _ACROSS)[None, :, None]
    result: _Array = rows[:, column] + share * (rows[:, column + 1] - rows[:, column])
    return result


def _grid_lines(camera: Camera, drop: float, width: int, height: int) -> _Array:
    """Coverage (height, width) of 1 cm lines every half metre, smoothed over the pixel's footprint."""
    rays, per_pixel = _rays(camera, np.arange(height), np.arange(width), width, height)
    lines = np.zeros((height, width))
    low = np.flatnonzero(rays[:, 0, 1] < -1e-4)  # rows: the camera is upright
    reach = drop / -rays[low, 0, 1]
    pos = np.asarray(camera.position) + reach[:, None, None] * rays[low]
    foot = np.maximum(reach * per_pixel, 1e-4) * np.sqrt(np.maximum(reach / drop, 1.0))
    for axis in (0, 2):
        offset = np.abs((pos[..., axis] / 0.5 + 0.5) % 1.0 - 0.5) * 0.5
        cover = np.clip((0.005 - offset) / foot[:, None] + 0.5, 0.0, 1.0) * np.minimum(1.0, 0.01 / foot)[:, None]
        lines[low] = np.maximum(lines[low], cover)
    return lines


def _floor_shadow(light: Light, surface: Surface, pos: _Array, dark: _Array, away: _Array) -> _Array:
    """What is left of the light on the floor: the cast shadow, and a soft dark patch under low parts."""
    center = _middle(surface)
    at = (pos[:, [2, 0]] - center[[2, 0]]) / _CELL + _DARK_SIZE / 2 - 0.5
    left = 1.0 - np.clip(_sample(dark, at), 0.0, 0.6)
    near = away < 3.0
    left[near] *= 0.80 + 0.20 * light.lit(pos[near], spread=2.5)
    return left


def dark_map(surface: Surface, floor: float) -> _Array:
    """Shade under low parts, (_DARK_SIZE, _DARK_SIZE) cells of _CELL along z and x about the surface's middle."""
    center, lib = _middle(surface), library()
    if lib is not None:
        low = np.zeros((_DARK_SIZE, _DARK_SIZE))
        faces = address(surface.faces), len(surface.faces)
        lib.picture_low(address(surface.pos), *faces, address(center), floor, _CELL, _DARK_SIZE, address(low))
    else:
        low = _low(surface, floor, center)
    narrow, broad = (smoothing(sigma) @ low @ smoothing(sigma) for sigma in (1.4, 4.0))
    return packed(0.55 * narrow + 0.6 * broad)


@cache
def smoothing(sigma: float) -> _Array:
    """The Gauss filter of ``sigma`` cells along a side, (_DARK_SIZE, _DARK_SIZE), cut off at three; zero beyond the ends. That
    of scipy takes 40 ms to import."""
    away = np.abs(np.subtract.outer(np.arange(_DARK_SIZE), np.arange(_DARK_SIZE)))
    weight = np.where(away <= int(3.0 * sigma + 0.5), np.exp(-0.5 * (away / sigma) ** 2), 0.0)
    filtered: _Array = weight / weight[_DARK_SIZE // 2].sum()
    return filtered


def _low(surface: Surface, floor: float, center: _Array) -> _Array:
    a, b, c = (surface.pos[surface.faces[:, k]] for k in range(3))
    middle = (a + b + c) / 3.0
    area = 0.25 * np.abs(np.cross(b - a, c - a)[:, 1])
    weight = area / _CELL**2 * np.exp(-np.maximum(middle[:, 1] - floor, 0.0) / 0.12)
    at = np.clip((middle[:, [2, 0]] - center[[2, 0]]) / _CELL + _DARK_SIZE / 2, 0, _DARK_SIZE - 1).astype(np.int64)
    flat = np.bincount(at[:, 0] * _DARK_SIZE + at[:, 1], weights=weight, minlength=_DARK_SIZE * _DARK_SIZE)
    return flat.astype(np.float64).reshape(_DARK_SIZE, _DARK_SIZE)


def _middle(surface: Surface) -> _Array:
    """Of the box that holds the surface, (3,)."""
    middle: _Array = 0.5 * np.add(*surface.ends)
    return middle


def _sample(image: _Array, at: _Array) -> _Array:
    """Bilinear samples (P,) at (row, column) `at` (P, 2); the border is repeated."""
    at = np.clip(at, 0.0, np.array(image.shape) - 1.001)
    low = at.astype(np.int64)
    part = at - low
    r, c = low[:, 0], low[:, 1]
    upper = image[r, c] * (1 - part[:, 1]) + image[r, c + 1] * part[:, 1]
    lower = image[r + 1, c] * (1 - part[:, 1]) + image[r + 1, c + 1] * part[:, 1]
    return upper * (1 - part[:, 0]) + lower * part[:, 0]


def _dot(a: _Array, b: _Array) -> _Array:
    return np.einsum("pi,pi->p", a, b)
