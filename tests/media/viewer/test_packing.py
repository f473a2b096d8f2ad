"""Numbers inside a page: what comes back is what went in, within what is promised, and small."""

from __future__ import annotations

import numpy as np
import pytest

from hood.media.viewer.page import STEP, pack_integers, pack_positions, unpack_integers, unpack_positions


@pytest.mark.parametrize("place", [0.0, 6.0, -250.0])
def test_positions_come_back_within_a_tenth_of_a_millimetre(place: float) -> None:
    pos = np.random.default_rng(0).normal(place, 1.0, (7, 50, 3))
    packed, lost = pack_positions(pos)
    assert lost == []
    assert np.abs(unpack_positions(packed) - pos).max() <= 0.5 * STEP + 1e-9 <= 1e-4


@pytest.mark.parametrize("wrong", [np.nan, np.inf, 1e20])
@pytest.mark.parametrize("frame, instead", [(0, 1), (2, 1), (3, 2)])
def test_a_frame_that_blew_up_repeats_the_one_before(wrong: float, frame: int, instead: int) -> None:
    pos = np.random.default_rng(0).normal(0.0, 1.0, (4, 5, 3))
    pos[frame, 3, 1] = wrong
    packed, lost = pack_positions(pos)
    assert lost == [frame]
    assert np.allclose(unpack_positions(packed)[frame], pos[instead], atol=1e-4, rtol=0)


def test_nothing_but_blown_up_frames_can_be_packed() -> None:
    packed, lost = pack_positions(np.full((2, 3, 3), np.nan))
    assert lost == [0, 1]
    assert not unpack_positions(packed).any()


def test_integers_of_every_size_come_back() -> None:
    values = np.array([0, -1, 1, 127, -128, 65536, 2**31 - 1, -(2**31)])
    assert unpack_integers(pack_integers(values)).tolist() == values.tolist()
    assert len(unpack_integers(pack_integers(np.empty(0, dtype=int)))) == 0


def test_a_smooth_motion_takes_a_byte_a_number_at_most() -> None:
    """300 frames of a 4k garment and a body of 6,890 vertices are 10 million numbers; 12 MB are base64 of 9."""
    time = np.arange(60)[:, None, None] / 30
    rest = np.random.default_rng(0).normal(0.0, 0.5, (1, 400, 3))
    pos = rest + 0.1 * np.sin(2 * np.pi * time + rest)
    assert len(pack_positions(pos)[0]["data"]) < pos.size
