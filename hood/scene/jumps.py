"""Jumps of a body, as at a cut in a recording: it is somewhere else, or looks another way, from one frame to the next.

Nothing could follow such a step: the body would pass through the cloth, or drag it along by half a metre. The cloth is carried
along instead, as one with the body, and the step is taken from there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from hood.cloth.state import Attachments, Obstacle, State, StepInput
from hood.scene.body_motion.mesh_motion import best_turn, moved
from hood.scene.body_motion.motion import Motion
from hood.scene.scene import Scene, local_origin

#: A step is a jump where the body is so much faster [m/s], or turns so much faster [rad/s], than it mostly does within so many
#: seconds around; motions that ship with the package reach 0.3 m/s and 0.8 rad/s, at eight times their speed 7 and 11.
_FASTER, _TURNING, _AROUND = 8.0, 15.0, 0.1
#: Steps to either side that this is at least.
_LEAST = 2
#: Of the body's vertices one in so many tells how it moves.
_SPARSE = 16


@dataclass(frozen=True)
class Jump:
    """A step in which the body jumps."""

    metres: float
    degrees: float


def find_jumps(motion: Motion, fps: float, faster: float = _FASTER) -> dict[int, Jump]:
    """Jumps by frame, that of a step being the one where it begins: in which the body is ``faster`` [m/s] than around it."""
    moved = np.diff(np.asarray(motion.translation, dtype=np.float64), axis=0)
    turns = motion.turns()
    frames = _outliers(moved, fps, faster) | _outliers(turns, fps, _TURNING)
    return {
        frame: Jump(float(np.linalg.norm(moved[frame])), float(np.degrees(np.linalg.norm(turns[frame]))))
        for frame in sorted(frames)
    }


def _outliers(steps: np.ndarray, fps: float, most: float) -> set[int]:
    """Rows of ``steps`` (T, 3) that differ from the median of those around by more than ``most`` per second."""
    reach = max(round(_AROUND * fps), _LEAST)
    found = set()
    for frame in np.flatnonzero(np.linalg.norm(steps, axis=1) * fps > most).tolist():
        usual = np.median(steps[max(frame - reach, 0) : frame + reach + 1], axis=0)
        if float(np.linalg.norm(steps[frame] - usual)) * fps > most:
            found.add(frame)
    return found


def describe_jumps(motion: Motion, jumps: dict[int, Jump]) -> str:
    """A sentence."""
    frames = sorted(jumps)
    named = ", ".join(map(str, frames[:4])) + ("" if len(frames) <= 4 else f" and {len(frames) - 4} more")
    many = "s" if len(frames) > 1 else ""
    metres, degrees = (max(getattr(jump, name) for jump in jumps.values()) for name in ("metres", "degrees"))
    how = [f"jumps by up to {metres:.2g} m"] if metres * motion.fps > _FASTER else []
    how += [f"turns by up to {degrees:.0f}° at once"] if np.radians(degrees) * motion.fps > _TURNING else []
    return (
        f"{motion.name!r} {' and '.join(how)} after frame{many} {named}, as at a cut: the cloth is "
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
    turn = best_turn(before - middle, after - goal)
    origin = local_origin(end)

    def along(pos: Tensor, at: np.ndarray) -> Tensor:
        """Positions relative to ``at`` as they are relative to the new origin when they have been taken along."""
        given = pos.detach().cpu().double().numpy() + (at - start)
        return torch.as_tensor((given - middle) @ turn.T + goal + (end - origin)).to(like) + turned(pos - pos.detach())

    def turned(change: Tensor) -> Tensor:
        """Zero, but for its derivative: what a ``change`` (V, 3) of what is taken along becomes."""
        return change @ torch.as_tensor(turn.T).to(change) if change.requires_grad else like.new_zeros(())

    velocity = torch.as_tensor(state.vel.detach().cpu().double().numpy() @ turn.T).to(like)
    velocity = velocity + turned(state.vel - state.vel.detach())
    taken = State(along(state.pos, state.origin[0].numpy()), velocity, torch.as_tensor(origin).unsqueeze(0))
    step = scene.step_input(frame, taken, attachments=attachments, jumping=True)
    assert step.obstacle is not None  # nothing jumps without a body
    earlier = motion.surface(max(frame - 1, 0), start)
    now = along(torch.as_tensor(before), start)
    return taken, replace(step, obstacle=replace(step.obstacle, pos=now, prev_pos=along(earlier, start)))


def moved_in_step(obstacle: Obstacle | None) -> tuple[float, float]:
    """Degrees that the body turns as one in a step, and the way [m] of its fastest vertex, of one in 16; 0 without a body."""
    if obstacle is None or not len(obstacle.pos):
        return 0.0, 0.0
    return moved(*(pos[::_SPARSE].cpu().numpy().astype(np.float64) for pos in (obstacle.pos, obstacle.next_pos)))
