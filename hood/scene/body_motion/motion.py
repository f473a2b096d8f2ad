"""A body in motion, frame by frame: what the cloth collides with and how the start garment is skinned."""

from __future__ import annotations

import weakref
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from hood.assets.body.body import Body, linear_blend_skinning
from hood.assets.garment.binding import bind_garment, hold_on_trunk
from hood.assets.garment.garment import Garment
from hood.assets.motion.sequence import PoseSequence
from hood.assets.motion.sequence_edit import blend_in
from hood.cloth.state import Obstacle
from hood.tensors.batch import forget, sent

#: Frames posed at once: enough to amortise the call, few enough for short training windows.
_CHUNK = 16


class Motion(Protocol):
    """What a scene needs of whatever moves in it: :class:`BodyMotion`, a parametric body, or one of
    :mod:`hood.scene.body_motion.mesh_motion`. Positions are relative to an ``origin`` (3,) [m], float64, in ``dtype`` on
    ``device``."""

    @property
    def name(self) -> str:
        """What is performed, and by whom."""
        ...

    @property
    def num_frames(self) -> int:
        """T."""
        ...

    @property
    def fps(self) -> float:
        """Frames per second."""
        ...

    @property
    def dtype(self) -> torch.dtype:
        """Of the positions that it gives."""
        ...

    @property
    def device(self) -> torch.device:
        """Where these are."""
        ...

    @property
    def translation(self) -> np.ndarray:
        """(T, 3) m, float64: a point of the world near the body in every frame."""
        ...

    def turns(self) -> np.ndarray:
        """(T − 1, 3) rad, float64: rotation vectors of the body as a whole, from every frame to the next."""
        ...

    @property
    def faces(self) -> np.ndarray:
        """(G, 3) int64; empty where there is no body."""
        ...

    @property
    def num_vertices(self) -> int:
        """W; 0 where there is no body."""
        ...

    def surface(self, frame: int, origin: np.ndarray) -> Tensor:
        """(W, 3) m."""
        ...

    def some_points(self, frames: np.ndarray, stride: int) -> np.ndarray:
        """(N, W′, 3) m, float64, in the world: every ``stride``-th vertex in ``frames`` (N,); nothing of it is kept."""
        ...

    def obstacle(self, frame: int, origin: np.ndarray, static: bool = False) -> Obstacle | None:
        """The body around the step ``frame`` → ``frame + 1``, frozen at ``frame`` when ``static``; None without a body."""
        ...

    def dressed(self, garment: Garment) -> Garment:
        """The garment with what it needs to follow this body.

        Raises:
            ValueError: it cannot follow it; says what to give instead.
        """
        ...

    def rest_pos(self, garment: Garment) -> np.ndarray:
        """(V, 3) m: the undeformed garment, grown with the body's shape."""
        ...

    def skinned(self, garment: Garment, frame: int, origin: np.ndarray) -> Tensor:
        """(V, 3) m: where the dressed garment is at ``frame`` when it moves with the body alone."""
        ...


@dataclass(frozen=True)
class BodyMotion:
    """Body of shape ``betas`` performing ``sequence``.

    Surfaces are posed and kept in float64 relative to the body's own translation, so that a walk far from the origin loses
    nothing; ``dtype`` is what comes out. Surfaces are posed in chunks on demand and the last chunk is kept.
    """

    body: Body
    sequence: PoseSequence
    betas: np.ndarray
    translation: np.ndarray  # (T, 3) m float64, world
    dtype: torch.dtype
    device: torch.device
    _cache: dict[int, Tensor]
    _bones: dict[int, Tensor] = field(default_factory=dict)  # joint transforms by chunk, float64
    _placed: dict[int, tuple[bytes, Tensor]] = field(default_factory=dict)  # the last surfaces by frame, with their origins

    @property
    def name(self) -> str:
        return self.sequence.name

    @property
    def num_frames(self) -> int:
        return self.sequence.num_frames

    @property
    def fps(self) -> float:
        return self.sequence.fps

    @property
    def faces(self) -> np.ndarray:
        return self.body.faces

    @property
    def num_vertices(self) -> int:
        return len(self.body.v_template)

    def turns(self) -> np.ndarray:
        """(T − 1, 3) rad: of its root joint."""
        root = Rotation.from_rotvec(self.sequence.poses[:, 0].astype(np.float64))
        return np.asarray((root[1:] * root[:-1].inv()).as_rotvec())

    def local_surface(self, frame: int) -> Tensor:
        """(W, 3) m, relative to ``translation[frame]``, float64."""
        chunk = frame // _CHUNK
        if chunk not in self._cache:
            _forget(self._cache, chunk, 1)
            self._cache[chunk] = self.body.surface(self._window(chunk), self.betas, torch.float64).to(self.device)
        return self._cache[chunk][frame % _CHUNK]

    def _window(self, chunk: int) -> PoseSequence:
        return self.sequence.window(chunk * _CHUNK, (chunk + 1) * _CHUNK)

    def _transforms(self, frame: int) -> Tensor:
        """(1, J, 3, 4) rest-to-posed joint transforms at ``frame``, in ``dtype``."""
        chunk = frame // _CHUNK
        if chunk not in self._bones:
            _forget(self._bones, chunk, 1)
            self._bones[chunk] = self.body.transforms(self._window(chunk), self.betas, torch.float64)
        return self._bones[chunk][frame % _CHUNK].unsqueeze(0).to(self.dtype)

    @property
    def posed(self) -> dict[int, Tensor]:
        """Chunks of surfaces posed so far and kept."""
        return self._cache

    def surfaces(self) -> dict[int, Tensor]:
        """Every surface, in the chunks in which :meth:`local_surface` poses them."""
        chunks = {}
        for chunk in range(-(-self.num_frames // _CHUNK)):
            self.local_surface(chunk * _CHUNK)
            chunks[chunk] = self._cache[chunk]
        return chunks

    def with_surfaces(self, chunks: Mapping[int, Tensor], device: torch.device | str) -> BodyMotion:
        """The same motion on ``device`` with surfaces posed before; none is posed again as long as all are given."""
        kept = {key: sent(chunk, device) for key, chunk in chunks.items()}
        return replace(self, device=torch.device(device), _cache=kept, _placed={})

    def surface(self, frame: int, origin: np.ndarray) -> Tensor:
        """(W, 3) m, relative to ``origin`` (3,) float64."""
        known, key = self._placed.get(frame), origin.tobytes()
        if known is not None and known[0] == key:
            return known[1]
        _forget(self._placed, frame, 2)
        local = self.local_surface(frame)
        way = self.translation[frame] - origin
        # Filled, not copied: nothing waits for a device.
        on_host = local.device.type == "cpu"
        shift = torch.from_numpy(way) if on_host else torch.stack([local.new_full((), value) for value in way])
        # Rounded once, at the end: a mesh that moves as this body does gives the same numbers.
        surface = (local + shift).to(self.dtype)
        self._placed[frame] = key, surface
        return surface

    def some_points(self, frames: np.ndarray, stride: int) -> np.ndarray:
        """(N, W′, 3) m, float64, in the world: every ``stride``-th vertex in ``frames`` (N,)."""
        posed = self.body.some_points(self.sequence.at(frames), self.betas, stride)
        return posed.numpy() + self.translation[frames][:, None]

    def obstacle(self, frame: int, origin: np.ndarray, static: bool = False) -> Obstacle:
        """The body around the step ``frame`` → ``frame + 1``; ``static`` freezes it at ``frame`` (relaxing step)."""
        now = self.surface(frame, origin)
        after = now if static else self.surface(frame + 1, origin)
        before = now if static or frame == 0 else self.surface(frame - 1, origin)
        faces, omitted, vertex_scene, face_scene = _body_tensors(self.body, self.device)
        return Obstacle(
            pos=now,
            next_pos=after,
            prev_pos=before,
            faces=faces,
            vertex_scene=vertex_scene,
            face_scene=face_scene,
            omitted=omitted,
        )

    def dressed(self, garment: Garment) -> Garment:
        """The garment bound to the body (:func:`hood.assets.garment.binding.bind_garment`), what is held there steadied
        (:func:`hood.assets.garment.binding.hold_on_trunk`)."""
        return hold_on_trunk(bind_garment(garment, self.body), self.body)

    def rest_pos(self, garment: Garment) -> np.ndarray:
        """(V, 3) m: the garment grown with the body's shape."""
        return garment.shaped(self.betas)

    def lead_in(self, frame: int, seconds: float) -> BodyMotion:
        """The same body moving from the T-pose into ``frame``, its last."""
        sequence = blend_in(self.sequence.window(frame, frame + 1), seconds)
        return body_motion(self.body, sequence, self.betas, self.dtype, self.device)

    def skinned(self, garment: Garment, frame: int, origin: np.ndarray) -> Tensor:
        """(V, 3) m: the garment posed with the body at ``frame`` by its skinning weights, relative to ``origin``."""
        rest = torch.as_tensor(garment.tpose(self.betas)).to(self.dtype)
        weights = torch.as_tensor(garment.lbs_weights).to(self.dtype)
        shift = torch.as_tensor(self.translation[frame] - origin).to(self.dtype)
        return sent(linear_blend_skinning(rest, weights, self._transforms(frame))[0] + shift, self.device)


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


def _forget(kept: dict[int, Any], place: int, reach: int) -> None:
    """Drop what lies apart from ``place``: two chunks cover the three frames around any step."""
    for old in [key for key in kept if abs(key - place) > reach]:
        del kept[old]


#: By body and device, as long as the body lives.
_TENSORS: dict[tuple[int, str], tuple[weakref.ref[Body], tuple[Tensor, ...]]] = {}


def _body_tensors(body: Body, device: torch.device) -> tuple[Tensor, ...]:
    """Faces, omitted vertices, and the scene of vertices and faces, one tensor each per body object: the search keeps what it
    knows of a surface with them."""
    key = (id(body), str(device))
    entry = _TENSORS.get(key)
    if entry is None or entry[0]() is not body:
        faces = torch.as_tensor(body.faces, device=device)
        scenes = faces.new_zeros(len(body.v_template)), faces.new_zeros(len(faces))
        tensors = (faces, torch.as_tensor(body.omitted, device=device), *scenes)
        entry = _TENSORS[key] = weakref.ref(body, forget(_TENSORS, key)), tensors
    return entry[1]
