"""Training scenes: random motion window, body shape, garment, size and fabric (paper, section 4.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from hood.assets.body import Body
from hood.assets.garment import Garment, bind_garment
from hood.assets.material import Material, sample_material
from hood.assets.sequence import PoseSequence, turn_world
from hood.scene.scene import Scene, build_scene


@dataclass(frozen=True)
class Window:
    """One training scene and the frame at which its rollout starts."""

    scene: Scene
    start_frame: int


class SceneSampler:
    """Draws training scenes; a scene is a function of the generator alone, so a seed replays it.

    Args:
        body: the body to dress.
        garments: templates, drawn uniformly.
        sequences: motions, drawn by their length.
        beta_range: shape coefficients are U(-beta_range, beta_range).
        size_range: garment scale is uniform in this interval.
        piecewise_fraction: share of the scenes with several fabrics on one garment.
        random_yaw: turn the world about the vertical axis, so that no direction is special.
        device: where the scenes' tensors live.
    """

    def __init__(
        self,
        body: Body,
        garments: Sequence[Garment],
        sequences: Sequence[PoseSequence],
        beta_range: float = 2.0,
        size_range: tuple[float, float] = (0.9, 1.1),
        piecewise_fraction: float = 0.2,
        random_yaw: bool = True,
        device: str = "cpu",
    ) -> None:
        if not garments or not sequences:
            raise ValueError("training needs at least one garment and one motion")
        self.body = body
        self.garments = [bind_garment(garment, body) for garment in garments]
        self.sequences = list(sequences)
        self.beta_range = beta_range
        self.size_low, self.size_high = size_range
        self.piecewise_fraction = piecewise_fraction
        self.random_yaw = random_yaw
        self.device = device

    def sample(self, rng: np.random.Generator, num_steps: int, garment: int | None = None) -> Window:
        """A scene with at least ``num_steps`` steps ahead of its start frame.

        ``garment`` fixes the template by its index; None draws one.

        Raises:
            ValueError: every motion is shorter than that.
        """
        index = int(rng.integers(len(self.garments))) if garment is None else garment % len(self.garments)
        template = self.garments[index]
        lengths = np.array([max(s.num_frames - num_steps - 1, 0) for s in self.sequences], dtype=np.float64)
        if not lengths.any():
            longest = max(self.sequences, key=lambda s: s.num_frames)
            raise ValueError(
                f"no motion has the {num_steps + 2} frames that a training rollout needs; the longest, {longest.name!r}, "
                f"has {longest.num_frames} (lower trainer.horizon.maximum or give longer motions)"
            )
        sequence = self.sequences[int(rng.choice(len(self.sequences), p=lengths / lengths.sum()))]
        start = int(rng.integers(sequence.num_frames - num_steps - 1))
        window = sequence.window(max(start - 1, 0), start + num_steps + 2)
        if self.random_yaw:
            turn = Rotation.from_rotvec([0.0, rng.uniform(-np.pi, np.pi), 0.0]).as_matrix()
            window = turn_world(window, turn)
        betas = np.asarray(rng.uniform(-self.beta_range, self.beta_range, self.body.shapedirs.shape[2]))
        size = float(rng.uniform(self.size_low, self.size_high))
        material: Material = sample_material(rng, template.rest_pos, self.piecewise_fraction)
        return Window(build_scene(template, self.body, window, material, betas, size, device=self.device), min(start, 1))
