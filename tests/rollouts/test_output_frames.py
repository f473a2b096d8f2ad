"""Frames at a rate of their own: simulated ones unchanged, and the order of what is interpolated between them."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Callable, Iterator
from fractions import Fraction

import numpy as np
import pytest
import torch
from torch import Tensor

from hood.cloth.state import State
from hood.rollouts.file.step_table import OutputRate
from hood.rollouts.frame import Frame
from hood.rollouts.frames import hermite, output_frames

Path = Callable[[Tensor], Tensor]


def simulated(path: Path, count: int, fps: float) -> Iterator[Frame]:
    """Frames of five vertices that follow ``path``, whose velocities, as those of steps, say nothing of the frames after."""
    for index in range(count):
        pos = place(path, index / fps)
        origin = torch.tensor([[0.25, 0.0, 0.0]], dtype=torch.float64)
        state = State(pos - origin, torch.zeros_like(pos), origin)
        yield Frame(index, state, pos, 2.0 * pos, {"strain": float(index)}, {"rg": torch.full((5,), float(index))})


def place(path: Path, time: float) -> Tensor:
    return path(torch.tensor(time, dtype=torch.float64) + torch.arange(15, dtype=torch.float64).reshape(5, 3) / 7.0)


def error(path: Path, fps: float, output: float, ends: bool = False) -> float:
    """Largest error of frames at ``output`` of a second at ``fps``; those of the first and last steps only if asked for."""
    frames = list(output_frames(simulated(path, round(fps) + 1, fps), OutputRate(output, fps)))
    assert [frame.index for frame in frames] == list(range(round(output) + 1))
    away = 0.0 if ends else 2.0 / fps
    found = [(frame.index / output, frame.world_pos) for frame in frames]
    return max(float((pos - place(path, time)).abs().max()) for time, pos in found if away <= time <= 1.0 - away)


def test_rates_are_exact() -> None:
    rate = OutputRate(24.0, 30.0)
    assert rate.stride == Fraction(5, 4)
    assert not rate.whole
    assert [rate.place(index) for index in (0, 1, 4)] == [(0, 0), (1, Fraction(1, 4)), (5, 0)]
    assert [rate.count(frames) for frames in (1, 2, 3, 6, 150)] == [1, 1, 2, 5, 120]
    assert OutputRate(24.0, 120.0).whole
    film = OutputRate(29.97, 119.88)  # no power of two is a factor of either
    assert film.place(10_001) == (40_004, 0)


def test_whole_ratios_give_the_simulated_frames_themselves() -> None:
    frames = list(simulated(torch.sin, 11, 120.0))
    given = list(output_frames(iter(frames), OutputRate(40.0, 120.0)))
    assert [frame.index for frame in given] == [0, 1, 2, 3]
    for frame, source in zip(given, frames[::3], strict=True):
        assert frame.simulated
        assert frame.world_pos is source.world_pos
        assert frame.body_pos is source.body_pos
        assert frame.state is source.state
        assert frame.metrics is source.metrics


@pytest.mark.parametrize("output", [24.0, 50.0])
def test_simulated_moments_are_exact_and_others_say_so(output: float) -> None:
    rate, frames = OutputRate(output, 30.0), list(simulated(torch.sin, 31, 30.0))
    given = list(output_frames(iter(frames), rate))
    assert len(given) == round(output) + 1
    for frame in given:
        before, share = rate.place(frame.index)
        assert frame.simulated == (share == 0)
        assert frame.metrics == frames[before + (share > 0)].metrics
        assert torch.equal(frame.fields["rg"], frames[before + (share > 0)].fields["rg"])
        if frame.simulated:
            assert frame.world_pos is frames[before].world_pos
        torch.testing.assert_close(frame.state.pos + frame.state.origin, frame.world_pos)
        torch.testing.assert_close(frame.body_pos, 2.0 * frame.world_pos)
    assert sum(frame.simulated for frame in given) == (7 if output == 24.0 else 11)


def test_the_error_falls_with_the_fourth_power_of_the_time_step() -> None:
    wave = [error(lambda t: torch.sin(5.0 * t), fps, 7.0 * fps) for fps in (20.0, 40.0, 80.0)]
    assert wave[0] < 1e-3
    assert 13.0 < wave[0] / wave[1] < 19.0
    assert 13.0 < wave[1] / wave[2] < 19.0


def test_what_moves_on_polynomials_is_exact() -> None:
    assert error(lambda t: t**3 - t, 20.0, 48.0) < 1e-12
    assert error(lambda t: 3.0 * t**2 - t, 20.0, 48.0, ends=True) < 1e-12
    for count, expected in ((2, lambda t: 2.0 * t), (3, lambda t: t**2)):
        frames = list(output_frames(simulated(expected, count, 1.0), OutputRate(4.0, 1.0)))
        assert len(frames) == 4 * count - 3
        for frame in frames:
            torch.testing.assert_close(frame.world_pos, place(expected, frame.index / 4.0))


def test_velocities_are_those_of_the_way() -> None:
    for frame in output_frames(simulated(lambda t: t**3, 31, 30.0), OutputRate(50.0, 30.0)):
        if not frame.simulated and 4 <= frame.index <= 46:
            torch.testing.assert_close(frame.state.vel, place(lambda t: 3.0 * t**2, frame.index / 50.0))


def test_a_cubic_has_the_slopes_that_it_says() -> None:
    start, end, left, right = torch.randn(4, 6, dtype=torch.float64)
    for share, value, slope in ((0.0, start, left), (1.0, end, right)):
        found = hermite(start, end, left, right, share)
        torch.testing.assert_close(found[0], value)
        torch.testing.assert_close(found[1], slope)
    ahead, behind = (hermite(start, end, left, right, 0.3 + step)[0] for step in (1e-5, -1e-5))
    torch.testing.assert_close((ahead - behind) / 2e-5, hermite(start, end, left, right, 0.3)[1], rtol=1e-8, atol=1e-8)


def test_nothing_is_interpolated_across_a_jump() -> None:
    def jumping(t: Tensor) -> Tensor:
        return t + 9.0 * (t[0, 0] > 0.45)

    rate = OutputRate(50.0, 10.0)  # the body jumps between the frames 4 and 5
    given = list(output_frames(simulated(jumping, 11, 10.0), rate, jumps=(4,)))
    smooth = list(output_frames(simulated(lambda t: t, 11, 10.0), rate))
    for frame, other in zip(given, smooth, strict=True):
        moment = frame.index / 5
        nearest = place(jumping, round(moment) / 10.0) if 4 < moment < 5 else other.world_pos + 9.0 * (moment > 4.5)
        torch.testing.assert_close(frame.world_pos, nearest)
        assert frame.simulated == (moment == round(moment))


def test_the_body_is_posed_where_a_motion_is_given() -> None:
    given = list(
        output_frames(simulated(torch.sin, 7, 30.0), OutputRate(24.0, 30.0), body=lambda index: torch.full((2, 3), index))
    )
    assert [frame.body_pos[0, 0].item() for frame in given if not frame.simulated] == [1, 2, 3]
    assert all(frame.body_pos.shape == (5, 3) for frame in given if frame.simulated)


@pytest.fixture
def few_objects() -> Iterator[None]:
    """A collection looks at objects that a test makes, not at all that the tests before it left."""
    gc.freeze()
    yield
    gc.unfreeze()


@pytest.mark.usefixtures("few_objects")
def test_no_more_than_six_simulated_frames_are_kept() -> None:
    seen: list[weakref.ref[Frame]] = []
    alive: list[int] = []

    def watched() -> Iterator[Frame]:
        for frame in simulated(torch.sin, 200, 30.0):
            seen.append(weakref.ref(frame))
            gc.collect()
            alive.append(sum(one() is not None for one in seen))
            yield frame

    last = 0
    for frame in output_frames(watched(), OutputRate(24.0, 30.0)):
        assert frame.index * 1.25 >= len(seen) - 1 - 3  # it comes three simulated frames later at most
        last = frame.index
    assert last == 159
    assert max(alive) <= 8  # with the one that is on its way, and the one before it


def test_what_is_not_finite_reaches_no_farther_than_its_neighbours() -> None:
    def broken(count: int) -> Iterator[Frame]:
        for frame in simulated(torch.sin, count, 30.0):
            bad = frame.world_pos * np.nan
            yield Frame(frame.index, frame.state, bad if frame.index == 15 else frame.world_pos, frame.body_pos, frame.metrics)

    rate = OutputRate(50.0, 30.0)
    for frame in output_frames(broken(31), rate):
        moment = frame.index * 0.6
        if frame.simulated:
            assert bool(torch.isfinite(frame.world_pos).all()) == (moment != 15)
        elif abs(moment - 15) > 3:
            assert bool(torch.isfinite(frame.world_pos).all())
        elif abs(moment - 15) < 1:
            assert not bool(torch.isfinite(frame.world_pos).any())
