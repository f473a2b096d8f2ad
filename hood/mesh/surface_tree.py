"""Closest points on triangle surfaces by a compiled tree of boxes (``hood/native/surface.cpp``)."""

from __future__ import annotations

import ctypes
from collections import deque
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from hood import native
from hood.native.build import NATIVE_FLAGS, BuildError, build

SOURCE = Path(native.__file__).with_name("surface.cpp")
_POINTER, _COUNT = ctypes.c_void_p, ctypes.c_int64


def _fields(text: str, kind: type) -> list[tuple[str, type]]:
    return [(name, kind) for name in text.split()]


class _Tree(ctypes.Structure):
    """``Tree`` of ``surface.cpp``."""

    _fields_ = [
        *_fields("num_faces num_nodes num_leaves", _COUNT),
        *_fields("faces order children leaves boxes corners pos", _POINTER),
        *_fields("around first valence face_edges edge_faces", _POINTER),
        ("edge_width", _COUNT),
    ]


class _Query(ctypes.Structure):
    """``Query`` of ``surface.cpp``."""

    _fields_ = [
        ("count", _COUNT),
        *_fields("points next_pos guess vertex face vertex_dist bary dist", _POINTER),
        *_fields("point normal next_point next_normal", _POINTER),
    ]


#: What is known of a matched point, then and now.
_PLACES = ("point", "normal", "next_point", "next_normal")


class Match(NamedTuple):
    """Closest surface points of N points, as in :class:`hood.mesh.proximity.SurfaceHit`, and the same material points when the
    surface has moved on."""

    vertex: Tensor  # (N,)
    vertex_dist: Tensor  # (N,) m
    face: Tensor  # (N,)
    bary: Tensor  # (N, 3)
    dist: Tensor  # (N,) m
    point: Tensor  # (N, 3) m
    normal: Tensor  # (N, 3) outward unit normals there, interpolated over the face
    next_point: Tensor  # (N, 3) m
    next_normal: Tensor  # (N, 3)


@cache
def library() -> ctypes.CDLL | None:
    """The compiled search; None without a compiler."""
    try:
        lib = build(SOURCE, NATIVE_FLAGS)
    except BuildError:
        return None
    return lib


class SurfaceTree:
    """The tree of some faces of a topology; its arrays serve every search.

    Args:
        faces: (G, 3) int64.
        members: (F,) the faces that are in it, at least one.
        incidence: around, first, valence, face_edges and edge_faces of :class:`hood.mesh.proximity.Incidence`.
        pos: (W, 3) m, a shape to order the faces by.
    """

    def __init__(self, faces: np.ndarray, members: np.ndarray, incidence: Sequence[np.ndarray], pos: np.ndarray) -> None:
        lib = library()
        assert lib is not None
        self._lib = lib
        size = len(members)
        leaves = -(-size // 8)  # all are full but one
        self._arrays = dict(zip(("around", "first", "valence", "face_edges", "edge_faces"), incidence, strict=True))
        self._arrays |= {
            "faces": np.ascontiguousarray(faces, np.int64),
            "order": members.astype(np.int32),
            "children": np.zeros((leaves, 8), np.int32),
            "leaves": np.zeros((leaves, 2), np.int32),
            "boxes": np.zeros((leaves, 6, 8)),
            "corners": np.zeros((leaves, 9, 8)),
            "pos": np.array(pos, np.float64, order="C"),
        }
        self._tree = _Tree(num_faces=size, edge_width=incidence[4].shape[1])
        _point(self._tree, self._arrays)
        centre = np.ascontiguousarray(np.nan_to_num(self._arrays["pos"][faces].mean(axis=1)))
        lib.surface_build(ctypes.byref(self._tree), centre.ctypes.data_as(_POINTER))
        self._guess = np.zeros(0, np.int32)

    def search(self, points: np.ndarray, pos: np.ndarray, next_pos: np.ndarray) -> dict[str, np.ndarray]:
        """Fields of :class:`Match` for ``points`` (N, 3) on the surface at ``pos`` (W, 3), all float64 and C-contiguous."""
        count = len(points)
        self._arrays["pos"][...] = pos
        self._lib.surface_refit(ctypes.byref(self._tree))
        if len(self._guess) != count:
            self._guess = np.full(count, -1, np.int32)
        found: dict[str, np.ndarray] = {name: np.empty(count, np.int64) for name in ("vertex", "face")}
        found |= {"vertex_dist": np.empty(count), "dist": np.empty(count)}
        found |= {name: np.empty((count, 3)) for name in ("bary", *_PLACES)}
        query = _Query(count=count)
        _point(query, {"points": points, "next_pos": next_pos, "guess": self._guess, **found})
        self._lib.surface_search(ctypes.byref(self._tree), ctypes.byref(query))
        return found


def _point(structure: ctypes.Structure, arrays: dict[str, np.ndarray]) -> None:
    for name, array in arrays.items():
        assert array.flags.c_contiguous, f"{name} has gaps"
        setattr(structure, name, array.ctypes.data)


@torch.no_grad()
def search(
    points: Tensor,
    point_scene: Tensor,
    vertices: Tensor,
    faces: Tensor,
    face_scene: Tensor,
    incidence: Sequence[Tensor],
    next_vertices: Tensor,
) -> Match | None:
    """Closest points, scene by scene; None where there is no compiled search, or not for these tensors.

    Args:
        incidence: as for :class:`SurfaceTree`.
        next_vertices: (W, 3) m, where the surface goes.
    """
    if type(points) is not Tensor or points.device.type != "cpu" or library() is None:
        return None
    given, pos, later = _double(points), _double(vertices), _double(next_vertices)
    single = bool((face_scene == face_scene[0]).all()) and bool((point_scene == face_scene[0]).all())
    if single:
        return _found(points, _tree_of(faces, None, face_scene, incidence, pos).search(given, pos, later))
    result = _nothing(len(points))
    for scene in point_scene.unique().tolist():
        rows = (point_scene == scene).numpy().nonzero()[0]
        if bool((face_scene == scene).any()):
            part = _tree_of(faces, scene, face_scene, incidence, pos).search(given[rows], pos, later)
            for name, values in part.items():
                result[name][rows] = values
    return _found(points, result)


def _double(values: Tensor) -> np.ndarray:
    return np.ascontiguousarray(values.detach().numpy(), np.float64)


def _nothing(count: int) -> dict[str, np.ndarray]:
    result: dict[str, np.ndarray] = {name: np.zeros(count, np.int64) for name in ("vertex", "face")}
    result |= {name: np.full(count, np.inf) for name in ("vertex_dist", "dist")}
    return result | {name: np.zeros((count, 3)) for name in ("bary", *_PLACES)}


def _found(points: Tensor, arrays: dict[str, np.ndarray]) -> Match:
    """The arrays as tensors, numbers in the type of ``points``."""
    tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
    return Match(**{name: value.to(points.dtype) if value.is_floating_point() else value for name, value in tensors.items()})


#: Incidence, scene and tree of the last topologies.
_TREES: deque[tuple[Tensor, int | None, SurfaceTree]] = deque(maxlen=16)


def _tree_of(faces: Tensor, scene: int | None, face_scene: Tensor, incidence: Sequence[Tensor], pos: np.ndarray) -> SurfaceTree:
    for key, known, tree in _TREES:
        if key is incidence[0] and known == scene:
            return tree
    members = np.arange(len(faces)) if scene is None else (face_scene == scene).numpy().nonzero()[0]
    arrays = [np.ascontiguousarray(part.numpy(), np.int64) for part in incidence]
    tree = SurfaceTree(faces.numpy(), members, arrays, pos)
    _TREES.append((incidence[0], scene, tree))
    return tree
