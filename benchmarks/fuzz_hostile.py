"""Files made to do harm: to run code, to reach files outside their folder, or to use up memory and time."""

from __future__ import annotations

import io
import json
import os
import pickle
import struct
import zipfile
import zlib
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from fuzz_inputs import Sample, gltf, rollout

from hood.testing import cylinder

#: Bytes that the bombs unpack to.
_BOMB = 12 << 30
#: Tables of a rollout; of another moving mesh only the first two are read.
_KEYS = ("body/pos", "body/faces", "cloth/pos", "cloth/faces", "metrics/strain_p50")
_SETTINGS = {"schedule": "1x(mesh)", "latent_dim": 2}


class Execute:
    """Pickles to a call."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.call = function, arguments

    def __reduce__(self) -> Any:
        return self.call


def pickles(mark: Path) -> list[bytes]:
    """Pickles that would leave ``mark`` behind: by a command, by code, and hidden in what looks like data."""
    command, code = f"touch {mark}", f"open({str(mark)!r}, 'w').close()"
    system, evaluate = Execute(os.system, command), Execute(eval, code)
    nested = Execute(map, Execute(getattr, Execute(__import__, "os"), "system"), [command])
    contents = [system, evaluate, Execute(exec, code), nested, {"dress": {"rest_pos": system, "faces": evaluate}}]
    contents += [{"poses": np.array([system], dtype=object), "trans": nested}, [evaluate], {system: 1}]
    contents += [{"verts": Execute(pickle.loads, pickle.dumps(system)), "faces": evaluate}]
    return [pickle.dumps(content, protocol) for content in contents for protocol in (0, 2, 4)] + [
        f"cos\nsystem\n(S'{command}'\ntR.".encode(),
        f"c__builtin__\neval\n(S{code!r}\ntR.".encode(),
    ]


def archives(mark: Path) -> list[bytes]:
    """NumPy archives with pickles in them, with bombs, and with headers that promise too much."""
    objects = np.array([Execute(os.system, f"touch {mark}")], dtype=object)
    keys = ("rest_pos", "faces", "poses", "trans", "verts", "v_template", "f", "weights")
    with_pickles = io.BytesIO()
    np.savez(with_pickles, **dict.fromkeys(keys, objects))
    huge = _npy_header((_BOMB // 8,))
    liar = io.BytesIO()
    with zipfile.ZipFile(liar, "w") as file:
        for key in keys:
            file.writestr(f"{key}.npy", huge + bytes(64))
    return [with_pickles.getvalue(), liar.getvalue(), _zip_bomb(keys, huge)]


def torch_bomb() -> bytes:
    """A zip archive whose pickle unpacks to more than the memory."""
    return _zip_bomb(("archive/data.pkl",), b"")


def tables(keys: Sequence[str], outside: Path) -> list[bytes]:
    """Rollouts of which a table lies in ``outside``, does not exist, or unpacks to more than the memory."""
    made = []
    for key in keys:
        made.append(_relinked(key, lambda file, key: _set(file, key, h5py.ExternalLink(str(outside), key))))
        made.append(_relinked(key, lambda file, key: _set(file, key, h5py.ExternalLink("/dev/stdin", key))))
        made.append(_relinked(key, lambda file, key: _virtual(file, key, outside)))
        made.append(_relinked(key, lambda file, key: _stored_outside(file, key, outside)))
        made.append(_relinked(key, _unwritten))
        made.append(_relinked(key, _compressed_bomb))
        made.append(_relinked(key, lambda file, key: _set(file, key, h5py.SoftLink("/" + key))))
    return made


def documents(outside: Path) -> list[bytes]:
    """glTF files whose buffers lie outside their folder."""
    pos, faces = cylinder(6, 3)
    uris = [
        f"../{outside.name}", str(outside), f"file://{outside}", "http://127.0.0.1:9/b.bin", "https://example.org/b.bin",
        f"sub/../../{outside.name}", f"..\\{outside.name}", "/dev/zero", "/proc/self/environ", "//example.org/b.bin",
        f"%2e%2e/{outside.name}", "\0", "a" * 100_000,
    ]  # fmt: skip
    return [gltf(pos, faces, uri) for uri in uris]


def texts() -> dict[str, list[bytes]]:
    """By ending: nesting without end, references that multiply, numbers without end."""
    laughs = ["a: &a [x, x, x, x, x, x, x, x, x]"]
    laughs += [f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]" for a, b in zip("abcdefghijkl", "bcdefghijklm", strict=True)]
    deep = b"[" * 100_000
    return {
        "json": [deep, b"[" + b"9" * 1_000_000 + b"]", b'{"a":' * 100_000, b"[1e999999999, 1]"],
        "gltf": [deep, b'{"a":' * 100_000, b'{"nodes": [{"children": [0]}], "scenes": [{"nodes": [0]}], "scene": 0}'],
        "yaml": [
            "\n".join(laughs).encode(),
            b"seed: !!python/object/apply:os.system ['true']",
            b"seed: ${oc.env:HOME}",
            b"seed: ${seed}",
            deep,
        ],
        "txt": [b"9" * 1_000_000, b"1 " * 1_000_000 + b"x"],
        "obj": [b"v 1 2 3\n" * 3 + b"f " + b"1 " * 200_000, b"v " + b"9" * 1_000_000 + b" 0 0\nf 1 1 1"],
        "off": [b"OFF\n999999999999 999999999999 0\n", b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n99999999999 0 1 2\n"],
        "ply": [
            b"ply\nformat ascii 1.0\nelement vertex 99999999999999\nproperty float x\nproperty float y\nproperty float z\n"
            b"element face 1\nproperty list uchar int vertex_indices\nend_header\n",
            b"ply\nformat binary_little_endian 1.0\n"
            + b"element face 4000000000\nproperty list uint int v\n" * 50
            + b"end_header\n",
        ],
        "stl": [b"\0" * 80 + b"\xff\xff\xff\xff" + bytes(100)],
    }  # fmt: skip


def weights() -> list[bytes]:
    """Model files that name models larger than the memory."""
    asked: list[dict[str, Any]] = [
        {**_SETTINGS, "latent_dim": 10**6},
        {**_SETTINGS, "latent_dim": 10**30},
        {**_SETTINGS, "latent_dim": -3},
        {**_SETTINGS, "schedule": "100000000x(mesh)"},
        {**_SETTINGS, "schedule": "99999x(mesh,coarse0)"},
        {**_SETTINGS, "schedule": ["mesh"]},
        {**_SETTINGS, "latent_dim": "text"},
        {"_target_": "os.system", "command": "true"},
        {},
    ]
    return [_safetensors({"format": "hood-1", "model": text}) for text in (*map(json.dumps, asked), "[" * 100_000, "null")]


@cache
def hostile(sample: Sample, mark: Path, outside: Path) -> list[bytes]:
    """The harmful files that a reader may be given, in an order that is always the same."""
    by_suffix = texts()
    if sample.names_file:
        found = list(by_suffix.get(sample.suffix, []))
    else:
        found = [b"+x=${oc.env:HOME}", b"losses._target_=os.system", b"garment=" + b"[" * 3000, b"seed=" + b"9" * 100_000]
    return (
        found
        + {
            "pkl": lambda: pickles(mark),
            "pth": lambda: [*pickles(mark), torch_bomb()],
            "npz": lambda: archives(mark),
            "h5": lambda: tables(_KEYS if sample.reader == "rollout" else _KEYS[:2], outside),
            "gltf": lambda: documents(outside),
            "safetensors": weights,
        }.get(sample.suffix, list[bytes])()
    )


def _npy_header(shape: tuple[int, ...]) -> bytes:
    text = repr({"descr": "<f8", "fortran_order": False, "shape": shape}).encode()
    text += b" " * (-(len(text) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


def _zip_bomb(keys: tuple[str, ...], begin: bytes) -> bytes:
    """Entries of zeros, each of :data:`_BOMB` bytes in a thousandth of them; the sizes are as they are, the sums are not."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    head = packer.compress(begin) + packer.flush(zlib.Z_FULL_FLUSH)
    block = packer.compress(bytes(1 << 24)) + packer.flush(zlib.Z_FULL_FLUSH)
    count = 64  # of the blocks that are there: the rest is claimed only, so that the file stays small
    data = head + block * count + packer.flush()
    file, directory = io.BytesIO(), b""
    for key in keys:
        name, start = (key if "." in key else f"{key}.npy").encode(), file.tell()
        extra = struct.pack("<HHQ", 1, 8, _BOMB + len(begin))
        sizes = (len(data), 0xFFFFFFFF, len(name), len(extra))
        file.write(b"PK\x03\x04" + struct.pack("<HHHHHIIIHH", 20, 0, 8, 0, 0, 0, *sizes) + name + extra + data)
        entry = struct.pack("<HHHHHHIIIHHHHHII", 20, 20, 0, 8, 0, 0, 0, *sizes, 0, 0, 0, 0, start)
        directory += b"PK\x01\x02" + entry + name + extra
    place = file.tell()
    end = struct.pack("<HHHHIIH", 0, 0, len(keys), len(keys), len(directory), place, 0)
    file.write(directory + b"PK\x05\x06" + end)
    return file.getvalue()


def _relinked(key: str, change: Any) -> bytes:
    content = io.BytesIO(rollout(*cylinder(6, 3)))
    with h5py.File(content, "r+") as file:
        change(file, key)
    return content.getvalue()


def _set(file: h5py.File, key: str, value: Any) -> None:
    del file[key]
    file[key] = value


def _virtual(file: h5py.File, key: str, outside: Path) -> None:
    old = file[key]
    layout = h5py.VirtualLayout(old.shape, old.dtype)
    layout[...] = h5py.VirtualSource(str(outside), key, old.shape, old.dtype)
    del file[key]
    file.create_virtual_dataset(key, layout)


def _stored_outside(file: h5py.File, key: str, outside: Path) -> None:
    old = file[key]
    shape, dtype, size = old.shape, old.dtype, old.size * old.dtype.itemsize
    del file[key]
    file.create_dataset(key, shape, dtype, external=[(str(outside), 0, size)])


def _unwritten(file: h5py.File, key: str) -> None:
    shape = (*file[key].shape[:-1], _BOMB // 8) if file[key].ndim == 1 else (_BOMB // 24, *file[key].shape[1:])
    del file[key]
    file.create_dataset(key, shape, np.float64, chunks=True)


def _compressed_bomb(file: h5py.File, key: str) -> None:
    """A thousand times as many numbers as bytes: the extent is honest."""
    rest = file[key].shape[1:]
    del file[key]
    rows = (48 << 20) // int(np.prod(rest, initial=1)) // 8
    file.create_dataset(key, (rows * 80, *rest), np.float64, chunks=(rows, *rest), compression="gzip")
    file[key][:rows] = 0.0


def _safetensors(metadata: dict[str, str]) -> bytes:
    tensor = {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]}
    text = json.dumps({"__metadata__": metadata, "x": tensor}).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text + bytes(4)
