"""The frames of a rollout kept in memory, to be judged and drawn when it is over."""

from __future__ import annotations

import numpy as np

from hood.dynamics.recorder import RolloutData, still_of
from hood.dynamics.rollout import Frame
from hood.scene.scene import Scene


class KeptFrames:
    """Keeps every frame that it is shown, all of one scene."""

    def __init__(self) -> None:
        self.cloth: list[np.ndarray] = []
        self.body: list[np.ndarray] = []
        self.metrics: list[dict[str, float]] = []
        self.scene: Scene | None = None

    def see(self, scene: Scene, frame: Frame) -> None:
        """Keep ``frame``."""
        self.scene = scene
        self.cloth.append(frame.world_pos.numpy())
        self.body.append(frame.body_pos.numpy().astype(np.float32))
        self.metrics.append(frame.metrics)

    def data(self) -> RolloutData:
        """The frames as a rollout that was read back; at least one must have been shown."""
        assert self.scene is not None
        names = {name for row in self.metrics for name in row}
        return RolloutData(
            cloth_pos=np.stack(self.cloth),
            cloth_faces=self.scene.garment.faces,
            rest_pos=self.scene.garment.rest_pos,
            body_pos=np.stack(self.body),
            body_faces=self.scene.motion.faces,
            time=np.arange(len(self.cloth)) * self.scene.dt,
            metrics={name: np.array([row.get(name, np.nan) for row in self.metrics]) for name in sorted(names)},
            attributes={"garment": self.scene.garment.name},
            still=still_of(self.scene.garment),
        )
