"""The triangles of all meshes of a glTF scene, in its world."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hood.assets.formats.gltf import Gltf, read_gltf
from hood.assets.formats.raw_mesh import RawMesh, Unreadable, named_polygons, unit_colours

_READ = ("POSITION", "TEXCOORD_0", "NORMAL", "COLOR_0")
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
#: Nodes deeper than this, or more of them, are a cycle or an attack.
_DEPTH_LIMIT, _NODE_LIMIT = 100, 100_000


def read_glb(path: Path) -> RawMesh:
    """Every mesh of the scene, placed by its nodes; skins and morph targets at rest, textures passed over.

    Raises:
        ValueError: not a glTF file, a compressed mesh, an index out of range, or no triangles.
    """
    gltf = read_gltf(path)
    parts, names = [], []
    for mesh, transform, name in _placed_meshes(gltf):
        for primitive in gltf.item("meshes", mesh).get("primitives", []):
            if primitive.get("mode", _TRIANGLES) in (_TRIANGLES, _STRIP, _FAN):
                parts.append(_primitive(gltf, primitive, transform))
                names.append((name or str(gltf.item("meshes", mesh).get("name", "")), _material(gltf, primitive)))
    if not parts:
        raise Unreadable("the scene has no mesh of triangles")
    joined = _join(parts)
    of_polygons = np.repeat(np.arange(len(parts)), [len(part.counts) for part in parts])
    joined.panels, notes = named_polygons([tuple(filter(None, own)) for own in names], of_polygons)
    joined.notes += notes
    return joined


def _material(gltf: Gltf, primitive: dict[str, Any]) -> str:
    """The name of a primitive's material; "" for none."""
    if "material" not in primitive:
        return ""
    return str(gltf.item("materials", primitive["material"]).get("name", ""))


def node_matrix(node: dict[str, Any]) -> np.ndarray:
    """Transform (4, 4) of a node relative to its parent: its matrix, or translation · rotation · scale."""
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    matrix = np.eye(4)
    if "rotation" in node:
        matrix[:3, :3] = Rotation.from_quat(node["rotation"]).as_matrix()
    matrix[:3, :3] *= np.array(node.get("scale", (1.0, 1.0, 1.0)), dtype=np.float64)
    matrix[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return matrix


def _placed_meshes(gltf: Gltf) -> Iterator[tuple[int, np.ndarray, str]]:
    """Mesh number, world transform (4, 4) and name of every node that has a mesh; every mesh where there is no scene."""
    nodes = gltf.items("nodes")
    if not nodes:
        yield from ((mesh, np.eye(4), "") for mesh in range(len(gltf.items("meshes"))))
        return
    scene = gltf.item("scenes", gltf.document.get("scene", 0)) if gltf.items("scenes") else {}
    children = {child for node in nodes for child in node.get("children", [])}
    roots = scene.get("nodes", [index for index in range(len(nodes)) if index not in children])
    waiting = [(root, np.eye(4), 0) for root in reversed(roots)]
    seen = 0
    while waiting:
        index, parent, depth = waiting.pop()
        seen += 1
        if depth > _DEPTH_LIMIT or seen > _NODE_LIMIT:
            raise Unreadable("the nodes form a cycle; a scene is a tree")
        node = gltf.item("nodes", index)
        # A skinned mesh ignores the place of its node.
        world = parent @ node_matrix(node)
        if "mesh" in node:
            yield node["mesh"], np.eye(4) if "skin" in node else world, str(node.get("name", ""))
        waiting.extend((child, world, depth + 1) for child in reversed(node.get("children", [])))


def _primitive(gltf: Gltf, primitive: dict[str, Any], transform: np.ndarray) -> RawMesh:
    attributes = primitive.get("attributes", {})
    if "POSITION" not in attributes:
        raise Unreadable("a primitive has no POSITION")
    columns = {name: gltf.table(attributes[name]) for name in _READ if name in attributes}
    pos = columns["POSITION"][:, :3].astype(np.float64)
    for name, column in columns.items():
        if len(column) != len(pos):
            raise Unreadable(f"{name} has {len(column)} rows for {len(pos)} vertices")
    indices = gltf.table(primitive["indices"])[:, 0] if "indices" in primitive else np.arange(len(pos))
    corners = _as_triangles(indices.astype(np.int64), primitive.get("mode", _TRIANGLES)).reshape(-1)
    mesh = RawMesh(pos @ transform[:3, :3].T + transform[:3, 3], corners, np.full(len(corners) // 3, 3, dtype=np.int64))
    if "TEXCOORD_0" in columns:
        # glTF counts v from the top, the other formats from the bottom.
        mesh.uv, mesh.uv_corners = columns["TEXCOORD_0"][:, :2] * [1.0, -1.0] + [0.0, 1.0], corners
    if "NORMAL" in columns:
        mesh.normals, mesh.normal_corners = columns["NORMAL"][:, :3].astype(np.float64), corners
    if "COLOR_0" in columns:
        mesh.colours = unit_colours(columns["COLOR_0"][:, :3])
    return mesh


def _as_triangles(indices: np.ndarray, mode: int) -> np.ndarray:
    if mode == _TRIANGLES:
        return indices[: len(indices) // 3 * 3].reshape(-1, 3)
    number = np.arange(max(len(indices) - 2, 0))
    if mode == _FAN:
        return np.stack([np.broadcast_to(indices[:1], number.shape), indices[number + 1], indices[number + 2]], axis=1)
    odd = number % 2
    return np.stack([indices[number], indices[number + 1 + odd], indices[number + 2 - odd]], axis=1)


def _join(parts: list[RawMesh]) -> RawMesh:
    """Several primitives as one mesh; what only some of them have is not kept, and noted."""
    if len(parts) == 1:
        return parts[0]
    offsets = np.cumsum([0, *(len(part.pos) for part in parts)])
    corners = np.concatenate([part.corners + offset for part, offset in zip(parts, offsets, strict=False)])
    joined = RawMesh(np.concatenate([part.pos for part in parts]), corners, np.concatenate([part.counts for part in parts]))
    for name, what in (("uv", "texture coordinates"), ("normals", "normals"), ("colours", "colours")):
        tables = [getattr(part, name) for part in parts]
        if all(table is not None for table in tables):
            setattr(joined, name, np.concatenate(tables))
        elif any(table is not None for table in tables):
            joined.notes.append(f"only some parts have {what}; they are not kept")
    joined.uv_corners = corners if joined.uv is not None else None
    joined.normal_corners = corners if joined.normals is not None else None
    return joined
