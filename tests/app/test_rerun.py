"""A folder holds one rollout: what an earlier one has left there is gone, and times are those of steps."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from hood.app.output.export import remove_earlier
from hood.cli.main import main

BASE = ["rollout", "sequence=plie", "stepper=newton", "metrics=none", "guard=off", "settle=paper"]


def test_files_of_an_earlier_rollout_are_removed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "out"
    assert main([*BASE, "garment=dress", "num_frames=2", "formats=[glb,obj]", f"output={folder}"]) == 0
    first = {path.name for path in folder.iterdir()}
    assert {"rollout.mp4", "contact_sheet.png", "rollout.glb", "rollout_obj"} <= first
    (folder / "notes.txt").write_text("mine")
    (folder / "plan.json").write_text("{}")
    capsys.readouterr()
    assert main([*BASE, "garment=tank", "num_frames=3", "video=none", "sheet=false", f"output={folder}"]) == 0
    left = {path.name for path in folder.iterdir()}
    assert left == {"notes.txt", "config.yaml", "rollout.h5", "summary.json", "versions.json"}
    assert "rollout.mp4" not in capsys.readouterr().out


def test_an_input_in_the_folder_stays(tmp_path: Path) -> None:
    image, film = tmp_path / "rollout_cloth_texture.png", tmp_path / "rollout.gif"
    for path in (image, film):
        path.write_bytes(b"mine")
    remove_earlier(tmp_path, OmegaConf.create({"texture": {"cloth": str(image)}, "garment": ["tank"]}))
    assert image.exists()
    assert not film.exists()


def test_of_a_link_the_link_goes(tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.mkdir()
    (other / "frame.obj").write_text("mine")
    (tmp_path / "rollout_obj").symlink_to(other)
    remove_earlier(tmp_path, OmegaConf.create({}))
    assert not (tmp_path / "rollout_obj").exists()
    assert (other / "frame.obj").exists()


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_times_are_those_of_the_steps_there_are(frames: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*BASE, "garment=tank", f"num_frames={frames}", "video=none", "sheet=false", f"output={tmp_path}"]) == 0
    said = capsys.readouterr().out
    assert ("ms per frame (median):" in said) == (frames > 1)
    assert "solver 0.0" not in said
    total = json.loads((tmp_path / "summary.json").read_text())["ms_per_frame"]["total"]["median"]
    assert (total is None) if frames == 1 else total > 0
