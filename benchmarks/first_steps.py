"""What a training has to learn in its first steps, and whether its scenes agree on it.

    python benchmarks/first_steps.py 100 experiment=paper model.latent_dim=32                  # before the first update
    python benchmarks/first_steps.py 100 experiment=paper model.latent_dim=32 weights=runs/paper/model.safetensors
    python benchmarks/first_steps.py 100 experiment=quickstart trainer.horizon.start=1 weights=quickstart

The number is that of steps, the words are those of ``hood train``. No weight is changed. From every prediction the solver goes
on to a relative gradient of 1e-3, at most 60 iterations. Printed are, for relaxing steps and for the regular ones after them:

- distance [mm] of the vertices to that minimum (medians over steps of the median and of the 99th percentile), for zero output
  and for the network's,
- energy above the minimum over e0 (γ) of both, medians, and what is left of that of zero output: the geometric mean of ratios,
- the mean cosine between the gradients that two of the scenes have for the weights: 1 where they agree, 0 where what
  one scene asks for tells nothing about the next. With ``trainer.batch_size`` it is of whole updates.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass

import torch
from torch import Tensor

from hood.app.settings.compose import load_config
from hood.app.train import make_trainer
from hood.energies.potential import Potential, scale
from hood.energies.problem import StepProblem
from hood.scene.scene import RELAXING_DT
from hood.solver.newton import Further
from hood.steppers.network import Prediction
from hood.training.trainer import Trainer

ENDED, MOST = 1e-3, 60


@dataclass(frozen=True)
class Step:
    """One step of a training rollout."""

    relaxing: bool
    sizes: tuple[float, float, float, float]  # [mm] of zero output, median and 99th percentile; of the network
    above: tuple[float, float]  # γ of both
    direction: Tensor  # of the gradient of all weights, length 1


class Look:
    """Told every step of a training by its ``observe``; ``weights`` are those whose gradients are compared."""

    def __init__(self, trainer: Trainer) -> None:
        self.trainer, self.steps = trainer, list[Step]()
        self.weights = [weight for weight in trainer.simulator.parameters() if weight.requires_grad]

    def __call__(self, problem: StepProblem, potential: Potential, prediction: Prediction, residual: Tensor) -> None:
        if not prediction.next_pos.requires_grad:  # statistics are collected
            return
        found, base = prediction.next_pos.detach(), self.trainer.simulator.output.base(problem).detach()
        force, _ = potential.gradient(problem, found, problem.acceleration(found))
        force = force * problem.cloth.free.unsqueeze(1)
        asked = torch.autograd.grad((prediction.next_pos * force).sum(), self.weights, retain_graph=True, allow_unused=True)
        pairs = zip(asked, self.weights, strict=True)
        flat = torch.cat([(torch.zeros_like(weight) if one is None else one).flatten() for one, weight in pairs])
        way = Further(potential, problem, found)
        for _ in range(MOST):
            if not (way.residual > ENDED and way.move()):
                break
        least = energy(potential, problem, way.pos)
        self.steps.append(
            Step(
                bool(problem.step.dt.max() > RELAXING_DT / 2),
                (*sizes(problem, base - way.pos), *sizes(problem, found - way.pos)),
                (energy(potential, problem, base) - least, energy(potential, problem, found) - least),
                flat.double() / flat.double().norm().clamp_min(1e-300),
            )
        )


def energy(potential: Potential, problem: StepProblem, pos: Tensor) -> float:
    """Φ over e0 at ``pos`` (V, 3) m, the mean over scenes."""
    _, energies = potential.gradient(problem, pos, problem.acceleration(pos))
    return float((sum(energies.values()) / scale(problem)).mean())


def sizes(problem: StepProblem, moved: Tensor) -> tuple[float, float]:
    """Median and 99th percentile [mm] of lengths of ``moved`` (V, 3) m over the free vertices."""
    lengths = 1e3 * torch.linalg.vector_norm(moved, dim=1)[problem.cloth.free]
    return float(lengths.median()), float(lengths.quantile(0.99))


def report(steps: list[Step]) -> str:
    lines = ["            steps   zero output [mm]   network [mm]   γ: zero  network    left  cosine"]
    for name, kind in (("relaxing", True), ("regular", False)):
        chosen = [step for step in steps if step.relaxing == kind]
        if len(chosen) < 2:
            continue
        mm = torch.tensor([step.sizes for step in chosen]).median(dim=0).values.tolist()
        above = torch.tensor([step.above for step in chosen]).median(dim=0).values.tolist()
        left = torch.tensor([network / zero for zero, network in (step.above for step in chosen)])
        count = len(chosen)
        together = float(torch.stack([step.direction for step in chosen]).sum(dim=0).square().sum())
        cosine = (together - count) / (count * (count - 1))
        lengths = f"{mm[0]:7.1f} / {mm[1]:6.1f}  {mm[2]:6.1f} / {mm[3]:6.1f}"
        lines.append(
            f"{name:>9}  {count:6d}  {lengths}  {above[0]:8.3g} {above[1]:8.3g}  "
            f"{left.clamp_min(1e-6).log().mean().exp():6.3f}  {cosine:6.3f}"
        )
    return "\n".join(lines)


def main(count: int, words: list[str]) -> None:
    quiet = ("trainer.learning_rate=1e-30", "trainer.horizon.maximum=1", "trainer.workers=0", "trainer.ema_decay=0.0")
    trainer = make_trainer(load_config("train", [*words, *quiet]))
    trainer.observe = look = Look(trainer)
    while len(look.steps) < count:
        trainer.update()
    trainer.slots.close()
    print(report(look.steps))


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(int(sys.argv[1]), sys.argv[2:])
