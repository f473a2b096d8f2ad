"""glTF 2.0 containers (``.glb``, ``.gltf`` with its ``.bin`` files): the document and its tables of numbers.

The triangles of all meshes of a scene, in its world.
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hood.assets.files.guarded import Refused, check_size, guarded
from hood.assets.files.library import SIZE_LIMIT
from hood.assets.files.text import decoded_text_file
from hood.assets.formats.raw_mesh import RawMesh, Unreadable, join_meshes, named_polygons, unit_colours

_DTYPES = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
_LARGEST = {5120: 127, 5121: 255, 5122: 32767, 5123: 65535, 5125: 4294967295}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_JSON_CHUNK, _BIN_CHUNK = 0x4E4F534A, 0x004E4942
#: Compressed geometry that this reader does not unpack; every exporter can leave it out.
_COMPRESSED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression")
#: Entries of one table; a character has some hundred thousand.
_MAX_ENTRIES = 50_000_000
#: Characters of a buffer's file name at most.
_LONGEST_NAME = 1024


@dataclass(frozen=True)
class Gltf:
    """A parsed file; tables are read on demand."""

    path: Path
    document: dict[str, Any]
    buffers: tuple[bytes, ...]

    def items(self, kind: str) -> list[dict[str, Any]]:
        """Entries of ``"nodes"``, ``"meshes"``, ``"skins"``, ``"animations"``…; empty where the file has none."""
        entries = self.document.get(kind, [])
        if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
            raise Refused(f"{kind} is not a list of objects; the file is damaged")
        return entries

    def item(self, kind: str, index: Any) -> dict[str, Any]:
        """Entry ``index``.

        Raises:
            Refused: there is none.
        """
        entries = self.items(kind)
        if not isinstance(index, int) or not 0 <= index < len(entries):
            raise Refused(f"refers to {kind} {index!r} of {len(entries)}; the file is damaged")
        return entries[index]

    def table(self, accessor: Any) -> np.ndarray:
        """Accessor as (count, width); normalised integers become reals in [-1, 1] or [0, 1].

        Raises:
            Refused: unknown types, or beyond the buffer.
        """
        spec = self.item("accessors", accessor)
        count, dtype, width = spec["count"], np.dtype(_DTYPES[spec["componentType"]]).newbyteorder("<"), _WIDTHS[spec["type"]]
        if not isinstance(count, int) or not 0 <= count * width <= _MAX_ENTRIES:
            raise Refused(f"accessor {accessor} claims {count!r} entries; the file is damaged")
        if "bufferView" in spec:
            values = self._view(spec["bufferView"], spec.get("byteOffset", 0), count, width, dtype)
        else:
            values = np.zeros((count, width), dtype)
        if "sparse" in spec:
            values = self._with_sparse(values, spec["sparse"], dtype)
        if spec.get("normalized", False) and dtype.kind in "iu":
            return np.maximum(values.astype(np.float64) / _LARGEST[spec["componentType"]], -1.0)
        return values.astype(np.float64 if dtype.kind == "f" else np.int64)

    def _view(self, index: Any, offset: int, count: int, width: int, dtype: np.dtype) -> np.ndarray:
        view = self.item("bufferViews", index)
        start, length = view.get("byteOffset", 0), view["byteLength"]
        if min(start, length, offset) < 0 or start + length > len(self.buffers[view["buffer"]]):
            raise Refused(f"bufferView {index} lies beyond its buffer; the file is damaged or cut off")
        content = self.buffers[view["buffer"]][start : start + length]
        stride = view.get("byteStride", width * dtype.itemsize)
        if stride < width * dtype.itemsize or (count and offset + (count - 1) * stride + width * dtype.itemsize > length):
            raise Refused(f"bufferView {index} is shorter than the {count} entries it should hold; the file is damaged")
        return np.ndarray((count, width), dtype, content, offset, (stride, dtype.itemsize)).copy()

    def _with_sparse(self, values: np.ndarray, spec: dict[str, Any], dtype: np.dtype) -> np.ndarray:
        count, where, what = spec["count"], spec["indices"], spec["values"]
        if not isinstance(count, int) or not 0 <= count <= len(values):
            raise Refused(f"a sparse accessor replaces {count!r} of {len(values)} entries; the file is damaged")
        index_type = np.dtype(_DTYPES[where["componentType"]]).newbyteorder("<")
        rows = self._view(where["bufferView"], where.get("byteOffset", 0), count, 1, index_type)[:, 0]
        values[rows] = self._view(what["bufferView"], what.get("byteOffset", 0), count, values.shape[1], dtype)
        return values


def read_gltf(path: Path) -> Gltf:
    """A ``.glb`` or ``.gltf`` file with its buffers; nothing is fetched from outside the file's folder.

    Raises:
        ValueError: damaged, too large, compressed geometry, or buffers elsewhere; names the file and the fix.
    """
    check_size(path, SIZE_LIMIT)
    return guarded(path, "glTF file", lambda: _read(path))


def _read(path: Path) -> Gltf:
    content = path.read_bytes()
    binary: bytes | None = None
    if content[:4] == b"glTF":
        chunks = _chunks(content)
        if _JSON_CHUNK not in chunks:
            raise Refused("no JSON chunk; the file is damaged")
        text, binary = chunks[_JSON_CHUNK], chunks.get(_BIN_CHUNK)
    else:
        text = content
    document = json.loads(decoded_text_file(text))
    if not isinstance(document, dict):
        raise Refused("its document is no object; the file is damaged")
    for name in document.get("extensionsRequired", []):
        if name in _COMPRESSED:
            raise Refused(f"geometry is compressed ({name}); export it without mesh compression")
    buffers = []
    for index, spec in enumerate(document.get("buffers", [])):
        data = binary if index == 0 and "uri" not in spec and binary is not None else _buffer(path, index, spec.get("uri"))
        if len(data) < spec["byteLength"]:
            raise Refused(f"buffer {index} has {len(data)} bytes of {spec['byteLength']}; the file is cut off, copy it again")
        buffers.append(data)
    return Gltf(path, document, tuple(buffers))


def _chunks(content: bytes) -> dict[int, bytes]:
    version, length = struct.unpack_from("<II", content, 4)
    if version != 2:
        raise Refused(f"glTF version {version}; export it as glTF 2.0")
    if length > len(content):
        raise Refused(f"has {len(content)} bytes of {length}; the file is cut off, copy it again")
    found: dict[int, bytes] = {}
    place = 12
    while place + 8 <= length:
        size, kind = struct.unpack_from("<II", content, place)
        if place + 8 + size > length:
            raise Refused("a chunk reaches beyond the file; the file is damaged")
        found.setdefault(kind, content[place + 8 : place + 8 + size])
        place += 8 + size
    return found


def _buffer(path: Path, index: int, uri: Any) -> bytes:
    if not isinstance(uri, str):
        raise Refused(f"buffer {index} is nowhere; the file is damaged")
    if uri.startswith("data:"):
        return base64.b64decode(uri.partition(",")[2], validate=True)
    if len(uri) > _LONGEST_NAME:
        raise Refused(f"buffer {index} has a name of {len(uri)} characters; the file is damaged")
    file = (path.parent / uri).resolve()
    # A document may name any file of the machine, or an address on the network; neither is part of a mesh.
    if "://" in uri or not file.is_relative_to(path.parent.resolve()):
        raise Refused(f"buffer {index} is {uri[:60]!r}, outside the file's folder; export it as one .glb")
    if not file.is_file():
        raise Refused(f"buffer {index} is the file {uri[:60]!r}, which is missing; put it beside, or export as one .glb")
    check_size(file, SIZE_LIMIT)
    return file.read_bytes()


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
    joined = join_meshes(parts)
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
