"""Numbers that change little from frame to frame, as short text inside a page, and back."""

from __future__ import annotations

import base64
import zlib
from typing import Any

import numpy as np

#: Distance [m] between the positions that a page can hold: none is off by more than half of it in each coordinate.
STEP = 1.8e-4
#: Coordinates beyond this [m] are taken for cloth that blew up.
_FARTHEST = 3e4


def pack_positions(pos: np.ndarray) -> tuple[dict[str, Any], list[int]]:
    """Positions as JSON, within ``STEP / 2`` of what they are, and the frames that cannot be drawn.

    Whole multiples of ``STEP`` are kept as their second differences over the frames, which are small while a mesh moves
    smoothly. Frames with a coordinate that is not finite or is beyond 30 km repeat the frame before.

    Args:
        pos: (T, V, 3) [m].
    """
    flat = np.asarray(pos, dtype=np.float64).reshape(len(pos), -1)
    with np.errstate(invalid="ignore"):
        sound = (np.abs(flat) <= _FARTHEST).all(axis=1)  # false for NaN
    latest = np.maximum.accumulate(np.where(sound, np.arange(len(flat)), -1))
    first = int(np.argmax(sound)) if sound.any() else 0
    drawn = flat[np.where(latest < 0, first, latest)] if sound.any() else np.zeros_like(flat)
    whole = np.rint(drawn / STEP).astype(np.int64)
    second = np.diff(np.diff(whole, axis=0, prepend=0), axis=0, prepend=0)
    packed = {"frames": len(flat), "vertices": int(pos.shape[1]), "step": STEP, "data": pack_integers(second)}
    return packed, np.flatnonzero(~sound).tolist()


def unpack_positions(packed: dict[str, Any]) -> np.ndarray:
    """(T, V, 3) [m] of :func:`pack_positions`; the page does the same."""
    second = unpack_integers(packed["data"]).reshape(packed["frames"], -1)
    whole = np.cumsum(np.cumsum(second, axis=0, dtype=np.int32), axis=0, dtype=np.int32)
    return (whole * packed["step"]).reshape(packed["frames"], packed["vertices"], 3)


def pack_integers(values: np.ndarray) -> str:
    """Integers modulo 2^32 as text: signs folded into the lowest bit, all lowest bytes first, deflated, base64."""
    wrapped = np.asarray(values).astype(np.int64).astype(np.int32).ravel()
    folded = ((wrapped << 1) ^ (wrapped >> 31)).view(np.uint32).astype("<u4")
    return pack_bytes(folded.view(np.uint8).reshape(-1, 4).T)


def unpack_integers(text: str) -> np.ndarray:
    """(N,) int32 of :func:`pack_integers`."""
    planes = np.frombuffer(unpack_bytes(text), dtype=np.uint8).reshape(4, -1)
    folded = planes.T.copy().view("<u4").ravel()
    return ((folded >> 1) ^ (np.uint32(0) - (folded & 1))).view(np.int32)


def pack_bytes(values: np.ndarray) -> str:
    """(...) uint8, deflated and in base64."""
    return base64.b64encode(zlib.compress(np.ascontiguousarray(values, dtype=np.uint8).tobytes(), 6)).decode()


def unpack_bytes(text: str) -> bytes:
    """The bytes of :func:`pack_bytes`."""
    return zlib.decompress(base64.b64decode(text))
