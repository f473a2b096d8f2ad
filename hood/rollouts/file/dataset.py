"""Rollouts as training data: windows of frames of many files, read when they are asked for."""

from __future__ import annotations

import json
import os
from collections import Counter, OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from hood.assets.files.library import unknown
from hood.rollouts.file.compact import BodyParameters, BodyWindows, PositionTable, read_parameters

#: Verdicts of rows of a manifest that have frames.
_VERDICTS = ("sound", "doubtful", "unsound", "unjudged")
#: What an item may have of the body.
_BODIES = ("none", "pos", "parameters")
#: Bytes of unpacked chunks of frames that a process keeps.
_KEPT = 64 << 20
#: Settings of a row that do not change the mesh of its garment.
_NOT_OF_MESH = ("seed", "name", "sequence", "material", "body")


class ClothMesh(NamedTuple):
    """The mesh of a rollout's cloth."""

    faces: Tensor  # (F, 3) int64
    rest_pos: Tensor  # (V, 3) m


@dataclass(frozen=True)
class _Source:
    """One rollout: its file, what it is called, its frames, and the settings that its mesh follows from, where known."""

    path: Path
    name: str
    frames: int
    settings: str | None = None


@dataclass
class _Opened:
    """A file that a process has open, and what is the same in all its frames."""

    file: h5py.File
    same: dict[str, Any]
    tables: dict[str, PositionTable] = field(default_factory=dict)
    posed: BodyWindows | None = None

    @cached_property
    def body(self) -> BodyParameters | None:
        """What gives the body back, where the file has that."""
        return read_parameters(self.file)


class RolloutDataset(Dataset[dict[str, Any]]):
    """Windows of frames from many rollouts, for :class:`torch.utils.data.DataLoader`.

    An item is a dictionary; V vertices of the cloth, W of the body, N frames of the window:

    | key | what |
    |---|---|
    | ``cloth_pos`` | (N, V, 3) m, world |
    | ``cloth_vel`` | (N, V, 3) m/s, with ``velocities``: the way from the frame before, by ``dt`` |
    | ``body_pos`` | (N, W, 3) m, world, with ``body="pos"`` |
    | ``body_poses``, ``body_transl``, ``body_betas`` | (N, 24, 3) rad, (N, 3) m and (S,), with ``body="parameters"`` |
    | ``dt`` | s, from one stored frame to the next |
    | ``frame``, ``rollout`` | number of the first frame, number of the rollout |
    | ``name``, ``garment`` | row of the manifest, or the file; the garment's name |
    | ``fabric`` | its constants by name: ``density`` [kg/m²], ``lame_mu``, ``lame_lambda`` [Pa], … |

    :meth:`mesh` gives faces and rest positions of a rollout. :class:`hood.RolloutBatches` makes batches of one garment each, in
    an order that is fast to read.

    Files are opened when they are read, by every worker for itself; at most ``open_files`` stay open. The data set can be
    pickled, and workers may be forked or spawned. Reading the compact layouts
    (``formats=[cloth]``) unpacks eight frames at once.

    Args:
        source: the output folder of ``hood dress``, its ``manifest.jsonl``, or a list of ``rollout.h5`` files or folders.
        window: N, frames of an item.
        stride: frames from the start of a window to that of the next.
        verdict: rows of the manifest that are taken; all of a list of files are.
        frames: first frame and the one after the last that are taken of every rollout; None: all.
        rows: patterns of names of rows, such as ``dress/*``; None: all.
        where: says of a line of the manifest whether its row is taken.
        velocities: with ``cloth_vel``; windows then begin with frame 1.
        body: ``none``, ``pos`` or ``parameters``, which files with ``formats=[cloth]`` have.
        dtype: of the tensors.
        open_files: files that a process keeps open.

    Raises:
        FileNotFoundError: no such file or manifest.
        ValueError: an argument that cannot be used, no window that is left, a file that is no rollout.

    Examples:
        >>> import hood
        >>> _ = hood.rollout(garment="tank", num_frames=4, video="none", sheet=False, formats=["cloth"], output="outputs/small")
        >>> pairs = hood.RolloutDataset(["outputs/small"], window=2, velocities=True)
        >>> len(pairs), tuple(pairs[0]["cloth_pos"].shape)
        (2, (2, 1016, 3))
    """

    def __init__(
        self,
        source: str | Path | Sequence[str | Path],
        window: int = 2,
        stride: int = 1,
        verdict: Sequence[str] = ("sound",),
        *,
        frames: tuple[int, int | None] | None = None,
        rows: Sequence[str] | None = None,
        where: Callable[[Mapping[str, Any]], bool] | None = None,
        velocities: bool = False,
        body: str = "none",
        dtype: torch.dtype = torch.float32,
        open_files: int = 128,
    ) -> None:
        for name, value in (("window", window), ("stride", stride), ("open_files", open_files)):
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(f"{name}={value!r}: give a whole number above 0")
        if body not in _BODIES:
            raise ValueError(unknown("value for body", str(body), _BODIES))
        if (wrong := next((word for word in verdict if word not in _VERDICTS), None)) is not None:
            raise ValueError(f"verdict: {unknown('verdict', str(wrong), _VERDICTS)}")
        self.window, self.stride, self.velocities, self.body, self.dtype = window, stride, velocities, body, dtype
        self._most, self._owner = open_files, os.getpid()
        self._forget()
        listed = not isinstance(source, (str, Path))
        sources = _of_files(source) if listed else _of_manifest(Path(source), verdict, rows, where)  # type: ignore[arg-type]
        first, last = (0, None) if frames is None else frames
        self._begin = max(first, int(velocities))
        counts = []
        for one in sources:
            usable = min(one.frames, one.frames if last is None else last) - self._begin
            counts.append(max(0, (usable - window) // stride + 1))
        self._sources = [one for one, count in zip(sources, counts, strict=True) if count]
        self._ends = np.cumsum([count for count in counts if count], dtype=np.int64)
        if not self._sources:
            raise ValueError(f"{source}: none of {len(sources)} rollouts has {window} frames from frame {self._begin} on")

    @property
    def names(self) -> list[str]:
        """Of the rollouts, by their number."""
        return [one.name for one in self._sources]

    def __len__(self) -> int:
        return int(self._ends[-1])

    def __getitem__(self, index: int) -> dict[str, Any]:
        """Window ``index``. Raises IndexError beyond the last, ValueError and OSError for a file that cannot be read."""
        index = index + len(self) if index < 0 else index
        if not 0 <= index < len(self):
            raise IndexError(f"window {index} of {len(self)}")
        number = int(np.searchsorted(self._ends, index, side="right"))
        place = index - (int(self._ends[number - 1]) if number else 0)
        start = self._begin + place * self.stride
        stop = start + self.window
        opened = self._open(number)
        before = int(self.velocities)
        pos = self._positions(number, opened, "cloth", start - before, stop)
        item: dict[str, Any] = {"cloth_pos": self._tensor(pos[before:])}
        if self.velocities:
            item["cloth_vel"] = self._tensor(np.diff(pos, axis=0) / opened.same["dt"])
        item |= self._body(number, opened, start, stop)
        return item | opened.same | {"frame": start, "rollout": number, "name": self._sources[number].name}

    def windows(self, rollout: int) -> range:
        """The items of a rollout, by its number."""
        return range(int(self._ends[rollout - 1]) if rollout else 0, int(self._ends[rollout]))

    @cached_property
    def graphs(self) -> list[int]:
        """Of the rollouts, by their number: the first of them that has the same faces. Of rows whose garment was made with the
        same settings from the same file, one is read."""
        found: dict[str | int, int] = {}
        first: dict[bytes, int] = {}
        for number, source in enumerate(self._sources):
            key = number if source.settings is None else source.settings
            if key not in found:
                cloth = self._open(number).file["cloth"]
                found[key] = first.setdefault(cloth["faces"][:].tobytes() + b"%d" % len(cloth["rest_pos"]), number)
        return [found[number if one.settings is None else one.settings] for number, one in enumerate(self._sources)]

    def mesh(self, rollout: int) -> ClothMesh:
        """Faces and rest positions of the cloth of a rollout, by its number; equal ones are shared."""
        file = self._open(rollout).file
        faces, rest_pos = file["cloth/faces"][:], file["cloth/rest_pos"][:]
        key = faces.tobytes() + rest_pos.tobytes()
        if key not in self._meshes:
            self._meshes[key] = ClothMesh(torch.as_tensor(faces).long(), torch.as_tensor(rest_pos).to(self.dtype))
        return self._meshes[key]

    def _tensor(self, values: np.ndarray) -> Tensor:
        """A copy: items may be changed, chunks that are kept may not."""
        return torch.from_numpy(np.ascontiguousarray(values)).to(self.dtype, copy=True)

    def _body(self, number: int, opened: _Opened, start: int, stop: int) -> dict[str, Tensor]:
        """What an item has of the body."""
        if self.body == "none":
            return {}
        if self.body == "pos":
            if opened.body is None:
                return {"body_pos": self._tensor(self._positions(number, opened, "body", start, stop))}
            if opened.posed is None:
                opened.posed = BodyWindows(opened.body, torch.float64 if self.dtype == torch.float64 else torch.float32)
            joints = self._chunks((number, "joints"), opened.posed.chunk, opened.posed.joints, start, stop)
            return {"body_pos": opened.posed.surface(joints, start).to(self.dtype).contiguous()}
        if opened.body is None:
            raise ValueError(f"{self._sources[number].path}: has the body's vertices, not its parameters; give body='pos'")
        moved = opened.body.sequence
        tables = {
            "body_poses": moved.poses[start:stop],
            "body_transl": moved.transl[start:stop],
            "body_betas": opened.body.betas,
        }
        return {name: self._tensor(values) for name, values in tables.items()}

    # ---- files --------------------------------------------------------------------------------------------------------

    def _positions(self, number: int, opened: _Opened, part: str, start: int, stop: int) -> np.ndarray:
        """Frames ``start`` to ``stop`` of a part, from chunks that are kept where there are chunks."""
        if part not in opened.tables:
            opened.tables[part] = PositionTable(opened.file, part)
        table = opened.tables[part]
        if table.chunk is None:
            return table.read(start, stop)
        return self._chunks((number, part), table.chunk, table.read, start, stop)

    def _chunks(
        self, key: tuple[int, str], length: int, read: Callable[[int, int], np.ndarray], start: int, stop: int
    ) -> np.ndarray:
        """Rows ``start`` to ``stop`` of what ``read(start, stop)`` gives in chunks of ``length`` rows, which are kept."""
        pieces = []
        for chunk in range(start // length, -(-stop // length)):
            place = (*key, chunk)
            if place not in self._unpacked:
                self._unpacked[place] = read(chunk * length, (chunk + 1) * length)
                self._kept += self._unpacked[place].nbytes
            self._unpacked.move_to_end(place)
            pieces.append(self._unpacked[place][max(0, start - chunk * length) : stop - chunk * length])
        while self._kept > _KEPT:
            self._kept -= self._unpacked.popitem(last=False)[1].nbytes
        return pieces[0] if len(pieces) == 1 else np.concatenate(pieces)

    def _open(self, number: int) -> _Opened:
        if self._owner != os.getpid():  # of a fork: files of the parent are the parent's
            self._forget()
        if number in self._files:
            self._files.move_to_end(number)
            return self._files[number]
        source = self._sources[number]
        opened = _opened(source, self._same.get(number))
        self._files[number], self._same[number] = opened, opened.same
        while len(self._files) > self._most:
            self._files.popitem(last=False)[1].file.close()
        return opened

    def _forget(self) -> None:
        self._owner = os.getpid()
        self._files: OrderedDict[int, _Opened] = OrderedDict()
        self._unpacked: OrderedDict[tuple[int, str, int], np.ndarray] = OrderedDict()
        self._kept = 0
        self._meshes: dict[bytes, ClothMesh] = {}
        self._same: dict[int, dict[str, Any]] = {}  # of files that were open before

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in self.__dict__.items() if key not in ("_files", "_unpacked", "_meshes", "_same")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._forget()


def _opened(source: _Source, known: dict[str, Any] | None = None) -> _Opened:
    """A rollout, open for reading; ``known`` is what was read of it before.

    Raises:
        FileNotFoundError, ValueError: there is none, or another one now.
    """
    if not source.path.is_file():
        raise FileNotFoundError(f"{source.path}: no such file; give the folders that hood dress or hood rollout wrote")
    try:
        file = h5py.File(source.path, "r", rdcc_nbytes=0)  # chunks are read whole, and kept unpacked
    except OSError as error:
        raise ValueError(f"{source.path}: not a rollout file ({error}); make one with hood rollout") from error
    if known is not None:
        return _Opened(file, known)
    try:
        frames = min(int(file.attrs["num_frames"]), len(file["time"]))
        material = json.loads(file.attrs.get("material", "{}"))
        fabric = {key: float(value) for key, value in material.items() if isinstance(value, (int, float))}
        same = {"dt": float(file.attrs["dt"]), "garment": str(file.attrs.get("garment", "")), "fabric": fabric}
    except (KeyError, ValueError, TypeError) as error:
        file.close()
        raise ValueError(f"{source.path}: not a rollout file ({error}); make one with hood rollout") from error
    if source.frames not in (frames, -1):
        file.close()
        raise ValueError(f"{source.path}: has {frames} frames, not {source.frames}; make the data set anew")
    return _Opened(file, same)


def _frames_in(path: Path) -> int:
    opened = _opened(_Source(path, "", -1))
    count = min(int(opened.file.attrs["num_frames"]), len(opened.file["time"]))
    opened.file.close()
    return count


def _of_files(source: Sequence[str | Path]) -> list[_Source]:
    paths = [Path(one).expanduser() for one in source]
    paths = [path / "rollout.h5" if path.is_dir() else path for path in paths]
    return [_Source(path, str(path), _frames_in(path)) for path in paths]


def _of_manifest(
    given: Path, verdict: Sequence[str], rows: Sequence[str] | None, where: Callable[[Mapping[str, Any]], bool] | None
) -> list[_Source]:
    """The rollouts of a manifest that are taken."""
    path = given.expanduser()
    path = path / "manifest.jsonl" if path.is_dir() else path
    if path.suffix == ".h5":
        raise ValueError(f"{given}: one file; give a list, [{str(given)!r}], or the output folder of hood dress")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; give the output folder of hood dress, or a list of rollout.h5")
    lines: dict[str, Mapping[str, Any]] = {}
    for text in path.read_bytes().split(b"\n"):
        try:
            line = json.loads(text)
        except ValueError:  # cut off by a kill
            continue
        if isinstance(line, dict) and {"row", "verdict"} <= {*line}:
            lines[str(line["row"])] = line
    taken = {
        name: line
        for name, line in lines.items()
        if line["verdict"] in verdict
        and (rows is None or any(fnmatchcase(name, pattern) for pattern in rows))
        and (where is None or where(line))
    }
    if not taken:
        counts = Counter(str(line["verdict"]) for line in lines.values())
        found = ", ".join(f"{count} {word}" for word, count in counts.items()) or "no row"
        raise ValueError(f"{path}: no row is taken; it has {found}: give other verdicts, rows or where")
    sources = []
    for name, line in taken.items():
        file, count = path.parent / name / "rollout.h5", int(line.get("stored_frames", -1))
        sources.append(_Source(file, name, count if count >= 0 else _frames_in(file), _mesh_settings(line)))
    return sources


def _mesh_settings(line: Mapping[str, Any]) -> str | None:
    """The settings that the mesh of a row follows from, with the digest of its garment; None where they are not known."""
    settings, digest = line.get("settings"), (line.get("inputs") or {}).get("garment", "none")
    if not isinstance(settings, dict) or digest == "none":
        return None
    return json.dumps([digest, sorted((key, value) for key, value in settings.items() if key not in _NOT_OF_MESH)])
