"""What changes during a rollout: the cloth's state, the obstacle's motion over one step, the step's own inputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from hood.tensors.batch import concatenate, indexes
from hood.tensors.dense import add_rows, is_whole, sum_scenes


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
    friction_scale: Tensor | None = None  # (G,) factors on the coefficient of friction; None: 1


@dataclass(frozen=True)
class Attachments:
    """Extra edges (buttons, zipper teeth) of one step, and which of them are closed now. They belong to the step,
    not to the scene: a button may open during a rollout."""

    edges: Tensor = indexes("vertices")  # (A, 2) cloth vertex pairs
    active: Tensor = None  # type: ignore[assignment]  # (A,) bool
    length: Tensor | None = None  # (A,) m, distance at which a closed pair is held; None: 0
    speed: Tensor | None = None  # (A,) m/s at which a closed pair that is not there comes to that distance; None: at once


@dataclass(frozen=True)
class StepInput:
    """Everything prescribed from outside for the step t → t+1."""

    dt: Tensor  # (B,) s
    obstacle: Obstacle | None = None  # the body; None: there is none
    pin_target: Tensor | None = None  # (V, 3) m local at t + 1; read at pinned vertices and those of ``pin_stiffness``
    attachments: Attachments | None = None  # pairs of vertices that are pulled together; None: there are none
    time: Tensor | None = None  # (B,) s since frame 0, at t + 1; what changes by itself (gusts) reads it, None: 0
    pin_stiffness: Tensor | None = None  # (V,) N/m of springs to ``pin_target`` (SoftPins), 0: none; None: nowhere

    def __post_init__(self) -> None:
        on_host = self.dt.device.type == "cpu" and not is_whole()  # values elsewhere are not read back: the host would wait
        sound = [0.0 < dt < float("inf") for dt in self.dt.reshape(-1).tolist()] if on_host else []
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


def concatenate_step_inputs(steps: Sequence[StepInput], vertex_counts: Sequence[int]) -> StepInput:
    """Inputs of several scenes as one flat batch; scenes without pins get their targets as zeros (never read)."""
    if len(steps) == 1:
        return steps[0]
    obstacles = [step.obstacle for step in steps if step.obstacle is not None]
    if obstacles and len(obstacles) != len(steps):
        raise ValueError("a batch mixes scenes with and without a body; put them in separate batches")
    return StepInput(
        dt=torch.cat([step.dt for step in steps]),
        obstacle=concatenate_obstacles(obstacles) if obstacles else None,
        pin_target=_concatenate_rows([step.pin_target for step in steps], vertex_counts),
        attachments=_concatenate_attachments([step.attachments for step in steps], vertex_counts),
        time=_concatenate_times(steps),
        pin_stiffness=_concatenate_rows([step.pin_stiffness for step in steps], vertex_counts),
    )


def _concatenate_rows(items: Sequence[Tensor | None], vertex_counts: Sequence[int]) -> Tensor | None:
    """Values of the vertices of all scenes, zeros of those that have none; None where none has."""
    like = next((item for item in items if item is not None), None)
    if like is None:
        return None
    filled = [like.new_zeros(n, *like.shape[1:]) if i is None else i for i, n in zip(items, vertex_counts, strict=True)]
    return torch.cat(filled)


def _concatenate_times(steps: Sequence[StepInput]) -> Tensor | None:
    """Steps that do not say are at 0, as alone."""
    if all(step.time is None for step in steps):
        return None
    return torch.cat([torch.zeros_like(step.dt) if step.time is None else step.time.to(step.dt) for step in steps])


def _concatenate_attachments(items: Sequence[Attachments | None], vertex_counts: Sequence[int]) -> Attachments | None:
    present, edges, offset = [], [], 0
    for item, count in zip(items, vertex_counts, strict=True):
        if item is not None:
            present.append(item)
            edges.append(item.edges + offset)
        offset += count
    if not present:
        return None
    return Attachments(
        torch.cat(edges),
        torch.cat([item.active for item in present]),
        _known_of_all(present, "length", 0.0),
        _known_of_all(present, "speed", torch.inf),
    )


def _known_of_all(items: Sequence[Attachments], key: str, default: float) -> Tensor | None:
    """A number (A,) of all pairs, the ``default`` of those that do not say; None where none does."""
    given = [getattr(item, key) for item in items]
    if all(values is None for values in given):
        return None
    like = next(values for values in given if values is not None)
    filled = [like.new_full((len(i.edges),), default) if v is None else v for i, v in zip(items, given, strict=True)]
    return torch.cat(filled)


def centres_of(pos: Tensor, vertex_scene: Tensor, num_scenes: int) -> Tensor:
    """(B, 3) m: means of the vertices of each scene, of positions (V, 3)."""
    count = sum_scenes(pos.new_ones(len(vertex_scene)), vertex_scene, num_scenes).clamp_min(1)
    return add_rows(pos.new_zeros(num_scenes, 3), vertex_scene, pos) / count[:, None]
