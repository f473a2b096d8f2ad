"""glTF 2.0 containers (``.glb``, ``.gltf`` with its ``.bin`` files): the document and its tables of numbers."""

from __future__ import annotations

import base64
import json
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hood.assets.files.guarded import Refused, check_size, guarded
from hood.assets.files.library import SIZE_LIMIT
from hood.assets.files.text import decoded_text_file

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
