"""Reads the file of a rollout, whole and checked."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from hood.assets.body.body import Body
from hood.assets.files.guarded import own_dataset
from hood.rollouts.file.compact import PositionTable, body_reader, check_compact, compact_paths, is_compact, most_bytes
from hood.rollouts.file.recorder import (
    ALARM_COLUMNS,
    STEP_COLUMNS,
    _alarm_paths,
    _field_paths,
    _frames_there,
    _metric_paths,
    _still_paths,
)
from hood.rollouts.file.step_table import Steps, read_steps, step_paths, still_step_paths


@dataclass(frozen=True)
class _Refined:
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
    def refined(self) -> _Refined | None:
        """The simulated mesh where the stored one is finer; None where it is the same."""
        faces = self.still.get("simulated_faces")
        if faces is None:
            return None
        return _Refined(int(self.attributes["refine_mesh"]), int(self.attributes["simulated_vertices"]), faces)

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


def read_rollout(path: Path | str, body: Body | None = None) -> RolloutData:
    """Read ``rollout.h5``, also one that is being written, whose frames so far it returns, or whose writer was killed.

    How many frames the whole is to have is the attribute ``num_planned``, whether it is finished ``complete``.

    Args:
        path: the file ``rollout.h5``, of any layout.
        body: the model of the body, where the file has the body as parameters (``formats=[cloth]``); None: that of the
            name or file which the rollout was made with.

    Returns:
        The :class:`RolloutData`, with ``cloth_pos`` (T, V, 3) m, ``body_pos`` (T, W, 3) m and ``time`` (T,) s.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not a rollout file, or a body model that is not found.

    Examples:
        >>> import hood
        >>> _ = hood.rollout(garment="tank", num_frames=3, video="none", sheet=False, output="outputs/tank")
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
            check_compact(file)
            done = _frames_there(file)
            body_tables = body_reader(file, done)
            data = RolloutData(
                cloth_pos=PositionTable(file, "cloth").read(0, done),
                cloth_faces=file["cloth/faces"][:],
                rest_pos=file["cloth/rest_pos"][:],
                body_pos=_NO_POS,
                body_faces=_NO_FACES,
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
    try:
        body_pos, body_faces = body_tables(body)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return replace(data, body_pos=body_pos, body_faces=body_faces)


#: Until the body is there.
_NO_POS, _NO_FACES = np.zeros((0, 0, 3)), np.zeros((0, 3), dtype=np.int32)


def _check_extents(file: h5py.File, num_bytes: int) -> None:
    """A table that claims more than the file holds would be read as empty memory."""
    names = ["cloth/faces", "cloth/rest_pos", "time"]
    names += compact_paths(file) if is_compact(file) else ["cloth/pos", "body/pos", "body/faces"]
    by_frame = (*_field_paths(file), *_metric_paths(file), *step_paths(file))
    for name in (*names, *by_frame, *_alarm_paths(file), *_still_paths(file), *still_step_paths(file)):
        table = own_dataset(file, name)
        if not table.shape or table.size * table.dtype.itemsize > most_bytes(table, num_bytes):
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
