"""Motions and garments beyond what anybody would ask for, made from the embedded ones: inputs of the stability map."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hood.assets.garment import Garment, load_garment, save_garment
from hood.assets.library import locate

#: Frames per second, and seconds of standing before anything happens.
FPS, CALM = 60.0, 0.5

Array = np.ndarray


def write_motion(path: Path, name: str, seconds: float) -> None:
    """Write the motion ``name`` as an AMASS file of so many seconds: ``teleport:0.5`` (m), ``spin:2`` (turns per second),
    ``stop:10`` (g), ``offset:1000`` (m), ``rest`` or ``nan``.

    Raises:
        ValueError: there is no such motion.
    """
    kind, _, amount = name.partition(":")
    if kind not in _MOTIONS:
        raise ValueError(f"motion {name!r}: give one of {', '.join(_MOTIONS)} with an amount, e.g. spin:2")
    with np.load(locate("motions", "stand_sway"), allow_pickle=False) as file:
        arrays = {key: file[key] for key in file.files}
    count = round(seconds * FPS) + 1
    poses, trans = (np.repeat(arrays[key][:1], count, axis=0).astype(np.float64) for key in ("poses", "trans"))
    time = np.maximum(np.arange(count) / FPS - CALM, 0.0)
    poses, trans = _MOTIONS[kind](poses, trans, time, float(amount or 0.0))
    arrays |= {"poses": poses, "trans": trans, "mocap_framerate": np.array(FPS)}
    np.savez_compressed(path, **arrays)


def _teleport(poses: Array, trans: Array, time: Array, metres: float) -> tuple[Array, Array]:
    """All at once, sideways."""
    return poses, trans + metres * (time[:, None] > 0) * [1.0, 0.0, 0.0]


def _spin(poses: Array, trans: Array, time: Array, rate: float) -> tuple[Array, Array]:
    """About the upright axis, of files with z up."""
    turns = Rotation.from_rotvec(2.0 * np.pi * rate * time[:, None] * [0.0, 0.0, 1.0])
    return np.column_stack([(turns * Rotation.from_rotvec(poses[:, :3])).as_rotvec(), poses[:, 3:]]), trans


def _stop(poses: Array, trans: Array, time: Array, g: float) -> tuple[Array, Array]:
    """From 3 m/s within the time that so many g take."""
    speed = 3.0
    slowing = speed / (9.81 * g)
    since = np.clip(time - 0.5, 0.0, slowing)
    way = speed * np.minimum(time, 0.5) + speed * since - 0.5 * speed / slowing * since**2
    return poses, trans + way[:, None] * [1.0, 0.0, 0.0]


def _offset(poses: Array, trans: Array, time: Array, metres: float) -> tuple[Array, Array]:
    """A slow walk far from the origin."""
    return poses, trans + [metres, metres, 0.0] + 0.5 * time[:, None] * [1.0, 0.0, 0.0]


def _rest(poses: Array, trans: Array, time: Array, amount: float) -> tuple[Array, Array]:
    return poses, trans


def _nan(poses: Array, trans: Array, time: Array, amount: float) -> tuple[Array, Array]:
    """A recording that loses a joint."""
    poses[len(poses) // 2, 7] = np.nan
    return poses, trans


_MOTIONS: dict[str, Callable[[Array, Array, Array, float], tuple[Array, Array]]] = {
    "teleport": _teleport, "spin": _spin, "stop": _stop, "offset": _offset, "rest": _rest, "nan": _nan,
}  # fmt: skip


def write_garment(path: Path, garment: str, name: str) -> None:
    """Write an embedded garment with a fault: ``size:0.5`` (its rest shape, put on as it was), ``slivers:100`` (faces so many
    times as long as high), ``duplicates:20`` (vertices doubled, 1 µm apart), ``flipped:30`` (faces), ``isolated:10`` (vertices
    of no face), ``nan`` (a position).

    Raises:
        ValueError: there is no such fault.
    """
    kind, _, amount = name.partition(":")
    if kind not in _FAULTS:
        raise ValueError(f"garment {name!r}: give one of {', '.join(_FAULTS)} with an amount, e.g. size:0.5")
    save_garment(path, _FAULTS[kind](load_garment(garment), float(amount or 0.0), np.random.default_rng(0)))


def _size(garment: Garment, factor: float, rng: np.random.Generator) -> Garment:
    worn = garment.rest_pos if garment.skin_pos is None else garment.skin_pos
    return replace(garment, rest_pos=garment.rest_pos * factor, skin_pos=worn)


def _slivers(garment: Garment, ratio: float, rng: np.random.Generator) -> Garment:
    """Ten faces get a vertex on their longest edge, but for a height of its length over the ratio."""
    faces, pos = garment.faces.copy(), garment.rest_pos
    chosen = rng.choice(len(faces), 10, replace=False)
    origin, weights, new_faces = [], [], []
    for face in chosen:
        a, b, c = faces[face]
        origin.append((a, b, c))
        share = 2.0 / ratio
        weights.append((0.5 - share / 2, 0.5 - share / 2, share))
        new = len(pos) + len(origin) - 1
        faces[face] = (a, b, new)
        new_faces += [(b, c, new), (c, a, new)]
    return _grown(garment, np.array(origin), np.array(weights), np.concatenate([faces, np.array(new_faces)]))


def _duplicates(garment: Garment, count: float, rng: np.random.Generator) -> Garment:
    """Faces split at a vertex that lies next to one of their corners."""
    faces, pos = garment.faces.copy(), garment.rest_pos
    chosen = rng.choice(len(faces), int(count), replace=False)
    origin, weights, new_faces = [], [], []
    for face in chosen:
        a, b, c = faces[face]
        near = 1e-6 / float(np.linalg.norm(pos[b] - pos[a]) + np.linalg.norm(pos[c] - pos[a]))
        origin.append((a, b, c))
        weights.append((1.0 - 2.0 * near, near, near))
        new = len(pos) + len(origin) - 1
        faces[face] = (a, b, new)
        new_faces += [(b, c, new), (c, a, new)]
    return _grown(garment, np.array(origin), np.array(weights), np.concatenate([faces, np.array(new_faces)]))


def _grown(garment: Garment, origin: Array, weights: Array, faces: Array) -> Garment:
    """With further vertices at weighted means of three."""

    def with_means(values: Array | None) -> Array | None:
        if values is None:
            return None
        means = np.einsum("nk,nk...->n...", weights, values[origin].astype(np.float64))
        return np.concatenate([values, means.astype(values.dtype)])

    def with_first(values: Array | None) -> Array | None:
        return None if values is None else np.concatenate([values, values[origin[:, 0]]])

    smooth = {key: with_means(getattr(garment, key)) for key in ("rest_pos", "skin_pos", "lbs_weights", "shapedirs")}
    marks = {key: with_first(getattr(garment, key)) for key in ("pinned", "region", "stiffness", "piece", "rest_turn")}
    none = dict.fromkeys(("uv", "uv_faces", "normal_faces", "colours", "coarse_edges"))
    return replace(garment, faces=faces, **smooth, **marks, **none)  # type: ignore[arg-type]


def _flipped(garment: Garment, count: float, rng: np.random.Generator) -> Garment:
    faces = garment.faces.copy()
    chosen = rng.choice(len(faces), int(count), replace=False)
    faces[chosen] = faces[chosen][:, ::-1]
    return replace(garment, faces=faces)


def _isolated(garment: Garment, count: float, rng: np.random.Generator) -> Garment:
    rows = rng.choice(len(garment.rest_pos), int(count), replace=False)
    return _grown(garment, np.repeat(rows[:, None], 3, axis=1), np.full((len(rows), 3), 1.0 / 3.0), garment.faces)


def _nowhere(garment: Garment, amount: float, rng: np.random.Generator) -> Garment:
    pos = garment.rest_pos.copy()
    pos[len(pos) // 2] = np.nan
    return replace(garment, rest_pos=pos)


_FAULTS: dict[str, Callable[[Garment, float, np.random.Generator], Garment]] = {
    "size": _size, "slivers": _slivers, "duplicates": _duplicates, "flipped": _flipped, "isolated": _isolated, "nan": _nowhere,
}  # fmt: skip
