"""Runs hood on a stand-in for a CUDA device, on a machine without one: ``import standin`` before ``import hood``.

The device is torch's PrivateUse1 under the name ``standin``, compiled from ``device.cpp`` at the first import into the folder
STANDIN_BUILD. What hood asks of CUDA by name is asked of the stand-in: while a module of hood is imported, ``"cuda"`` in its
text becomes ``"standin"``, ``torch.cuda`` becomes ``torch.standin``, and ``.is_cuda`` likewise. The files stay as they are.

``torch.standin.counts()`` says how often each operation was called, and under ``sync …`` how often the host would have waited.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.abc
import importlib.machinery
import os
import re
import subprocess
import sys
import tempfile
import types
from pathlib import Path

import torch
from torch.utils.cpp_extension import include_paths

_NAME = "standin"
_SOURCE = Path(__file__).with_name("device.cpp")
_FLAGS = ("-O1", "-std=c++20", "-shared", "-fPIC", "-w")


def build(folder: Path) -> Path:
    """The compiled device in ``folder``: made where there is none of this source, compiler and torch."""
    compiler = os.environ.get("CXX", "g++")
    version = subprocess.run([compiler, "--version"], capture_output=True, text=True, check=True).stdout
    parts = (_SOURCE.read_text(encoding="utf-8"), version, torch.__version__, *_FLAGS)
    path = folder / f"standin_{hashlib.sha256(chr(0).join(parts).encode()).hexdigest()[:16]}.so"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        libraries = Path(torch.__file__).parent / "lib"
        with tempfile.TemporaryDirectory(dir=folder) as place:
            made = Path(place) / path.name
            includes = [f"-I{one}" for one in include_paths()]
            linked = [f"-L{libraries}", "-ltorch_cpu", "-lc10"]
            subprocess.run([compiler, *_FLAGS, *includes, str(_SOURCE), *linked, "-o", str(made)], check=True)
            os.replace(made, path)
    return path


torch.ops.load_library(str(build(Path(os.environ.get("STANDIN_BUILD", Path(tempfile.gettempdir()) / "standin_build")))))
device = torch.ops.standin
torch.utils.rename_privateuse1_backend(_NAME)


class _Stream:
    """One queue is all there is: work is done when a call returns."""

    cuda_stream = 0

    def __init__(self, *_: object, **__: object) -> None: ...
    def wait_stream(self, _: object) -> None: ...
    def wait_event(self, _: object) -> None: ...
    def synchronize(self) -> None: ...
    def record_event(self, *_: object) -> None: ...


class _Graph:
    """A recording of device calls; dropped with its memory when the last reference goes."""

    def __init__(self, *_: object, **__: object) -> None:
        self._number = 0

    def begin(self) -> None:
        self._number = device.begin_graph()

    def pool(self) -> None:
        """All memory is one."""

    def replay(self) -> None:
        device.replay(self._number)

    def __del__(self) -> None:
        if self._number:
            device.drop(self._number)


#: Calls of the graphs that were recorded, in their order.
recorded: list[int] = []


@contextlib.contextmanager
def _graph(graph: _Graph, *_: object, **__: object):
    graph.begin()
    try:
        yield
    finally:
        device.end_graph()
    recorded.append(device.length(graph._number))


def _module() -> types.ModuleType:
    module = types.ModuleType(f"torch.{_NAME}")
    given = {
        "is_available": lambda: True,
        "is_initialized": lambda: True,
        "device_count": lambda: 1,
        "current_device": lambda: 0,
        "set_device": lambda _: None,
        "synchronize": lambda *_: device.wait_for("synchronize"),
        "get_rng_state": lambda *_: torch.get_rng_state(),
        "set_rng_state": lambda state, *_: torch.set_rng_state(state),
        "manual_seed_all": lambda _: None,
        "_is_in_bad_fork": lambda: False,
        "get_amp_supported_dtype": lambda: [torch.float16, torch.bfloat16],
        "get_device_name": lambda *_: "stand-in",
        "get_device_capability": lambda *_: (0, 0),
        "is_current_stream_capturing": lambda: device.is_recording(),
        "Stream": _Stream,
        "current_stream": lambda *_: _Stream(),
        "stream": lambda _: contextlib.nullcontext(),
        "CUDAGraph": _Graph,
        "graph": _graph,
        "counts": lambda: dict(device.counts()),
        "forget": lambda: device.forget(),
    }
    vars(module).update(given)
    return module


torch._register_device_module(_NAME, _module())
torch.utils.generate_methods_for_privateuse1_backend(for_storage=True)

#: What is read otherwise while a module of hood is imported.
_OTHERWISE = (
    (re.compile(r"(?<![\w.])torch\.cuda\b"), f"torch.{_NAME}"),
    (re.compile(r"([\"'])cuda\1"), rf"\1{_NAME}\1"),
    (re.compile(r"\.is_cuda\b"), f".is_{_NAME}"),
)


def otherwise(text: str) -> str:
    """A module's text for the stand-in."""
    for pattern, replacement in _OTHERWISE:
        text = pattern.sub(replacement, text)
    return text


class _Loader(importlib.machinery.SourceFileLoader):
    def source_to_code(self, data, path, *, _optimize=-1):  # type: ignore[no-untyped-def,override]
        return super().source_to_code(otherwise(data.decode("utf-8")).encode("utf-8"), path, _optimize=_optimize)

    def get_code(self, fullname):  # type: ignore[no-untyped-def]
        path = self.get_filename(fullname)
        return self.source_to_code(self.get_data(path), path)  # never the cached bytecode, never written


class _Finder(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):  # type: ignore[no-untyped-def]
        if name != "hood" and not name.startswith("hood."):
            return None
        spec = importlib.machinery.PathFinder.find_spec(name, path, target)
        if spec is not None and isinstance(spec.loader, importlib.machinery.SourceFileLoader):
            spec.loader = _Loader(spec.loader.name, spec.loader.path)
        return spec


sys.meta_path.insert(0, _Finder())
