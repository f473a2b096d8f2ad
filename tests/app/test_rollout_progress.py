"""``resume=true`` on a rollout that was stopped: the frames, metrics and summary of one that nobody disturbed."""

from __future__ import annotations

import errno
import json
import shutil
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import h5py
import pytest

from hood.app import progress
from hood.app.output.export import StreamedCaches
from hood.app.rollout import rollout

SKIRT = ("garment=skirt", "sequence=walk_proud", "video=none", "sheet=false", "num_frames=5")
NEWTON = (*SKIRT, "stepper=newton", "formats=[pc2]")
HELD = "events=[{frame: 1, detach: waistband}, {frame: 3, attach: waistband}]"
AIR = ("wind=[0,0,3]", "losses.terms.air.gusts=0.3", "size_end={size:1.1,seconds:0.1}", "pins=[0,1,2]")
NETWORK = ("stepper=network", "checkpoint=quickstart", "refine=5%", "guard=repair")


@pytest.fixture(autouse=True)
def _every_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "_APART", 0.0)


def _at(frame: int, act: Callable[[], None]) -> Any:
    """A bar that does something when so many frames are whole."""

    def bar(frames: Iterable[Any], total: int, what: str) -> Iterator[Any]:
        for place, one in enumerate(frames):
            if place == frame:
                act()
            yield one

    return bar


def _interrupt() -> None:
    raise KeyboardInterrupt


def _tables(path: Path) -> dict[str, bytes]:
    """Everything in the file but times."""
    found: dict[str, bytes] = {}
    with h5py.File(path, "r") as file:
        file.visititems(lambda name, item: found.update({name: item[()].tobytes()} if hasattr(item, "shape") else {}))
        found |= {name: str(value).encode() for name, value in file.attrs.items() if name not in ("config", "asked")}
    return {name: value for name, value in found.items() if "ms_" not in name and "seconds" not in name}


def _summary(folder: Path) -> Any:
    def timeless(value: Any) -> Any:
        if not isinstance(value, dict):
            return value
        return {key: timeless(one) for key, one in value.items() if "ms_" not in key and "seconds" not in key}

    return timeless(json.loads((folder / "summary.json").read_text()))


def _same(one: Path, other: Path) -> None:
    assert _tables(one / "rollout.h5") == _tables(other / "rollout.h5")
    assert _summary(one) == _summary(other)
    assert sorted(path.name for path in one.iterdir()) == sorted(path.name for path in other.iterdir())
    for path in (one / "rollout_pc2").glob("*"):
        assert path.read_bytes() == (other / "rollout_pc2" / path.name).read_bytes()


@pytest.mark.parametrize(
    "words",
    [[*NEWTON, HELD], [*NEWTON, *AIR], [*SKIRT, *NETWORK], [*SKIRT, *NETWORK, "num_frames=7", "output_fps=20"]],
    ids=["events", "wind and size", "network", "between frames"],
)
def test_a_killed_rollout_comes_to_the_same(tmp_path: Path, words: list[str]) -> None:
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    # What is on the disk at a moment is what a kill leaves then.
    rollout([*words, f"output={whole}"], _at(3, lambda: shutil.copytree(whole, killed) and None))
    made = rollout([*words, f"output={killed}", "resume=true"])
    assert any(f"resume=true: {killed} goes on after frame " in note for note in made.notes)
    _same(whole, killed)


SHEET = "v 0 1 {z}\nv 0.2 1 {z}\nv 0.2 1.2 {z}\nv 0 1.2 {z}\nf 1 2 3\nf 1 3 4\n"


def _sheet(folder: Path, *words: str) -> list[str]:
    """A square that falls."""
    (folder / "sheet.obj").write_text(SHEET.format(z=0.5))
    scene = [f"garment={folder / 'sheet.obj'}", "body=none", "sequence=plie", "stepper=newton", "num_frames=5"]
    return [*scene, "video=none", "sheet=false", "formats=[pc2]", *words]


def test_ctrl_c_says_how_to_go_on_and_a_longer_one_does(tmp_path: Path) -> None:
    words = _sheet(tmp_path, f"output={tmp_path / 'out'}")
    made = rollout([*words, "num_frames=4"], _at(2, _interrupt))
    assert made.interrupted
    there = tmp_path / "out" / "rollout.h5"
    assert made.notes[-1].endswith(f"the 2 frames done are kept in {there}; the same command with resume=true goes on")
    longer = rollout([*words, "resume=true"])
    assert any("goes on after frame 1" in note for note in longer.notes)
    rollout(_sheet(tmp_path, f"output={tmp_path / 'whole'}"))
    _same(tmp_path / "whole", tmp_path / "out")
    assert not (tmp_path / "out" / "rollout.state").exists()


def test_a_full_disk_leaves_whole_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out, seen = tmp_path / "out", list[int]()
    words = _sheet(tmp_path, f"output={out}")
    append = StreamedCaches.append

    def full(self: StreamedCaches, *given: Any) -> None:
        seen.append(0)
        if len(seen) == 3:
            raise OSError(errno.ENOSPC, "No space left on device", str(out / "rollout_pc2" / "sheet.pc2"))
        append(self, *given)

    monkeypatch.setattr(StreamedCaches, "append", full)
    with pytest.raises(OSError, match=r"No space left on device: .*sheet\.pc2"):
        rollout(words)
    made = rollout([*words, "resume=true"])
    assert any("goes on after frame 1" in note for note in made.notes)
    assert made.summary["num_frames"] == 5


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("setting", "gravity is 9.81 there, 5 in this command"),
        ("garment", "the garment or its fabric is not what it was then"),
        ("shorter", "num_frames is 5 there, 2 in this command"),
        ("damaged", "its rollout.state is damaged"),
        ("gone", "no rollout.state there says where it was stopped"),
    ],
)
def test_what_cannot_go_on_says_why(tmp_path: Path, change: str, said: str) -> None:
    out = tmp_path / "out"
    words = _sheet(tmp_path, "metrics=none", f"output={out}")
    assert rollout(words, _at(2, _interrupt)).interrupted
    state = out / "rollout.state"
    if change == "garment":
        (tmp_path / "sheet.obj").write_text(SHEET.format(z=0.6))
    elif change == "damaged":
        state.write_bytes(state.read_bytes()[:200])
    elif change == "gone":
        state.unlink()
    more = {"setting": ["gravity=5"], "shorter": ["num_frames=2"]}.get(change, [])
    made = rollout([*words, *more, "resume=true"])
    assert f"resume=true: the rollout in {out} is made again ({said})" in made.notes
    assert made.summary["num_frames"] == (2 if change == "shorter" else 5)
