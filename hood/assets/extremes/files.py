"""Writes the input files of the stability map: extreme motions and garments, and broken files."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from hood.assets.body.load import load_body
from hood.assets.extremes.garments import FAULTS
from hood.assets.extremes.motions import MOTIONS
from hood.assets.files.atomic import write_atomically
from hood.assets.files.library import locate, unknown
from hood.assets.garment.garment import load_garment, save_garment

#: Frames per second, and seconds of standing before anything happens.
FPS, CALM = 60.0, 0.5
#: Values that no array may hold, and files that are none.
_VALUES = {"nan": np.nan, "inf": np.inf}
_FILES = {"empty": 0.0, "cut": 0.5}  # the share that is left of it
#: Faces that no garment may have.
_FACES = {"beyond": 10**6, "negative": -1}


def write_motion(path: Path, name: str, seconds: float) -> None:
    """Write the motion ``name`` as an AMASS file of so many seconds, after half a second of standing.

    Amounts: ``teleport:0.5`` (m), ``turn:90`` (degrees at once), ``spin:2`` (turns per second), ``stop:10`` (g), ``fall:2``
    (m), ``offset:1000`` (m), ``rest``; poses taken within a second, in degrees: ``through:130``, ``crossed:110``,
    ``crouch:110``, ``split:45``, ``reach:80``, ``handstand:180``. Broken ones: ``nan:poses`` (an entry of an array),
    ``inf:trans``, ``empty``, ``cut``.

    Raises:
        ValueError: there is no such motion.
    """
    kind, _, amount = name.partition(":")
    if kind not in (*MOTIONS, *_VALUES, *_FILES):
        raise ValueError(unknown("motion", kind, (*MOTIONS, *_VALUES, *_FILES)))
    with np.load(locate("motions", "stand_sway"), allow_pickle=False) as file:
        arrays = {key: file[key] for key in file.files}
    count = round(seconds * FPS) + 1
    poses, trans = (np.repeat(arrays[key][:1], count, axis=0).astype(np.float64) for key in ("poses", "trans"))
    if kind in MOTIONS:
        time = np.maximum(np.arange(count) / FPS - CALM, 0.0)
        poses, trans = MOTIONS[kind](poses, trans, time, float(amount or 0.0))
    arrays |= {"poses": poses, "trans": trans, "mocap_framerate": np.array(FPS)}
    _write(path, kind, amount, arrays)


def write_garment(path: Path, garment: str, name: str) -> None:
    """Write an embedded garment with a fault.

    Amounts: ``size:0.5`` (factor), ``slivers:100`` (length over height of ten faces), ``duplicates:20`` (vertices 1 µm
    apart), ``flipped:30`` (faces), ``isolated:10`` (vertices), ``irregular:0.5`` (share of the way that vertices are moved),
    ``components:10``, ``remesh:300`` (vertices), ``subdivide:1`` (times), ``sheet:2`` (m above the head). Broken:
    ``nan:rest_pos`` (an entry of an array), ``inf:uv``, ``faces:beyond``, ``faces:negative``, ``empty``, ``cut``.

    Raises:
        ValueError: there is no such fault.
    """
    kind, _, amount = name.partition(":")
    if kind not in (*FAULTS, *_VALUES, *_FILES, "faces"):
        raise ValueError(unknown("fault", kind, (*FAULTS, *_VALUES, *_FILES, "faces")))
    whole = load_garment(garment)
    if kind in FAULTS:
        save_garment(path, FAULTS[kind](whole, float(amount or 0.0), np.random.default_rng(0)))
        return
    save_garment(path, whole)
    with np.load(path, allow_pickle=False) as file:
        arrays = {key: file[key] for key in file.files}
    if kind == "faces":
        arrays["faces"][len(arrays["faces"]) // 2, 1] = _FACES[amount]
    _write(path, kind, amount, arrays)


def write_still_body(path: Path) -> None:
    """Write the default body in T-pose as an OBJ mesh."""
    body = load_body()
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in body.v_template]
    lines += [f"f {a} {b} {c}" for a, b, c in body.faces + 1]
    write_atomically(path, ("\n".join(lines) + "\n").encode())


def _write(path: Path, kind: str, where: str, arrays: dict[str, np.ndarray]) -> None:
    """Write ``arrays``, with a value that one of them may not hold, or not all of the file, where ``kind`` says so."""
    if kind in _VALUES:
        broken = arrays[where].astype(np.float64)
        broken.reshape(-1)[broken.size // 2] = _VALUES[kind]
        arrays = arrays | {where: broken}
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)  # type: ignore[arg-type]
    whole = content.getvalue()
    write_atomically(path, whole[: round(len(whole) * _FILES.get(kind, 1.0))])
