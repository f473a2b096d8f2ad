"""The compact layout of ``rollout.h5``: positions in steps of 0.01 mm, compressed, and the body as parameters where these give
it back.

A part (``cloth``, ``body``) has the table ``steps`` (T, N, 3) in place of ``pos``. With q_t the positions of frame t from the
attribute ``origin`` (3,) [m], in whole steps, it holds in every chunk of frames q_0, q_1 − q_0 and then q_t − 2 q_{t−1} +
q_{t−2}, with the sign in the last bit: 0, −1, 1, −2, … are 0, 1, 2, 3, …; such numbers are small, and their upper bytes are 0.
Frames with numbers that are not finite, or too large, stand in ``exact_pos`` (K, N, 3) as they were, with their numbers in
``exact_frames`` (K,).
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch

from hood.assets.body.body import Body, axis_angle_to_matrix, joint_transforms
from hood.assets.body.load import load_body
from hood.assets.files.guarded import own_dataset, own_group
from hood.assets.motion.sequence import PoseSequence
from hood.rollouts.file.recorder import _field_paths, _plain_error

#: What ``formats`` may say of ``rollout.h5``: positions as they are; cloth alone, the body as parameters; both in steps.
STORES = FULL, CLOTH, BOTH = "full", "cloth", "cloth+body"
#: Length of a step [m]. A coordinate is off by half of it at most, a vertex by less than all of it.
POSITION_STEP = 1e-5
#: Frames of a chunk: more make smaller files, and single frames slower to read.
_FRAMES = 8
#: Steps from the origin beyond this do not fit.
_FARTHEST = 2.0**30
#: Smaller tables [bytes] are stored as they are: what HDF5 notes of a chunk would take as much.
_SMALL = 4096
#: Bytes that one compressed byte can stand for at most.
_MOST_DENSE = 1100
#: Tables of the body's parameters.
_POSES, _TRANSL, _FINGERS, _BETAS = "body/poses", "body/transl", "body/fingers", "body/betas"


@dataclass(frozen=True)
class BodyParameters:
    """What gives a body back: the model by its name or file, its shape, and the pose in every stored frame.

    Args:
        model: as :func:`hood.load_body` takes it.
        gender: likewise.
        digest: of the model, see :func:`digest_of`.
        sequence: of T frames, with the world's turn in its translation.
        betas: (S,) shape coefficients.
    """

    model: str
    gender: str | None
    digest: str
    sequence: PoseSequence
    betas: np.ndarray

    def find(self, given: Body | None = None) -> Body:
        """The body's model: the ``given`` one, or the one that the name says.

        Raises:
            ValueError: it cannot be loaded, or is another; says how to give it.
        """
        try:
            body, digest = _loaded(self.model, self.gender) if given is None else (given, digest_of(given))
        except (OSError, ValueError, ImportError) as error:
            raise ValueError(f"the body model {self.model} cannot be loaded ({error}); {_GIVE}") from error
        if digest != self.digest:
            what = self.model if given is None else given.name
            raise ValueError(f"the body model {what} is not the one of the rollout, {self.model}; {_GIVE}")
        return body

    def surfaces(self, body: Body, start: int = 0, stop: int | None = None) -> np.ndarray:
        """(T', W, 3) m, world, float64: the surface of ``body`` in frames ``start`` to ``stop``."""
        sequence = self.sequence.window(start, self.sequence.num_frames if stop is None else stop)
        place = body.translation(sequence, self.betas)
        return body.surface(sequence, self.betas, torch.float64).numpy() + place[:, None]


class BodyWindows:
    """The surface of a body in windows of frames. What is the same in all of them is computed once a body and shape, and a
    window is one product: the matrix (W, 4 J) of weights times rest positions and 1, by the joints' transforms (4 J, 3 N).

    Args:
        parameters: of the rollout.
        dtype: in which it is posed; float32 is within 1e-6 m of :meth:`BodyParameters.surfaces`, and twice as fast.

    Raises:
        ValueError: the model cannot be loaded, or is another.
    """

    #: Frames whose joints are best moved together: one frame alone takes half as long as all of them.
    chunk = 32

    def __init__(self, parameters: BodyParameters, dtype: torch.dtype) -> None:
        self._sequence, self._dtype, self._body = parameters.sequence, dtype, parameters.find()
        self._skin, self._joints = _skin(parameters.model, parameters.gender, tuple(parameters.betas.tolist()), dtype)

    def joints(self, start: int, stop: int) -> np.ndarray:
        """(N, 4 J, 3): what :meth:`surface` needs of frames ``start`` to ``stop``, or to the last."""
        poses = self._body.joint_poses(self._sequence.window(start, min(stop, self._sequence.num_frames)))
        moved = joint_transforms(axis_angle_to_matrix(torch.as_tensor(poses)), self._joints, self._body.parents)
        return moved.to(self._dtype).transpose(2, 3).flatten(1, 2).numpy()

    def surface(self, joints: np.ndarray, start: int) -> torch.Tensor:
        """(N, W, 3) m, world: the surface in the frames from ``start`` on, from their ``joints``."""
        count = len(joints)
        local = self._skin @ torch.from_numpy(joints).transpose(0, 1).reshape(-1, 3 * count)
        place = torch.as_tensor(self._sequence.transl[start : start + count]).to(self._dtype)
        return local.unflatten(1, (count, 3)).transpose(0, 1) + place[:, None]


@lru_cache(maxsize=8)
def _skin(model: str, gender: str | None, betas: tuple[float, ...], dtype: torch.dtype) -> tuple[torch.Tensor, torch.Tensor]:
    """Of :class:`BodyWindows` the matrix, and the joints at rest (J, 3) [m]."""
    body = _loaded(model, gender)[0]
    rest, joints = body.shaped(np.array(betas))
    factors = body.weights[:, :, None] * np.c_[rest, np.ones(len(rest))][:, None]
    return torch.as_tensor(factors.reshape(len(rest), -1)).to(dtype), torch.as_tensor(joints)


_GIVE = "give the model with hood.read_rollout(file, body=hood.load_body(…)); formats=[cloth+body] keeps the body in the file"


def digest_of(body: Body) -> str:
    """SHA-256 of the numbers of a body's model."""
    found = hashlib.sha256(repr(body.parents).encode())
    for name in ("v_template", "shapedirs", "joint_regressor", "weights", "faces", "posedirs"):
        values = getattr(body, name, None)
        found.update(b"" if values is None else np.ascontiguousarray(values).tobytes())
    return found.hexdigest()


@lru_cache(maxsize=4)
def _loaded(model: str, gender: str | None) -> tuple[Body, str]:
    body = load_body(model, gender)
    return body, digest_of(body)


def store_of(forms: Iterable[object]) -> str:
    """The layout among the words of ``formats``, the first of :data:`STORES`."""
    return next((str(form) for form in forms if str(form) in STORES), FULL)


def is_compact(file: h5py.File) -> bool:
    """Whether a rollout file has the compact layout."""
    return _has(file, "cloth/steps")


def _has(file: h5py.File, name: str) -> bool:
    """Whether there is a table, or a link in its place; nothing is followed."""
    part, _, table = name.partition("/")
    group = own_group(file, part)
    return group is not None and group.get(table, getlink=True) is not None


def make_compact(path: Path, store: str, body: BodyParameters | None) -> None:
    """Give the finished rollout in the file ``path`` the layout ``store``, at once for whoever reads it.

    Args:
        store: one of :data:`STORES`.
        body: what gives the body back; None where the rollout has none. Not looked at unless ``store`` is ``cloth``.

    Raises:
        ValueError: the parameters do not give back the body that the file has; it stays as it was.
        OSError: it cannot be written; it stays as it was.
    """
    if store == FULL:
        return
    temporary = path.with_name(path.name + ".partial")
    try:
        with h5py.File(path, "r") as source, h5py.File(temporary, "w") as target:
            done = int(source.attrs["num_frames"])
            target.attrs.update(source.attrs)
            target.attrs.update({"store": store, "position_error": POSITION_STEP})
            _write_steps(target, "cloth", source["cloth/pos"][:done])
            if not source["body/pos"].shape[1]:
                _copy(source, target, ("body/pos", "body/faces"))
            elif store == CLOTH:
                assert body is not None
                _write_parameters(target, body, source["body/pos"][:done], path)
            else:
                _write_steps(target, "body", source["body/pos"][:done])
                _copy(source, target, ("body/faces",))
            _copy(source, target, (name for name in _tables(source) if not name.startswith("body/")))
            for name in _field_paths(source):
                _copy(source, target, (name,), done)
        with open(temporary, "rb") as written:
            os.fsync(written.fileno())
        os.replace(temporary, path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise _plain_error(error, path) from error
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def _tables(file: h5py.File) -> list[str]:
    """All tables but positions and values of every vertex."""
    found: list[str] = []
    file.visititems(lambda name, place: found.append(name) if isinstance(place, h5py.Dataset) else None)
    return [name for name in found if name not in {"cloth/pos", "body/pos", *_field_paths(file)}]


def _copy(source: h5py.File, target: h5py.File, names: Iterable[str], rows: int | None = None) -> None:
    for name in names:
        _write(target, name, source[name][:rows])


def _write(file: h5py.File, name: str, values: np.ndarray, chunks: Any = True) -> h5py.Dataset:
    """A table, compressed where that is worth it."""
    if values.nbytes < _SMALL:
        return file.create_dataset(name, data=values)
    return file.create_dataset(name, data=values, chunks=chunks, compression="gzip", compression_opts=4, shuffle=True)


# ---- positions -------------------------------------------------------------------------------------------------------


def _write_steps(file: h5py.File, part: str, pos: np.ndarray) -> None:
    """Positions (T, N, 3) [m] of a part."""
    exact = ~(np.isfinite(pos).all(axis=(1, 2)))
    known = pos[~exact]
    origin = known[0].astype(np.float64).mean(axis=0) if len(known) and known.shape[1] else np.zeros(3)
    steps = np.rint((pos.astype(np.float64) - origin) / POSITION_STEP)
    with np.errstate(invalid="ignore"):
        exact |= ~(np.abs(steps) < _FARTHEST).all(axis=(1, 2))
    steps[exact] = 0.0
    whole = steps.astype(np.int32)
    frames = min(_FRAMES, len(whole))
    packed = np.concatenate([_packed(whole[start : start + frames]) for start in range(0, len(whole), frames)])
    table = file.create_dataset(
        f"{part}/steps", data=packed, chunks=(frames, *packed.shape[1:]), compression="gzip", compression_opts=4, shuffle=True
    )
    table.attrs.update({"origin": origin, "step": POSITION_STEP, "dtype": pos.dtype.name})
    _write(file, f"{part}/exact_frames", np.flatnonzero(exact))
    _write(file, f"{part}/exact_pos", pos[exact])


def _packed(steps: np.ndarray) -> np.ndarray:
    """Second differences over time of whole numbers (T, N, 3) int32, with the sign in the last bit, uint32."""
    first = np.diff(steps, axis=0, prepend=np.zeros_like(steps[:1]))
    second = first.copy()
    second[2:] -= first[1:-1]
    return ((second << 1) ^ (second >> 31)).view(np.uint32)


def _unpacked(packed: np.ndarray) -> np.ndarray:
    """What :func:`_packed` was given."""
    steps = ((packed >> 1) ^ (-(packed & 1).astype(np.int32)).view(np.uint32)).view(np.int32)
    for start in (2, 1):  # a sum row by row is faster here than numpy's
        for frame in range(start, len(steps)):
            steps[frame] += steps[frame - 1]
    return steps


class PositionTable:
    """The positions of a part, ``cloth`` or ``body``, of an open rollout file of either layout.

    Args:
        file: a rollout file, checked or written by ourselves.
        part: ``cloth`` or ``body``.

    Raises:
        ValueError, KeyError: tables that are not there, or do not belong together.
    """

    def __init__(self, file: h5py.File, part: str) -> None:
        #: Frames that are stored together, and are best read together; None where each stands for itself.
        self.chunk: int | None = None
        self._table = own_dataset(file, f"{part}/{'steps' if _has(file, f'{part}/steps') else 'pos'}")
        if self._table.name.endswith("/pos"):
            return
        says = self._table.attrs
        self.chunk, self._kind = int(self._table.chunks[0]), np.dtype(str(says["dtype"]))
        self._step, self._origin = float(says["step"]), np.asarray(says["origin"], dtype=np.float64)
        self._frames, self._exact = own_dataset(file, f"{part}/exact_frames")[:], own_dataset(file, f"{part}/exact_pos")

    def read(self, start: int = 0, stop: int | None = None) -> np.ndarray:
        """(T', N, 3) m, world: frames ``start`` to ``stop``, in the type in which they were written."""
        if self.chunk is None:
            return np.asarray(self._table[start:stop])
        length, count = self.chunk, len(self._table)
        stop = count if stop is None else min(stop, count)
        begin = start - start % length
        packed = self._table[begin : min(-(-stop // length) * length, count)]
        pieces = [_unpacked(packed[at : at + length]) for at in range(0, len(packed), length)]
        whole = np.concatenate(pieces) if len(pieces) != 1 else pieces[0]
        pos = (whole[start - begin : stop - begin] * self._step + self._origin).astype(self._kind, copy=False)
        inside = (self._frames >= start) & (self._frames < stop)
        if inside.any():
            pos[self._frames[inside] - start] = self._exact[inside]
        return pos


def check_compact(file: h5py.File) -> None:
    """Raise ValueError, KeyError or TypeError unless the tables of a compact file belong together."""
    for part in ("cloth", "body"):
        if not _has(file, f"{part}/steps"):
            continue
        table, frames = own_dataset(file, f"{part}/steps"), own_dataset(file, f"{part}/exact_frames")[:]
        exact, sort = own_dataset(file, f"{part}/exact_pos"), np.dtype(str(table.attrs["dtype"]))
        right = table.dtype == np.uint32 and table.ndim == 3 and table.shape[2] == 3 and table.chunks is not None
        right = right and sort.kind == "f" and frames.ndim == 1 and np.shape(table.attrs["origin"]) == (3,)
        if not right or len(table) != len(own_dataset(file, "time")):
            raise ValueError(f"{part}/steps {table.shape} {table.dtype} are not positions in every frame")
        if exact.shape != (len(frames), *table.shape[1:]) or (
            len(frames) and not 0 <= frames.min() <= frames.max() < len(table)
        ):
            raise ValueError(f"{part}/exact_pos {exact.shape} does not belong to {part}/steps {table.shape}")


def compact_paths(file: h5py.File) -> list[str]:
    """Tables of a compact file in place of positions, and of the body."""
    steps = [f"{part}/{name}" for part in ("cloth", "body") for name in ("steps", "exact_frames", "exact_pos")]
    body = ["body/pos", "body/faces", _POSES, _TRANSL, _FINGERS, _BETAS]
    return [name for name in (*steps, *body) if _has(file, name)]


def most_bytes(table: h5py.Dataset, num_bytes: int) -> int:
    """Bytes that a table of a file of ``num_bytes`` can hold at most: more is claimed, and would be read as empty memory."""
    return num_bytes if table.chunks is None else _MOST_DENSE * int(table.id.get_storage_size())


# ---- the body --------------------------------------------------------------------------------------------------------


def _write_parameters(file: h5py.File, body: BodyParameters, pos: np.ndarray, path: Path) -> None:
    """The parameters of a body, after a look at whether they give back ``pos`` (T, W, 3) [m]."""
    model, sequence = body.find(), body.sequence
    for start in range(0, len(pos), 64):
        own = pos[start : start + 64]
        off = float(np.abs(body.surfaces(model, start, start + len(own)) - own).max(initial=0.0))
        if not off <= POSITION_STEP:
            raise ValueError(f"{path}: its body is {1e3 * off:.3g} mm off its parameters; choose formats=[cloth+body]")
    tables = {_POSES: sequence.poses, _TRANSL: sequence.transl, _FINGERS: sequence.fingers, _BETAS: body.betas}
    for name, values in tables.items():
        if values is not None:
            _write(file, name, values[: len(pos)] if name != _BETAS else values)
    says = {"model": body.model, "digest": body.digest, "dtype": pos.dtype.name}
    optional = {"gender": body.gender, "family": sequence.family}
    file["body"].attrs.update(says | {key: value for key, value in optional.items() if value is not None})


def read_parameters(file: h5py.File) -> BodyParameters | None:
    """The parameters of the body; None where the file has it as it is.

    Raises:
        ValueError, KeyError: tables that are not there, or do not belong together.
    """
    if not _has(file, _POSES):
        return None
    says, frames = own_group(file, "body").attrs, len(own_dataset(file, "time"))  # type: ignore[union-attr]
    tables = {name: own_dataset(file, name)[:] for name in (_POSES, _TRANSL, _FINGERS, _BETAS) if _has(file, name)}
    for name, shape in ((_POSES, (24, 3)), (_TRANSL, (3,)), (_FINGERS, (30, 3))):
        if name in tables and tables[name].shape != (frames, *shape):
            raise ValueError(f"{name} has the shape {tables[name].shape}, not {(frames, *shape)}")
    sequence = PoseSequence(
        name="rollout",
        poses=tables[_POSES],
        transl=tables[_TRANSL],
        fps=1.0 / float(file.attrs["dt"]),
        betas=tables[_BETAS],
        world_rotation=np.eye(3),
        fingers=tables.get(_FINGERS),
        gender=says.get("gender"),
        family=says.get("family"),
    )
    return BodyParameters(str(says["model"]), says.get("gender"), str(says["digest"]), sequence, tables[_BETAS])


def body_reader(file: h5py.File, done: int) -> Callable[[Body | None], tuple[np.ndarray, np.ndarray]]:
    """Reads what the file has of the body; what comes back gives, with the model or None, ``body_pos`` (T, W, 3) [m] and its
    faces (G, 3), or raises ValueError where the model is not found."""
    parameters = read_parameters(file)
    if parameters is None:
        pos, faces = PositionTable(file, "body").read(0, done), own_dataset(file, "body/faces")[:]
        return lambda _: (pos, faces)
    sort = np.dtype(str(file["body"].attrs["dtype"]))

    def rebuilt(given: Body | None) -> tuple[np.ndarray, np.ndarray]:
        body = parameters.find(given)
        return parameters.surfaces(body, 0, done).astype(sort), body.faces.astype(np.int32)

    return rebuilt
