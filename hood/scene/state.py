"""What changes during a rollout: the cloth's state, the obstacle's motion over one step, the step's own inputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from hood.scene.batch import concatenate, indexes


@dataclass(frozen=True)
class State:
    """Cloth at time t, in a garment-local frame: world position = ``origin[vertex_scene] + pos``."""

    pos: Tensor  # (V, 3) m, local
    vel: Tensor  # (V, 3) m/s
    origin: Tensor = field(metadata={"float64": True})  # (B, 3) m, float64, world


@dataclass(frozen=True)
class Obstacle:
    """Body surfaces of B scenes, concatenated, around the step t → t+1; same local frame as the cloth's state."""

    pos: Tensor  # (W, 3) m at t
    next_pos: Tensor  # (W, 3) m at t + 1
    prev_pos: Tensor  # (W, 3) m at t - 1
    faces: Tensor = indexes("body_vertices")  # (G, 3)
    vertex_scene: Tensor = indexes("scenes")  # (W,)
    face_scene: Tensor = indexes("scenes")  # (G,)
    omitted: Tensor = None  # type: ignore[assignment]  # (W,) bool: no body edges to these (hands)


@dataclass(frozen=True)
class Attachments:
    """Extra edges (buttons, zipper teeth) of one step, and which of them are closed now. They belong to the step,
    not to the scene: a button may open during a rollout."""

    edges: Tensor = indexes("vertices")  # (A, 2) cloth vertex pairs
    active: Tensor = None  # type: ignore[assignment]  # (A,) bool


@dataclass(frozen=True)
class StepInput:
    """Everything prescribed from outside for the step t → t+1."""

    dt: Tensor  # (B,) s
    obstacle: Obstacle | None = None
    pin_target: Tensor | None = None  # (V, 3) m local at t + 1; read at pinned vertices only
    attachments: Attachments | None = None
    time: Tensor | None = None  # (B,) s since frame 0, at t + 1; what changes by itself (gusts) reads it, None: 0

    def __post_init__(self) -> None:
        sound = [0.0 < dt < float("inf") for dt in self.dt.reshape(-1).tolist()]
        if self.dt.ndim != 1 or not all(sound):
            scene = sound.index(False) if False in sound else 0
            raise ValueError(
                f"time step: dt of scene {scene} is {self.dt.reshape(-1)[scene]} in shape {tuple(self.dt.shape)}; give one "
                "finite number of seconds > 0 per scene, shape (num_scenes,)"
            )


def concatenate_obstacles(obstacles: Sequence[Obstacle]) -> Obstacle:
    """Obstacles of several scenes (one scene each) as one flat batch."""
    counts = {"body_vertices": [len(o.pos) for o in obstacles], "scenes": [1] * len(obstacles)}
    return concatenate(obstacles, counts)


def concatenate_states(states: Sequence[State]) -> State:
    """States of several scenes as one flat batch."""
    return State(*(torch.cat([getattr(s, name) for s in states]) for name in ("pos", "vel", "origin")))
