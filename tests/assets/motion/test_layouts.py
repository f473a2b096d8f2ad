"""Published layouts: every one is the same walk, and says what it is; what is not read is answered in one sentence."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
from motion_kinds.refused import REFUSALS
from motion_kinds.variants import GENERATORS
from motion_kinds.walks import walk
from motion_kinds.writers import write
from scipy.spatial.transform import Rotation

from hood.assets.files.doubt import Doubt
from hood.assets.motion.load import load_sequence
from hood.assets.motion.recording import read_recording
from hood.assets.motion.up_axis import bearing_notice


@pytest.mark.parametrize("name", GENERATORS)
def test_every_layout_is_the_same_walk(name: str, tmp_path: Path) -> None:
    file = GENERATORS[name]
    path = write(tmp_path / f"m{file.suffix}", file.make())
    found = read_recording(path, **file.keys)
    assert (found.layout, found.fps, found.fps_assumed, found.family) == (file.layout, file.fps, file.assumed, file.family)
    assert (len(found.people), found.unit) == (file.people, "m")
    assert bearing_notice(path, found)[0] == file.up
    if file.betas:
        np.testing.assert_allclose(found.betas[:10], walk().betas, atol=1e-6)
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        sequence = load_sequence(path, file.fps, **file.keys)
    kinds = {said.message.kind for said in heard if isinstance(said.message, Doubt)}
    assert kinds == {*file.doubts, *(("frame_rate",) if file.assumed else ())}
    before_camera = [0.0, 0.0, -30.0] if name == "4DHumans" else [0.0, 0.0, 0.0]
    np.testing.assert_allclose(sequence.transl, walk().transl + before_camera, atol=1e-6)
    own, wanted = (Rotation.from_rotvec(poses[:, :22].reshape(-1, 3)) for poses in (sequence.poses, walk().poses))
    assert (own.inv() * wanted).magnitude().max() < 1e-6


@pytest.mark.parametrize("name", REFUSALS)
def test_what_is_not_read_is_answered_in_one_sentence(name: str, tmp_path: Path) -> None:
    refusal = REFUSALS[name]
    path = write(tmp_path / f"m{refusal.suffix}", refusal.make())
    with pytest.raises(ValueError, match=refusal.words) as error:
        read_recording(path, **refusal.keys)
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)
    assert len(str(error.value).removeprefix(str(path))) < 300
