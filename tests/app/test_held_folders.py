"""A run into a folder that another one is writing to is refused, and changes nothing there."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from hood.assets.files.atomic import is_occupied, occupy
from hood.cli.main import main
from hood.rollouts.file.recorder import RolloutWriter
from hood.testing import cylinder, sphere

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="folders are not locked there")

COMMANDS = {
    "train": ["train", "model=small", "data.garments=[tank]", "model.latent_dim=8", "trainer.iterations=1"],
    "evaluate": ["evaluate", "models=[guess]", "garments=[tank]", "num_frames=5", "gap_states=0"],
    "tradeoff": ["tradeoff", "models=[]", "models_4k=[]", "models_12k=[]", "guess_4k=[]", "guess_12k=[]"],
    "envelope": ["envelope", "models=[newton]", "factors=[input]"],
    "compare": ["compare", "a.h5", "b.h5", "video=none"],
}


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (pos, faces), (ball, ball_faces) = cylinder(12, 3, 0.3, 0.5), sphere(1, 0.25)
    for name in ("a.h5", "b.h5"):
        with RolloutWriter(Path(name), 1, pos, faces, ball_faces, len(ball), (), 1 / 30, {"garment": "tube"}) as file:
            file.append(pos, ball, {}, {})


@pytest.mark.parametrize("command", COMMANDS.values(), ids=COMMANDS.keys())
def test_the_second_run_is_refused(command: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "run").mkdir()
    with occupy(tmp_path / "run"):
        assert main([*command, "output=run"]) == 2
    sentence = "hood: error: run: another run is writing there; wait for its end or choose another output\n"
    assert capsys.readouterr().err.endswith(sentence)
    assert list((tmp_path / "run").iterdir()) == []
    assert not is_occupied(tmp_path / "run")
