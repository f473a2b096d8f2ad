"""What ``hood train`` makes of data.* and of the keys that are about time, size and machine."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from reference_oracle import make_state
from torch import Tensor

from hood.app.notices import collected
from hood.app.settings.compose import ConfigError, load_config
from hood.app.train import make_trainer
from hood.assets.material import Material
from hood.assets.motion.motion_files import MotionFiles
from hood.cli.main import main
from hood.energies.mass_points import Gravity
from hood.energies.problem import StepProblem
from hood.steppers.checkpoint import read_header
from hood.steppers.published import import_reference_weights
from hood.training.trainer import Trainer

SMALL = ["model.latent_dim=8", "data.garments=[tank]"]


def trainer(*overrides: str) -> Trainer:
    return make_trainer(load_config("train", [*SMALL, *overrides]))


def write(path: Path, num_frames: int) -> str:
    poses, transl = np.zeros((num_frames, 156)), np.zeros((num_frames, 3))
    np.savez(path, poses=poses, trans=transl, mocap_framerate=30.0)
    return str(path)


def test_the_embedded_split_is_the_default() -> None:
    sequences = trainer().slots.sampler.sequences
    assert isinstance(sequences, MotionFiles)
    assert len(sequences) == 22
    assert "walk_proud" not in sequences.names


def test_globs_and_splits_on_the_command_line(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write(tmp_path / f"{name}_poses.npz", 100)
    assert trainer(f"data.sequences=[{tmp_path}/**/*_poses.npz]").slots.sampler.sequences[1].name == "b_poses"
    (tmp_path / "split.json").write_text(json.dumps({"train": ["b_poses.npz"], "validation": ["a_poses.npz"]}))
    split = f"[{tmp_path}/split.json]"
    both = trainer(f"data.sequences={split}", f"data.validation_sequences={split}", "trainer.validate_every=1")
    assert [s.name for s in both.slots.sampler.sequences] == ["b_poses"]
    assert both.watch is not None
    assert [s.name for s in both.watch.validation.motions] == ["a_poses"]


def test_motions_shorter_than_a_rollout(tmp_path: Path) -> None:
    entries = f"data.sequences=[{write(tmp_path / 'short.npz', 40)},{write(tmp_path / 'long.npz', 80)}]"
    with pytest.raises(ValueError, match=r"short\.npz: 40 frames at 30 fps, at least 63.*data\.unusable=skip"):
        trainer(entries)
    with collected() as said:
        assert [s.name for s in trainer(entries, "data.unusable=skip").slots.sampler.sequences] == ["long"]
    assert "1 of 2 motions skipped, first: " in said[-1]
    with pytest.raises(ConfigError, match="did you mean 'skip'"):
        trainer(entries, "data.unusable=skipp")


def test_time_scale_reaches_the_trainer() -> None:
    settings = trainer("trainer=paper", "trainer.time_scale=0.02").settings
    assert (settings.iterations, settings.horizon.every, settings.collision.end_iteration) == (3000, 100, 3000)


def test_a_weight_of_contact_is_given_to_the_ramp(tmp_path: Path) -> None:
    """Refused before a file is read; validation is judged by the potential to which the ramp leads."""
    for key in ("losses.terms.collision.weight=1e6", "losses.terms.friction.weight=1e6"):
        with pytest.raises(ValueError, match=r"weight=1000000: .* give trainer\.collision\.end=1000000"):
            trainer(key, "data.garments=[nowhere.obj]")
    made = trainer("trainer=paper", "trainer.collision.end=1e6", "trainer.validate_every=10")
    assert made.watch is not None
    terms = made.watch.validation.potential.terms
    assert (terms["collision"].weight, terms["friction"].weight) == (1e6, 1e6)
    assert made.simulator.trained_for.potential["collision"]["weight"] == 1e6


def test_contact_without_weight_trains() -> None:
    report = trainer("trainer.collision.start=0", "trainer.collision.end=0", "trainer.workers=0").update()
    assert report["collision"] == 0.0


def test_a_training_without_an_update_ends_with_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [
        *SMALL, "model.schedule='1x(mesh)'", "model.features=paper", "trainer.iterations=2", "trainer.statistics_iterations=1",
        "trainer.batch_size=1", "trainer.workers=0",
    ]  # fmt: skip
    energies, broken = Gravity.__call__, [1, 2]

    def fail(term: Gravity, problem: StepProblem, pos: Tensor, acc: Tensor) -> Tensor:
        count[0] += 1
        return energies(term, problem, pos, acc) * (math.nan if count[0] in broken else 1.0)

    monkeypatch.setattr(Gravity, "__call__", fail)
    for output, wrong, code, said in (
        (
            "none",
            (1, 2),
            2,
            "hood: error: nothing was trained: 1 of 1 updates were skipped (iteration 2: energy gravity is nan)",
        ),
        ("some", (2,), 0, "hood: 1 of 2 updates were skipped, the last one (iteration 2: energy gravity is nan)"),
    ):
        broken[:], count = wrong, [0]
        more = ["trainer.iterations=3"] if code == 0 else []
        assert main(["train", *words, *more, f"output={tmp_path / output}"]) == code
        heard = capsys.readouterr()
        assert said in heard.err
        assert ("weights in" in heard.out) == (code == 0)


def test_one_fabric_for_every_scene() -> None:
    sampler = trainer("data.sampling.material={density: 0.3, lame_mu: 2e4}").slots.sampler
    assert sampler.material == Material(density=0.3, lame_mu=2e4)
    assert trainer().slots.sampler.material is None
    with pytest.raises(ConfigError, match="densty"):
        trainer("data.sampling.material={densty: 0.3}")
    with pytest.raises(ValueError, match=r"material 'density' is -1\.0; it must be finite and > 0"):
        trainer("data.sampling.material={density: -1.0}")


def test_buckets_by_size() -> None:
    slots = trainer("data.garments=[tank,dress,dress_4k]", "trainer.batch_size=1", "trainer.max_vertices=4500").slots
    assert [(bucket.templates, bucket.count) for bucket in slots.buckets] == [((0, 1), 4), ((2,), 1)]


def test_training_from_given_weights(tmp_path: Path) -> None:
    model = ["model=small", "model.features=paper", "model.output=acceleration", "model.latent_dim=8"]
    first = trainer(*model, f"output={tmp_path}/first", "trainer.iterations=3", "trainer.statistics_iterations=2", "seed=1")
    first.run()
    given = f"weights={tmp_path}/first/model.safetensors"
    second = trainer(*model, given, f"output={tmp_path}/second", "seed=2")
    expected, fresh = first.averaged().state_dict(), trainer(*model, "seed=2").simulator.state_dict()
    for name, value in second.simulator.state_dict().items():
        assert value.equal(expected[name]), name
    assert any(not value.equal(expected[name]) for name, value in fresh.items())
    assert all(value.equal(expected[name]) for name, value in second._steps.average.items())
    second.folder.mkdir()
    second.save()  # says how long the weights have been trained in all
    assert read_header(tmp_path / "second" / "model.safetensors")["iteration"] == "3"
    # The statistics are those of the weights: the first update learns.
    assert "parameter_gradient_norm" in second.update()
    assert "parameter_gradient_norm" not in trainer(*model).update()


def test_given_weights_go_on_with_whitening(tmp_path: Path) -> None:
    """What encoders see is counted first; that statistics come along is no reason to refuse."""
    model, short = ["experiment=paper_fast"], ["trainer.iterations=3", "trainer.statistics_iterations=2"]
    trainer(*model, *short, f"output={tmp_path}/first").run()
    given = f"weights={tmp_path}/first/model.safetensors"
    second = trainer(*model, *short, given, f"output={tmp_path}/second")
    scale = {name: value.clone() for name, value in second.simulator.output.named_buffers()}
    assert ["parameter_gradient_norm" in second.update() for _ in range(3)] == [False, False, True]
    assert set(second.whitening.state_dict()["bases"]) == {"mesh", "coarse0", "coarse1", "body"}
    assert scale
    assert all(value.equal(scale[name]) for name, value in second.simulator.output.named_buffers())  # it came with the weights


def test_given_weights_may_go_on_with_other_levels() -> None:
    begun = trainer("model=edges", "model.schedule=ours", "model.latent_dim=48", "model.coarse_edge=0.04", "weights=edges")
    assert begun.simulator.config["coarse_edge"] == 0.04


def test_published_weights_go_on_as_they_were_trained(tmp_path: Path) -> None:
    """Their statistics come along and stay: how new ones would be averaged is no part of the model."""
    weights = tmp_path / "postcvpr.pth"
    state = make_state("postcvpr", 8)
    torch.save(state, weights)
    begun = trainer("experiment=released", f"weights={weights}", f"output={tmp_path}/run")
    held = import_reference_weights(state)[0].state_dict()
    assert all(value.equal(held[name]) for name, value in begun.simulator.state_dict().items())
    assert "parameter_gradient_norm" in begun.update()
    assert all(value.equal(held[name]) for name, value in begun.simulator.named_buffers() if name in held)


def test_weights_of_another_model_are_refused(tmp_path: Path) -> None:
    with pytest.raises(
        ConfigError,
        match=r"small-ours\.safetensors: holds a model of .*features=local.*schedule=ours.*not the model asked for.*"
        "weights=small-ours",
    ):
        trainer("model=small", "weights=small-ours")
    with pytest.raises(FileNotFoundError, match="did you mean 'quickstart'"):
        trainer("weights=quickstrat")
