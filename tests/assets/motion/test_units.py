"""Units of a translation: found by the body's steps or its height, never changed where metres fit, doubted where it is open."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from motion_kinds.parameters import amass
from motion_kinds.walks import world
from motion_kinds.writers import write

from hood.assets.files.library import locate, names
from hood.assets.files.said import Doubt
from hood.assets.motion.load import load_sequence
from hood.assets.motion.recording import Recording, read_recording
from hood.assets.motion.skeleton import TRANSLATION_UNITS, Unit, find_unit


def unit_of(recording: Recording, transl: np.ndarray, up: str = "z") -> Unit:
    return find_unit(Path("m.npz"), "trans", recording.poses, transl, recording.fps, up)


@pytest.fixture(scope="module", params=names("motions"))
def own(request: pytest.FixtureRequest) -> Recording:
    return read_recording(locate("motions", request.param))


def test_metres_stay_metres(own: Recording) -> None:
    """With noise, from the origin, slowed down, of tall and of short people."""
    rng = np.random.default_rng(0)
    for size, centred in ((1.0, False), (1.15, True), (0.8, True)):
        noisy = size * own.transl + rng.normal(scale=0.005, size=own.transl.shape)
        found = unit_of(own, noisy - noisy.mean(axis=0) * centred)
        assert (found.name, found.note) == ("m", None)


@pytest.mark.parametrize("unit", ["cm", "mm"])
def test_other_units_are_found_on_a_floor(own: Recording, unit: str) -> None:
    found = unit_of(own, own.transl / TRANSLATION_UNITS[unit])
    assert (found.name, found.sure) == (unit, True)
    assert not isinstance(found.note, Doubt)
    assert "unit=m" in str(found.note)


@pytest.mark.parametrize("unit", ["cm", "mm"])
def test_a_walk_tells_its_unit_without_a_floor(unit: str, tmp_path: Path) -> None:
    """In slow motion too: feet that stand still do not depend on the frame rate."""
    clean = world("z").transl - world("z").transl.mean(axis=0)
    for rate in (30.0, 6.0):
        path = write(tmp_path / "m.npz", amass(trans=clean / TRANSLATION_UNITS[unit], mocap_framerate=rate))
        with pytest.warns(UserWarning, match="feet stand still only so"):
            sequence = load_sequence(path, rate, up="z")
        assert np.abs(sequence.transl - clean @ np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])).max() < 1e-9


def test_a_body_that_is_carried_is_a_doubt() -> None:
    """On skates or in centimetres: the feet do not tell."""
    own = read_recording(locate("motions", "arm_raises"))
    slide = np.outer(np.arange(len(own.poses)) / own.fps, [3.0, 0.0, 0.0])
    found = unit_of(own, slide)
    assert isinstance(found.note, Doubt)
    assert (found.name, found.sure, found.note.kind) == ("m", False, "units")
    assert all(word in str(found.note) for word in ("unit=cm", "unit=m "))


def test_the_unit_can_be_given(tmp_path: Path) -> None:
    path = write(tmp_path / "m.npz", amass())
    for unit, metres in TRANSLATION_UNITS.items():
        found = read_recording(path, trans_unit=unit)
        np.testing.assert_allclose(found.transl, world("z").transl * metres)
        assert found.notes == ()
    with pytest.raises(ValueError, match="unit=inch: give m, cm, mm or auto"):
        read_recording(path, trans_unit="inch")
