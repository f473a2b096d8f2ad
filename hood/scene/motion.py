"""A body in motion, frame by frame: what the cloth collides with and how the start garment is skinned."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hood.assets.body import Body
from hood.assets.garment import Garment
from hood.assets.sequence import PoseSequence
from hood.assets.skinning import linear_blend_skinning
from hood.scene.state import Obstacle

#: Frames posed at once: enough to amortise the call, few enough for short training windows.
_CHUNK = 16


@dataclass(frozen=True)
class BodyMotion:
    """Body of shape ``betas`` performing ``sequence``.

    Surfaces are kept relative to the body's own translation in ``dtype``; translations are float64, so that a walk far from
    the origin loses nothing. Surfaces are posed in chunks on demand and the last chunk is kept.
    """

    body: Body
    sequence: PoseSequence
    betas: np.ndarray
    translation: np.ndarray  # (T, 3) m float64, world
    dtype: torch.dtype
    device: torch.device
    _cache: dict[int, Tensor]

    @property
    def num_frames(self) -> int:
        return self.sequence.num_frames

    def local_surface(self, frame: int) -> Tensor:
        """(W, 3) m, relative to ``translation[frame]``."""
        chunk = frame // _CHUNK
        if chunk not in self._cache:
            # Two chunks cover the three frames around any step.
            for old in [key for key in self._cache if abs(key - chunk) > 1]:
                del self._cache[old]
            window = self.sequence.window(chunk * _CHUNK, (chunk + 1) * _CHUNK)
            self._cache[chunk] = self.body.surface(window, self.betas, self.dtype).to(self.device)
        return self._cache[chunk][frame % _CHUNK]

    def surface(self, frame: int, origin: np.ndarray) -> Tensor:
        """(W, 3) m, relative to ``origin`` (3,) float64."""
        shift = torch.as_tensor(self.translation[frame] - origin).to(self.device, self.dtype)
        return self.local_surface(frame) + shift

    def obstacle(self, frame: int, origin: np.ndarray, static: bool = False) -> Obstacle:
        """The body around the step ``frame`` → ``frame + 1``; ``static`` freezes it at ``frame`` (relaxing step)."""
        now = self.surface(frame, origin)
        after = now if static else self.surface(frame + 1, origin)
        before = now if static or frame == 0 else self.surface(frame - 1, origin)
        faces = _body_faces(self.body, self.device)
        return Obstacle(
            pos=now,
            next_pos=after,
            prev_pos=before,
            faces=faces,
            vertex_scene=faces.new_zeros(len(now)),
            face_scene=faces.new_zeros(len(faces)),
            omitted=torch.as_tensor(self.body.omitted, device=self.device),
        )

    def skinned(self, garment: Garment, frame: int, origin: np.ndarray) -> Tensor:
        """(V, 3) m: the garment posed with the body at ``frame`` by its skinning weights, relative to ``origin``."""
        rest = torch.as_tensor(garment.shaped(self.betas)).to(self.dtype)
        weights = torch.as_tensor(garment.lbs_weights).to(self.dtype)
        transforms = self.body.transforms(self.sequence.window(frame, frame + 1), self.betas, self.dtype)
        shift = torch.as_tensor(self.translation[frame] - origin).to(self.dtype)
        return (linear_blend_skinning(rest, weights, transforms)[0] + shift).to(self.device)


def body_motion(
    body: Body,
    sequence: PoseSequence,
    betas: np.ndarray,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str = "cpu",
) -> BodyMotion:
    """The motion of ``body`` with shape ``betas`` (S,) through ``sequence``."""
    betas = np.asarray(betas, dtype=np.float64)
    return BodyMotion(body, sequence, betas, body.translation(sequence, betas), dtype, torch.device(device), {})


_FACES: dict[tuple[int, str], tuple[Body, Tensor]] = {}


def _body_faces(body: Body, device: torch.device) -> Tensor:
    """One faces tensor per body object: the search keeps its incidence table with the tensor."""
    key = (id(body), str(device))
    entry = _FACES.get(key)
    if entry is None or entry[0] is not body:
        entry = (body, torch.as_tensor(body.faces, device=device))
        _FACES[key] = entry
    return entry[1]
