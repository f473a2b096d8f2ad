"""Frames on a finer mesh than the simulated one, outside the body."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
import torch

from hood.assets.garment.binding import push_out
from hood.dynamics.rollout import Frame
from hood.mesh.compiled_crossing import Eights, eights
from hood.mesh.crossing import self_crossings
from hood.mesh.subdivision import Subdivision

#: Times that the bulge of new vertices is halved where cloth passes through cloth; then they lie on the simulated faces.
_HALVED, _ROUNDS = 3, 8


def refined_frames(frames: Iterable[Frame], finer: Subdivision, body_faces: np.ndarray, clearance: float) -> Iterator[Frame]:
    """The frames with the positions and fields of the finer mesh. Simulated vertices come first and stay where they are.

    In sharp folds the smooth surface can pass through itself. There the new vertices are moved towards the simulated faces, and
    onto them if need be, which do not pass through each other where the simulation kept them apart. Then new vertices that are
    in the body, or nearer to it than ``clearance`` [m], are moved straight out to there. States and metrics stay those of the
    simulated mesh.

    Args:
        body_faces: (G, 3) of the frames' ``body_pos``; empty without a body.
    """
    own = eights(finer.faces, finer.rest_pos)
    for frame in frames:
        pos = finer.positions(frame.world_pos.numpy())
        if np.isfinite(pos).all():
            pos = _apart(pos, finer, own)
            if len(body_faces):
                new = pos[finer.num_coarse :]
                new[:] = push_out(new, frame.body_pos.numpy(), body_faces, clearance).pos
        fields = {name: torch.as_tensor(finer.spread(values.numpy())) for name, values in frame.fields.items()}
        yield replace(frame, world_pos=torch.as_tensor(pos), fields=fields)


def _apart(pos: np.ndarray, finer: Subdivision, own: Eights | None) -> np.ndarray:
    """Positions (V′, 3) with the new vertices of triangles that pass through each other moved towards the simulated faces."""
    flat = finer.spread(pos[: finer.num_coarse])
    for turn in range(_ROUNDS):
        pairs = self_crossings(pos, finer.faces, own)
        if not len(pairs):
            break
        near = np.unique(finer.faces[pairs])  # simulated vertices among them are where they were
        pos[near] = flat[near] + (0.5 if turn < _HALVED else 0.0) * (pos[near] - flat[near])
    return pos
