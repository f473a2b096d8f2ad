"""Loading a body in motion: any body (model, mesh, none) with any motion, behind one function."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from hood.assets.body.body import Body
from hood.assets.body.load import load_body
from hood.assets.files.said import Doubt
from hood.assets.motion.animated_mesh import NO_BODY, BodyMesh, body_kind, load_mesh_sequence, perform_mesh
from hood.assets.motion.load import load_sequence, perform_poses
from hood.assets.motion.sequence import PoseSequence
from hood.scene.body_motion.mesh_motion import NoBody, mesh_motion
from hood.scene.body_motion.motion import Motion, body_motion

#: A sequence that says so: meshes perform their own, and without a body there is none.
NO_MOTION = "none"
#: Characters of a value that a message repeats at most.
_SHOWN = 100
#: Shape coefficients are standard deviations; body models say nothing of what lies this far out.
_MEANT = 5.0


@dataclass(frozen=True)
class MotionOptions:
    """How a motion is performed. What does not apply to a kind of body is not looked at: a mesh has no betas."""

    fps: float = 30.0
    up: str = "auto"
    start: float | str | None = None
    stop: float | str | None = None
    loop: int = 1
    file_fps: float | None = None
    num_frames: int = 150  # for bodies that do not move, and for a single pose
    # parametric bodies
    person: int | str | None = None  # who of several people in the motion's file
    trans_unit: str = "auto"
    betas: Sequence[float] | None = (
        None  # None: the recorded subject's where the body is the model that recorded it, else zeros
    )
    gender: str | None = None  # of the model, from a folder of models; None: the motion's
    blend_in: float = 0.0
    blend_from: str = "t"
    hands: str = "flat"
    # meshes
    scale: float | None = None
    animation: int | str | None = None  # None: the first
    parts: Sequence[str] = ()


def load_motion(
    body: str | Path | Body | BodyMesh = "default",
    sequence: str | Path | PoseSequence = "walk_proud",
    options: MotionOptions | None = None,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str = "cpu",
) -> Motion:
    """``body`` performing ``sequence``.

    Args:
        body: embedded name, model file of the SMPL family or a folder of them, a moving or still mesh
            (:func:`hood.assets.motion.animated_mesh.load_mesh_sequence`), or "none"; or the body itself.
        sequence: embedded name or motion file, or the motion itself; a mesh performs its own, and "none" has none: it is not
            looked at then.

    Raises:
        FileNotFoundError: unknown name or missing file.
        ValueError: unreadable, an option out of range, or a body that needs a motion and has none; names the file or option
            and the fix.
    """
    options = options or MotionOptions()
    if isinstance(body, BodyMesh):
        performed = perform_mesh(
            body, options.fps, options.up, start=options.start, stop=options.stop, loop=options.loop, scale=options.scale
        )
        return mesh_motion(performed, options.num_frames, dtype, device)
    if isinstance(body, Body):
        return _posed_body(body, sequence, options, dtype, device)
    kind = body_kind(body)
    if kind == NO_BODY:
        return NoBody(options.num_frames, options.fps, dtype, torch.device(device))
    if kind == "mesh":
        mesh = load_mesh_sequence(
            body, options.fps, options.up, start=options.start, stop=options.stop, loop=options.loop,
            file_fps=options.file_fps, scale=options.scale, animation=options.animation or 0, parts=options.parts,
        )  # fmt: skip
        return mesh_motion(mesh, options.num_frames, dtype, device)
    if str(sequence) == NO_MOTION:
        raise ValueError(
            f"body={body} has no motion of its own and sequence=none; give a motion, sequence=walk_proud or a file, or a mesh "
            "that stands still as body"
        )
    return _posed_body(body, sequence, options, dtype, device)


def _posed_body(
    body: str | Path | Body,
    sequence: str | Path | PoseSequence,
    options: MotionOptions,
    dtype: torch.dtype,
    device: torch.device | str,
) -> Motion:
    """A body with joints performing a motion."""
    if isinstance(sequence, PoseSequence):
        poses = perform_poses(
            sequence, options.fps, options.up, start=options.start, stop=options.stop, loop=options.loop,
            blend_in=options.blend_in, blend_from=options.blend_from, hands=options.hands, num_frames=options.num_frames,
        )  # fmt: skip
    else:
        poses = _read(sequence, options)
    model = body if isinstance(body, Body) else load_body(body, options.gender or poses.gender)
    return body_motion(model, poses, _betas(options.betas, model.subject_betas(poses)), dtype, device)


def _read(sequence: str | Path, options: MotionOptions) -> PoseSequence:
    """The motion of a file, as it is to be performed."""
    return load_sequence(
        sequence, options.fps, options.up, start=options.start, stop=options.stop, loop=options.loop,
        blend_in=options.blend_in, blend_from=options.blend_from, hands=options.hands, file_fps=options.file_fps,
        person=options.person, trans_unit=options.trans_unit, num_frames=options.num_frames,
    )  # fmt: skip


def _betas(given: Sequence[float] | None, recorded: np.ndarray) -> np.ndarray:
    if given is None:
        return recorded
    betas = np.zeros(max(len(recorded), 10))
    values = np.asarray(given, dtype=np.float64).reshape(-1)
    if len(values) > len(betas) or not np.isfinite(values).all():
        raise ValueError(
            f"betas={str(list(given))[:_SHOWN]}: give at most {len(betas)} finite shape coefficients, e.g. [1.5, 0, -1]"
        )
    betas[: len(values)] = values
    _doubt(betas)
    return betas


def _doubt(betas: np.ndarray) -> None:
    """Warn about the largest coefficient that no body model is made for."""
    index = int(np.abs(betas).argmax())
    value = float(betas[index])
    if abs(value) > _MEANT:
        hint = f"; if a point is missing, give {value / 10:g}" if abs(value) / 10 <= _MEANT else ""
        sentence = (
            f"betas[{index}]={value:g} is beyond what body models are made for, {-_MEANT:g} to {_MEANT:g}: the body is hardly "
            f"a person's, and garments may not fit it{hint}"
        )
        warnings.warn(Doubt("shape", sentence, value=value, unit="standard deviations"), stacklevel=2)
