"""Mesh sequences: a moving mesh, resampled, turned, cut and repeated."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hood.assets.files.library import SIZE_LIMIT
from hood.assets.motion.sequence import time_stamps
from hood.assets.motion.sequence_edit import frame_at
from hood.assets.motion.skeleton import UP_AXES

#: First and last frame of a motion that can be repeated may differ by this share of its size.
_SEAM = 0.05


@dataclass(frozen=True)
class MeshSequence:
    """A moving mesh, y up, in metres.

    Without a skin only what is given in its first frame can follow it. ``transforms`` take points of a rest pose, in the same
    world, to every frame: a garment with weights for those joints is posed by them. Where the file also has the mesh in
    that pose and its weights, garments given there can be bound.
    """

    name: str
    verts: np.ndarray  # (T, W, 3) m, world; float64 or float32, as the file has them
    faces: np.ndarray  # (G, 3) int64
    fps: float
    transforms: np.ndarray | None = None  # (T, J, 3, 4) float64
    rest: np.ndarray | None = None  # (W, 3) m, float64
    weights: np.ndarray | None = None  # (W, J)
    joints: tuple[str, ...] = ()  # names of J; empty where the file has none
    fps_assumed: bool = False  # the file does not say a frame rate

    @property
    def num_frames(self) -> int:
        return len(self.verts)

    @property
    def bones(self) -> dict[str, np.ndarray]:
        """By the name of each joint the vertices (W,) bool that follow it most; empty where they have no weights or names."""
        if self.weights is None:
            return {}
        most = self.weights.argmax(axis=1)
        return {name: most == number for number, name in enumerate(self.joints)}

    def window(self, start: int, stop: int) -> MeshSequence:
        """Frames ``start:stop``."""
        transforms = None if self.transforms is None else self.transforms[start:stop]
        return replace(self, verts=self.verts[start:stop], transforms=transforms)


def resample_mesh(sequence: MeshSequence, fps: float) -> MeshSequence:
    """The motion at another frame rate: linear in time, time stamps k / fps, no drift. A still mesh stays one frame."""
    if sequence.num_frames == 1 or abs(sequence.fps - fps) < 1e-9:
        return replace(sequence, fps=fps)
    source, target = time_stamps(sequence.name, sequence.num_frames, sequence.fps, fps)
    if len(target) * sequence.verts[0].nbytes > SIZE_LIMIT:
        raise ValueError(f"{sequence.name}: {len(target)} frames at {fps:g} fps are too many to keep; trim it with start, stop")
    at = target * sequence.fps
    first = np.minimum(np.floor(at + 1e-9).astype(np.int64), len(source) - 2)
    share = np.clip(at - first, 0.0, 1.0)
    verts = np.empty((len(target), *sequence.verts.shape[1:]), sequence.verts.dtype)
    for frame, (index, u) in enumerate(zip(first, share, strict=True)):
        verts[frame] = _mix(sequence.verts[index], sequence.verts[index + 1], u)
    transforms = sequence.transforms
    if transforms is not None:
        transforms = np.stack([_mix(transforms[i], transforms[i + 1], u) for i, u in zip(first, share, strict=True)])
    return replace(sequence, verts=verts, fps=fps, transforms=transforms)


def turn_mesh(sequence: MeshSequence, scale: float, up: str) -> MeshSequence:
    """The motion scaled by ``scale`` [m per unit] and turned so that ``up``, an axis of :data:`UP_AXES` or "auto" for y, is y.

    Raises:
        ValueError: ``scale`` is not a positive number.
    """
    if not np.isfinite(scale) or scale <= 0:
        raise ValueError(f"unit={scale}: give metres per unit of the file, more than zero")
    turn = UP_AXES["y" if up == "auto" else up]
    if scale == 1.0 and np.array_equal(turn, np.eye(3)):
        return sequence
    # Column by column: a product with a matrix would take the memory of a second sequence in float64.
    verts = np.empty_like(sequence.verts)
    for row in range(3):
        column = int(np.abs(turn[row]).argmax())
        np.multiply(sequence.verts[..., column], scale * turn[row, column], out=verts[..., row])
    # The rest pose is scaled and turned as the frames are: rotations change their axes, shifts also their length.
    transforms, rest = sequence.transforms, sequence.rest
    if transforms is not None:
        linear, shift = turn @ transforms[..., :3] @ turn.T, scale * transforms[..., 3] @ turn.T
        transforms = np.concatenate([linear, shift[..., None]], axis=-1)
    return replace(sequence, verts=verts, transforms=transforms, rest=None if rest is None else scale * rest @ turn.T)


def trim_mesh(sequence: MeshSequence, start: float | str | None, stop: float | str | None) -> MeshSequence:
    """The part from ``start`` to ``stop`` (included), see :func:`hood.assets.motion.sequence_edit.frame_at`.

    Raises:
        ValueError: no frame is left.
    """
    if start is None and stop is None:
        return sequence
    first = 0 if start is None else frame_at("start", start, sequence.fps)
    last = sequence.num_frames - 1 if stop is None else frame_at("stop", stop, sequence.fps)
    if first > min(last, sequence.num_frames - 1):
        raise ValueError(f"{sequence.name}: start={start}, stop={stop} leave none of its {sequence.num_frames} frames")
    return sequence.window(first, last + 1)


def loop_mesh(sequence: MeshSequence, plays: int) -> MeshSequence:
    """The motion ``plays`` times; the end of one play is the beginning of the next.

    Raises:
        ValueError: it does not end as it began, or ``plays`` is not a positive number.
    """
    if plays == 1 or sequence.num_frames == 1:
        return sequence
    if plays < 1 or plays * sequence.verts.nbytes > SIZE_LIMIT:
        raise ValueError(f"loop={plays}: give how often the motion is played, at least 1; so many frames cannot be kept")
    gap = float(np.abs(sequence.verts[-1] - sequence.verts[0]).max())
    if gap > _SEAM * float(np.ptp(sequence.verts[0], axis=0).max()):
        raise ValueError(
            f"{sequence.name}: its last frame is {gap:.3g} m from its first; loop needs a motion that ends as it began"
        )
    verts = np.concatenate([sequence.verts, *([sequence.verts[1:]] * (plays - 1))])
    transforms = sequence.transforms
    if transforms is not None:
        transforms = np.concatenate([transforms, *([transforms[1:]] * (plays - 1))])
    return replace(sequence, verts=verts, transforms=transforms)


def _mix(first: np.ndarray, second: np.ndarray, share: float) -> np.ndarray:
    return first * (1.0 - share) + second * share
