"""Walking, running and stepping for the puppet: footsteps along a path, and a body that moves with them.

A foot is planted where the pelvis will be at the middle of its stance, so that no foot slides; between
two plants it swings. Phase counts cycles (two steps); the left stance is centred at whole numbers, the
right one half a cycle later.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter1d

from tools.assets.puppet import Controls, Skeleton

Array = NDArray[np.float64]

_START_PHASE = 0.25  # both feet on the floor


@dataclass(frozen=True)
class Gait:
    """One style. Lengths in metres, angles in degrees, times in seconds.

    Attributes:
        speed: along the path; `sidestep` turns the direction of travel to the left of where the puppet looks.
        cycle: time of two steps. `duty`: share of it that a foot is on the floor; below 0.5 both feet fly.
        half_width: of the track. `lift`: extra height of a swinging foot; `heel_kick`: its pitch early on.
        bounce: of the pelvis, positive highest over the standing foot (walk), negative lowest there (run).
    """

    speed: float
    cycle: float = 1.08
    duty: float = 0.62
    half_width: float = 0.085
    lift: float = 0.035
    heel_kick: float = 42.0
    toe_up: float = 16.0
    sidestep: float = 0.0
    drop: float = 0.015
    bounce: float = 0.012
    sway: float = 0.025
    hip_yaw: float = 5.0
    hip_roll: float = 3.5
    shoulder_twist: float = 11.0
    lean: float = 2.0
    arm_swing: float = 24.0
    arm_lower: float = 66.0
    arm_forward: float = 2.0
    elbow: float = 20.0
    elbow_swing: float = 12.0


def ease(time: Array, start: float = 0.15, length: float = 0.7) -> Array:
    """Smooth step from 0 to 1 that begins at `start` and takes `length` seconds."""
    part = np.clip((time - start) / length, 0.0, 1.0)
    return part**3 * (10.0 - 15.0 * part + 6.0 * part**2)


def walk(controls: Controls, skeleton: Skeleton, gait: Gait, turn_rate: Array | float = 0.0) -> Array:
    """Moves the puppet in place of its stand; returns the phase (T,).

    `turn_rate` is the change of heading [degrees/s], a number or per frame (T,).
    """
    time, dt = controls.time, 1.0 / controls.fps
    strength = ease(time)
    phase = _START_PHASE + _integral(ease(time, 0.1, 0.5) / gait.cycle, dt)
    heading = _integral(np.broadcast_to(turn_rate, time.shape) * strength, dt)
    travel = np.radians(heading + gait.sidestep)
    speed = gait.speed * ease(time, 0.2, 1.2)
    path = np.stack([_integral(speed * np.sin(travel), dt), _integral(speed * np.cos(travel), dt)], axis=1)
    controls.pelvis[:, [0, 2]] += path
    controls.pelvis_turn[:, 1] += heading
    _place_feet(controls, skeleton, gait, phase, strength)
    _move_body(controls, gait, phase, strength, np.radians(heading))
    return phase


def _place_feet(controls: Controls, skeleton: Skeleton, gait: Gait, phase: Array, strength: Array) -> None:
    duty = 0.62 + (gait.duty - 0.62) * strength
    pitch_of = _pitch_curve(gait)
    blur = 0.026 * controls.fps
    for side, offset in enumerate((0.0, 0.5)):
        sign = 1.0 - 2.0 * side
        cycle = np.round(phase - offset)
        since = phase - offset - cycle
        swing = np.where(since > 0, since - 0.5 * duty, since + 1.0 - 0.5 * duty) / (1.0 - duty)
        swing = np.clip(np.where(np.abs(since) <= 0.5 * duty, 0.0, swing), 0.0, 1.0)
        leaving = np.where((swing > 0) & (since < 0), cycle - 1, cycle)
        before = _plant(controls, skeleton, gait, phase, leaving + offset, sign)
        after = _plant(controls, skeleton, gait, phase, leaving + 1 + offset, sign)
        # Less than a full ease: the foot already moves when it leaves the floor.
        part = swing - 0.7 * np.sin(2 * np.pi * swing) / (2 * np.pi)
        place = before + part[:, None] * (after - before)
        lift = gait.lift * np.sin(np.pi * swing**0.8) ** 1.3
        stance = np.where(np.abs(since) <= 0.5 * duty, since / duty, 0.0)
        pitch = np.where(swing > 0, pitch_of(0.5 + swing), pitch_of(stance))
        controls.foot[:, side, 0] = gaussian_filter1d(place[:, 0], blur, mode="nearest")
        controls.foot[:, side, 2] = gaussian_filter1d(place[:, 1], blur, mode="nearest")
        controls.foot[:, side, 1] += gaussian_filter1d(lift * strength, blur, mode="nearest")
        controls.foot_yaw[:, side] = gaussian_filter1d(place[:, 2], blur, mode="nearest")
        controls.foot_pitch[:, side] += gaussian_filter1d(pitch * strength, blur, mode="nearest")


def _plant(controls: Controls, skeleton: Skeleton, gait: Gait, phase: Array, middle: Array, sign: float) -> Array:
    """Place x, z and yaw (T, 3) of the footstep whose stance is centred at the phase `middle` (T,)."""
    # Past the last frame the walk goes on straight with its last speed.
    rate, last = (phase[-1] - phase[-2]), len(phase) - 1
    frame = np.where(middle <= phase[-1], np.interp(middle, phase, np.arange(last + 1)), last + (middle - phase[-1]) / rate)
    over = np.maximum(frame - last, 0.0)
    x, z, yaw = (
        np.interp(frame, np.arange(last + 1), track) + over * (track[-1] - track[-2])
        for track in (controls.pelvis[:, 0], controls.pelvis[:, 2], controls.pelvis_turn[:, 1])
    )
    heading = np.radians(yaw)
    width = skeleton.ankle_spacing + (gait.half_width - skeleton.ankle_spacing) * np.clip(middle - 0.5, 0.0, 1.0)
    aside = sign * width
    return np.stack([x + aside * np.cos(heading), z - aside * np.sin(heading), yaw + 7.0 * sign], axis=1)


def _pitch_curve(gait: Gait) -> PchipInterpolator:
    """Foot pitch over a cycle: -0.5..0.5 is the stance, from heel strike to toe-off; 0.5..1.5 the swing."""
    push = min(0.75 * gait.heel_kick, 40.0)
    keys = [-0.5, -0.34, 0.0, 0.12, 0.5, 0.72, 1.12, 1.38, 1.5]
    values = [-gait.toe_up, 0.0, 0.0, 0.0, push, gait.heel_kick, 0.0, -gait.toe_up, -gait.toe_up]
    return PchipInterpolator(keys, values)


def _move_body(controls: Controls, gait: Gait, phase: Array, strength: Array, heading: Array) -> None:
    turn = 2.0 * np.pi * phase
    over_left, left_back = np.cos(turn), np.sin(turn)
    sway = gait.sway * over_left * strength
    controls.pelvis[:, 0] += sway * np.cos(heading)
    controls.pelvis[:, 2] -= sway * np.sin(heading)
    controls.pelvis[:, 1] += strength * (gait.bounce * np.cos(2 * turn) - gait.drop)
    controls.pelvis_turn += strength[:, None] * np.stack(
        [0.4 * gait.lean + 0 * turn, gait.hip_yaw * left_back, gait.hip_roll * over_left], axis=1
    )
    twist = -(gait.hip_yaw + gait.shoulder_twist) * left_back
    # Spine and head undo the sway of the pelvis below them.
    controls.spine += strength[:, None] * np.stack(
        [0.6 * gait.lean + 0.8 * np.cos(2 * turn), twist, gait.hip_roll * 1.1 * over_left], axis=1
    )
    controls.head += strength[:, None] * np.stack(
        [-0.7 * gait.lean - 0.6 * np.cos(2 * turn), 0.85 * gait.shoulder_twist * left_back, 0 * turn], axis=1
    )
    for side, forward in enumerate((left_back, -left_back)):
        goal = np.stack(
            [
                gait.arm_lower - 2.0 * forward,
                gait.arm_forward + gait.arm_swing * (forward + 0.15),
                -4.0 + 0 * turn,
                gait.elbow + gait.elbow_swing * forward,
            ],
            axis=1,
        )
        controls.arm[:, side] += strength[:, None] * (goal - controls.arm[:, side])


def _integral(rate: Array, dt: float) -> Array:
    """Trapezoidal integral from zero, same length."""
    return np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]))]) * dt
