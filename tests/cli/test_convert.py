"""``hood convert``, and published weights in ``hood rollout``."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from reference_oracle import make_state
from safetensors import safe_open

from hood.cli.main import main
from hood.rollouts.file.reader import read_rollout
from hood.steppers.checkpoint import load_simulator, read_header


@pytest.fixture
def weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HOOD_TRACEBACK", raising=False)
    torch.save({"training_module": make_state("postcvpr", 4)}, "postcvpr.pth")
    return tmp_path / "postcvpr.pth"


def test_published_and_converted_weights_give_the_same_rollout(weights: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["convert", "checkpoint=postcvpr.pth", "output=new/model.safetensors"]) == 0
    text = capsys.readouterr().out
    assert "postcvpr weights, 15 steps" in text
    with safe_open(weights.parent / "new" / "model.safetensors", "pt") as file:
        header = file.metadata()
        count = sum(file.get_tensor(name).numel() for name in file.keys() if "normalizer" not in name)
    assert f"{count} parameters" in text
    assert header["layout"] == "postcvpr"
    assert json.loads(header["model"])["velocity"] == "carried"
    # Random weights: what they do is not sound.
    arguments = ["garment=skirt", "num_frames=3", "video=none", "sheet=false", "fail_on=nothing"]
    runs = []
    for checkpoint in ("postcvpr.pth", "new/model.safetensors"):
        assert main(["rollout", f"checkpoint={checkpoint}", *arguments, "output=run"]) == 0
        runs.append(read_rollout(weights.parent / "run" / "rollout.h5").cloth_pos)
    np.testing.assert_array_equal(*runs)
    assert np.isfinite(runs[0]).all()


def test_the_output_defaults_to_the_checkpoints_name(weights: Path) -> None:
    assert main(["convert", "checkpoint=postcvpr.pth"]) == 0
    assert sorted(path.name for path in weights.parent.iterdir()) == ["postcvpr.pth", "postcvpr.safetensors"]


def test_half_the_size(weights: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """From published weights and from a model file; what the file says about itself stays."""
    assert main(["convert", "checkpoint=postcvpr.pth"]) == 0
    assert main(["convert", "checkpoint=postcvpr.pth", "half=true", "output=a.safetensors"]) == 0
    assert main(["convert", "checkpoint=postcvpr.safetensors", "half=true", "output=b.safetensors"]) == 0
    changes = [float(line.rsplit(" ", 1)[1]) for line in capsys.readouterr().out.splitlines() if "float16" in line]
    assert changes[0] == changes[1]
    assert 1e-5 < changes[0] < 2**-11
    files = [weights.parent / name for name in ("postcvpr.safetensors", "a.safetensors", "b.safetensors")]
    plain, first, second = ([*load_simulator(path).state_dict().items()] for path in files)
    headers = [read_header(path) for path in files]
    assert headers[0] == headers[1] == headers[2]
    for (name, value), (_, half), (_, copy) in zip(plain, first, second, strict=True):
        assert torch.equal(half, copy), name
        if "normalizer" in name:
            assert torch.equal(half, value), name  # counts are beyond float16
        else:
            torch.testing.assert_close(half, value, rtol=2**-11, atol=1e-7)
    assert files[1].stat().st_size == files[2].stat().st_size < files[0].stat().st_size


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["convert"], ("checkpoint is not given",)),
        (["convert", "checkpoint=quickstart"], ("is a model file already", "half=true")),
        (["convert", "checkpoint=quickstart", "half=true"], ("output is not given", "output=small.safetensors")),
        (["convert", "checkpoint=none.pth"], ("none.pth", "no such file")),
        (["convert", "checkpoint=postcvpr.pth", "output=m.pt"], ("output=m.pt", ".safetensors")),
        (["convert", "chekpoint=postcvpr.pth"], ("'chekpoint'", "'checkpoint'")),
        (["convert", "checkpoint=text.pth"], ("text.pth", "not a readable torch file")),
        (["rollout", "checkpoint=postcvpr.pth", "fps=60"], ("fps=60", "use fps=30")),
        (["rollout", "checkpoint=text.pth"], ("text.pth", "not a readable torch file")),
        (["evaluate", "models=[text.pth]"], ("text.pth", "not a readable torch file")),
    ],
)
def test_user_errors_are_one_line_and_leave_nothing(
    arguments: list[str], words: tuple[str, ...], weights: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (weights.parent / "text.pth").write_text("hello")
    before = sorted(path.name for path in weights.parent.rglob("*"))
    assert main(arguments) == 2
    message = capsys.readouterr().err
    assert message.startswith("hood: error: ")
    assert message.count("\n") == 1
    assert all(word in message for word in words), message
    assert sorted(path.name for path in weights.parent.rglob("*")) == before


def test_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["convert", "--help"]) == 0
    text = capsys.readouterr().out
    assert all(word in text for word in ("checkpoint=null", "output=null", "hood convert checkpoint="))
    assert "config groups" not in text
