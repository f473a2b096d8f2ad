"""Rollouts on disk: frames stream into ``rollout.h5``, readable at any moment: by others while it grows, and after a kill."""

from __future__ import annotations

import errno
import json
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import h5py
import numpy as np

from hood.assets.files.guarded import own_dataset, own_group
from hood.assets.garment.garment import Garment
from hood.cloth.cloth import Cloth
from hood.rollouts.file.step_table import RowWriter, StepPlan, StepTable, step_paths, still_step_paths
from hood.scene.holding import Fastening

#: World coordinates beyond this [m] are written in float64: float32 resolves only 8 µm there.
_FAR = 100.0
#: What is said of an alarm, with the types in the file; and how many a frame can have: one of its step, one of its surface.
ALARM_COLUMNS = {
    "frame": np.dtype(np.int32),
    "cause": np.dtype("S16"),
    "value": np.dtype(np.float64),
    "limit": np.dtype(np.float64),
    "repair": np.dtype("S16"),
    "iterations": np.dtype(np.int32),
    "rg_before": np.dtype(np.float64),
    "rg_after": np.dtype(np.float64),
}
#: What files of later versions say beside it of a step; NaN in rows of earlier ones.
STEP_COLUMNS = {name: np.dtype(np.float64) for name in ("strain", "force", "depth")}
#: Alarms of a frame at most: of the step, of triangles in the skin that were taken out, and of the surface that is measured.
_ALARMS = 3
#: What a file may hold of the cloth beside its mesh, the same in all frames, with the types in the file.
STILL = {
    "uv": np.float32,
    "uv_faces": np.int32,
    "piece": np.int32,
    "fastened": np.int32,
    "fastened_row": np.int32,
    "fastened_length": np.float64,
    "rest_length": np.float64,
    "simulated_faces": np.int32,
    "pinned": np.int32,
    "fabric": np.int32,
}


def still_of(garment: Garment, fastening: Fastening | None = None, cloth: Cloth | None = None) -> dict[str, np.ndarray]:
    """What a file holds of the garment and its fasteners beside its mesh, by the names of :data:`STILL`."""
    found = {} if garment.piece is None else {"piece": garment.piece}
    if cloth is not None and cloth.flat is not None:
        found["rest_length"] = cloth.rest_length.double().cpu().numpy()
    if garment.pinned.any():
        found["pinned"] = np.flatnonzero(garment.pinned)
    if fastening is not None:
        pairs = fastening.pairs
        tables = {"fastened": pairs.edges, "fastened_row": fastening.row, "fastened_length": pairs.length}
        found |= {name: table.cpu().numpy() for name, table in tables.items() if table is not None}
    if garment.uv is None:
        return found
    return {**found, "uv": garment.uv, "uv_faces": garment.faces if garment.uv_faces is None else garment.uv_faces}


class Done(NamedTuple):
    """How much of a rollout file was done: frames, simulated ones where these have tables of their own, and alarms."""

    frames: int
    steps: int
    alarms: int


class RolloutWriter:
    """Streams a rollout into an HDF5 file.

    Datasets: ``cloth/pos (T,V,3)``, ``cloth/faces``, ``cloth/rest_pos``, ``body/pos (T,W,3)``, ``body/faces``, ``time (T,)``,
    ``metrics/* (T,)``, of every vertex ``cloth/NAME (T,V)`` for each name in ``fields``, and those of :data:`STILL` that are
    given: texture coordinates ``cloth/uv (U,2)`` with ``cloth/uv_faces (F,3)``, which garment of an outfit a vertex belongs to,
    ``cloth/piece (V,)``, which vertices are held, ``cloth/pinned (P,)``, and pairs of vertices that are fastened to each other,
    ``cloth/fastened (A,2)``, with the number of their row and the distance [m] that they are held at, and of a garment that
    has a flat pattern the lengths of its edges there, ``cloth/rest_length (E,)`` [m], and of several fabrics which of
    the attribute ``fabric_names``, joined by ``+``, a vertex is of, ``cloth/fabric (V,)``; attributes:
    ``num_frames`` done so far of ``num_planned``, ``complete``, and what is given as ``attributes``. Real numbers are float32,
    positions far from the origin float64; with ``double`` the cloth's are float64 anyway, for states that meet an accuracy
    which float32 does not resolve.

    With ``guarded`` there are the alarms of a guard, one a row: ``guard/frame``, ``guard/cause`` and ``guard/repair`` (words of
    :data:`hood.rollouts.checks.guard.CAUSES` and :mod:`hood.rollouts.checks.step_repair`), ``guard/value`` and ``guard/limit``
    (of the
    cause: share of strain or of cut triangles, relative gradient, degrees, m), ``guard/iterations``, ``guard/rg_before``
    and ``guard/rg_after``; of a step also ``guard/strain``, ``guard/force`` and ``guard/depth``. The attribute ``num_alarms``
    counts them; rows beyond it are empty, with the frame -1.

    All datasets are laid out, filled with NaN, before the file takes its name: a full disk shows at once, and later writes
    never touch the file's structure. A frame is counted in ``num_frames`` after its values are written. So whoever opens the
    file at any moment, with plain ``h5py.File(path)``, finds a sound file that ends at ``num_frames``, and a killed process
    leaves one. HDF5's own mode for this (SWMR) would forbid the attributes, need a repair after a kill, and it does not hold
    on network disks. A reader opens the file anew for later frames.
    On a normal close after fewer frames, the file is cut to the frames done.

    With ``steps`` the stored frames are not the simulated ones: these have tables of their own
    (:class:`hood.rollouts.file.step_table.StepTable`), and alarms count them.

    With ``done`` the file at ``path`` is of the same rollout, stopped: so much of it is taken over, and the new file takes its
    place. Where it ``goes_on`` later, frames stay where the disk refuses further ones; else the file goes away then.
    """

    def __init__(
        self,
        path: Path,
        num_frames: int,
        cloth_rest_pos: np.ndarray,
        cloth_faces: np.ndarray,
        body_faces: np.ndarray,
        num_body_vertices: int,
        metric_names: tuple[str, ...],
        dt: float,
        attributes: Mapping[str, Any],
        farthest: float = 0.0,
        fields: Sequence[str] = (),
        double: bool = False,
        guarded: bool = False,
        still: Mapping[str, np.ndarray] | None = None,
        steps: StepPlan | None = None,
        done: Done | None = None,
        goes_on: bool = False,
    ) -> None:
        self.path, self._goes_on = path, goes_on
        self.frames_done = self.alarms_done = 0
        # Windows does not rename a file that is open.
        self._draft = path if sys.platform == "win32" else path.with_name(path.name + ".partial")
        before = path if done is None or self._draft != path else path.replace(path.with_name(path.name + ".before"))
        try:
            self._file = h5py.File(self._draft, "w")
        except OSError as error:
            raise _plain_error(error, path) from error
        try:
            real = np.float64 if farthest > _FAR else np.float32
            cloth_real = np.float64 if double else real
            cloth, body = (num_frames, len(cloth_rest_pos), 3), (num_frames, num_body_vertices, 3)
            for name, shape, kind in (("cloth/pos", cloth, cloth_real), ("body/pos", body, real)):
                self._file.create_dataset(name, shape, dtype=kind, fillvalue=np.nan)
            _lay_out_values(self._file, cloth[:2], fields, metric_names)
            rest_pos = np.asarray(cloth_rest_pos, dtype=np.float64 if double else np.float32)
            _lay_out_still(self._file, rest_pos, cloth_faces, body_faces, still or {})
            self._file["time"] = np.arange(num_frames) * dt
            own = {"dt": dt, "num_frames": 0, "num_planned": num_frames, "complete": False}
            self._steps = None if steps is None else StepTable(self._file, steps, metric_names)
            if guarded:
                own["num_alarms"] = 0
                _lay_out_alarms(self._file, _ALARMS * (num_frames if steps is None else steps.count))
            for key, value in {**own, **attributes}.items():
                self._file.attrs[key] = value if np.isscalar(value) or isinstance(value, np.ndarray) else json.dumps(value)
            self._touch_all()
            by_frame = ("cloth/pos", "body/pos", *_field_paths(self._file), *_metric_paths(self._file))
            self._rows = {name: RowWriter(self._file[name]) for name in by_frame}
            self._take_over(before, done)
            self._file.flush()
            self._take_name()
        except OSError as error:
            self._discard(self._draft)
            raise _plain_error(error, path) from error
        except BaseException:
            self._discard(self._draft)
            raise

    def append(
        self,
        cloth_pos: np.ndarray,
        body_pos: np.ndarray,
        metrics: Mapping[str, float],
        fields: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        """Write one frame: world positions (V, 3) and (W, 3) [m], its metrics and its fields (V,)."""
        frame, rows = self.frames_done, self._rows
        rows["cloth/pos"].write(frame, cloth_pos)
        rows["body/pos"].write(frame, body_pos)
        for name, value in metrics.items():
            rows[f"metrics/{name}"].write(frame, value)
        for name, values in (fields or {}).items():
            rows[f"cloth/{name}"].write(frame, values)
        self._file.flush()  # the frame before its count, for those who read meanwhile
        self.frames_done += 1
        self._file.attrs.modify("num_frames", self.frames_done)
        self._file.flush()

    def append_step(self, cloth_pos: np.ndarray, metrics: Mapping[str, float]) -> None:
        """Write what is known of one simulated frame where stored frames have a rate of their own: from world positions (V, 3)
        [m] and its metrics."""
        assert self._steps is not None
        self._steps.append(cloth_pos, metrics)

    @property
    def done(self) -> Done:
        """How much of the file is done."""
        return Done(self.frames_done, 0 if self._steps is None else self._steps.done, self.alarms_done)

    def append_alarms(self, alarms: Sequence[Mapping[str, Any]]) -> None:
        """Write further alarms, each with the names of :data:`ALARM_COLUMNS`."""
        for alarm in alarms:
            for name, kind in ALARM_COLUMNS.items():
                value = alarm[name]
                self._file[f"guard/{name}"][self.alarms_done] = value.encode() if kind.kind == "S" else value
            for name in STEP_COLUMNS:
                self._file[f"guard/{name}"][self.alarms_done] = alarm.get(name, np.nan)
            self.alarms_done += 1
        if alarms:
            self._file.flush()
            self._file.attrs.modify("num_alarms", self.alarms_done)
            self._file.flush()

    def close(self, complete: bool) -> None:
        """Finish the file; fewer frames than announced are cut off."""
        total = len(self._file["time"])
        self._file.attrs.modify("complete", complete)
        self._file.close()
        if self.frames_done < total:
            _truncate(self.path, self.frames_done, None if self._steps is None else self._steps.done)

    def discard(self) -> None:
        """Close and delete the file: nothing half-written stays behind."""
        self._discard(self.path)

    def _leave(self) -> None:
        """Close the file as a killed process leaves it: to cut it would take space."""
        try:
            self._file.close()
        except (OSError, RuntimeError):
            pass

    def _discard(self, path: Path) -> None:
        try:
            self._file.close()
        except (OSError, RuntimeError):
            pass  # a full disk refuses the final flush too; the file goes away anyway
        path.unlink(missing_ok=True)

    def _take_over(self, before: Path, done: Done | None) -> None:
        """Copy what is done from the file of before, if there is one, and count it."""
        target = self._file
        if done is None:
            return
        with h5py.File(before, "r") as source:
            for name in ("cloth/pos", "body/pos", *_field_paths(target), *_metric_paths(target)):
                _copy_rows(source[name], target[name], done.frames)
            for name in step_paths(target):
                _copy_rows(source[name], target[name], done.steps)
            for name in _alarm_paths(target):
                _copy_rows(source[name], target[name], done.alarms)
        self.frames_done, self.alarms_done = done.frames, done.alarms
        target.attrs.modify("num_frames", done.frames)
        if "num_alarms" in target.attrs:
            target.attrs.modify("num_alarms", done.alarms)
        if self._steps is not None:
            self._steps.begin_after(done.steps)
        if before != self.path:
            target.flush()
            before.unlink()

    def _take_name(self) -> None:
        """Let others read: the layout is on the disk, the file has its name and HDF5's lock on it is given back."""
        descriptor = self._file.id.get_vfd_handle()
        os.fsync(descriptor)
        os.replace(self._draft, self.path)
        if sys.platform != "win32":
            import fcntl

            try:
                fcntl.flock(descriptor, fcntl.LOCK_UN)
            except OSError:
                pass  # a file system without locks: there is none to give back

    def _touch_all(self) -> None:
        # HDF5 lays contiguous data out at the first write; one row is enough to allocate and fill everything.
        tables = (*_field_paths(self._file), *_metric_paths(self._file), *_alarm_paths(self._file), *step_paths(self._file))
        for name in ("cloth/pos", "body/pos", *tables):
            table = self._file[name]
            table[-1] = np.full(table.shape[1:], table.fillvalue)  # of a single value h5py makes a write a vertex

    def __enter__(self) -> RolloutWriter:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self.frames_done == 0 or (isinstance(error, OSError) and not self._goes_on):
            self.discard()
        elif isinstance(error, OSError):
            self._leave()
        else:
            self.close(complete=error is None)
        if isinstance(error, OSError):
            raise _plain_error(error, self.path if error.filename is None else Path(error.filename)) from error


#: Rows that are copied at once.
_COPIED = 64


def _copy_rows(source: h5py.Dataset, target: h5py.Dataset, count: int) -> None:
    for first in range(0, count, _COPIED):
        last = min(first + _COPIED, count)
        target[first:last] = source[first:last]


def _frames_there(file: h5py.File) -> int:
    """Frames done. A network disk may show the count before the values: what is still NaN as laid out is not counted."""
    done = min(int(file.attrs["num_frames"]), len(file["time"]))
    if not bool(file.attrs.get("complete", False)) and "cloth/pos" in file:  # else it was written at once
        while done > 0 and not _is_there(file, done - 1):
            done -= 1
    return max(done, 0)


def _is_there(file: h5py.File, index: int) -> bool:
    """Whether a frame's values have arrived. Cloth that blew up is NaN as well, but its frame has times."""
    cloth = (file["cloth/pos"], *(file[name] for name in _metric_paths(file)))
    return bool(np.isfinite(file["body/pos"][index]).all() and any(np.isfinite(table[index]).any() for table in cloth))


def _field_paths(file: h5py.File) -> list[str]:
    """Values of every vertex in every frame: tables beside the positions, two axes long."""
    known = ("pos", "faces", "rest_pos", *STILL)
    beside = [f"cloth/{name}" for name in own_group(file, "cloth") or () if name not in known]
    return [name for name in beside if own_dataset(file, name).ndim == 2]


def _metric_paths(file: h5py.File) -> list[str]:
    return [f"metrics/{name}" for name in own_group(file, "metrics") or ()]


def _still_paths(file: h5py.File) -> list[str]:
    known = own_group(file, "cloth") or ()
    return [f"cloth/{name}" for name in STILL if name in known]


def _alarm_paths(file: h5py.File) -> list[str]:
    known = own_group(file, "guard") or ()
    return [f"guard/{name}" for name in (*ALARM_COLUMNS, *STEP_COLUMNS) if name in known]


def _lay_out_still(
    file: h5py.File, rest_pos: np.ndarray, cloth_faces: np.ndarray, body_faces: np.ndarray, still: Mapping[str, np.ndarray]
) -> None:
    """What is the same in all frames."""
    file["cloth/faces"], file["cloth/rest_pos"] = np.asarray(cloth_faces, dtype=np.int32), rest_pos
    file["body/faces"] = np.asarray(body_faces, dtype=np.int32)
    for name, values in still.items():
        file.create_dataset(f"cloth/{name}", data=np.asarray(values, dtype=STILL[name]))


def _lay_out_values(file: h5py.File, shape: tuple[int, int], fields: Sequence[str], metric_names: Sequence[str]) -> None:
    """Tables of values of every vertex and of every frame; ``shape`` is (T, V)."""
    for name in fields:
        file.create_dataset(f"cloth/{name}", shape, dtype=np.float32, fillvalue=np.nan)
    for name in metric_names:
        file.create_dataset(f"metrics/{name}", shape[:1], dtype=np.float64, fillvalue=np.nan)


def _lay_out_alarms(file: h5py.File, rows: int) -> None:
    for name, kind in (ALARM_COLUMNS | STEP_COLUMNS).items():
        fill = {"i": -1, "f": np.nan, "S": b""}[kind.kind]
        file.create_dataset(f"guard/{name}", (rows,), dtype=kind, fillvalue=np.array(fill, dtype=kind))


def _plain_error(error: OSError, path: Path) -> OSError:
    """HDF5 buries the reason of a failed write in a long message: the same error with number, reason and file."""
    number = errno.ENOSPC if "errno = 28" in str(error) else error.errno or errno.EIO
    return OSError(number, os.strerror(number), str(path))


def _truncate(path: Path, num_frames: int, num_steps: int | None = None) -> None:
    """Rewrite the file with its first ``num_frames`` frames, of ``num_steps`` simulated ones where these have tables."""
    temporary = path.with_name(path.name + ".partial")
    try:
        with h5py.File(path, "r") as source, h5py.File(temporary, "w") as target:
            for key, value in source.attrs.items():
                target.attrs[key] = value
            per_frame = {"cloth/pos", "body/pos", "time", *_field_paths(source), *_metric_paths(source)}
            for name in ("cloth/faces", "cloth/rest_pos", "body/faces", *_still_paths(source), *still_step_paths(source)):
                target[name] = source[name][:]
            for name in per_frame:
                target[name] = source[name][:num_frames]
            for name in step_paths(source):
                target[name] = source[name][:num_steps]
            for name in _alarm_paths(source):
                target[name] = source[name][:]
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
