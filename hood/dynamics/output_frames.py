"""Frames at a rate of their own: simulated ones where these fall on their moments, interpolated between them elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import replace

from torch import Tensor

from hood.dynamics.output_rate import OutputRate
from hood.dynamics.rollout import Frame
from hood.scene.state import State

#: Simulated frames before and after an interval that say how fast its ends move.
_AROUND = 2


def output_frames(
    frames: Iterable[Frame], rate: OutputRate, jumps: Collection[int] = (), body: Callable[[int], Tensor] | None = None
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
    """
    kept: dict[int, Frame] = {}
    index = 0
    for frame in frames:
        kept[frame.index] = frame
        while _is_known(rate, index, frame.index, over=False):
            yield _frame_at(kept, rate, index, jumps, body)
            index += 1
        for old in [number for number in kept if number < rate.place(index)[0] - _AROUND]:
            del kept[old]
    while kept and _is_known(rate, index, max(kept), over=True):
        yield _frame_at(kept, rate, index, jumps, body)
        index += 1


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
