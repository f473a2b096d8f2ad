"""``output_fps``: stored frames at a rate of their own, what a user says about it and how it is reported.

``refine_mesh``: stored frames on a finer mesh than the simulated one, and how that is reported.

``store``: what gives the body back where it is left out.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hood.app.scene.motion import NAMED, Own, is_blended, motion_options, perform
from hood.app.settings.compose import ConfigError, shown
from hood.app.settings.rollout_settings import RolloutSettings
from hood.mesh.editing.subdivision import Subdivision
from hood.rollouts.file.compact import CLOTH, BodyParameters, digest_of, store_of
from hood.rollouts.file.reader import RolloutData
from hood.rollouts.file.step_table import OutputRate, StepPlan
from hood.rollouts.frame import Frame
from hood.rollouts.frames import output_frames, refined_frames
from hood.scene.body_motion.motion import BodyMotion, Motion
from hood.scene.jumps import find_jumps
from hood.scene.scene import Scene

#: Stored frames for a simulated one, at most: more would show the interpolation, not the simulation.
_MOST_BETWEEN = 10


def check_output_fps(config: RolloutSettings) -> None:
    """Raise ConfigError unless frames can be stored at ``output_fps``."""
    if config.output_fps is None:
        return
    given, most = config.output_fps, min(1000.0, _MOST_BETWEEN * float(config.fps))
    if isinstance(given, bool) or not isinstance(given, int | float) or not 1.0 <= given <= most:
        raise ConfigError(
            f"output_fps={shown(given)}: give stored frames per second, 1 to {most:g}, {_MOST_BETWEEN} times fps at most; "
            "null stores every simulated frame"
        )


def output_rate(config: RolloutSettings) -> OutputRate | None:
    """The rate of stored frames; None where these are the simulated ones."""
    if config.output_fps is None or float(config.output_fps) == float(config.fps):
        return None
    return OutputRate(float(config.output_fps), float(config.fps))


def at_output_fps(
    frames: Iterable[Frame],
    config: RolloutSettings,
    scene: Scene,
    count: int,
    own: Own = NAMED,
    given: int = 0,
    known: Iterable[Frame] = (),
) -> Iterator[Frame]:
    """The frames to store of ``count`` simulated ones: all of them where there is no ``output_fps``. ``given`` and ``known`` as
    in :func:`hood.rollouts.frames.output_frames`."""
    rate = output_rate(config)
    if rate is None:
        yield from frames
        return
    jumps = find_jumps(scene.motion, 1.0 / scene.dt)
    body = None if rate.whole else _posed(config, scene, rate.count(count), own)
    yield from output_frames(frames, rate, jumps, body, given, known)


def planned_steps(config: RolloutSettings, scene: Scene, count: int) -> StepPlan | None:
    """What a file keeps of ``count`` simulated frames where it stores others; None where it does not."""
    rate = output_rate(config)
    return None if rate is None else StepPlan(rate, count, _watched(scene))


def _watched(scene: Scene) -> list[int]:
    """Vertices whose every simulated position the summary needs: those that are fastened, held, let go or in tables of pins."""
    found: set[int] = set()
    if scene.fastening is not None:
        found |= set(scene.fastening.pairs.edges.flatten().tolist())
    for grasp in () if scene.holding is None else scene.holding.grasps:
        found |= set(np.flatnonzero(grasp.vertices.cpu().numpy()).tolist())
    for group in () if scene.held is None else scene.held.groups:
        found |= set(group.vertices.tolist())
    return sorted(found)


def _posed(config: RolloutSettings, scene: Scene, count: int, own: Own) -> Callable[[int], Tensor] | None:
    """The body at the moments of stored frames, posed by the motion itself; None where its parts are joined at simulated
    frames, so that another rate would move the joints: it is interpolated then, as the cloth is."""
    motion = _at_moments(config, scene, count, own)
    if motion is None:
        return None

    def surface(index: int) -> Tensor:
        origin = motion.translation[index]
        return motion.surface(index, origin).cpu().double() + torch.as_tensor(origin)

    return surface


def _at_moments(config: RolloutSettings, scene: Scene, count: int, own: Own) -> Motion | None:
    """The motion, whose frames are the stored ones; None as :func:`_posed`."""
    if config.output_fps is None or config.loop != 1 or is_blended(config):
        return None
    options = replace(motion_options(config), fps=float(config.output_fps), num_frames=count)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what is said of the motion has been said
        return perform(config, own, options, scene.motion.dtype, scene.motion.device)


def stored_body(config: RolloutSettings, scene: Scene, own: Own = NAMED) -> BodyParameters | None:
    """What gives the body of the stored frames back, for ``formats=[cloth]``; None where it is not needed.

    Raises:
        ConfigError: nothing does; names what to choose.
    """
    if store_of(config.formats) != CLOTH or not scene.motion.num_vertices:
        return None
    count, rate, motion = min(int(config.num_frames), scene.num_frames), output_rate(config), scene.motion
    frames = np.arange(count)
    if rate is not None and rate.whole:
        frames = np.arange(rate.count(count)) * int(rate.stride)
    elif rate is not None:
        found, frames = _at_moments(config, scene, rate.count(count), own), np.arange(rate.count(count))
        if found is None:
            raise ConfigError(
                f"formats=[cloth]: at output_fps={shown(config.output_fps)} the body is interpolated, no parameters give it "
                "back; choose formats=[cloth+body], or an output_fps of which fps is a multiple"
            )
        motion = found
    if not isinstance(motion, BodyMotion):
        raise ConfigError(
            f"formats=[cloth]: body={shown(config.body)} is a mesh, which no parameters give back; choose formats=[cloth+body]"
        )
    path = Path(str(config.body)).expanduser()
    model = str(path.absolute()) if path.exists() else str(config.body)
    # The world's turn is in the translation: poses, translation and betas are all that it takes.
    sequence = replace(motion.sequence.at(frames), transl=motion.translation[frames], world_rotation=np.eye(3))
    return BodyParameters(model, config.gender or sequence.gender, digest_of(motion.body), sequence, motion.betas)


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


#: Sixteen times the faces show all that the surface has.
_LEVELS = 2


def check_refine_mesh(config: RolloutSettings) -> None:
    """Raise ConfigError unless a mesh can be refined so often."""
    if not 0 <= int(config.refine_mesh) <= _LEVELS:
        raise ConfigError(
            f"refine_mesh={config.refine_mesh}: give how often every face is cut into four for stored frames, 1 or {_LEVELS}; "
            "0 stores the simulated mesh"
        )


def finer_mesh(config: RolloutSettings, scene: Scene) -> Subdivision | None:
    """The mesh of stored frames; None where it is the simulated one."""
    if int(config.refine_mesh) == 0:
        return None
    return Subdivision(scene.garment.faces, scene.cloth.rest_pos.cpu().numpy(), int(config.refine_mesh))


def on_finer_mesh(frames: Iterator[Frame], finer: Subdivision | None, scene: Scene) -> Iterator[Frame]:
    """The frames on the finer mesh, as they are without one."""
    return frames if finer is None else refined_frames(frames, finer, scene.motion.faces, scene.clearance)


def refined_still(still: dict[str, np.ndarray], finer: Subdivision | None, faces: np.ndarray) -> dict[str, np.ndarray]:
    """What a file holds of the garment beside its mesh, for the finer mesh; with the simulated ``faces`` (F, 3)."""
    if finer is None:
        return still
    refined = {**still, "simulated_faces": faces}
    refined |= {name: finer.marks(still[name]) for name in ("piece", "fabric") if name in still}
    if "uv" in still:
        refined["uv"], refined["uv_faces"] = finer.texture(still["uv"], still["uv_faces"])
    return refined


def summarise_mesh(data: RolloutData) -> dict[str, Any]:
    """Entry ``refined_mesh``: how often faces were cut, numbers of vertices, and what that is; nothing of other rollouts."""
    if data.refined is None:
        return {}
    return {
        "refined_mesh": {
            "times": data.refined.times,
            "vertices": int(data.cloth_pos.shape[1]),
            "simulated_vertices": data.refined.num_coarse,
            "what": "a smooth surface through the simulated vertices, for pictures and exports: it has no wrinkle that the "
            "simulated mesh has not, and what is measured is of the simulated mesh",
        }
    }


def describe_mesh(summary: Mapping[str, Any]) -> list[str]:
    """A line on the finer mesh; none where there is none."""
    found = summary.get("refined_mesh")
    if found is None:
        return []
    return [f"stored with {found['vertices']} vertices, refined from {found['simulated_vertices']}: {found['what']}"]
