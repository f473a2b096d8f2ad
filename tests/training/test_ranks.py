"""Two processes under torchrun do what one does: training, resuming, batches of rollouts, evaluations.

The file is its own worker: ``torchrun … test_ranks.py VARIANT FILE``.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from hood.assets.body.load import load_body
from hood.assets.garment.garment import load_garment
from hood.assets.motion.load import load_sequence
from hood.energies.potential import default_potential
from hood.rollouts.file.reader import read_rollout
from hood.steppers.network import build_simulator
from hood.training import distributed
from hood.training.curriculum import CollisionRamp, Horizon, WarmupCosine
from hood.training.scenes import SceneSampler
from hood.training.settings import TrainerSettings
from hood.training.trainer import Trainer

pytestmark = pytest.mark.slow

SETTINGS = TrainerSettings(
    iterations=12, batch_size=2, learning_rate=1e-3, schedule=WarmupCosine(3), horizon=Horizon(every=3, maximum=2),
    collision=CollisionRamp(5e5, 5e5), signal="scaled", ema_decay=0.9, statistics_iterations=2, checkpoint_every=100,
    log_every=1,
)  # fmt: skip
VARIANTS: dict[str, tuple[dict, TrainerSettings]] = {
    "physical": ({"features": "physical", "output": "velocity_base", "output_init": 0.1}, SETTINGS),
    # Running statistics of nodes, edges, body edges and outputs, two garments of different size.
    "paper": ({"features": "paper", "output": "acceleration"}, replace(SETTINGS, signal="potential")),
    "white": ({"features": "paper", "output": "acceleration"}, replace(SETTINGS, signal="scaled_by_frame", whitening=True)),
}
_UPDATES = 6


def make(variant: str, folder: Path) -> Trainer:
    options, settings = VARIANTS[variant]
    sampler = SceneSampler(load_body(), [load_garment("tank"), load_garment("skirt")], [load_sequence("walk_proud")])
    torch.manual_seed(0)
    simulator = build_simulator(schedule="1x(mesh+coarse0)", latent_dim=8, **options)
    return Trainer(simulator, default_potential(), sampler, settings, folder, 0)


def train(variant: str, target: Path) -> None:
    """A few updates of two scenes, alone or shared; gradients, weights, statistics and reports go to ``target``."""
    torch.set_num_threads(1)
    distributed.start()
    trainer = make(variant, target.parent)
    trace = []
    for _ in range(_UPDATES):
        report = distributed.mean(trainer.update())
        gradients = {name: p.grad.clone() for name, p in trainer.simulator.named_parameters() if p.grad is not None}
        trace.append({"report": report, "gradients": gradients})
    state = {name: value.clone() for name, value in trainer.simulator.state_dict().items()}
    states = distributed.gather(state)
    if distributed.rank() == 0:
        torch.save({"trace": trace, "states": states}, target)
    distributed.stop()


def torchrun(arguments: list[str], folder: Path, ranks: int = 2) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(ranks), *arguments]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": "", "HOOD_CACHE": "off"}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300)


@pytest.mark.parametrize("variant", VARIANTS)
def test_two_ranks_train_what_one_process_trains(variant: str, tmp_path: Path) -> None:
    train(variant, tmp_path / "one.pt")
    result = torchrun([__file__, variant, str(tmp_path / "two.pt")], tmp_path)
    assert result.returncode == 0, result.stderr[-2000:]
    one, two = (torch.load(tmp_path / f"{name}.pt", weights_only=True) for name in ("one", "two"))
    for name, value in two["states"][0].items():
        assert torch.equal(value, two["states"][1][name]), f"the ranks disagree about {name}"
    worst: dict[str, float] = {}
    for alone, shared in zip(one["trace"], two["trace"], strict=True):
        assert alone["gradients"].keys() == shared["gradients"].keys()
        if alone["gradients"]:
            flat = [torch.cat([g.reshape(-1) for g in trace["gradients"].values()]) for trace in (alone, shared)]
            # As the optimiser takes them: clipped to a norm of 1.
            worst["gradient"] = max(worst.get("gradient", 0.0), float((flat[0] - flat[1]).abs().max()))
        for name in ("total", "loss", "parameter_gradient_norm"):
            if name in alone["report"]:
                error = abs(alone["report"][name] - shared["report"][name]) / abs(alone["report"][name])
                worst[name] = max(worst.get(name, 0.0), error)
    for name, value in one["states"][0].items():
        error = float((value.double() - two["states"][0][name].double()).abs().max())
        kind = "statistics" if "normalizer" in name else "weights"
        worst[kind] = max(worst.get(kind, 0.0), error)
    print(f"{variant}: largest differences {worst}")
    # Steps in white coordinates are up to 1/0.02 times as long in those of the weights.
    limit = {"weights": 1e-5} if variant == "white" else {}
    assert all(error <= limit.get(name, 1e-6) for name, error in worst.items()), worst


def train_half(target: Path) -> None:
    """Two processes train the first three of six updates and stop with a checkpoint."""
    torch.set_num_threads(1)
    distributed.start()
    trainer = make("paper", target)
    assert not trainer.run(should_stop=lambda: trainer.iteration >= 3)
    distributed.stop()


def test_a_checkpoint_of_two_ranks_resumes_on_one(tmp_path: Path) -> None:
    result = torchrun([__file__, "half", str(tmp_path / "half")], tmp_path)
    assert result.returncode == 0, result.stderr[-2000:]
    whole, parts = make("paper", tmp_path / "whole"), make("paper", tmp_path / "half")
    parts.resume(parts.checkpoint_path)
    assert parts.iteration == 3
    for _ in range(3):
        parts.update()
    for _ in range(6):
        whole.update()
    for name, value in whole.simulator.state_dict().items():
        torch.testing.assert_close(parts.simulator.state_dict()[name], value, rtol=1e-6, atol=1e-6)


TINY = ["model.latent_dim=4", "model.schedule='1x(mesh)'"]


def motions(folder: Path, count: int) -> None:
    folder.mkdir()
    rng = np.random.default_rng(0)
    for index in range(count):
        poses = np.zeros((4, 156))
        poses[:, 3:] = rng.normal(0.0, 0.02, 153)
        still = {"trans": np.zeros((4, 3)), "mocap_framerate": 30.0, "betas": np.zeros(16), "gender": "neutral"}
        np.savez(folder / f"m{index}.npz", poses=poses, **still)


def test_two_ranks_share_rollouts(tmp_path: Path) -> None:
    motions(tmp_path / "in", 3)
    command = [
        "rollout", "checkpoint=untrained", "model=small", *TINY, "garment=tank", "num_frames=3", "video=none", "sheet=false",
        "sequence=in",
    ]  # fmt: skip
    result = torchrun(["-m", "hood.cli.main", *command, "output=two"], tmp_path)
    assert result.returncode == 0, result.stderr[-2000:]
    assert result.stdout.count("3 of 3 motions simulated") == 1
    one = torchrun(["-m", "hood.cli.main", *command, "output=one"], tmp_path, ranks=1)
    assert one.returncode == 0, one.stderr[-2000:]
    for index in range(3):
        alone, shared = (read_rollout(tmp_path / name / f"m{index}" / "rollout.h5").cloth_pos for name in ("one", "two"))
        assert np.array_equal(alone, shared)
    rows = [json.loads((tmp_path / name / "summary.json").read_text())["motions"] for name in ("one", "two")]
    assert list(rows[0]) == list(rows[1])
    assert len(rows[1]) == 3


@pytest.mark.slow
def test_shards_of_two_ranks_each_lose_no_file_in_one_folder(tmp_path: Path) -> None:
    """Two lists at the same time, with motions of the same names."""
    for shard in ("01", "02"):
        motions(tmp_path / shard, 3)
        (tmp_path / f"{shard}.txt").write_text(f"{shard}/*.npz\n")
    command = ["-m", "hood.cli.main", "rollout", "checkpoint=untrained", "model=small", *TINY, "garment=tank", "num_frames=3"]
    command += ["video=none", "sheet=false", "root=.", "output=out"]
    with ThreadPoolExecutor() as pool:
        results = list(pool.map(lambda shard: torchrun([*command, f"sequence={shard}.txt"], tmp_path), ("01", "02")))
    for result in results:
        assert result.returncode == 0, result.stderr[-2000:]
        assert result.stdout.count("3 of 3 motions simulated") == 1
    overview = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert overview["num_motions"] == len(overview["motions"]) == 6
    for shard in ("01", "02"):
        for index in range(3):
            data = read_rollout(tmp_path / "out" / shard / f"m{index}" / "rollout.h5")
            assert data.attributes["motion_file"] == str(tmp_path / shard / f"m{index}.npz")
            assert len(data.cloth_pos) == 3


def test_two_ranks_share_an_evaluation(tmp_path: Path) -> None:
    motions(tmp_path / "in", 2)
    command = ["evaluate", "models=[newton]", "garments=[tank,skirt]", "sequences=[in]", "num_frames=4", "gap_states=0"]
    command += ["solver.max_iterations=1"]
    for ranks, name in ((2, "two"), (1, "one")):
        result = torchrun(["-m", "hood.cli.main", *command, f"output={name}"], tmp_path, ranks)
        assert result.returncode == 0, result.stderr[-2000:]
        assert result.stdout.count("tables in") == 1
    one, two = (json.loads((tmp_path / name / "table.json").read_text()) for name in ("one", "two"))
    times = ("ms", "ms_low", "ms_high", "ms_p99", "fps")
    assert [{k: v for k, v in row.items() if k not in times} for row in one] == [
        {k: v for k, v in row.items() if k not in times} for row in two
    ]
    assert len(list((tmp_path / "two").glob("rollouts.*.jsonl"))) == 2


def test_training_by_two_ranks_from_the_command_line(tmp_path: Path) -> None:
    """One record, one set of files, one complaint."""
    command = [
        "-m", "hood.cli.main", "train", *TINY, "trainer.iterations=2", "trainer.batch_size=2", "trainer.log_every=1",
        "trainer.workers=0", "data.garments=[tank]", "data.sequences=[walk_proud]", "output=run",
    ]  # fmt: skip
    result = torchrun(command, tmp_path)
    assert result.returncode == 0, result.stderr[-2000:]
    assert result.stdout.count("weights in run/model.safetensors") == 1
    assert "broadcast_buffers" not in result.stderr
    assert len((tmp_path / "run" / "metrics.jsonl").read_text().splitlines()) == 2
    again = torchrun(command, tmp_path)
    assert again.returncode != 0
    assert again.stderr.count("holds a training run") == 1


if __name__ == "__main__":
    if sys.argv[1] == "half":
        train_half(Path(sys.argv[2]))
    else:
        train(sys.argv[1], Path(sys.argv[2]))
