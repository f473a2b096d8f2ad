"""Point caches that grow while a rollout runs: whole frames at any moment, and in the end the bytes of ``hood export``."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import pytest

from hood.app.output.export import StreamedCaches
from hood.app.rollout import rollout
from hood.cli.main import main
from hood.rollouts.file.recorder import RolloutWriter

FRAMES = 5
FACES = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
SHORT = ("garment=skirt", "sequence=plie", "stepper=refine", "refine=1", "metrics=none", "video=none", "sheet=false")


def _samples(path: Path) -> int:
    """Frames that the head counts; all of them are in the file."""
    content = path.read_bytes()
    points, count = struct.unpack_from("<i", content, 16)[0], struct.unpack_from("<i", content, 28)[0]
    assert len(content) == 32 + 12 * points * count
    return int(count)


def _same_as_exported(folder: Path) -> bool:
    """Whether the caches are what ``hood export`` makes of the rollout beside them."""
    exported = folder / "exported"
    assert main(["export", str(folder / "rollout.h5"), "format=pc2", f"output={exported}"]) == 0
    files = {path.name: path.read_bytes() for path in exported.iterdir()}
    return bool(files) and files == {path.name: path.read_bytes() for path in (folder / "rollout_pc2").iterdir()}


@pytest.mark.parametrize(
    ("away", "farthest"),
    [([0.0] * FRAMES, 0.0), ([0.0, 0.0, 40.0, 41.0, 0.0], 0.0), ([200.0] * FRAMES, 200.0)],
    ids=["near", "walks away", "far"],
)
def test_every_frame_is_there_when_it_is_counted(tmp_path: Path, away: list[float], farthest: float) -> None:
    random = np.random.default_rng(5)
    cloth = random.normal(size=(FRAMES, 8, 3)) + np.array(away)[:, None, None]
    body = random.normal(size=(FRAMES, 4, 3)) + np.array(away)[:, None, None]
    attributes, still = {"garment": "top+skirt"}, {"piece": np.repeat([0, 1], 4)}
    caches = StreamedCaches(tmp_path / "rollout.h5", ["pc2"], {})
    with RolloutWriter(
        tmp_path / "rollout.h5", FRAMES, cloth[0], FACES, FACES[:2], 4, ("rg",), 0.1, attributes, farthest, still=still
    ) as writer:
        for frame in range(FRAMES):
            writer.append(cloth[frame], body[frame], {"rg": 0.0})
            caches.append(cloth[frame], body[frame])
            assert {path.name: _samples(path) for path in (tmp_path / "rollout_pc2").glob("*.pc2")} == dict.fromkeys(
                ("top.pc2", "skirt.pc2", "body.pc2"), frame + 1
            )
    caches.close()
    assert _same_as_exported(tmp_path)


def test_a_frame_that_is_not_finite_ends_them(tmp_path: Path) -> None:
    cloth, body = np.zeros((FRAMES, 8, 3)), np.zeros((4, 3))
    cloth[2, 5] = np.nan
    caches = StreamedCaches(tmp_path / "rollout.h5", ["pc2"], {})
    with RolloutWriter(tmp_path / "rollout.h5", FRAMES, cloth[0], FACES, FACES[:2], 4, ("rg",), 0.1, {}) as writer:
        for pos in cloth:
            writer.append(pos, body, {"rg": 0.0})
            caches.append(pos, body)
    caches.close()
    assert {_samples(path) for path in (tmp_path / "rollout_pc2").glob("*.pc2")} == {2}


@pytest.mark.parametrize(
    "words", [[], ["output_fps=15"], ["refine_mesh=1"], ["formats=[pc2,cloth+body]"]], ids=["plain", "fps", "finer", "steps"]
)
def test_a_rollout_writes_them_frame_by_frame(tmp_path: Path, words: list[str]) -> None:
    seen: list[int] = []

    def bar(frames: Iterable[object], total: int, what: str) -> Iterator[object]:
        for frame in frames:
            yield frame
            found = [_samples(path) for path in (tmp_path / "rollout_pc2").glob("*.pc2")]
            seen.append(max(found, default=0))
            assert len(set(found)) <= 1

    rollout([*SHORT, "num_frames=4", "formats=[pc2]", *words, f"output={tmp_path}"], bar)
    assert sorted(seen) == seen
    assert seen[0] == 1  # the first frame before the second is simulated
    assert seen[2] >= 2
    assert _same_as_exported(tmp_path)
