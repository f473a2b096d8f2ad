"""``output_fps``: stored frames at a rate of their own, what a user says about it and how it is reported."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig
from torch import Tensor

from hood.commands.motion import motion_options
from hood.config import ConfigError, shown
from hood.dynamics.output_frames import output_frames
from hood.dynamics.output_rate import OutputRate
from hood.dynamics.recorder import RolloutData
from hood.dynamics.rollout import Frame
from hood.dynamics.step_table import StepPlan
from hood.scene.jumps import find_jumps
from hood.scene.load_motion import load_motion
from hood.scene.scene import Scene

#: Stored frames for a simulated one, at most: more would show the interpolation, not the simulation.
_MOST_BETWEEN = 10


def check_output_fps(config: DictConfig) -> None:
    """Raise ConfigError unless frames can be stored at ``output_fps``."""
    if config.output_fps is None:
        return
    given, most = config.output_fps, min(1000.0, _MOST_BETWEEN * float(config.fps))
    if isinstance(given, bool) or not isinstance(given, int | float) or not 1.0 <= given <= most:
        raise ConfigError(
            f"output_fps={shown(given)}: give stored frames per second, 1 to {most:g}, {_MOST_BETWEEN} times fps at most; "
            "null stores every simulated frame"
        )


def output_rate(config: DictConfig) -> OutputRate | None:
    """The rate of stored frames; None where these are the simulated ones."""
    if config.output_fps is None or float(config.output_fps) == float(config.fps):
        return None
    return OutputRate(float(config.output_fps), float(config.fps))


def at_output_fps(frames: Iterable[Frame], config: DictConfig, scene: Scene, count: int) -> Iterator[Frame]:
    """The frames to store of ``count`` simulated ones: all of them where there is no ``output_fps``."""
    rate = output_rate(config)
    if rate is None:
        yield from frames
        return
    jumps = find_jumps(scene.motion, 1.0 / scene.dt)
    yield from output_frames(frames, rate, jumps, None if rate.whole else _posed(config, scene, rate.count(count)))


def planned_steps(config: DictConfig, scene: Scene, count: int) -> StepPlan | None:
    """What a file keeps of ``count`` simulated frames where it stores others; None where it does not."""
    rate = output_rate(config)
    return None if rate is None else StepPlan(rate, count, _watched(scene))


def _watched(scene: Scene) -> list[int]:
    """Vertices whose every simulated position a report on events needs: those that are fastened, held or let go."""
    found: set[int] = set()
    if scene.fastening is not None:
        found |= set(scene.fastening.pairs.edges.flatten().tolist())
    for grasp in () if scene.holding is None else scene.holding.grasps:
        found |= set(np.flatnonzero(grasp.vertices.cpu().numpy()).tolist())
    return sorted(found)


def _posed(config: DictConfig, scene: Scene, count: int) -> Callable[[int], Tensor] | None:
    """The body at the moments of stored frames, posed by the motion itself; None where its parts are joined at simulated
    frames, so that another rate would move the joints: it is interpolated then, as the cloth is."""
    if int(config.loop) != 1 or float(config.blend_in) != 0:
        return None
    options = replace(motion_options(config), fps=float(config.output_fps), num_frames=count)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what is said of the motion has been said
        motion = load_motion(str(config.body), str(config.sequence), options, scene.motion.dtype, scene.motion.device)

    def surface(index: int) -> Tensor:
        origin = motion.translation[index]
        return motion.surface(index, origin).cpu().double() + torch.as_tensor(origin)

    return surface


def summarise_rate(data: RolloutData) -> dict[str, Any]:
    """Entry ``output``: rates of stored and simulated frames, how many were simulated and how many of the stored ones are
    interpolated; nothing where every simulated frame is stored."""
    if data.steps is None:
        return {}
    rate = data.steps.rate
    between = sum(rate.place(index)[1] != 0 for index in range(len(data.time)))
    return {
        "output": {
            "fps": rate.fps,
            "simulated_fps": rate.simulated_fps,
            "simulated_frames": len(data.steps.finite),
            "interpolated_frames": between,
        }
    }


def describe_rate(summary: Mapping[str, Any]) -> list[str]:
    """A line on stored and simulated frames; none where these are the same."""
    found = summary.get("output")
    if found is None:
        return []
    between = found["interpolated_frames"]
    how = f"{between} of them interpolated" if between else "each of them simulated"
    return [
        f"stored at {found['fps']:g} frames a second ({how}) of {found['simulated_frames']} simulated at "
        f"{found['simulated_fps']:g}; what is measured, and every number of a frame, is of simulated frames"
    ]
