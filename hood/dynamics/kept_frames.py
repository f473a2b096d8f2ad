"""The frames of a rollout kept in memory, to be drawn when it is over."""

from __future__ import annotations

import numpy as np

from hood.dynamics.recorder import RolloutData
from hood.dynamics.rollout import Frame
from hood.scene.scene import Scene


class KeptFrames:
    """Keeps every frame that it is shown, all of one scene."""

    def __init__(self) -> None:
        self.cloth: list[np.ndarray] = []
        self.body: list[np.ndarray] = []
        self.scene: Scene | None = None

    def see(self, scene: Scene, frame: Frame) -> None:
        """Keep ``frame``."""
        self.scene = scene
        self.cloth.append(frame.world_pos.numpy())
        self.body.append(frame.body_pos.numpy())

    def data(self) -> RolloutData:
        """The frames as a rollout without metrics; at least one must have been shown."""
        assert self.scene is not None
        return RolloutData(
            cloth_pos=np.stack(self.cloth),
            cloth_faces=self.scene.garment.faces,
            rest_pos=self.scene.garment.rest_pos,
            body_pos=np.stack(self.body),
            body_faces=self.scene.motion.faces,
            time=np.arange(len(self.cloth)) * self.scene.dt,
            metrics={},
            attributes={},
        )
