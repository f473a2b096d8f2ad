"""Updates of the released trainer, computed once more in plain torch: network, loss, clipping, Adam and its rate."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from coded_energies import TRANSCRIPTION, Case, collision
from reference_oracle import Oracle, OracleScene, OracleStep, make_state
from torch import Tensor

from hood.app.settings.compose import build, load_config
from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.assets.material import Material
from hood.assets.motion.sequence import PoseSequence
from hood.energies.problem import StepProblem
from hood.scene.body_motion.motion import BodyMotion, body_motion
from hood.scene.scene import dressed_scene
from hood.steppers.published import detect_layout, import_reference_weights, network_sources
from hood.training.scenes import SceneSampler, Window
from hood.training.trainer import Trainer

FABRIC = Material(density=0.3, lame_mu=40_000.0, lame_lambda=20_000.0, bending_stiffness=1e-4)
EMBEDDINGS = {"features.node.1.table.weight": "nodetype_embedding", "features.node.2.table.weight": "vertexlevel_embedding"}


class Doubled(SceneSampler):
    """Scenes of one fabric in float64."""

    def sample(self, rng: np.random.Generator, num_steps: int, garment: int | None = None) -> Window:
        window = super().sample(rng, num_steps, garment)
        motion = window.scene.motion
        assert isinstance(motion, BodyMotion)
        precise = body_motion(self.body, motion.sequence, motion.betas, torch.float64)
        return Window(dressed_scene(self.garments[0], precise, self.material), window.start_frame, still=window.still)


class Transcription:
    """The released trainer: what is known of it, and no code of this package but the tables of a garment's levels."""

    def __init__(self, state: dict[str, Tensor]) -> None:
        self.oracle = Oracle("postcvpr", state)
        self.learned = {
            name: value.requires_grad_(True) for name, value in self.oracle.state.items() if "_normalizer" not in name
        }
        self.first = {name: torch.zeros_like(value) for name, value in self.learned.items()}
        self.second = {name: torch.zeros_like(value) for name, value in self.learned.items()}
        self.updates = 0
        self.norm = 0.0

    def update(self, case: Case, scene: OracleScene, step: OracleStep, weight: float) -> tuple[Tensor, Tensor]:
        """One update; position and velocity after the step, detached."""
        _, following, velocity = self.oracle.predict(scene, step)
        loss = sum(term(case, following) for term in TRANSCRIPTION.values()) + collision(case, following, False, weight)
        slopes = torch.autograd.grad(loss, list(self.learned.values()), allow_unused=True)  # type: ignore[arg-type]
        gradient = {
            name: torch.zeros_like(value) if slope is None else slope
            for (name, value), slope in zip(self.learned.items(), slopes, strict=True)
        }
        self.norm = float(torch.stack([slope.square().sum() for slope in gradient.values()]).sum().sqrt())
        rate = 5e-5 * (0.5 ** (self.updates // 1) + 0.01)  # here every update, not every 50,000, halves it
        self.updates += 1
        with torch.no_grad():
            for name, value in self.learned.items():
                slope = gradient[name] * min(1.0, 1.0 / (self.norm + 1e-6))
                self.first[name] = 0.9 * self.first[name] + 0.1 * slope
                self.second[name] = 0.999 * self.second[name] + 0.001 * slope**2
                mean = self.first[name] / (1 - 0.9**self.updates)
                spread = (self.second[name] / (1 - 0.999**self.updates)).sqrt() + 1e-8
                value -= rate * mean / spread
        return following.detach(), velocity.detach()


def oracle_scene(problem: StepProblem, garment: Garment, body: Body, coarse: list[np.ndarray]) -> OracleScene:
    obstacle = problem.step.obstacle
    assert obstacle is not None
    fabric = (FABRIC.density, FABRIC.lame_mu, FABRIC.lame_lambda, FABRIC.bending_stiffness)
    types = np.where(obstacle.omitted.numpy(), 2, 1)
    return OracleScene(problem.cloth.rest_pos.numpy(), garment.faces, garment.pinned, coarse, *fabric, body.faces, types)  # type: ignore[arg-type]


@pytest.mark.parametrize("seed", [0, 1])
def test_two_updates_are_those_of_the_transcription(
    seed: int, tmp_path: Path, body: Body, garments: dict[str, Garment], walk: PoseSequence
) -> None:
    """The relaxing step, from a shaken start with 3 mm of noise, then a regular one with the velocity of the first."""
    words = ["trainer.statistics_iterations=0", "trainer.horizon.start=2", "trainer.schedule.every=1", "trainer.kernels=torch"]
    config = load_config("train", ["experiment=released", *words, "trainer.workers=0"])
    sampling = {**config.data.sampling, "material": FABRIC}
    sampler = Doubled(body, [garments["skirt"]], [walk.window(30, 90)], **sampling)
    state = make_state("postcvpr", seed=seed)
    simulator = import_reference_weights(state)[0].double()
    before = {name: value.detach().clone() for name, value in simulator.named_parameters()}
    trainer = Trainer(simulator, build(config.losses), sampler, build(config.trainer), tmp_path, seed)
    seen: list[StepProblem] = []
    trainer.observe = lambda problem, *_: seen.append(problem)
    transcription = Transcription(state)
    carried = following = None
    for number, timestep in enumerate((1 / 3, 1 / 30)):
        report = trainer.update()
        problem, slot = seen[-1], trainer.slots._slots[0]
        assert slot.prepared is not None
        coarse = [edges.numpy() for edges in slot.prepared.hierarchy.coarse_edges]
        obstacle, target, dt = problem.step.obstacle, problem.step.pin_target, float(problem.step.dt)
        assert dt == pytest.approx(timestep)
        assert obstacle is not None
        assert target is not None
        x = problem.state.pos if following is None else following
        torch.testing.assert_close(x, problem.state.pos, rtol=0, atol=1e-9)
        way = dt * problem.state.vel
        if carried is not None:
            torch.testing.assert_close(carried, way, rtol=0, atol=1e-9)
        surfaces = (obstacle.prev_pos, obstacle.pos, obstacle.next_pos)
        step = OracleStep(x, x - way, carried, target, *surfaces, timestep)
        scene = oracle_scene(problem, garments["skirt"], body, coarse)
        case = Case(problem, scene.rest, scene.faces, body.faces, surfaces, x, FABRIC)
        following, carried = transcription.update(case, scene, step, 5e3)

        assert report["parameter_gradient_norm"] == pytest.approx(transcription.norm, rel=1e-6)
        assert report["learning_rate"] == pytest.approx(5e-5 * (0.5**number + 0.01))
        assert transcription.norm > 10  # so that it was clipped
        sources = {f"network.{name}": source.key for name, source in network_sources(detect_layout(state)).items()}
        sources |= {name: f"model.{key}.weight" for name, key in EMBEDDINGS.items()}
        mine = dict(trainer.simulator.named_parameters())
        assert mine.keys() == sources.keys()
        moved = 0.0
        for name, key in sources.items():
            change, expected = mine[name] - before[name], transcription.learned[key] - before[name]
            # Of the change, not of the weight, which hardly changes.
            assert float((change - expected).detach().norm()) <= 1e-5 * float(expected.detach().norm()), name
            moved += float(expected.detach().square().sum())
        assert moved**0.5 > 1e-3
