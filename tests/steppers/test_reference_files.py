"""Checkpoint files in the published layouts: what is accepted, and what is said about the rest."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf
from reference_oracle import LAYOUTS, make_state
from torch import Tensor

import hood
from hood.steppers.network import NetworkStepper, build_simulator
from hood.steppers.published import import_reference_weights, read_reference_checkpoint

WEIGHT = "model._learned_model.node_encoder.0.layers.2.weight"
MESH = "model._learned_model.levels.1.2.edge_processor_dict.coarse_edge1.0.layers.0.bias"


def same(first: NetworkStepper, second: NetworkStepper) -> bool:
    other = second.state_dict()
    equal = all(torch.equal(value, other[name]) for name, value in first.state_dict().items())
    return equal and first.config == second.config


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("zipped", [True, False])
def test_a_training_checkpoint_is_read(layout: str, zipped: bool, tmp_path: Path) -> None:
    state = make_state(layout, 4)
    config = OmegaConf.create({"runner": {layout: {"lr": [1e-4]}}, "again": "${runner}"})
    content = {"training_module": state, "config": config, "optimizer": {"state": {}}, "scheduler": None}
    torch.save(content, tmp_path / "c.pth", _use_new_zipfile_serialization=zipped)
    simulator, name = read_reference_checkpoint(tmp_path / "c.pth")
    assert name == layout
    assert not simulator.training
    assert same(simulator, import_reference_weights(state)[0])
    assert same(simulator, hood.load_reference_checkpoint(str(tmp_path / "c.pth")))


def test_reading_moves_no_generator_and_counts_nothing_later() -> None:
    before = torch.get_rng_state()
    simulator, _ = import_reference_weights(make_state("cvpr", 4))
    assert torch.equal(torch.get_rng_state(), before)
    normalizer = simulator.features.edge_normalizer.train()
    mean, std = normalizer.statistics(torch.float64)
    normalizer(torch.ones(5, 9))
    assert torch.equal(normalizer.statistics(torch.float64)[0], mean)
    assert bool((std > 0.01).all())


def test_other_spellings_of_the_same_tensors() -> None:
    """A bare state dict, keys without or with more prefixes, the processors of one layout written as in another."""
    state = make_state("cvpr", 4)
    expected, _ = import_reference_weights(state)
    short = {key.replace("model._learned_model.", "").replace("model.", ""): value for key, value in state.items()}
    wrapped = {"module." + key: value for key, value in state.items()}
    suffixed = {
        key.replace("edge_processor_dict.mesh_edge", "mesh_edge_processor").replace(
            "node_processor_dict.node", "node_processor"
        ): value
        for key, value in state.items()
    }
    columns = {key: value.reshape(1) if value.ndim == 0 else value for key, value in state.items()}
    floors = {key.replace("acc_sum_squared", "std_epsilon"): torch.tensor(1e-8) for key in state if "acc_sum_squared" in key}
    for other in (short, wrapped, suffixed, columns, state | floors):
        assert same(import_reference_weights(other)[0], expected)


def test_single_level_models_of_any_depth() -> None:
    deeper = [f"processor_steps.{step}." for step in range(9, 15)]
    state = {key: value for key, value in make_state("fine15", 4).items() if not any(part in key for part in deeper)}
    simulator, name = import_reference_weights(state)
    assert name == "fine9"
    assert len(simulator.schedule) == 9


def renamed(state: dict[str, Tensor], key: str, new: str) -> dict[str, Tensor]:
    return {new if name == key else name: value for name, value in state.items()}


@pytest.mark.parametrize(
    "key, new, words",
    [
        (WEIGHT, WEIGHT.replace("node_encoder", "node_encodr"), ("node_encodr.0.layers.2.weight' does not fit", WEIGHT)),
        (MESH, MESH.replace("coarse_edge1", "coarse_edgy1"), ("coarse_edgy1.0.layers.0.bias' does not fit", MESH)),
        ("model._output_normalizer._acc_sum", "model._output_normaliser._acc_sum", ("_output_normaliser._acc_sum", "nearest")),
        ("model.nodetype_embedding.weight", "model.nodetype_embeding.weight", ("model.nodetype_embedding.weight",)),
    ],
)
def test_a_misspelt_key_is_named_with_the_nearest_one(key: str, new: str, words: tuple[str, ...], tmp_path: Path) -> None:
    torch.save({"training_module": renamed(make_state("postcvpr", 4), key, new)}, tmp_path / "c.pth")
    with pytest.raises(ValueError, match=r"c\.pth: key ") as error:
        hood.load_reference_checkpoint(tmp_path / "c.pth")
    assert all(word in str(error.value) for word in words), str(error.value)


def test_missing_extra_doubled_and_misshapen_tensors() -> None:
    state = make_state("postcvpr", 4)
    without = {key: value for key, value in state.items() if key != MESH}
    with pytest.raises(ValueError, match=f"key '{MESH}' is missing; the nearest"):
        import_reference_weights(without)
    with pytest.raises(ValueError, match=r"key 'model\.head\.weight' does not fit"):
        import_reference_weights(state | {"model.head.weight": torch.zeros(2)})
    with pytest.raises(ValueError, match="name the same tensor"):
        import_reference_weights(state | {"module." + WEIGHT: state[WEIGHT]})
    with pytest.raises(ValueError, match=rf"'{WEIGHT}' has shape \(4, 5\).*\(4, 4\)"):
        import_reference_weights(state | {WEIGHT: torch.zeros(4, 5)})
    with pytest.raises(ValueError, match="statistics .*_node_normalizer are not finite"):
        import_reference_weights(state | {"model._node_normalizer._acc_count": torch.tensor(float("nan"))})
    with pytest.raises(ValueError, match="_std_epsilon' is 0.1"):
        import_reference_weights(state | {"model._node_normalizer._std_epsilon": torch.tensor(0.1)})


@pytest.mark.parametrize(
    "content, words",
    [
        ({"training_module": {"a.weight": torch.zeros(2)}}, "not HOOD weights: no processor steps"),
        ({"epoch": 3, "weights": torch.zeros(2)}, "entry 'epoch' is not a tensor"),
        ({"training_module": {}}, "no state dict under 'training_module'"),
        ([1, 2], "found a list"),
        ({"iteration": 1, "simulator": {}}, "give the model.safetensors"),
    ],
)
def test_foreign_files_are_refused_in_one_sentence(content: object, words: str, tmp_path: Path) -> None:
    torch.save(content, tmp_path / "c.pth")
    with pytest.raises(ValueError, match=words) as error:
        hood.load_reference_checkpoint(tmp_path / "c.pth")
    assert str(error.value).startswith(str(tmp_path / "c.pth"))
    assert "\n" not in str(error.value)


def test_native_weights_are_not_mistaken_for_published_ones() -> None:
    with pytest.raises(ValueError, match="not HOOD weights"):
        import_reference_weights(build_simulator(latent_dim=4).state_dict())


def test_importing_the_package_loads_no_torch() -> None:
    code = "import sys, hood; assert 'torch' not in sys.modules and 'load_reference_checkpoint' in hood.__all__"
    subprocess.run([sys.executable, "-c", code], check=True)
    with pytest.raises(AttributeError, match="nothing_such"):
        hood.nothing_such  # noqa: B018
