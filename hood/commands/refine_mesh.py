"""``refine_mesh``: stored frames on a finer mesh than the simulated one, and how that is reported."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from omegaconf import DictConfig

from hood.config import ConfigError
from hood.dynamics.recorder import RolloutData
from hood.dynamics.refined_frames import refined_frames
from hood.dynamics.rollout import Frame
from hood.mesh.subdivision import Subdivision
from hood.scene.scene import Scene

#: Sixteen times the faces show all that the surface has.
_LEVELS = 2


def check_refine_mesh(config: DictConfig) -> None:
    """Raise ConfigError unless a mesh can be refined so often."""
    if not 0 <= int(config.refine_mesh) <= _LEVELS:
        raise ConfigError(
            f"refine_mesh={config.refine_mesh}: give how often every face is cut into four for stored frames, 1 or {_LEVELS}; "
            "0 stores the simulated mesh"
        )


def finer_mesh(config: DictConfig, scene: Scene) -> Subdivision | None:
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
    if "piece" in still:
        refined["piece"] = finer.marks(still["piece"])
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
