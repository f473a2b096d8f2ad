"""The motions that ship with the package: seeded, procedural, written as AMASS SMPL+H files.

Every motion begins in an easy stand with the arms half lowered, still for a moment, so that clothes can
be put on, and then eases into its movement. Motions are written for one body; on another the joints turn
the same way.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tools.assets import recipes
from tools.assets.gait import Gait
from tools.assets.puppet import NUM_POSED_JOINTS, Controls, Skeleton, solve
from tools.assets.recipes import Recipe, dance, walking

Array = NDArray[np.float64]

_POSE_COLUMNS = 156
_Y_UP_TO_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
# Binary fractions of about 1e-4: exact in float32 with zero low bits, which halves the compressed files.
_STEPS_PER_UNIT = 8192


@dataclass(frozen=True)
class Motion:
    """One file: what moves, how often it is sampled, how long it is [s], which split it belongs to."""

    name: str
    recipe: Recipe
    fps: float = 60.0
    seconds: float = 13.0
    validation: bool = False


def write_motions(folder: Path, body_path: Path, seed: int = 0) -> None:
    """Writes every motion and `split.json` into `folder`.

    Each file has the keys of AMASS: poses (N, 156) with the 22 body joints in the first 66 columns, trans
    (N, 3), betas (16,) zero, gender, mocap_framerate; z is up and the floor is z = 0. The same seed gives the
    same files.
    """
    folder.mkdir(parents=True, exist_ok=True)
    skeleton = Skeleton.from_body(body_path)
    motions = all_motions()
    for index, motion in enumerate(motions):
        arrays = perform(motion, skeleton, np.random.default_rng([seed, index]))
        partial = folder / f".{motion.name}.partial.npz"
        np.savez_compressed(partial, allow_pickle=False, **arrays)
        os.replace(partial, folder / f"{motion.name}.npz")
    split = {
        "train": [motion.name for motion in motions if not motion.validation],
        "validation": [motion.name for motion in motions if motion.validation],
    }
    (folder / "split.json").write_text(json.dumps(split, indent=2) + "\n")


def perform(motion: Motion, skeleton: Skeleton, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """The arrays of one AMASS file."""
    controls = Controls.standing(round(motion.seconds * motion.fps), motion.fps, skeleton)
    motion.recipe(controls, skeleton, rng)
    recipes.breathe(controls, rng)
    local, pelvis = solve(controls, skeleton)
    local[:, 0] = _Y_UP_TO_Z_UP @ local[:, 0]
    rotvec = Rotation.from_matrix(local.reshape(-1, 3, 3)).as_rotvec().reshape(len(local), -1)
    poses = np.zeros((len(local), _POSE_COLUMNS))
    poses[:, : 3 * NUM_POSED_JOINTS] = rotvec
    # SMPL turns the body about its pelvis joint, which is not its origin.
    trans = pelvis @ _Y_UP_TO_Z_UP.T - skeleton.joints[0]
    return {
        # Columns in order of time compress better than rows.
        "poses": np.asfortranarray(_rounded(poses)),
        "trans": np.asfortranarray(_rounded(trans)),
        "betas": np.zeros(16, dtype=np.float32),
        "gender": np.array("neutral"),
        "mocap_framerate": np.array(motion.fps),
    }


def all_motions() -> list[Motion]:
    """The repertoire, in a fixed order."""
    stroll = Gait(speed=0.75, cycle=1.28, arm_swing=16.0, elbow_swing=8.0, hip_yaw=4.0, shoulder_twist=7.0)
    steady = Gait(speed=1.15, cycle=1.10)
    brisk = Gait(
        speed=1.4,
        cycle=0.96,
        duty=0.6,
        arm_swing=32.0,
        elbow=32.0,
        elbow_swing=16.0,
        lean=4.0,
        shoulder_twist=13.0,
    )
    proud = Gait(speed=1.0, cycle=1.16, hip_yaw=9.0, hip_roll=6.0, sway=0.035, half_width=0.065, arm_swing=20.0)
    tired = Gait(speed=0.65, cycle=1.4, lean=11.0, arm_swing=9.0, elbow=12.0, drop=0.03, sway=0.035, lift=0.02)
    march = Gait(speed=0.7, cycle=1.15, duty=0.58, lift=0.24, heel_kick=32.0, toe_up=4.0, arm_swing=42.0, elbow=28.0)
    jog = Gait(
        speed=2.1, cycle=0.74, duty=0.40, lift=0.20, heel_kick=62.0, toe_up=8.0, drop=0.045, bounce=-0.03,
        lean=8.0, sway=0.012, hip_roll=2.5, arm_swing=30.0, arm_lower=64.0, arm_forward=-2.0, elbow=78.0,
        elbow_swing=14.0,
    )  # fmt: skip
    spot = replace(jog, speed=0.0, cycle=0.70, lift=0.30, heel_kick=40.0, toe_up=0.0, lean=3.0, half_width=0.095)
    sideways = Gait(
        speed=0.42, cycle=1.05, duty=0.6, half_width=0.17, lift=0.05, heel_kick=14.0, toe_up=2.0,
        sidestep=90.0, hip_yaw=0.0, shoulder_twist=5.0, arm_swing=6.0, arm_lower=56.0, elbow=35.0, drop=0.05,
        sway=0.0,
    )  # fmt: skip
    return [
        Motion("stand_sway", recipes.sway, seconds=12.0),
        Motion("walk_stroll", walking(stroll), seconds=12.0),
        Motion("walk_steady", walking(steady), fps=120.0, seconds=10.0),
        Motion("walk_brisk", walking(brisk), fps=100.0, seconds=9.0),
        Motion("walk_tired", walking(tired), seconds=11.0),
        Motion("walk_march", walking(march), seconds=10.0),
        Motion("walk_curve", walking(steady, turn=32.0, period=7.0), seconds=14.0),
        Motion("walk_circle", walking(replace(stroll, speed=0.9), turn=38.0), fps=100.0, seconds=11.0),
        Motion("walk_back", walking(replace(stroll, speed=0.55, sidestep=180.0, toe_up=0.0, heel_kick=16.0))),
        Motion("jog", walking(jog), fps=120.0, seconds=8.0),
        Motion("run_on_spot", walking(spot), fps=100.0, seconds=9.0),
        Motion("side_steps", recipes.side_steps(sideways), seconds=12.0),
        Motion("squats", recipes.squats, seconds=13.0),
        Motion("bends", recipes.bends, seconds=14.0),
        Motion("twists", recipes.twists, seconds=12.0),
        Motion("arm_raises", recipes.arm_raises, seconds=14.0),
        Motion("jumps", recipes.jumps, fps=120.0, seconds=9.0),
        Motion("lunges", recipes.lunges, seconds=14.0),
        Motion("kicks", recipes.kicks, fps=100.0, seconds=10.0),
        Motion("wave_and_reach", recipes.wave_and_reach, seconds=13.0),
        Motion("dance_slow", dance(beat=0.82, energy=0.8), seconds=16.0),
        Motion("dance_disco", dance(beat=0.62, energy=1.0), seconds=16.0),
        Motion("walk_proud", walking(proud, turn=12.0, period=5.0), seconds=12.0, validation=True),
        Motion("dance_mixed", dance(beat=0.70, energy=0.95), seconds=14.0, validation=True),
        Motion("twist_and_bend", recipes.twist_and_bend, seconds=12.0, validation=True),
        Motion("plie", recipes.plie, fps=100.0, seconds=10.0, validation=True),
    ]


def _rounded(values: Array) -> NDArray[np.float32]:
    return (np.round(values * _STEPS_PER_UNIT) / _STEPS_PER_UNIT).astype(np.float32)
