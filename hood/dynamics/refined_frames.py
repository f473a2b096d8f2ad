"""Frames on a finer mesh than the simulated one, outside the body."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
import torch

from hood.assets.garment.binding import push_out
from hood.dynamics.rollout import Frame
from hood.mesh.subdivision import Subdivision


def refined_frames(frames: Iterable[Frame], finer: Subdivision, body_faces: np.ndarray, clearance: float) -> Iterator[Frame]:
    """The frames with the positions and fields of the finer mesh. Simulated vertices come first and stay where they are.

    New vertices that are in the body, or nearer to it than ``clearance`` [m], are moved straight out to there. States and
    metrics stay those of the simulated mesh.

    Args:
        body_faces: (G, 3) of the frames' ``body_pos``; empty without a body.
    """
    for frame in frames:
        pos = finer.positions(frame.world_pos.numpy())
        new = pos[finer.num_coarse :]
        if len(body_faces) and np.isfinite(pos).all():
            new[:] = push_out(new, frame.body_pos.numpy(), body_faces, clearance).pos
        fields = {name: torch.as_tensor(finer.spread(values.numpy())) for name, values in frame.fields.items()}
        yield replace(frame, world_pos=torch.as_tensor(pos), fields=fields)
