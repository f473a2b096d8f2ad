"""Reads the file of a rollout, whole and checked.

Rollouts as the published HOOD code writes them: a pickle of a dictionary, in and out.
"""

from __future__ import annotations

import io
import pickle
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from hood.assets.body.body import Body
from hood.assets.files.guarded import listed, own_dataset
from hood.assets.pickles.content import load_content
from hood.rollouts.file.compact import PositionTable, body_reader, check_compact, compact_paths, is_compact, most_bytes
from hood.rollouts.file.recorder import (
    ALARM_COLUMNS,
    STEP_COLUMNS,
    RolloutWriter,
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
    metrics: dict[str, np.ndarray]  # (T,) by name, such as strain_p99; NaN where not measured
    attributes: dict[str, Any]  # of the file: garment, material, solver settings, num_planned, complete, …
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
                alarms=alarms_in(file),
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


def alarms_in(file: h5py.File) -> list[dict[str, Any]]:
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


# ---- the published layout --------------------------------------------------------------------------------------------

#: Keys of the dictionary. Ours hold ``rest_pos`` (V, 3) m and ``dt`` s beside them, which the published code passes over.
_PUBLISHED = ("pred", "obstacle", "cloth_faces", "obstacle_faces")


def read_published(path: Path, fps: float | None = None) -> tuple[RolloutData, list[str]]:
    """A rollout of the published HOOD code, a pickle of ``pred`` (T, V, 3) m, ``obstacle`` (T, W, 3) m, ``cloth_faces`` (F, 3),
    ``obstacle_faces`` (G, 3) and ``metrics``. No class is unpickled.

    Args:
        path: the file.
        fps: frames per second; None: what the file says, else 30, as those of the published code have.

    Returns:
        The rollout, and sentences on what the file does not say.

    Raises:
        FileNotFoundError: no such file.
        ValueError: it cannot be used; names the file and the key.
    """
    content = load_content(path)
    if not isinstance(content, Mapping):
        raise ValueError(f"{path}: holds no dictionary; a published rollout is one of {', '.join(_PUBLISHED)}, metrics")
    missing = [key for key in _PUBLISHED if key not in content]
    if missing:
        found = listed(map(str, content))
        raise ValueError(f"{path}: has no {' and no '.join(missing)}, but {found}; give a rollout of the published code")
    pos = {key: _points(path, key, content[key], 3) for key in _PUBLISHED[:2]}
    count = len(pos["pred"])
    if count == 0 or len(pos["obstacle"]) != count:
        raise ValueError(f"{path}: pred has {count} frames and obstacle {len(pos['obstacle'])}; they need as many, and some")
    faces = {f"{key}_faces": _triangles(path, f"{key}_faces", content, pos[of].shape[1]) for key, of in _OF_FACES.items()}
    dt = _duration(path, content.get("dt", 1 / 30)) if fps is None else 1.0 / fps
    said = []
    rest_pos = pos["pred"][0]
    if "rest_pos" in content:
        rest_pos = _points(path, "rest_pos", content["rest_pos"], 2)
    else:
        said.append(f"{path}: has no rest_pos; strains are from the cloth's shape in frame 0")
    metrics, left_out = _published_metrics(content.get("metrics"), count)
    if left_out:
        said.append(f"{path}: metrics that are not one number a frame are left out: {listed(left_out)}")
    if len(rest_pos) != pos["pred"].shape[1]:
        raise ValueError(f"{path}: rest_pos {rest_pos.shape} does not belong to pred {pos['pred'].shape}; leave it out")
    time, attributes = np.arange(count) * dt, {"dt": dt, "garment": path.stem, "source": path.name}
    data = RolloutData(
        *(pos["pred"], faces["cloth_faces"], rest_pos, pos["obstacle"], faces["obstacle_faces"], time, metrics, attributes)
    )
    return data, said


_OF_FACES = {"cloth": "pred", "obstacle": "obstacle"}


def _duration(path: Path, value: Any) -> float:
    """``dt`` of a published rollout [s]."""
    found = np.asarray(value)
    if found.dtype.kind not in "fiu" or found.size != 1 or not 0 < float(found.item()) < np.inf:
        raise ValueError(f"{path}: dt is {str(value)[:40]!r}; it has to be seconds above 0, or give fps=")
    return float(found.item())


def _points(path: Path, key: str, value: Any, axes: int) -> np.ndarray:
    """Positions [m] with so many axes, in float32 unless they are in float64."""
    try:
        found = np.asarray(value)
    except ValueError:  # frames of several sizes
        found = np.empty(0, dtype=object)
    if found.dtype.kind not in "fiu" or found.ndim != axes or found.shape[-1] != 3:
        shape = ("(frames, vertices, 3)", "(vertices, 3)")[axes == 2]
        raise ValueError(f"{path}: {key} is {found.shape} of {found.dtype}; it has to be {shape} of numbers, in metres")
    if not np.isfinite(found).all():
        place = "" if axes == 2 else f" from frame {int(np.argmin(np.isfinite(found).all(axis=(1, 2))))} on"
        raise ValueError(f"{path}: {key} has numbers that are not finite{place}; leave those frames out")
    return found if found.dtype == np.float64 else found.astype(np.float32)


def _triangles(path: Path, key: str, content: Mapping[str, Any], num_vertices: int) -> np.ndarray:
    found = np.asarray(content[key])
    right = (found.dtype.kind in "iu" or not found.size) and found.ndim == 2 and found.shape[1] == 3
    if not right or (found.size and not 0 <= found.min() <= found.max() < num_vertices):
        what = (
            f"is {found.shape} of {found.dtype}"
            if not right
            else f"names vertex {found.min() if found.min() < 0 else found.max()}"
        )
        raise ValueError(f"{path}: {key} {what}; it has to be (faces, 3) of vertices from 0 to {num_vertices - 1}")
    return found.astype(np.int32)


def _published_metrics(value: Any, count: int) -> tuple[dict[str, np.ndarray], list[str]]:
    """Those with a number a frame, or from frame 1 on; and the names of the others."""
    found, left_out = dict[str, np.ndarray](), list[str]()
    for name, values in (value if isinstance(value, Mapping) else {}).items():
        plain = re.sub(r"[^\w.-]", "_", str(name)).strip(".")
        try:
            numbers = np.asarray(values, dtype=np.float64)
        except (TypeError, ValueError):
            numbers = np.empty(0)
        if plain and plain not in found and numbers.shape in ((count,), (count - 1,)):
            found[plain] = np.concatenate([np.full(count - len(numbers), np.nan), numbers])
        else:
            left_out.append(str(name))
    return found, left_out


def write_rollout(path: Path, data: RolloutData) -> None:
    """Write positions, meshes, metrics and attributes of a rollout as ``rollout.h5``; of other tables none.

    Raises:
        OSError: it cannot be written; nothing stays behind.
    """
    farthest = max(float(np.abs(pos).max(initial=0.0)) for pos in (data.cloth_pos, data.body_pos))
    arguments = (len(data.time), data.rest_pos, data.cloth_faces, data.body_faces, data.body_pos.shape[1], (*data.metrics,))
    attributes = {key: value for key, value in data.attributes.items() if key != "dt"}
    double = data.cloth_pos.dtype == np.float64
    with RolloutWriter(path, *arguments, float(data.attributes["dt"]), attributes, farthest, double=double) as target:
        for frame, (cloth, body) in enumerate(zip(data.cloth_pos, data.body_pos, strict=True)):
            target.append(cloth, body, {name: values[frame] for name, values in data.metrics.items()})


def published_bytes(path: Path, data: RolloutData) -> bytes:
    """The pickle of a rollout, which ``path`` holds, in the published layout: a dictionary of arrays that plain ``pickle.load``
    reads with numpy from 1.17 on; positions in float32.

    Raises:
        ValueError: it has no frames, or positions that are not finite.
    """
    pos = {"pred": _points(path, "cloth/pos", data.cloth_pos, 3), "obstacle": _points(path, "body/pos", data.body_pos, 3)}
    if not len(data.time):
        raise ValueError(f"{path}: holds no frames; run hood rollout again")
    content: dict[str, Any] = {key: value.astype(np.float32) for key, value in pos.items()}
    content |= {"cloth_faces": data.cloth_faces.astype(np.int64), "obstacle_faces": data.body_faces.astype(np.int64)}
    content |= {"metrics": data.metrics, "rest_pos": data.rest_pos.astype(np.float32)}
    file = io.BytesIO()
    _Pickler(file, protocol=4).dump(content | {"dt": np.array(float(data.attributes["dt"]))})
    return file.getvalue()


class _Pickler(pickle._Pickler):  # type: ignore[name-defined,misc]
    """Names numpy's parts as numpy 1 does, which numpy 2 reads too."""

    def save_global(self: Any, obj: Any, name: str | None = None) -> None:
        """Write the name of what an array is made by."""
        module = str(getattr(obj, "__module__", ""))
        if not module.startswith("numpy._core"):
            pickle._Pickler.save_global(self, obj, name)  # type: ignore[attr-defined]
            return
        self.write(pickle.GLOBAL + f"{module.replace('numpy._core', 'numpy.core')}\n{name or obj.__qualname__}\n".encode())
        self.memoize(obj)
