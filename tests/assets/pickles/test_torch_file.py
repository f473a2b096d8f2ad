"""Torch files: tensors come out as torch itself reads them, configurations stay closed, nothing is run."""

from __future__ import annotations

import os
import zipfile
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

from hood.assets.pickles.content import load_torch
from hood.assets.pickles.records import load_pickle

FORMATS = {"zip": True, "stream": False}


def checkpoint() -> dict:
    """What a training run saves: weights, a configuration, the state of an optimiser and of a schedule."""
    torch.manual_seed(0)
    model = torch.nn.Linear(3, 4)
    optimizer = torch.optim.Adam(model.parameters())
    model(torch.ones(1, 3)).sum().backward()
    optimizer.step()
    base = torch.arange(12.0).reshape(3, 4)
    return {
        "training_module": model.state_dict(),
        "config": OmegaConf.create({"a": [1, {"b": "${c}"}], "c": 3}),
        "optimizer": optimizer.state_dict(),
        "scheduler": torch.optim.lr_scheduler.MultiStepLR(optimizer, [3, 4]).state_dict(),
        "half": torch.arange(5).half(),
        "bfloat": torch.arange(4).bfloat16(),
        "int": torch.tensor([[1, -2]]),
        "flags": torch.tensor([True, False]),
        "turned": base.t(),
        "part": base[1:, 2],
        "scalar": torch.tensor(2.5, dtype=torch.float64),
        "empty": torch.zeros(0, 3),
        "parameter": torch.nn.Parameter(torch.ones(2)),
        "shape": torch.Size([2, 3]),
        "dtype": torch.float32,
    }


def save(content: object, path: Path, kind: str) -> Path:
    torch.save(content, path, _use_new_zipfile_serialization=FORMATS[kind])
    return path


@pytest.mark.parametrize("kind", FORMATS)
def test_tensors_come_out_as_they_went_in(kind: str, tmp_path: Path) -> None:
    content = checkpoint()
    found = load_torch(save(content, tmp_path / "c.pth", kind))
    for name, value in content.items():
        if isinstance(value, torch.Tensor):
            assert torch.equal(found[name], value), name
            assert found[name].dtype == value.dtype
    assert found["training_module"].keys() == content["training_module"].keys()
    for name, value in content["training_module"].items():
        assert torch.equal(found["training_module"][name], value)
    assert torch.equal(found["optimizer"]["state"][0]["exp_avg"], content["optimizer"]["state"][0]["exp_avg"])
    assert found["scheduler"]["milestones"] == {3: 1, 4: 1}
    assert found["shape"] == (2, 3)
    assert found["dtype"] == torch.float32
    assert repr(found["config"]) == "<omegaconf.dictconfig.DictConfig>"


class Call:
    def __init__(self, command: str) -> None:
        self.command = command

    def __reduce__(self) -> tuple:
        return os.system, (self.command,)


@pytest.mark.parametrize("kind", FORMATS)
def test_calls_are_refused_by_name_and_not_made(kind: str, tmp_path: Path) -> None:
    path = save({"training_module": {"a": torch.zeros(2)}, "config": Call(f"touch {tmp_path}/ran")}, tmp_path / "e.pth", kind)
    with pytest.raises(ValueError, match=rf"e\.pth: names {os.system.__module__}\.system"):
        load_torch(path)
    assert not (tmp_path / "ran").exists()


def test_configurations_are_closed_in_plain_pickles(tmp_path: Path) -> None:
    import pickle

    (tmp_path / "c.pkl").write_bytes(pickle.dumps(OmegaConf.create({"a": 1})))
    with pytest.raises(ValueError, match=r"names omegaconf\."):
        load_pickle(tmp_path / "c.pkl")


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_cut_files_are_one_sentence(kind: str, share: float, tmp_path: Path) -> None:
    content = save({"a": torch.zeros(1000)}, tmp_path / "c.pth", kind).read_bytes()
    (tmp_path / "c.pth").write_bytes(content[: int(share * len(content))])
    with pytest.raises(ValueError, match=r"c\.pth: ") as error:
        load_torch(tmp_path / "c.pth")
    assert "\n" not in str(error.value)


@pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")
def test_programs_other_archives_and_large_files_are_refused(tmp_path: Path) -> None:
    torch.jit.save(torch.jit.script(torch.nn.Linear(2, 2)), tmp_path / "script.pth")
    with zipfile.ZipFile(tmp_path / "other.pth", "w") as archive:
        archive.writestr("readme.txt", "hello")
    for name in ("script.pth", "other.pth"):
        with pytest.raises(ValueError, match="zip archive without a state dict"):
            load_torch(tmp_path / name)
    with zipfile.ZipFile(tmp_path / "bomb.pth", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a/data.pkl", bytes(10**6))
    with pytest.raises(ValueError, match="unpacks to 1000000 bytes"):
        load_torch(tmp_path / "bomb.pth", size_limit=10**5)
    save(torch.zeros(1000), tmp_path / "large.pth", "zip")
    with pytest.raises(ValueError, match="the limit is 1000"):
        load_torch(tmp_path / "large.pth", size_limit=1000)
