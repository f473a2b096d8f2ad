"""Stored frames with what rides on the cloth: its vertices follow those of the cloth, in every frame and table."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from hood.assets.garment.garment import Garment
from hood.dynamics.rollout import Frame
from hood.mesh.riders import Riders


def ridden_frames(frames: Iterable[Frame], garment: Garment) -> Iterator[Frame]:
    """The frames with the riders of ``garment`` behind the vertices of the cloth, of which the simulated ones come first; in
    fields each has the value of a vertex that carries it. The frames as they are without any."""
    riders = garment.riders
    if riders is None:
        yield from frames
        return
    carriers = torch.as_tensor(riders.first_anchor)
    for frame in frames:
        there = riders.positions(frame.world_pos[: len(garment.rest_pos)].numpy(), garment.rest_pos)
        fields = {name: torch.cat([values, values[carriers]]) for name, values in frame.fields.items()}
        yield replace(frame, world_pos=torch.cat([frame.world_pos, torch.as_tensor(there)]), fields=fields)


def ridden_rest(rest_pos: np.ndarray, garment: Garment) -> np.ndarray:
    """(V + R, 3) m: the rest shape (V, 3), whose first vertices are the simulated ones, with the riders on it."""
    riders = garment.riders
    if riders is None:
        return rest_pos
    return np.concatenate([rest_pos, riders.positions(rest_pos[: len(garment.rest_pos)], garment.rest_pos)])


def ridden_faces(faces: np.ndarray, count: int, riders: Riders | None) -> np.ndarray:
    """(F + N, 3): the faces between ``count`` vertices of cloth, and the riders' behind them."""
    return faces if riders is None else np.concatenate([faces, riders.faces + count])


def ridden_still(still: Mapping[str, np.ndarray], riders: Riders | None) -> dict[str, np.ndarray]:
    """What a file holds of the cloth beside its mesh, for riders too: the garment that each is of, and its texture."""
    found = dict(still)
    if riders is None:
        return found
    if "piece" in found:
        found["piece"] = np.concatenate([found["piece"], found["piece"][riders.first_anchor]])
    if "uv_faces" in found:
        own = np.zeros_like(riders.faces) if riders.uv_faces is None else riders.uv_faces
        found["uv_faces"] = np.concatenate([found["uv_faces"], own])
    return found


def riding_attributes(riders: Riders | None) -> dict[str, Any]:
    """Attributes of the file: how many vertices and faces, the last ones, ride. None of other rollouts."""
    return {} if riders is None else {"riding_vertices": len(riders.pos), "riding_faces": len(riders.faces)}
