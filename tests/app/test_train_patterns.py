"""``hood train data.patterns=FOLDER``: a folder of sewn garments as the source of the garments."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from hood.app.settings.compose import load_config
from hood.app.train import make_trainer
from hood.assets.garment.garment import load_garment, save_garment
from hood.cli.main import main
from hood.mesh.flat import edge_lengths
from hood.training.trainer import Trainer

SMALL = [
    "model.latent_dim=4", "model.schedule='1x(mesh)'", "data.sequences=[walk_proud]", "trainer.batch_size=2",
    "trainer.workers=0", "trainer.kernels=torch", "trainer.log_every=1",
]  # fmt: skip


def trainer(*overrides: str) -> Trainer:
    return make_trainer(load_config("train", [*SMALL, *overrides]))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two garments of the folder and one below it, and a picture beside them."""
    (tmp_path / "sewn" / "b").mkdir(parents=True)
    for name, source in (("c", "shorts"), ("b/x", "tank"), ("a", "skirt")):
        save_garment(tmp_path / "sewn" / f"{name}.npz", load_garment(source))
    (tmp_path / "sewn" / "a.png").write_bytes(b"")
    return tmp_path / "sewn"


def test_its_garments_are_sorted_behind_the_others(folder: Path) -> None:
    beside = trainer("data.garments=[dress]", f"data.patterns={folder}", "trainer.validate_every=1")
    assert [garment.name for garment in beside.slots.sampler.garments] == ["dress", "a", "x", "c"]
    assert beside.watch is not None
    assert [garment.name for garment in beside.watch.validation.garments] == ["dress"]
    alone = trainer("data.garments=[]", f"data.patterns={folder}", "trainer.validate_every=1")
    assert [garment.name for garment in alone.slots.sampler.garments] == ["a", "x", "c"]
    assert alone.watch is not None
    assert len(alone.watch.validation.garments) == 3


def test_what_is_sewn_trains_with_the_lengths_of_its_pattern(tmp_path: Path) -> None:
    save_garment(tmp_path / "circle.npz", load_garment("circle"))
    made = trainer(
        "data.garments=[]", f"data.patterns={tmp_path}", "data.sampling.beta_range=0", "data.sampling.size_range=[1,1]"
    )
    cloth = made.slots.sampler.sample(np.random.default_rng(0), 3).scene.cloth
    flat = load_garment("circle").flat
    assert flat is not None
    corners = torch.as_tensor(flat[:, 1:] - flat[:, :1], dtype=torch.float64)
    lengths = edge_lengths(corners, cloth.faces, cloth.edges)
    off = (cloth.rest_length.double() / lengths - 1.0).abs()
    assert off.median() < 1e-3, "the elastic of the waist is shorter, the rest as it was cut"
    assert np.isfinite(list(made.update().values())).all()


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda folder: [path.unlink() for path in folder.rglob("*.npz")], r"sewn: no garments .*hood sew design:tshirt"),
        (lambda folder: folder.rename(folder.with_name("gone")), r"data\.patterns=.*sewn: no such folder"),
        (lambda folder: np.savez(folder / "walk.npz", poses=np.zeros((9, 156))), r"sewn/walk\.npz: .*rest_pos"),
        (
            lambda folder: (folder / "b" / "specification.json").touch(),
            r"b/specification\.json: not sewn yet; .*b\.npz sews",
        ),
        (lambda folder: (folder / "d_specification.json").touch(), r"not sewn yet; hood sew .*/d_specification\.npz sews it"),
    ],
)
def test_a_folder_that_cannot_be_used(spoil: object, told: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    spoil(folder)  # type: ignore[operator]
    assert main(["train", *SMALL, f"data.patterns={folder}", f"output={folder.parent}/run"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert not (folder.parent / "run").exists()
    with pytest.raises(ValueError, match=told):
        raise ValueError(said)


def test_a_pattern_beside_its_garment_is_sewn(folder: Path) -> None:
    (folder / "b" / "specification.json").touch()
    save_garment(folder / "b.npz", load_garment("tank"))
    assert len(trainer("data.garments=[]", f"data.patterns={folder}").slots.sampler.garments) == 4


def test_a_resumed_run_ends_where_an_uninterrupted_one_does_and_refuses_other_garments(folder: Path) -> None:
    words = ["data.garments=[]", f"data.patterns={folder}", "loggers=[]", "seed=3", "trainer.iterations=4"]
    whole, first = (trainer(*words, f"output={folder.parent / name}") for name in ("whole", "parts"))
    assert whole.run()
    assert not first.run(should_stop=lambda: first.iteration >= 2)
    before = load_garment(folder / "a.npz")
    save_garment(folder / "a.npz", replace(before, rest_pos=before.rest_pos * 1.01))
    with pytest.raises(ValueError, match=r"the first that differs is a \(\w+\) there, a \(\w+\) here; give back the files"):
        trainer(*words, f"output={folder.parent}/parts").resume(first.checkpoint_path)
    save_garment(folder / "a.npz", before)
    second = trainer(*words, f"output={folder.parent}/parts")
    second.resume(first.checkpoint_path)
    assert second.run()
    weights = [(folder.parent / name / "model.safetensors").read_bytes() for name in ("whole", "parts")]
    assert weights[0] == weights[1]
