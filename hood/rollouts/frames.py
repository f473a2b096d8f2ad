"""Frames at a rate of their own: simulated ones where these fall on their moments, interpolated between them elsewhere.

The frames of a rollout kept in memory, to be judged and drawn when it is over.

Frames on a finer mesh than the simulated one, outside the body.

Stored frames with what rides on the cloth: its vertices follow those of the cloth, in every frame and table.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hood.assets.garment.binding import push_out
from hood.assets.garment.garment import Garment
from hood.cloth.state import State
from hood.mesh.editing.subdivision import Subdivision
from hood.mesh.parts import Riders
from hood.mesh.penetration.compiled import Eights, eights
from hood.mesh.penetration.crossing import self_crossings
from hood.rollouts.file.reader import RolloutData
from hood.rollouts.file.recorder import still_of
from hood.rollouts.file.step_table import OutputRate
from hood.rollouts.frame import Frame
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
            still=still_of(self.scene.garment, cloth=self.scene.cloth),
        )


#: Simulated frames before and after an interval that say how fast its ends move.
_AROUND = 2


def output_frames(
    frames: Iterable[Frame],
    rate: OutputRate,
    jumps: Collection[int] = (),
    body: Callable[[int], Tensor] | None = None,
    given: int = 0,
    known: Iterable[Frame] = (),
) -> Iterator[Frame]:
    """Frames at ``rate`` of simulated ones, 0, 1, …, as soon as they are known; six simulated frames are kept at most.

    A frame at the moment of a simulated one is that frame with its new number. Others lie between two simulated frames: a
    cubic (:func:`hermite`) leads from one to the other, with the velocities that the neighbours of its ends say (differences
    of fourth order; of second order next to the ends and at jumps). At simulated moments it is exact; between them its error
    falls with the fourth power of the time step. Such a frame says ``simulated=False``; its metrics and fields are those of
    the step that it lies in.

    The velocity of a state is that of the step that led to it, half a step ago. Interpolated with it the error falls with the
    second power only.

    Args:
        jumps: simulated frames after which the body jumps (:mod:`hood.scene.jumps`). Within the step the nearer simulated frame
            is given; nothing is interpolated across.
        body: the body's surface (W, 3) [m], float64, world, in the frame of this number, where it is not a simulated one;
            None: the body is interpolated as the cloth is.
        given: so many frames were given before; this goes on after them.
        known: the simulated frames before ``frames`` that these need (:func:`still_needed`).
    """
    kept = {frame.index: frame for frame in known}
    index = given
    for frame in frames:
        kept[frame.index] = frame
        while _is_known(rate, index, frame.index, over=False):
            yield _frame_at(kept, rate, index, jumps, body)
            index += 1
        kept = {one.index: one for one in still_needed(kept.values(), rate, index)}
    while kept and _is_known(rate, index, max(kept), over=True):
        yield _frame_at(kept, rate, index, jumps, body)
        index += 1


def still_needed(frames: Iterable[Frame], rate: OutputRate, given: int) -> list[Frame]:
    """Those of simulated frames that frames after the ``given`` ones are made of."""
    return [frame for frame in frames if frame.index >= rate.place(given)[0] - _AROUND]


def hermite(start: Tensor, end: Tensor, start_slope: Tensor, end_slope: Tensor, share: float) -> tuple[Tensor, Tensor]:
    """Value and slope at ``share`` of the way from ``start`` to ``end``, all of one shape, of the cubic that has these values
    and slopes (per way) at its ends."""
    left, way = 1.0 - share, end - start
    value = start + share * way + share * left * (left * (start_slope - way) - share * (end_slope - way))
    slope = way + left * (1.0 - 3.0 * share) * (start_slope - way) + share * (3.0 * share - 2.0) * (end_slope - way)
    return value, slope


def _is_known(rate: OutputRate, index: int, newest: int, over: bool) -> bool:
    """Whether the frame ``index`` can be given after the simulated frame ``newest``, the last one where it is ``over``."""
    before, share = rate.place(index)
    if share == 0:
        return before <= newest
    return before + 1 + (0 if over else _AROUND) <= newest


def _frame_at(
    kept: Mapping[int, Frame],
    rate: OutputRate,
    index: int,
    jumps: Collection[int],
    body: Callable[[int], Tensor] | None,
) -> Frame:
    before, share = rate.place(index)
    if share == 0:
        return replace(kept[before], index=index)
    if before in jumps:
        return replace(kept[before if share < 0.5 else before + 1], index=index, simulated=False)
    first = max([0, before - _AROUND, *(jump + 1 for jump in jumps if jump < before)])
    last = min([max(kept), before + 1 + _AROUND, *(jump for jump in jumps if jump > before)])
    near = [kept[number] for number in range(first, last + 1)]
    pos, vel = _between([one.world_pos for one in near], before - first, float(share))
    surface = _between([one.body_pos for one in near], before - first, float(share))[0] if body is None else body(index)
    after, like = kept[before + 1], kept[before].state
    state = State((pos - like.origin[0].cpu()).to(like.pos), (vel * rate.simulated_fps).to(like.vel), like.origin)
    return Frame(index, state, pos, surface, after.metrics, after.fields, simulated=False)


def _between(near: list[Tensor], at: int, share: float) -> tuple[Tensor, Tensor]:
    """Value and slope per step at ``share`` of the step from ``near[at]`` to the next of these equally distant values."""
    start, end = _slope(near, at), _slope(near, at + 1)
    way = near[at + 1] - near[at]
    if start is None:  # at the end of what is known: a parabola, or a straight line
        start = way if end is None else 2.0 * way - end
    end = 2.0 * way - start if end is None else end
    return hermite(near[at], near[at + 1], start, end, share)


def _slope(near: list[Tensor], at: int) -> Tensor | None:
    """Slope per step at ``near[at]`` by central differences over as many neighbours as there are; None at an end."""
    neighbours = min(at, len(near) - 1 - at, _AROUND)
    if neighbours == 0:
        return None
    central = near[at + 1] - near[at - 1]
    return central / 2.0 if neighbours == 1 else (8.0 * central - (near[at + 2] - near[at - 2])) / 12.0


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
    """What a file holds of the cloth beside its mesh, for riders too: garment and fabric that each is of, and its texture."""
    found = dict(still)
    if riders is None:
        return found
    for name in ("piece", "fabric"):
        if name in found:
            found[name] = np.concatenate([found[name], found[name][riders.first_anchor]])
    if "uv_faces" in found:
        own = np.zeros_like(riders.faces) if riders.uv_faces is None else riders.uv_faces
        found["uv_faces"] = np.concatenate([found["uv_faces"], own])
    return found


def riding_attributes(riders: Riders | None) -> dict[str, Any]:
    """Attributes of the file: how many vertices and faces, the last ones, ride. None of other rollouts."""
    return {} if riders is None else {"riding_vertices": len(riders.pos), "riding_faces": len(riders.faces)}
