"""Rollouts on disk: frames stream into ``rollout.h5``, readable at any moment: by others while it grows, and after a kill."""

from __future__ import annotations

import errno
import json
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

import h5py
import numpy as np

from hood.assets.files.guarded import own_dataset, own_group
from hood.assets.garment.garment import Garment
from hood.rollouts.file.step_table import RowWriter, StepPlan, Steps, StepTable, read_steps, step_paths, still_step_paths
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
    "simulated_faces": np.int32,
    "pinned": np.int32,
}


def still_of(garment: Garment, fastening: Fastening | None = None) -> dict[str, np.ndarray]:
    """What a file holds of the garment and its fasteners beside its mesh, by the names of :data:`STILL`."""
    found = {} if garment.piece is None else {"piece": garment.piece}
    if garment.pinned.any():
        found["pinned"] = np.flatnonzero(garment.pinned)
    if fastening is not None:
        pairs = fastening.pairs
        tables = {"fastened": pairs.edges, "fastened_row": fastening.row, "fastened_length": pairs.length}
        found |= {name: table.cpu().numpy() for name, table in tables.items() if table is not None}
    if garment.uv is None:
        return found
    return {**found, "uv": garment.uv, "uv_faces": garment.faces if garment.uv_faces is None else garment.uv_faces}


class RolloutWriter:
    """Streams a rollout into an HDF5 file.

    Datasets: ``cloth/pos (T,V,3)``, ``cloth/faces``, ``cloth/rest_pos``, ``body/pos (T,W,3)``, ``body/faces``, ``time (T,)``,
    ``metrics/* (T,)``, of every vertex ``cloth/NAME (T,V)`` for each name in ``fields``, and those of :data:`STILL` that are
    given: texture coordinates ``cloth/uv (U,2)`` with ``cloth/uv_faces (F,3)``, which garment of an outfit a vertex belongs to,
    ``cloth/piece (V,)``, which vertices are held, ``cloth/pinned (P,)``, and pairs of vertices that are fastened to each other,
    ``cloth/fastened (A,2)``, with the number of their row and the distance [m] that they are held at; attributes:
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
    ) -> None:
        self.path = path
        self.frames_done = self.alarms_done = 0
        # Windows does not rename a file that is open.
        self._draft = path if sys.platform == "win32" else path.with_name(path.name + ".partial")
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
            self._file["cloth/faces"] = np.asarray(cloth_faces, dtype=np.int32)
            self._file["cloth/rest_pos"] = np.asarray(cloth_rest_pos, dtype=np.float64 if double else np.float32)
            self._file["body/faces"] = np.asarray(body_faces, dtype=np.int32)
            for name, values in (still or {}).items():
                self._file.create_dataset(f"cloth/{name}", data=np.asarray(values, dtype=STILL[name]))
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

    def _discard(self, path: Path) -> None:
        try:
            self._file.close()
        except (OSError, RuntimeError):
            pass  # a full disk refuses the final flush too; the file goes away anyway
        path.unlink(missing_ok=True)

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
            self._file[name][-1] = self._file[name].fillvalue

    def __enter__(self) -> RolloutWriter:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if isinstance(error, OSError) or self.frames_done == 0:
            self.discard()
            if isinstance(error, OSError):
                raise _plain_error(error, self.path) from error
        else:
            self.close(complete=error is None)


@dataclass(frozen=True)
class Refined:
    """The simulated mesh of a rollout that stores a finer one (:class:`hood.mesh.editing.subdivision.Subdivision`)."""

    times: int  # that every face was cut into four
    num_coarse: int  # simulated vertices, the first of those stored
    faces: np.ndarray  # (F, 3) between them


@dataclass(frozen=True)
class RolloutData:
    """A rollout read back; arrays hold the frames done."""

    cloth_pos: np.ndarray  # (T, V, 3) m, world
    cloth_faces: np.ndarray  # (F, 3)
    rest_pos: np.ndarray  # (V, 3) m
    body_pos: np.ndarray  # (T, W, 3) m, world
    body_faces: np.ndarray  # (G, 3)
    time: np.ndarray  # (T,) s
    metrics: dict[str, np.ndarray]
    attributes: dict[str, Any]
    fields: dict[str, np.ndarray] = field(default_factory=dict)  # (T, V) by name, such as rg
    alarms: list[dict[str, Any]] = field(default_factory=list)  # of a guard, with the names of ALARM_COLUMNS
    still: dict[str, np.ndarray] = field(default_factory=dict)  # of the cloth, by the names of STILL
    steps: Steps | None = None  # all simulated frames, where those stored have a rate of their own (``output_fps``)

    @property
    def refined(self) -> Refined | None:
        """The simulated mesh where the stored one is finer; None where it is the same."""
        faces = self.still.get("simulated_faces")
        if faces is None:
            return None
        return Refined(int(self.attributes["refine_mesh"]), int(self.attributes["simulated_vertices"]), faces)

    @property
    def riding(self) -> tuple[int, int]:
        """How many vertices and faces of the cloth, the last ones, ride on it and are not simulated, as those of buttons."""
        return int(self.attributes.get("riding_vertices", 0)), int(self.attributes.get("riding_faces", 0))

    @property
    def step_metrics(self) -> dict[str, np.ndarray]:
        """(S,) by name: of every simulated frame, stored or not."""
        return self.metrics if self.steps is None else self.steps.metrics

    @property
    def step_finite(self) -> np.ndarray:
        """(S,) bool: simulated frames whose positions are all finite."""
        return np.isfinite(self.cloth_pos).all(axis=(1, 2)) if self.steps is None else self.steps.finite

    @property
    def step_time(self) -> np.ndarray:
        """(S,) s: moments of the simulated frames."""
        return self.time if self.steps is None else self.steps.time

    def step_pos(self, vertices: np.ndarray) -> np.ndarray:
        """(S, N, 3) m: where vertices (N,) that events fasten or hold are in every simulated frame."""
        return self.cloth_pos[:, vertices] if self.steps is None else self.steps.pos_of(vertices)


def read_rollout(path: Path | str) -> RolloutData:
    """Read ``rollout.h5``, also one that is being written, whose frames so far it returns, or whose writer was killed.

    How many frames the whole is to have is the attribute ``num_planned``, whether it is finished ``complete``.

    Args:
        path: the file ``rollout.h5``.

    Returns:
        The :class:`RolloutData`, with ``cloth_pos`` (T, V, 3) m, ``body_pos`` (T, W, 3) m and ``time`` (T,) s.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not a rollout file.

    Examples:
        >>> import hood
        >>> _ = hood.rollout(garment="tank", num_frames=3, video="none", sheet=False, output="outputs/tank")
        stepper=newton: the solver, the default on a CPU; ...
        tank: 3 frames, all finite
        ...
        >>> hood.read_rollout("outputs/tank/rollout.h5").cloth_pos.shape
        (3, 1016, 3)
    """
    path = Path(path)
    if path.is_dir():
        raise ValueError(f"{path}: a folder; give the rollout.h5 in it")
    try:
        with h5py.File(path, "r") as file:
            _check_extents(file, path.stat().st_size)
            _check_riding(file)
            _check_refined(file)
            done = _frames_there(file)
            return RolloutData(
                cloth_pos=file["cloth/pos"][:done],
                cloth_faces=file["cloth/faces"][:],
                rest_pos=file["cloth/rest_pos"][:],
                body_pos=file["body/pos"][:done],
                body_faces=file["body/faces"][:],
                time=file["time"][:done],
                metrics={name.removeprefix("metrics/"): file[name][:done] for name in _metric_paths(file)},
                attributes=dict(file.attrs),
                fields={name.removeprefix("cloth/"): file[name][:done] for name in _field_paths(file)},
                alarms=_read_alarms(file),
                still={name.removeprefix("cloth/"): file[name][:] for name in _still_paths(file)},
                steps=read_steps(file, len(file["cloth/rest_pos"])),
            )
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{path}: no such file; give the rollout.h5 that hood rollout writes") from error
    except Exception as error:  # damaged files make h5py raise nearly anything
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(f"{path}: not a rollout file ({reason}); make one with hood rollout") from error


def _frames_there(file: h5py.File) -> int:
    """Frames done. A network disk may show the count before the values: what is still NaN as laid out is not counted."""
    done = min(int(file.attrs["num_frames"]), len(file["time"]))
    if not bool(file.attrs.get("complete", False)):
        while done > 0 and not _is_there(file, done - 1):
            done -= 1
    return max(done, 0)


def _is_there(file: h5py.File, index: int) -> bool:
    """Whether a frame's values have arrived. Cloth that blew up is NaN as well, but its frame has times."""
    cloth = (file["cloth/pos"], *(file[name] for name in _metric_paths(file)))
    return bool(np.isfinite(file["body/pos"][index]).all() and any(np.isfinite(table[index]).any() for table in cloth))


def _check_extents(file: h5py.File, num_bytes: int) -> None:
    """Rollouts are stored as they are: a table that claims more than the file holds would be read as empty memory."""
    names = ("cloth/pos", "cloth/faces", "cloth/rest_pos", "body/pos", "body/faces", "time")
    by_frame = (*_field_paths(file), *_metric_paths(file), *step_paths(file))
    for name in (*names, *by_frame, *_alarm_paths(file), *_still_paths(file), *still_step_paths(file)):
        table = own_dataset(file, name)
        if not table.shape or table.size * table.dtype.itemsize > num_bytes:
            raise ValueError(f"{name} claims the shape {table.shape}, the file has {num_bytes} bytes")


def _check_riding(file: h5py.File) -> None:
    """Raise ValueError where more rides on the cloth than there is."""
    for name, table in (("riding_vertices", "cloth/rest_pos"), ("riding_faces", "cloth/faces")):
        if not 0 <= int(file.attrs.get(name, 0)) < max(len(file[table]), 1):
            raise ValueError(f"{name} is {file.attrs[name]}, {table} has {len(file[table])} rows")


def _check_refined(file: h5py.File) -> None:
    """Raise ValueError where the stored mesh cannot be the simulated one, refined."""
    if "cloth/simulated_faces" not in _still_paths(file):
        return
    times, count = int(file.attrs["refine_mesh"]), int(file.attrs["simulated_vertices"])
    faces, finer = file["cloth/simulated_faces"][:], file["cloth/faces"]
    number = len(finer) - int(file.attrs.get("riding_faces", 0))
    fits = faces.ndim == 2 and faces.shape[1] == 3 and 1 <= times <= 8 and len(faces) * 4**times == number
    if not (fits and count <= len(file["cloth/rest_pos"]) and 0 <= faces.min(initial=0) <= faces.max(initial=0) < count):
        raise ValueError(
            f"cloth/faces {finer.shape} are not {faces.shape} simulated faces of {count} vertices, refined {times} times"
        )


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


def _read_alarms(file: h5py.File) -> list[dict[str, Any]]:
    paths = _alarm_paths(file)
    if any(f"guard/{name}" not in paths for name in ALARM_COLUMNS):
        return []
    for name, kind in (ALARM_COLUMNS | STEP_COLUMNS).items():
        if f"guard/{name}" not in paths:
            continue
        table = file[f"guard/{name}"]
        if table.ndim != 1 or table.dtype.kind != kind.kind:
            raise ValueError(
                f"guard/{name} is {table.ndim}-dimensional, of type {table.dtype}; it has to be a column of {kind}"
            )
    columns = {path.removeprefix("guard/"): file[path][: int(file.attrs["num_alarms"])] for path in paths}
    for frame in columns["frame"].tolist():
        planned = int(file.attrs.get("steps_planned", file.attrs["num_planned"]))
        if not 0 <= frame <= planned:
            raise ValueError(f"guard/frame holds {frame}, there are {planned} frames")
    plain = {name: _words(values) if values.dtype.kind == "S" else values.tolist() for name, values in columns.items()}
    return [dict(zip(plain, row, strict=True)) for row in zip(*plain.values(), strict=True)]


def _words(values: np.ndarray) -> list[str]:
    return [value.decode("utf-8", "replace") for value in values.tolist()]


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
