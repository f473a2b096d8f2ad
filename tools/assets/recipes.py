"""What the puppet does, one function per kind of motion; each changes the controls of a still puppet."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator
from scipy.ndimage import gaussian_filter1d

from tools.assets.gait import Gait, ease, walk
from tools.assets.puppet import Controls, Skeleton

Array = NDArray[np.float64]
Recipe = Callable[[Controls, Skeleton, np.random.Generator], None]

# Arm poses (lowering, swing forward, twist, elbow) a dance blends between.
_ARMS = {
    "easy": (60.0, 5.0, 0.0, 22.0),
    "wide": (6.0, 0.0, 0.0, 10.0),
    "high": (-62.0, 5.0, -20.0, 18.0),
    "front": (52.0, 78.0, 0.0, 18.0),
    "cactus": (2.0, 0.0, -70.0, 85.0),
    "chest": (28.0, 38.0, 0.0, 80.0),
    "low_wide": (38.0, -8.0, -10.0, 12.0),
    "disco": (-30.0, 18.0, -20.0, 20.0),
    "behind": (50.0, -28.0, 0.0, 20.0),
    "pump": (55.0, 25.0, 0.0, 95.0),
}


def walking(gait: Gait, turn: float = 0.0, period: float = 0.0) -> Recipe:
    """A walk that turns by `turn` degrees/s, to and fro with the given period [s] or always to one side."""

    def recipe(controls: Controls, skeleton: Skeleton, rng: np.random.Generator) -> None:
        time = controls.time
        rate = turn * (np.sin(2 * np.pi * time / period) if period else np.ones_like(time))
        walk(controls, skeleton, gait, rate)
        # Into a curve one leans and looks.
        controls.pelvis_turn[:, 2] -= 0.06 * rate * gait.speed * ease(time, 0.5, 1.0)
        controls.head[:, 1] += 0.35 * rate * ease(time, 0.3, 1.0)

    return recipe


def side_steps(gait: Gait) -> Recipe:
    def recipe(controls: Controls, skeleton: Skeleton, rng: np.random.Generator) -> None:
        # A quarter turn to and fro turns steps to the side into steps around the place.
        rate = 24.0 * np.sin(2 * np.pi * controls.time / 5.5)
        walk(controls, skeleton, gait, rate)
        controls.head[:, 1] += 22.0 * ease(controls.time, 0.4, 1.0)

    return recipe


def sway(controls: Controls, skeleton: Skeleton, rng: np.random.Generator) -> None:
    time, on = controls.time, ease(controls.time)
    shift = np.sin(2 * np.pi * (time - 0.2) / 4.2) * on
    controls.pelvis[:, 0] += 0.055 * shift
    controls.pelvis[:, 1] -= 0.006 * on
    controls.pelvis_turn[:, 2] += 4.0 * shift
    controls.pelvis_turn[:, 1] += 6.0 * _drift(time, rng) * on
    controls.spine += on[:, None] * np.stack([3 * _drift(time, rng), 9 * _drift(time, rng), 4.5 * shift], axis=1)
    controls.head += on[:, None] * np.stack([7 * _drift(time, rng), 26 * _drift(time, rng), 0 * on], axis=1)
    for side in range(2):
        goal = np.array([65.0, 4.0, 0.0, 20.0]) + 5.0 * _drift(time, rng)[:, None] * [0.6, 1.0, 0.0, 2.0]
        _arm_to(controls, side, goal, on)


def squats(controls: Controls, skeleton: Skeleton, rng: np.random.Generator) -> None:
    time = controls.time
    _widen(controls, 0.07, 18.0)
    depth = _pulses(time, start=1.2, period=2.5, depths=[0.6, 1.0, 0.85, 1.0])
    _squat_pose(controls, depth)
    for side in range(2):
        _arm_to(controls, side, np.array([60.0, 3.0, 0.0, 20.0]), ease(time))
        _arm_to(controls, side, np.array([58.0, 112.0, 0.0, 20.0]), depth)


def plie(controls: Controls, skeleton: Skeleton, rng: np.random.Generator) -> None:
    time = controls.time
    _widen(controls, 0.16, 38.0)
    depth = _pulses(time, start=1.1, period=2.2, depths=[0.8, 1.0, 0.7, 1.0])
    controls.pelvis[:, 1] -= 0.26 * depth
    controls.pelvis_turn[:, 0] += 4.0 * depth
    controls.spine[:, 2] += 16.0 * np.sin(2 * np.pi * (time - 1.1) / 4.4) * ease(time, 1.1, 1.0)
    for side in range(2):
        _arm_to(controls, side, np.array([45.0, 15.0, -10.0, 20.0]), ease(time))
        _arm_to(controls, side, np.array([-40.0, 15.0, -20.0, 35.0]), 0.9 * depth)


def _squat_pose(controls: Controls, depth: Array) -> None:
    controls.pelvis[:, 1] -= 0.40 * depth
    controls.pelvis[:, 2] -= 0.17 * depth
    controls.pelvis_turn[:, 0] += 32.0 * depth
    controls.spine[:, 0] += 12.0 * depth
    controls.head[:, 0] -= 26.0 * depth


def bends(controls: Controls, skeleton: Skeleton, rng: np.random.Generator) -> None:
    time = controls.time
    _widen(controls, 0.04, 12.0)
    forward = _pulses(time, start=1.0, period=3.0, depths=[0.75, 0.0, 1.0, 0.0])
    side = _track(time, [0, 4.0, 5.1, 5.4, 6.8, 7.1, 8.0, 10.0, 11.0, 11.3, 12.7, 13.0, 14.0],
                  [0, 0, 1, 1, -1, -1, 0, 0, -1, -1, 1, 1, 0])  # fmt: skip
    _bend_pose(controls, forward)
    controls.pelvis[:, 0] -= 0.05 * side
    controls.spine[:, 2] += 30.0 * side
    controls.head[:, 2] += 10.0 * side
    for index, sign in enumerate((1.0, -1.0)):
        _arm_to(controls, index, np.array([62.0, 4.0, 0.0, 18.0]), ease(time))
        _arm_to(controls, index, np.array([-55.0, 8.0, -15.0, 25.0]), np.clip(-sign * side, 0, 1) ** 2)
        controls.arm[:, index, 1] += 62.0 * forward
        controls.arm[:, index, 0] += 4.0 * forward


def _bend_pose(controls: Controls, amount: Array) -> None:
    controls.pelvis_turn[:, 0] += 42.0 * amount
    controls.spine[:, 0] += 42.0 * amount
    controls.head[:, 0] -= 14.0 * amount
    controls.pelvis[:, 2] -= 0.13 * amount
    controls.pelvis[:, 1] -= 0.05 * amount


def twists(controls: Controls, skeleton: Skeleton, rng: np.random.Generator) -> None:
    time = controls.time
    _widen(controls, 0.06, 10.0)
    on = ease(time, 0.4, 1.4)
    period = 2.3 - 0.5 * ease(time, 4.0, 4.0)
    swing = np.sin(2 * np.pi * np.cumsum(1.0 / period) / controls.fps) * on
    _twist_pose(controls, swing, 1.0)
    arms = _track(time, [0, 0.6, 1.4, 5.5, 6.6, 12.0], [0, 0, 1, 1, 2, 2])
    for index, sign in enumerate((1.0, -1.0)):
        _arm_to(controls, index, np.array([26.0, 12.0, 0.0, 20.0]), np.clip(arms, 0, 1))
        _arm_to(controls, index, np.array([30.0, 48.0, 0.0, 70.0]), np.clip(arms - 1, 0, 1))
        # Arms trail behind the chest.
        controls.arm[:, index, 1] += 14.0 * sign * np.roll(swing, round(0.18 * controls.fps)) * on


def _twist_pose(controls: Controls, swing: Array, amount: float) -> None:
    controls.pelvis_turn[:, 1] += 18.0 * amount * swing
    controls.spine[:, 1] += 42.0 * amount * swing
    controls.head[:, 1] += 12.0 * amount * swing
    controls.pelvis[:, 0] += 0.03 * amount * swing
    controls.pelvis[:, 1] -= 0.02 * np.abs(swing)


def twist_and_bend(controls: Controls, skeleton: Skeleton, rng: np.random.Generator) -> None:
    """Windmill: bend forward with one hand towards the other foot, rise, and turn to the other side."""
    time = controls.time
    _widen(controls, 0.14, 12.0)
    amount = _pulses(time, start=0.9, period=2.6, depths=[0.7, 0.85, 0.8, 0.9])
    side = np.sign(np.sin(np.pi * np.maximum(time - 0.9, 1e-6) / 2.6)) * amount
    _bend_pose(controls, 0.85 * amount)
    controls.spine[:, 1] += 40.0 * side
    controls.pelvis_turn[:, 1] += 9.0 * side
    on = ease(time)
    for index, sign in enumerate((1.0, -1.0)):
        _arm_to(controls, index, np.array([22.0, 5.0, 0.0, 12.0]), on)
        controls.arm[:, index, 1] += 26.0 * np.clip(-sign * side, 0, 1)


def arm_raises(controls: Controls, skeleton: Skeleton, rng: np.random.Generator) -> None:
    time = controls.time
    times = np.array([0, 0.5, 1.7, 2.2, 3.4, 4.6, 5.0, 6.2, 7.4, 8.4, 9.4, 10.6, 11.6, 12.6, 14.0])
    poses = ["start", "start", "high", "high", "easy", "front", "front", "high_front", "front", "wide",
             "cactus", "wide", "chest", "wide", "easy"]  # fmt: skip
    table = _ARMS | {"start": (52.0, 2.0, 0.0, 14.0), "high_front": (55.0, 155.0, 0.0, 12.0)}
    for side in range(2):
        lag = 0.0 if side == 0 else 0.06
        controls.arm[:, side] = _track(time - lag, times, [table[name] for name in poses])
    lift = _track(time, [0, 0.6, 1.8, 2.2, 3.4, 5.2, 6.2, 7.2, 14.0], [0, 0, 1, 1, 0, 0, 1, 0, 0])
    controls.foot_pitch += 14.0 * lift[:, None]
    controls.pelvis[:, 1] += 0.03 * lift
    controls.pelvis[:, 2] += 0.035 * lift
    controls.spine[:, 0] -= 5.0 * lift
    controls.head[:, 0] -= 10.0 * lift


def jumps(controls: Controls, skeleton: Skeleton, rng: np.random.Generator) -> None:
    time = controls.time
    for start, height in zip((1.3, 3.2, 5.1, 6.9), (0.14, 0.22, 0.18, 0.27), strict=True):
        _jump(controls, start, height)
    controls.spine[:, 1] += 5.0 * _drift(time, rng) * ease(time)


def _jump(controls: Controls, takeoff: float, height: float) -> None:
    """Crouch, ballistic flight of the pelvis, soft landing. The feet fly with the pelvis."""
    time, gravity = controls.time, 9.81
    speed = np.sqrt(2 * gravity * height)
    flight = 2 * speed / gravity
    land = takeoff + flight
    air = np.clip(time - takeoff, 0.0, flight)
    rise = speed * air - 0.5 * gravity * air**2
    rise_at_toes, dip = 0.03, 0.20 + 0.25 * height
    push = 2.2 * (dip + rise_at_toes) / speed
    keys = np.array([takeoff - push - 0.55, takeoff - push, takeoff, land, land + push, land + push + 0.6])
    slopes = [0.0, 0.0, speed, -speed, 0.0, 0.0]
    crouch = _hermite(time, keys, [0.0, -dip, rise_at_toes, rise_at_toes, -0.85 * dip, 0.0], slopes)
    airborne = (time > takeoff) & (time < land)
    controls.pelvis[:, 1] += np.where(airborne, rise_at_toes + rise, crouch)
    bend = np.clip(-crouch / dip, 0.0, 1.0) * ~airborne
    bend = gaussian_filter1d(bend, 0.03 * controls.fps)
    controls.pelvis[:, 2] -= 0.09 * bend
    controls.pelvis_turn[:, 0] += 24.0 * bend
    controls.spine[:, 0] += 12.0 * bend
    controls.head[:, 0] -= 18.0 * bend
    toes = _track(time, [0, takeoff - 0.16, takeoff + 0.03, land - 0.03, land + 0.12, 99.0], [0, 0, 1, 0.85, 0, 0])
    controls.foot_pitch += 38.0 * toes[:, None]
    # The feet do not gain their speed in an instant.
    controls.foot[:, :, 1] += 0.95 * gaussian_filter1d(rise, 0.03 * controls.fps)[:, None]
    up = _track(time, [0, takeoff - push, takeoff + 0.1, land, land + 0.5, 99.0], [0, 0, 1, 0.7, 0, 0])
    back = _track(time, [0, takeoff - push - 0.5, takeoff - push, takeoff, 99.0], [0, 0, 1, 0, 0])
    for side in range(2):
        controls.arm[:, side] += up[:, None] * [6.0, 54.0, 0.0, 20.0] + back[:, None] * [8.0, -34.0, 0.0, 4.0]


def lunges(controls: Controls, skeleton: Skeleton, rng: np.random.Generator) -> None:
    time = controls.time
    on = ease(time)
    for side in range(2):
        _arm_to(controls, side, np.array([60.0, 4.0, 0.0, 40.0]), on)
    for index, start in enumerate((0.9, 4.1, 7.3, 10.5)):
        side, sign = index % 2, 1.0 - 2.0 * (index % 2)
        aside = 1.0 if index >= 2 else 0.0
        down = _track(time, [0, start, start + 0.95, start + 1.5, start + 2.5, 99.0], [0, 0, 1, 1, 0, 0])
        step = _track(time, [0, start, start + 0.62, start + 1.75, start + 2.4, 99.0], [0, 0, 1, 1, 0, 0])
        lift = np.sin(np.pi * step) ** 2 * 0.09
        ahead, out = 0.72 * (1 - aside), 0.52 * aside
        controls.foot[:, side, 2] += ahead * step
        controls.foot[:, side, 0] += sign * out * step
        controls.foot[:, side, 1] += lift
        controls.foot_yaw[:, side] += sign * 14.0 * aside * step
        controls.pelvis[:, 2] += (0.33 * (1 - aside) - 0.10 * aside) * down
        controls.pelvis[:, 0] += sign * 0.36 * aside * down
        # The weight moves over the standing foot before the other one is lifted.
        controls.pelvis[:, 0] -= sign * 0.05 * np.sin(np.pi * step) ** 2
        controls.pelvis[:, 1] -= (0.30 - 0.02 * aside) * down
        controls.foot_pitch[:, 1 - side] += 42.0 * (1 - aside) * down
        controls.pelvis_turn[:, 0] += (6.0 + 18.0 * aside) * down
        controls.spine[:, 0] += (2.0 + 10.0 * aside) * down
        controls.head[:, 0] -= 14.0 * aside * down
        controls.spine[:, 1] += sign * 16.0 * (1 - aside) * down
        for arm in range(2):
            _arm_to(controls, arm, np.array(_ARMS["chest"]), 0.8 * down)


def kicks(controls: Controls, skeleton: Skeleton, rng: np.random.Generator) -> None:
    time, on = controls.time, ease(controls.time)
    for side in range(2):
        _arm_to(controls, side, np.array([48.0, 24.0, 0.0, 70.0]), on)
    controls.pelvis[:, 1] -= 0.02 * on
    hip_height = skeleton.joints[1, 1] - skeleton.joints[7, 1]
    for index, (start, angle) in enumerate(zip((0.9, 3.1, 5.3, 7.5), (50.0, 56.0, 70.0, 66.0), strict=True)):
        side, sign = index % 2, 1.0 - 2.0 * (index % 2)
        weight = _track(time, [0, start, start + 0.4, start + 1.35, start + 1.9, 99.0], [0, 0, 1, 1, 0, 0])
        keys = start + np.array([0.25, 0.65, 0.95, 1.08, 1.38, 1.8])
        ahead = 0.93 * skeleton.leg_length * np.sin(np.radians(angle))
        height = hip_height - 0.93 * skeleton.leg_length * np.cos(np.radians(angle))
        forward = _track(time, [0, *keys, 99.0], [0, 0, 0.10, ahead, ahead, 0.12, 0, 0])
        lift = _track(time, [0, *keys, 99.0], [0, 0, 0.36, height, height, 0.32, 0, 0])
        controls.foot[:, side, 2] += forward
        controls.foot[:, side, 1] += lift
        controls.foot_pitch[:, side] += 30.0 * np.clip(lift / 0.4, 0, 1)
        controls.pelvis[:, 0] -= sign * 0.085 * weight
        kick = np.clip(forward / ahead, 0, 1)
        controls.pelvis_turn[:, 0] -= 12.0 * kick
        controls.pelvis_turn[:, 1] -= sign * 10.0 * kick
        controls.pelvis_turn[:, 2] += sign * 5.0 * weight
        controls.spine[:, 0] += 10.0 * kick
        controls.spine[:, 1] += sign * 24.0 * kick
        controls.spine[:, 2] += sign * 4.0 * weight
        controls.arm[:, side, 1] -= 45.0 * kick
        controls.arm[:, 1 - side, 1] += 22.0 * kick
        controls.arm[:, :, 0] -= 14.0 * kick[:, None]


def wave_and_reach(controls: Controls, skeleton: Skeleton, rng: np.random.Generator) -> None:
    time, on = controls.time, ease(controls.time)
    for side in range(2):
        _arm_to(controls, side, np.array([63.0, 4.0, 0.0, 20.0]), on)
    wave = _track(time, [0, 0.8, 1.6, 4.4, 5.2, 99.0], [0, 0, 1, 1, 0, 0])
    beat = np.sin(2 * np.pi * 1.5 * time)
    _arm_to(controls, 1, np.stack([0 * time - 8, 0 * time + 12, 0 * time - 62, 75 + 20 * beat], axis=1), wave)
    controls.spine[:, 2] += 5.0 * wave + 1.5 * beat * wave
    controls.head[:, 1] -= 12.0 * wave
    for side, start in ((0, 5.2), (1, 7.8), (0, 10.3)):
        sign = 1.0 - 2.0 * side
        reach = _track(time, [0, start, start + 0.9, start + 1.3, start + 2.3, 99.0], [0, 0, 1, 1, 0, 0])
        pose = np.array([45.0, 128.0, 0.0, 8.0]) if start < 10 else np.array([30.0, 62.0, 0.0, 10.0])
        _arm_to(controls, side, pose, reach)
        controls.spine += reach[:, None] * [6.0, -sign * 20.0, -sign * 7.0]
        controls.pelvis += reach[:, None] * [sign * 0.05, 0.0, 0.04]
        controls.pelvis_turn[:, 2] += -sign * 3.0 * reach
        controls.foot_pitch[:, 1 - side] += 20.0 * reach
        controls.head[:, 0] -= 12.0 * reach


def dance(beat: float, energy: float) -> Recipe:
    """Steps on the spot, a swaying and twisting trunk, and arm poses that change every two to four beats."""

    def recipe(controls: Controls, skeleton: Skeleton, rng: np.random.Generator) -> None:
        time, on = controls.time, ease(controls.time, 0.2, 1.0)
        turn = rng.uniform(18.0, 34.0) * np.sin(2 * np.pi * time / (8 * beat)) * energy
        gait = Gait(
            speed=0.0, cycle=2 * beat, duty=0.58, half_width=0.125, lift=0.05 + 0.05 * energy, heel_kick=18.0,
            toe_up=0.0, drop=0.05 + 0.02 * energy, bounce=0.018 * energy, sway=0.05, hip_yaw=8.0 * energy,
            hip_roll=6.0, shoulder_twist=6.0 * energy, lean=2.0, arm_swing=0.0, arm_lower=60.0, elbow=22.0,
        )  # fmt: skip
        phase = walk(controls, skeleton, gait, turn)
        groove = 2 * np.pi * phase
        slow = np.sin(0.5 * groove + rng.uniform(0, 6.28))
        controls.spine += (energy * on)[:, None] * np.stack(
            [4.0 * np.cos(2 * groove) + 3.0, 16.0 * slow, 9.0 * np.sin(groove + 0.6)], axis=1
        )
        controls.head += (energy * on)[:, None] * np.stack(
            [4.0 * np.cos(2 * groove + 0.5), 10.0 * np.sin(0.25 * groove), -5.0 * np.sin(groove)], axis=1
        )
        _dance_arms(controls, rng, beat)
        # Hands keep the beat.
        controls.arm[:, :, 1] += (6.0 * energy * on * np.cos(2 * groove))[:, None]
        controls.arm[:, :, 3] += (8.0 * energy * on * (1 + np.cos(2 * groove + 0.7)))[:, None]

    return recipe


def _dance_arms(controls: Controls, rng: np.random.Generator, beat: float) -> None:
    names = [name for name in _ARMS if name != "easy"]
    times, left, right = [0.0, 0.3], [_ARMS["easy"]] * 2, [_ARMS["easy"]] * 2
    times[1] = 0.4
    start = tuple(controls.arm[0, 0])
    left[0] = left[1] = right[0] = right[1] = start
    while times[-1] < controls.time[-1] + beat:
        hold, move = beat * rng.choice([0.5, 1.0, 2.0]), beat * rng.choice([1.0, 1.5])
        first = names[rng.integers(len(names))]
        second = first if rng.random() < 0.55 else names[rng.integers(len(names))]
        times += [times[-1] + max(move, 0.7), times[-1] + max(move, 0.7) + hold]
        left += [_ARMS[first]] * 2
        right += [_ARMS[second]] * 2
    controls.arm[:, 0] = _track(controls.time, times, left)
    controls.arm[:, 1] = _track(controls.time, times, right)


def _widen(controls: Controls, step: float, toes_out: float) -> None:
    """Starts in a wider stand than usual: feet apart by twice `step` more, toes turned out by `toes_out`."""
    for side, sign in enumerate((1.0, -1.0)):
        controls.foot[:, side, 0] += sign * step
        controls.foot_yaw[:, side] = sign * toes_out


def breathe(controls: Controls, rng: np.random.Generator) -> None:
    """Small slow motion everywhere: nobody stands like a statue."""
    time, on = controls.time, ease(controls.time, 0.2, 1.5)
    controls.spine += on[:, None] * np.stack([1.0 * _drift(time, rng) for _ in range(3)], axis=1)
    controls.head += on[:, None] * np.stack([2.0 * _drift(time, rng) for _ in range(3)], axis=1)
    for side in range(2):
        controls.arm[:, side] += on[:, None] * np.stack([1.5 * _drift(time, rng) for _ in range(4)], axis=1)


def _arm_to(controls: Controls, side: int, goal: Array, amount: Array) -> None:
    controls.arm[:, side] += amount[:, None] * (goal - controls.arm[:, side])


def _pulses(time: Array, start: float, period: float, depths: list[float]) -> Array:
    """Bells of the given heights, one after the other: 0 at both ends of each period, flat at the middle."""
    turn = (time - start) / period
    index = np.clip(np.floor(turn).astype(int), 0, len(depths) - 1)
    inside = (turn > 0) & (turn < len(depths))
    bell = np.sin(np.pi * (turn - np.floor(turn))) ** 2
    return np.where(inside, np.array(depths)[index] * bell * (1.6 - 0.6 * bell), 0.0)


def _track(time: Array, keys: object, values: object) -> Array:
    """Smooth monotone interpolation of key poses; flat before the first and after the last key."""
    knots = np.asarray(keys, dtype=np.float64)
    curve = PchipInterpolator(knots, np.asarray(values, dtype=np.float64))(np.clip(time, knots[0], knots[-1]))
    dt = float(time[1] - time[0])
    return gaussian_filter1d(curve, 0.04 / dt, axis=0, mode="nearest")


def _hermite(time: Array, keys: Array, values: list[float], slopes: list[float]) -> Array:
    return CubicHermiteSpline(keys, values, slopes)(np.clip(time, keys[0], keys[-1]))


def _drift(time: Array, rng: np.random.Generator) -> Array:
    """A slow wandering signal of about unit size."""
    periods, phases = rng.uniform(2.2, 6.0, size=3), rng.uniform(0, 2 * np.pi, size=3)
    return 0.55 * np.sin(2 * np.pi * time[:, None] / periods + phases).sum(axis=1)
