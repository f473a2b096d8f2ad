"""Jumps of a body, as at a cut in a recording: it is somewhere else from one frame to the next.

Nothing could follow such a step: the body would pass through the cloth, or drag it along by half a metre. The cloth is carried
along instead, as one with the body, and the step is taken from there.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from hood.scene.motion import Motion
from hood.scene.scene import Scene, local_origin
from hood.scene.state import Attachments, State, StepInput

#: A step is a jump where the body is so much faster [m/s] than it mostly is within so many seconds around; motions that ship
#: with the package reach 0.3 m/s, at eight times their speed 7.
_FASTER, _AROUND = 8.0, 0.1
#: Steps to either side that this is at least.
_LEAST = 2


def find_jumps(motion: Motion, fps: float) -> dict[int, float]:
    """Metres by frame, of the steps from there in which the body jumps."""
    moved = np.diff(np.asarray(motion.translation, dtype=np.float64), axis=0)
    reach = max(round(_AROUND * fps), _LEAST)
    found = {}
    for frame in np.flatnonzero(np.linalg.norm(moved, axis=1) * fps > _FASTER).tolist():
        usual = np.median(moved[max(frame - reach, 0) : frame + reach + 1], axis=0)
        if float(np.linalg.norm(moved[frame] - usual)) * fps > _FASTER:
            found[frame] = float(np.linalg.norm(moved[frame]))
    return found


def describe_jumps(motion: Motion, jumps: dict[int, float]) -> str:
    """A sentence."""
    frames = sorted(jumps)
    named = ", ".join(map(str, frames[:4])) + ("" if len(frames) <= 4 else f" and {len(frames) - 4} more")
    many = "s" if len(frames) > 1 else ""
    return (
        f"{motion.name!r} jumps by up to {max(jumps.values()):.2g} m after frame{many} {named}, as at a cut: the cloth is "
        "carried along there; start and stop leave a part of the motion out"
    )


def carried(scene: Scene, frame: int, state: State, attachments: Attachments | None = None) -> tuple[State, StepInput]:
    """The state and the input of the step ``frame`` → ``frame + 1`` with cloth and body taken along as one to where the body
    will be; what is left of its motion are its limbs.

    The turn and the shift are those that fit the body's vertices best.
    """
    motion, like = scene.motion, state.pos
    start, end = motion.translation[frame], motion.translation[frame + 1]
    before, after = (motion.surface(k, at).cpu().double().numpy() for k, at in ((frame, start), (frame + 1, end)))
    middle, goal = before.mean(axis=0), after.mean(axis=0)
    turn = _best_turn(before - middle, after - goal)
    origin = local_origin(end)

    def along(pos: Tensor, at: np.ndarray) -> Tensor:
        """Positions relative to ``at`` as they are relative to the new origin when they have been taken along."""
        given = pos.detach().cpu().double().numpy() + (at - start)
        return torch.as_tensor((given - middle) @ turn.T + goal + (end - origin)).to(like)

    velocity = torch.as_tensor(state.vel.cpu().double().numpy() @ turn.T).to(like)
    moved = State(along(state.pos, state.origin[0].numpy()), velocity, torch.as_tensor(origin).unsqueeze(0))
    step = scene.step_input(frame, moved, attachments=attachments)
    assert step.obstacle is not None  # nothing jumps without a body
    earlier = motion.surface(max(frame - 1, 0), start)
    now = along(torch.as_tensor(before), start)
    return moved, replace(step, obstacle=replace(step.obstacle, pos=now, prev_pos=along(earlier, start)))


def _best_turn(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """The rotation (3, 3) that takes points (N, 3) about their middle nearest to others."""
    left, _, right = np.linalg.svd(end.T @ start)
    mirrored = np.linalg.det(left @ right) < 0.0
    return np.asarray(left @ np.diag([1.0, 1.0, -1.0 if mirrored else 1.0]) @ right)
