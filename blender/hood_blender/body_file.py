"""The captured body: positions are appended frame by frame, then become one ``.npz`` that hood reads."""

from __future__ import annotations

import os
import zipfile
from pathlib import Path

import numpy as np


class BodyFile:
    """Positions of a body that is captured, on disk.

    Args:
        path: the ``.npz`` to be; beside it lies what is captured meanwhile.
        faces: (G, 3) triangles.
    """

    def __init__(self, path: Path, faces: np.ndarray) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path, self.faces = path, faces
        self._whole, self._half = path.with_suffix(".whole"), path.with_suffix(".half")
        for part in (self._whole, self._half):
            part.write_bytes(b"")
        self.num_vertices, self.frames = 0, 0
        self._halves: list[int] = []
        self._last: np.ndarray | None = None
        #: Frames after which the fastest vertex moves farther than asked for.
        self.fast: list[int] = []

    def add(self, pos: np.ndarray, farthest: float) -> None:
        """The next frame, (W, 3) m; ``farthest`` [m] is how far a vertex may move in one."""
        pos = pos.astype("<f4")
        if self._last is not None and float(np.linalg.norm(pos - self._last, axis=1).max()) > farthest:
            self.fast.append(self.frames - 1)
        _append(self._whole, pos)
        self.num_vertices, self._last = len(pos), pos
        self.frames += 1

    def add_half(self, after: int, pos: np.ndarray) -> None:
        """The moment halfway from frame ``after`` to the next one."""
        _append(self._half, pos.astype("<f4"))
        self._halves.append(after)

    def finish(self, fps: float) -> int:
        """Write the ``.npz``: as many samples as there are frames, or twice as many a second where halves were added (those not
        captured lie in the middle). Returns the samples per frame."""
        shape = (-1, self.num_vertices, 3)
        whole = np.fromfile(self._whole, "<f4").reshape(shape)
        each = 2 if self._halves else 1
        if each == 2:
            verts = np.empty((2 * len(whole) - 1, self.num_vertices, 3), "<f4")
            verts[0::2], verts[1::2] = whole, 0.5 * (whole[:-1] + whole[1:])
            verts[2 * np.array(self._halves) + 1] = np.fromfile(self._half, "<f4").reshape(shape)
        else:
            verts = whole
        draft = self.path.with_suffix(".partial")
        with open(draft, "wb") as file:
            np.savez(file, verts=verts, faces=self.faces, fps=np.float64(each * fps))
        os.replace(draft, self.path)
        self.remove_parts()
        return each

    def remove_parts(self) -> None:
        """Remove what lies beside the ``.npz``."""
        for part in (self._whole, self._half, self.path.with_suffix(".partial")):
            part.unlink(missing_ok=True)


def _append(path: Path, pos: np.ndarray) -> None:
    with open(path, "ab") as file:
        file.write(pos.tobytes())


def is_body_file(path: Path) -> bool:
    """Whether a whole capture lies there."""
    return path.is_file() and zipfile.is_zipfile(path)
