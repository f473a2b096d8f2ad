"""Shaded pictures of a body and its clothing on a CPU: no display, no graphics card.

Deferred shading: `raster.rasterise` finds the nearest face of every sample, of which a pixel has 2 x 2, then
one pass lights the covered pixels (key light with a soft shadow map, sky and bounce light, a rim), once where
their samples see one surface, and the floor behind them, darker in creases and where one surface lies near
another. Lights turn with the camera, so that every view is lit from the upper left.

The hems of a garment in pictures: how far its vertices are from them, and the lines along them.

Images on surfaces, looked up in every pixel.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import takewhile

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from hood.assets.files.said import install
from hood.assets.formats.raw_mesh import Texture
from hood.media.renderer.raster import (
    Camera,
    SeenValues,
    VisibilityBuffer,
    address,
    creased,
    from_behind,
    library,
    mean_normals,
    packed,
    unit,
)
from hood.media.renderer.shading import (
    AROUND,
    CLEAR,
    REACH,
    Background,
    Light,
    Nodes,
    Surface,
    backdrop,
    dark_map,
    floor_values,
    node_pixels,
    openness,
)
from hood.media.renderer.view import ViewedSurface
from hood.mesh.editing.subdivision import Extrusion
from hood.mesh.topology import connected_components, counted_edges

_Array = NDArray[np.float64]

#: Distance [m] that stands for no hem near by.
FAR = 1.0
#: Distances of at least this [m] do not matter: the seam is nearer.
_REACH = 0.08
_SAMPLES = 8  # points of every boundary edge

_EDGE_WIDTH, _EDGE_SHADE = 0.0025, 0.3  # m, share of the colour taken
_SEAM_AT, _SEAM_HALF_WIDTH, _SEAM_SHADE = 0.02, 0.0015, 0.35


#: Ways along edges of triangles are longer than straight ones by less than this factor.
_DETOUR = 1.5


def hem_distance(pos: ArrayLike, faces: ArrayLike) -> _Array:
    """Distance [m] of every vertex from the next open edge of its surface, (V,); :data:`FAR` where none is near.

    Near is what is near along the surface: a sleeve beside the waist is not, nor a pocket upon a hem.

    Args:
        pos: (V, 3) [m], at rest.
        faces: (F, 3).
    """
    points, corners = np.asarray(pos, dtype=np.float64), np.asarray(faces, dtype=np.int64)
    edges, count = counted_edges(corners)
    open_edges = edges[count == 1]
    result = np.full(len(points), FAR)
    if not len(open_edges) or not np.isfinite(points).all():
        return result
    length = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    graph = coo_matrix((np.maximum(length, 1e-9), (edges[:, 0], edges[:, 1])), shape=2 * (len(points),))
    along = dijkstra(graph, directed=False, indices=np.unique(open_edges), min_only=True, limit=_REACH)
    share = np.linspace(0.0, 1.0, _SAMPLES)[:, None, None]
    near, part = np.isfinite(along), connected_components(len(points), edges)
    for own in np.unique(part[open_edges[:, 0]]):
        start, end = points[open_edges[part[open_edges[:, 0]] == own].T]
        rows = near & (part == own)
        dist, _ = cKDTree((start + share * (end - start)).reshape(-1, 3)).query(points[rows])
        # A layer below has an edge, too, which is nearer than along the surface.
        result[rows] = np.where(along[rows] > _DETOUR * dist, along[rows], dist)
    return result


def sewn(dist: _Array, foot: _Array) -> _Array:
    """Share (P,) of a colour that is left by the edge of a hem and by its seam, 2 cm from it.

    Args:
        dist: (P,) distance from the hem [m].
        foot: (P,) side of a pixel there [m], over which lines are smoothed.
    """
    edge = np.clip((_EDGE_WIDTH - dist) / foot + 0.5, 0.0, 1.0)
    seam = np.clip((_SEAM_HALF_WIDTH - np.abs(dist - _SEAM_AT)) / foot + 0.5, 0.0, 1.0)
    seam *= np.minimum(1.0, 2.0 * _SEAM_HALF_WIDTH / foot)
    left: _Array = 1.0 - _EDGE_SHADE * edge - _SEAM_SHADE * seam
    return left


#: Larger images [pixels along a side] are drawn smaller: pictures are small, and their pixels would miss most of it.
_SIDE = 1024


@dataclass(frozen=True)
class Print:
    """An image on some faces of a mesh."""

    image: _Array  # (H, W, 3) linear colours, the top row first
    faces: NDArray[np.int64]  # (N,) numbers of the faces
    corners: _Array  # (N, 3, 2) texture coordinates of their corners, v up; the image repeats beyond 0 and 1

    def on(self, shell: Extrusion) -> Print:
        """The image on the shell of the mesh."""
        face, corner = np.divmod(shell.source, 3)
        row = np.full(int(face.max(initial=-1)) + 1, -1)
        row[self.faces] = np.arange(len(self.faces))
        mine = np.flatnonzero(row[face[:, 0]] >= 0)
        return replace(self, faces=mine, corners=self.corners[row[face[mine]], corner[mine]])

    def at(self, uv: _Array) -> _Array:
        """Colours (P, 3) at texture coordinates (P, 2), linear between pixels."""
        height, width = self.image.shape[:2]
        across, down = uv[:, 0] * width - 0.5, (1.0 - uv[:, 1]) * height - 0.5
        left, top = np.floor(across), np.floor(down)
        right_share, low_share = (across - left)[:, None], (down - top)[:, None]
        columns = [(left + k).astype(np.int64) % width for k in range(2)]
        rows = [(top + k).astype(np.int64) % height for k in range(2)]
        upper, lower = (
            (1.0 - right_share) * self.image[row, columns[0]] + right_share * self.image[row, columns[1]] for row in rows
        )
        return np.asarray((1.0 - low_share) * upper + low_share * lower)


def pixels_of(texture: Texture) -> _Array:
    """(H, W, 3) linear colours of an image, of 1,024 pixels a side at most.

    Raises:
        ImportError: Pillow is missing.
        ValueError: the image is damaged.
    """
    return np.asarray((texture.pixels(_SIDE) / 255.0) ** 2.2)


def printed(prints: Sequence[tuple[int, Print]], face: NDArray[np.int64], weights: _Array) -> _Array:
    """Colours (P, 3) of pixels whose faces have an image; NaN for others.

    Args:
        prints: every image with the number from which the faces of its mesh are counted.
        face: (P,) number of the face in each pixel.
        weights: (P, 3) shares of its corners there.
    """
    found = np.full((len(face), 3), np.nan)
    for first, one in prints:
        place = np.full(max(int(face.max(initial=-1)), int(one.faces.max(initial=-1)) + first) + 1, -1)
        place[one.faces + first] = np.arange(len(one.faces))
        mine = np.flatnonzero(place[face] >= 0)
        uv = (weights[mine, :, None] * one.corners[place[face[mine]]]).sum(axis=1)
        found[mine] = one.at(uv)
    return found


Picture = NDArray[np.uint8]

BODY_COLOR = (0.74, 0.70, 0.66)
GARMENT_COLOR = (0.20, 0.42, 0.66)
#: Shares of the light in the broad highlight of a surface, and in what its fibres scatter where it is seen at a grazing angle.
SHEEN, FUZZ = 0.06, 0.10

#: Pixels are drawn in so many rows and columns.
SUPERSAMPLING = 2


@dataclass(frozen=True)
class RenderMesh:
    """A surface to draw: `pos` (V, 3) [m], y up, `faces` (F, 3), `color` (3,) or per vertex (V, 3) in 0..1.

    Both sides are drawn, in one colour: a collar and a lapel show their inner side. `hem` (V,) [m] is the distance from the
    next hem, along which a line and a seam are drawn; without it there is none. `behind` [m] draws the surface farther from
    the eye than it is: what lies closer upon it is not cut by it. `prints` are images on some of its faces. `shine`, (3,) or
    per vertex (V, 3): shares of the light in a broad and in a narrow highlight, and in what fibres scatter. Of a surface that
    is `closed`, its faces counterclockwise from outside, the inner side is not drawn, which saves time. Faces `unsewn` (N,)
    have no lines of the hem.
    """

    pos: ArrayLike
    faces: ArrayLike
    color: ArrayLike = GARMENT_COLOR
    hem: ArrayLike | None = None
    behind: float = 0.0
    prints: Sequence[Print] = ()
    shine: ArrayLike = (SHEEN, 0.0, FUZZ)
    closed: bool = False
    unsewn: NDArray[np.int64] | None = None


def render_frame(
    meshes: Sequence[RenderMesh],
    camera: Camera,
    width: int = 480,
    height: int = 640,
    *,
    floor: float | None = None,
    background: Background = None,
) -> Picture:
    """Draws the meshes above a floor; returns (height, width, 3) uint8, or 4 with straight alpha where they are seen through.

    Args:
        floor: height of the floor [m]. By default the lowest vertex drawn; give it for a film, where it must
            not move.
        background: see :data:`hood.media.renderer.shading.Background`.
    """
    return render_views(meshes, [camera], width, height, floor=floor, background=background)


def render_views(
    meshes: Sequence[RenderMesh],
    cameras: Sequence[Camera],
    width: int,
    height: int,
    *,
    floor: float | None = None,
    background: Background = None,
) -> Picture:
    """The same meshes from each camera, as :func:`render_frame` does, side by side: (height, cameras * width, 3 or 4)."""
    surface = _join(meshes)
    floor_height = float(surface.ends[0][1]) if floor is None else floor
    firsts = np.cumsum([0, *(len(np.asarray(mesh.faces)) for mesh in meshes)]).tolist()
    prints = [(first, one) for first, mesh in zip(firsts, meshes, strict=False) for one in mesh.prints]
    dark, lib = dark_map(surface, floor_height), library()
    picture = np.empty((height, len(cameras) * width, 4 if background == CLEAR else 3), dtype=np.uint8)
    for number, camera in enumerate(cameras):
        own = picture[:, number * width : (number + 1) * width]
        light = Light(camera, surface.pos, surface.faces, "shadow", surface.closed)
        view = ViewedSurface.of(camera, surface, SUPERSAMPLING * width, SUPERSAMPLING * height)
        if lib is None:
            own[:] = _drawn(camera, light, surface, view, prints, floor_height, (width, height), dark, background)
            continue
        floor_there = floor_values(camera, surface, floor_height, (width, height), dark, background)
        seen, _alive = _seen_values(camera, surface, view, prints)
        given = (ctypes.byref(value) for value in (light.values(), seen, floor_there))
        lib.picture_draw(*given, len(surface.pos), picture.strides[0], address(own))
    return picture


def _drawn(
    camera: Camera,
    light: Light,
    surface: Surface,
    view: ViewedSurface,
    prints: Sequence[tuple[int, Print]],
    floor: float,
    size: tuple[int, int],
    dark: _Array,
    background: Background,
) -> Picture:
    """The picture in numpy."""
    image, clear = backdrop(camera, light, surface, floor, *size, dark, background), background == CLEAR
    image = np.repeat(np.repeat(image, SUPERSAMPLING, axis=0), SUPERSAMPLING, axis=1)
    covered = np.zeros(image.shape[:2])
    part = slice(view.top, view.top + len(view.buffer.face)), slice(view.left, view.left + view.buffer.face.shape[1])
    covered[part] = view.buffer.face >= 0
    _draw_surface(image[part], camera, light, surface, view, prints)
    share = _mean(covered)[..., None]
    image = _mean(image) / (np.maximum(share, 1e-9) if clear else 1.0)
    shown = (255.0 * np.clip(image, 0.0, 1.0) ** (1 / 2.2) + 0.5).astype(np.uint8)
    return np.concatenate([shown, (255.0 * share + 0.5).astype(np.uint8)], axis=2) if clear else shown


def _mean(samples: _Array) -> _Array:
    """Of the samples of every pixel."""
    steps = range(SUPERSAMPLING)
    every = [samples[i::SUPERSAMPLING, j::SUPERSAMPLING] for i in steps for j in steps]
    mean: _Array = np.sum(every, axis=0) / len(every)
    return mean


def contact_sheet(images: Sequence[Picture], columns: int, labels: Sequence[str] | None = None) -> Picture:
    """Equal-sized pictures in rows of `columns`, each with its label in the upper left corner."""
    if not images or columns < 1:
        raise ValueError(f"contact_sheet: needs an image and a column, got {len(images)} images, {columns} columns")
    if labels is not None and len(labels) != len(images):
        raise ValueError(f"contact_sheet: {len(labels)} labels for {len(images)} images; give one for each")
    height, width = images[0].shape[:2]
    for index, image in enumerate(images):
        if image.shape != (height, width, 3):
            raise ValueError(f"contact_sheet: image {index} is {image.shape}, image 0 {images[0].shape}; use one size")
    rows = -(-len(images) // columns)
    sheet = np.full((rows * height, columns * width, 3), 255, dtype=np.uint8)
    for index, image in enumerate(images):
        top, left = (index // columns) * height, (index % columns) * width
        cell = image if labels is None else _labelled(image, labels[index])
        sheet[top : top + height, left : left + width] = cell
    return sheet


def captioned(image: Picture, text: str) -> Picture:
    """A copy of the picture with a line of small text in its upper right corner."""
    size = max(11, image.shape[0] // 40)
    return _written(image, text, size, (image.shape[1] - size // 2, size // 3), "ra")


def _labelled(image: Picture, label: str) -> Picture:
    size = max(12, image.shape[0] // 28)
    return _written(image, label, size, (size // 2, size // 3), "la")


def _written(image: Picture, text: str, size: int, place: tuple[int, int], anchor: str) -> Picture:
    try:
        from PIL import Image, ImageDraw, ImageFont
    except ImportError as error:
        raise ImportError(f"labels on pictures need Pillow: {install('pictures')}") from error
    canvas = Image.fromarray(image)
    font = ImageFont.load_default(size)
    ImageDraw.Draw(canvas).text(place, text, fill=(60, 62, 66), font=font, anchor=anchor)
    return np.asarray(canvas)


def _join(meshes: Sequence[RenderMesh]) -> Surface:
    if not meshes:
        raise ValueError("render_frame: no meshes given; pass at least one RenderMesh")
    parts: list[tuple[_Array, NDArray[np.int64], _Array, _Array, _Array, _Array, _Array]] = []
    offset = 0
    for index, mesh in enumerate(meshes):
        pos, faces = np.asarray(mesh.pos, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)
        color = np.asarray(mesh.color, dtype=np.float64)
        if not np.isfinite(pos).all():
            bad = int(np.flatnonzero(~np.isfinite(pos).all(axis=1))[0])
            raise ValueError(f"render_frame: mesh {index}: vertex {bad} is not finite; draw an earlier frame")
        if color.shape not in ((3,), pos.shape):
            raise ValueError(f"render_frame: mesh {index}: color is {color.shape}, needs (3,) or {pos.shape}")
        linear = np.broadcast_to(np.clip(color, 0.0, 1.0) ** 2.2, pos.shape)
        hem = np.full(len(pos), FAR) if mesh.hem is None else np.asarray(mesh.hem, dtype=np.float64)
        if hem.shape != (len(pos),):
            raise ValueError(f"render_frame: mesh {index}: hem is {hem.shape}, needs ({len(pos)},)")
        behind = np.full(len(pos), mesh.behind)
        shine = np.broadcast_to(np.asarray(mesh.shine, dtype=np.float64), pos.shape)
        normal = mean_normals(pos, faces)
        faces, carrier, own = creased(pos, faces, normal)
        rows = [values[carrier] for values in (pos, linear, normal, hem, behind, shine)]
        rows[2][len(pos) :] = own
        if mesh.unsewn is not None and len(mesh.unsewn):
            alone = faces[mesh.unsewn].reshape(-1)
            faces, first = np.array(faces), len(carrier)
            faces[mesh.unsewn] = first + np.arange(len(alone)).reshape(-1, 3)
            rows, carrier = (
                [np.concatenate([values, values[alone]]) for values in rows],
                np.concatenate([carrier, carrier[alone]]),
            )
            rows[3][first:] = FAR
        parts.append((rows[0], faces + offset, *rows[1:]))  # type: ignore[arg-type]
        offset += len(carrier)
    outer = takewhile(lambda mesh: mesh.closed, meshes)
    pos, corners, color, normal, hem, behind, shine = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Surface(pos, corners, color, normal, hem, behind, shine, sum(len(np.asarray(mesh.faces)) for mesh in outer))


def _draw_surface(
    image: _Array, camera: Camera, light: Light, surface: Surface, view: ViewedSurface, prints: Sequence[tuple[int, Print]]
) -> None:
    row, column, corners, weights = view.covered()
    if len(row) == 0:
        return
    axes, face = camera.axes(), view.buffer.face[row, column]
    pos = _blend(weights, surface.pos, corners)
    color = _blend(weights, surface.color, corners)
    if prints:
        own = printed(prints, view.number[face], weights)
        color = np.where(np.isnan(own), color, own)
    normal = _normals(surface, view, row, column, corners, weights)
    to_eye = unit(np.asarray(camera.position) - pos)
    near = np.asarray(view.buffer.nearness[row, column], dtype=np.float64)
    color = sewn((weights * surface.hem[corners]).sum(axis=1), 1.0 / (view.focal * near))[:, None] * color
    open_share, lit = _nodes(axes, light, surface, view).at(row, column, near, normal).T
    shine = _blend(weights, surface.shine, corners)
    image[row, column] = light.shade(normal, to_eye, color, shine, open_share, lit)
    image[:] = np.where(view.buffer.face[..., None] >= 0, image.reshape(-1, 3)[view.first()], image)


def _normals(
    surface: Surface,
    view: ViewedSurface,
    row: NDArray[np.integer],
    column: NDArray[np.integer],
    corners: NDArray[np.int64],
    weights: _Array,
) -> _Array:
    """Unit normals (P, 3) of samples, towards the eye."""
    normal = unit(_blend(weights, surface.normal, corners))
    normal[from_behind(view.screen, view.faces)[view.buffer.face[row, column]]] *= -1.0
    return normal


def _nodes(axes: _Array, light: Light, surface: Surface, view: ViewedSurface) -> Nodes:
    half = VisibilityBuffer(view.buffer.face[::2, ::2], view.buffer.nearness[::2, ::2])
    there, rows, columns = node_pixels(half.face)
    row, column = rows[there], columns[there]
    corners, weights = view.seen(2 * row, 2 * column)
    own = _normals(surface, view, 2 * row, 2 * column, corners, weights)
    places = np.add.outer(np.arange(there.shape[0]), np.arange(there.shape[1]))[there] % 2
    middle = 0.5 * view.middle[0], 0.5 * view.middle[1]
    received, normal, nearness = np.ones((*there.shape, 2)), np.zeros((*there.shape, 3)), np.zeros(there.shape)
    received[there, 0] = openness(half, 0.5 * view.focal, row, column, own @ axes.T, middle, places)
    received[there, 1] = light.lit(_blend(weights, surface.pos, corners) + 0.006 * own, spread=0.9)
    normal[there], nearness[there] = own, half.nearness[row, column]
    return Nodes(there, received, nearness, normal)


def _seen_values(
    camera: Camera, surface: Surface, view: ViewedSurface, prints: Sequence[tuple[int, Print]]
) -> tuple[SeenValues, list[NDArray[np.generic]]]:
    """What :func:`_draw_surface` needs, for the compiled drawing, and the arrays that it points to."""
    height, width = view.buffer.face.shape
    own = None
    if prints:
        row, column, _, weights = view.covered()
        own = np.full((height, width, 3), np.nan)
        own[row, column] = printed(prints, view.number[view.buffer.face[row, column]], weights)
    seen = (surface.pos, surface.color, surface.normal, surface.shine, view.screen, view.depth, surface.hem)
    arrays = [packed(value) for value in seen]
    arrays += [packed(view.faces, np.int64), packed(view.buffer.face, np.int32)]
    arrays += [packed(view.buffer.nearness, np.float32)]
    arrays += [packed(value) for value in (AROUND, camera.axes())] + ([] if own is None else [own])
    eye = tuple(float(value) for value in camera.position)
    addresses = [*(address(value) for value in arrays), *([None] if own is None else [])]
    sizes = width, height, AROUND.shape[1], view.left, view.top
    return SeenValues(*addresses, *sizes, eye, view.middle, view.focal, REACH), arrays


def _blend(weights: _Array, values: _Array, corners: NDArray[np.int64]) -> _Array:
    a, b, c = (weights[:, k, None] * values[corners[:, k]] for k in range(3))
    return a + b + c
