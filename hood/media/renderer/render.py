"""Shaded pictures of a body and its clothing on a CPU: no display, no graphics card.

Deferred shading: `raster.rasterise` finds the nearest face of every pixel at twice the resolution, then
one vectorised pass lights the covered pixels (key light with a soft shadow map, sky and bounce light, a
rim) and the floor behind them, darker in creases and where one surface lies near another. Lights turn
with the camera, so that every view is lit from the upper left.

The hems of a garment in pictures: how far its vertices are from them, and the lines along them.

Images on surfaces, looked up in every pixel.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from hood.assets.files.said import install
from hood.assets.formats.image import Texture
from hood.media.renderer.raster import (
    NEAR,
    Camera,
    SeenValues,
    VisibilityBuffer,
    address,
    barycentric,
    library,
    packed,
    rasterise,
    unit,
)
from hood.media.renderer.shading import AROUND, REACH, Light, Surface, backdrop, dark_map, floor_values, openness
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
#: A face whose normal has less than this [cosine] in common with the mean at a vertex is beyond a fold there.
_CREASE = 0.5


@dataclass(frozen=True)
class RenderMesh:
    """A surface to draw: `pos` (V, 3) [m], y up, `faces` (F, 3), `color` (3,) or per vertex (V, 3) in 0..1.

    Both sides are drawn, in one colour: a collar and a lapel show their inner side. `hem` (V,) [m] is the distance from the
    next hem, along which a line and a seam are drawn; without it there is none. `behind` [m] draws the surface farther from
    the eye than it is: what lies closer upon it is not cut by it. `prints` are images on some of its faces. `shine`, (3,) or
    per vertex (V, 3): shares of the light in a broad and in a narrow highlight, and in what fibres scatter.
    """

    pos: ArrayLike
    faces: ArrayLike
    color: ArrayLike = GARMENT_COLOR
    hem: ArrayLike | None = None
    behind: float = 0.0
    prints: Sequence[Print] = ()
    shine: ArrayLike = (SHEEN, 0.0, FUZZ)


def render_frame(
    meshes: Sequence[RenderMesh],
    camera: Camera,
    width: int = 480,
    height: int = 640,
    *,
    floor: float | None = None,
) -> Picture:
    """Draws the meshes above a floor; returns (height, width, 3) uint8.

    Args:
        floor: height of the floor [m]. By default the lowest vertex drawn; give it for a film, where it must
            not move.
    """
    surface = _join(meshes)
    light = Light(camera, surface.pos, surface.faces, place="shadow")
    floor_height = float(surface.pos[:, 1].min()) if floor is None else floor
    firsts = np.cumsum([0, *(len(np.asarray(mesh.faces)) for mesh in meshes)]).tolist()
    prints = [(first, one) for first, mesh in zip(firsts, meshes, strict=False) for one in mesh.prints]
    view = _View.of(camera, surface, SUPERSAMPLING * width, SUPERSAMPLING * height)
    lib = library()
    if lib is not None:
        dark, picture = dark_map(surface, floor_height), np.empty((height, width, 3), dtype=np.uint8)
        floor_there = floor_values(camera, surface, floor_height, (width, height), dark)
        seen, _alive = _seen_values(camera, surface, view, prints)
        lib.picture_draw(*(ctypes.byref(value) for value in (light.values(), seen, floor_there)), address(picture))
        return picture
    image = backdrop(camera, light, surface, floor_height, width, height, SUPERSAMPLING)
    _draw_surface(image, camera, light, surface, view, prints)
    steps = range(SUPERSAMPLING)
    samples = [image[i::SUPERSAMPLING, j::SUPERSAMPLING] for i in steps for j in steps]
    image = np.sum(samples, axis=0) / len(samples)
    return (255.0 * np.clip(image, 0.0, 1.0) ** (1 / 2.2) + 0.5).astype(np.uint8)


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
        normal = _vertex_normals(pos, faces)
        faces, carrier, own = _creased(pos, faces, normal)
        rows = [values[carrier] for values in (pos, linear, normal, hem, behind, shine)]
        rows[2][len(pos) :] = own
        parts.append((rows[0], faces + offset, *rows[1:]))  # type: ignore[arg-type]
        offset += len(carrier)
    return Surface(*(np.concatenate(column) for column in zip(*parts, strict=True)))


@dataclass(frozen=True)
class _View:
    """A surface as the camera sees it."""

    number: NDArray[np.int64]  # (N,) of the faces that are not behind the camera
    faces: NDArray[np.int64]  # (N, 3), these
    screen: _Array  # (V, 2) pixels
    depth: _Array  # (V,) m
    buffer: VisibilityBuffer  # its faces are numbers of ``faces``
    focal: float  # pixels that 1 m takes at a distance of 1 m

    @classmethod
    def of(cls, camera: Camera, surface: Surface, width: int, height: int) -> _View:
        seen = (surface.pos - np.asarray(camera.position)) @ camera.axes().T
        number = np.flatnonzero((seen[surface.faces, 2] > NEAR).all(axis=1))
        faces, depth, focal = surface.faces[number], np.maximum(seen[:, 2], NEAR), camera.focal(height)
        offset = focal * seen[:, :2] / depth[:, None]
        screen = np.stack([0.5 * width + offset[:, 0], 0.5 * height - offset[:, 1]], axis=1)
        buffer = rasterise(screen, 1.0 / (depth + surface.behind), faces, width, height, place="view")
        return cls(number, faces, screen, depth, buffer, focal)

    def first(self) -> NDArray[np.int64]:
        """(H, W) number of the pixel that gives each pixel its colour: the first of its 2 x 2 that sees the same face."""
        height, width = self.buffer.face.shape
        four = self._fours(self.buffer.face)
        first = (four[:, :, None] == four[:, None, :]).argmax(axis=2)
        chosen = np.take_along_axis(self._fours(np.arange(height * width).reshape(height, width)), first, axis=1)
        return np.asarray(chosen.reshape(height // 2, width // 2, 2, 2).swapaxes(1, 2).reshape(height, width))

    @staticmethod
    def _fours(values: NDArray[Any]) -> NDArray[Any]:
        """(H W / 4, 4) of (H, W)."""
        height, width = values.shape
        return values.reshape(height // 2, 2, width // 2, 2).swapaxes(1, 2).reshape(-1, 4)

    def covered(self) -> tuple[NDArray[np.integer], NDArray[np.integer], NDArray[np.int64], _Array]:
        """Row and column (P,) of the pixels that see a face and give it its colour, its corners (P, 3) and their shares
        (P, 3)."""
        own = self.first() == np.arange(self.buffer.face.size).reshape(self.buffer.face.shape)
        row, column = np.nonzero((self.buffer.face >= 0) & own)
        corners = self.faces[self.buffer.face[row, column]]
        weights = barycentric(self.screen, corners, np.stack([column + 0.5, row + 0.5], axis=1)) / self.depth[corners]
        return row, column, corners, np.clip(weights / (weights @ np.ones(3))[:, None], 0.0, 1.0)


def _draw_surface(
    image: _Array, camera: Camera, light: Light, surface: Surface, view: _View, prints: Sequence[tuple[int, Print]]
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
    normal = unit(_blend(weights, surface.normal, corners))
    to_eye = unit(np.asarray(camera.position) - pos)
    a, b, c = (view.screen[view.faces[:, k]] for k in range(3))
    turned = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) > (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    normal[turned[face]] *= -1.0
    foot = np.asarray(1.0 / (view.focal * view.buffer.nearness[row, column]), dtype=np.float64)
    color = sewn((weights * surface.hem[corners]).sum(axis=1), foot)[:, None] * color
    open_share = openness(view.buffer, view.focal, row, column, normal @ axes.T)
    shine = _blend(weights, surface.shine, corners)
    image[row, column] = light.shade(pos, normal, to_eye, color, shine, open_share)
    image[:] = np.where(view.buffer.face[..., None] >= 0, image.reshape(-1, 3)[view.first()], image)


def _seen_values(
    camera: Camera, surface: Surface, view: _View, prints: Sequence[tuple[int, Print]]
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
    arrays += [packed(value) for value in (view.buffer.nearness, AROUND, camera.axes())] + ([] if own is None else [own])
    eye = tuple(float(value) for value in camera.position)
    addresses = [*(address(value) for value in arrays), *([None] if own is None else [])]
    return SeenValues(*addresses, width, height, AROUND.shape[1], eye, view.focal, REACH), arrays


def _vertex_normals(pos: _Array, faces: NDArray[np.int64]) -> _Array:
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


def _creased(pos: _Array, faces: NDArray[np.int64], normal: _Array) -> tuple[NDArray[np.int64], NDArray[np.int64], _Array]:
    """Faces with their own vertices where the mean normal (V, 3) of a vertex is not theirs, as in a pleat; the vertex (V + N,)
    that each stands for, and the normals (N, 3) of the new ones."""
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


def _blend(weights: _Array, values: _Array, corners: NDArray[np.int64]) -> _Array:
    a, b, c = (weights[:, k, None] * values[corners[:, k]] for k in range(3))
    return a + b + c
