"""What contact of cloth with cloth costs: rollouts of the solver with and without it, frame by frame in turns.

    python benchmarks/layers.py                                              # 1,000 and 4,400 vertices, with contact
    python benchmarks/layers.py longsleeve_4k:12000@dance_mixed --frames 8   # refined to 12,000 vertices
    python benchmarks/layers.py skirt@walk_proud dress_4k@walk_proud dress_12k@walk_proud

A case is garments joined by ``+`` and a motion. Embedded body, default fabric and accuracy of ``hood rollout``; frames are
whole ones without metrics and files, CPU milliseconds. Two lines per case. The first: medians of both, their ratio and that of
the sums, Newton iterations of a step (mean, both), frames that missed the accuracy, and the share of frames that are the same
to the bit. The second: what the layers were about, per frame: pairs of features in reach at the end, pairs in the list,
searches (of all, of some vertices), and CPU milliseconds of the search, of limiting moves, of energies and of models.
"""

from __future__ import annotations

import argparse
import gc
import os
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from statistics import mean, median

import torch
from frame import refined
from torch import Tensor

from hood.app.candidates import machine_name
from hood.assets.body.load import load_body
from hood.assets.garment.garment import Garment, load_garment
from hood.assets.garment.outfit import join_garments
from hood.assets.motion.load import load_sequence
from hood.cli.main import ENVIRONMENT
from hood.energies.potential import Potential, default_potential
from hood.energies.problem import StepProblem
from hood.energies.self_contact import LayerBarrier
from hood.mesh.cloth_proximity import Work
from hood.rollouts.frame import Frame
from hood.rollouts.loop import simulate
from hood.scene.scene import Scene, build_scene
from hood.solver.newton import NewtonSettings
from hood.steppers.network import Prediction
from hood.steppers.newton import NewtonStepper

CASES = ("longsleeve@dance_mixed", "tank+skirt@plie", "longsleeve_4k@dance_mixed", "tank_4k+skirt_4k@plie")
#: Frames that make tables and are not counted.
FIRST = 2


@dataclass
class Rollout:
    """A rollout on its way, and what its frames were like."""

    frames: Iterator[Frame]
    layers: list[tuple[Work, int]] = field(default_factory=list)
    spent: list[float] = field(default_factory=list)  # ms of CPU time
    iterations: list[float] = field(default_factory=list)
    missed: int = 0
    pos: Tensor | None = None

    def step(self) -> None:
        """One frame."""
        began = time.process_time()
        frame = next(self.frames)
        self.spent.append(1e3 * (time.process_time() - began))
        self.iterations.append(frame.metrics["solver_iterations"])
        self.missed += frame.metrics["solver_converged"] == 0.0
        self.pos = frame.state.pos

    def observe(self, index: int, problem: StepProblem, prediction: Prediction) -> None:
        """Keeps what the layers of a step came to."""
        for scene in problem.layers:
            near = len(scene.layers.contacts(scene.of(prediction.next_pos)).corners)
            self.layers.append((scene.layers.work, near))


def make_scene(case: str) -> Scene:
    """The scene of ``tank+skirt@plie``; ``dress:12000`` is refined to so many vertices."""
    names, _, motion = case.partition("@")
    outfit = join_garments([_garment(name) for name in names.split("+")])
    return build_scene(outfit, load_body(), load_sequence(motion, 30.0), dtype=torch.float64)


def _garment(text: str) -> Garment:
    name, _, count = text.partition(":")
    garment = load_garment(name)
    return refined(garment, int(count)) if count else garment


def start(scene: Scene, potential: Potential, first: int, frames: int) -> Rollout:
    """A rollout of ``potential`` that has come to its first frame, the same one whatever the potential."""
    stepper = NewtonStepper(potential, NewtonSettings(target_rg=1e-2))
    rollout = Rollout(iter(()))
    rollout.frames = simulate(stepper, scene, potential, frames + 1, start_frame=first, observe=rollout.observe, metrics="none")
    next(rollout.frames)
    return rollout


def run(case: str, first: int, frames: int) -> Iterator[str]:
    """Lines of the table of one case."""
    scene, plain = make_scene(case), default_potential()
    both = plain.with_terms(layers=LayerBarrier())
    on, off = start(scene, both, first, frames + FIRST), start(scene, plain, first, frames + FIRST)
    same = 0
    for _ in range(frames + FIRST):
        on.step()
        off.step()
        assert on.pos is not None
        assert off.pos is not None
        same += torch.equal(on.pos, off.pos)
    slow, fast = on.spent[FIRST:], off.spent[FIRST:]
    ratio, total = median(slow) / median(fast), sum(slow) / sum(fast)
    iterations = " ".join(f"{mean(rollout.iterations[FIRST:]):5.1f}" for rollout in (on, off))
    missed = f"{on.missed:3d} {off.missed:3d}"
    yield (
        f"{case:34s} {scene.cloth.num_vertices:6d} {median(slow):8.1f} {median(fast):8.1f} {ratio:6.2f} {total:6.2f} "
        f"{iterations}  {missed} {same / (frames + FIRST):6.0%}"
    )
    works = on.layers[FIRST:]
    near, listed = mean(near for _, near in works), mean(work.listed for work, _ in works)
    searches, refreshes = (mean(getattr(work, name) for work, _ in works) for name in ("searches", "refreshes"))
    parts = [1e3 * mean(getattr(work, name) for work, _ in works) for name in ("searching", "limiting", "energies", "models")]
    yield f"{'':34s} near {near:.0f}, listed {listed:.0f}, searches {searches:.1f} + {refreshes:.1f}; ms " + " ".join(
        f"{name} {value:.1f}" for name, value in zip(("search", "limit", "energy", "model"), parts, strict=True)
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", default=CASES)
    parser.add_argument("--frames", type=int, default=16)
    parser.add_argument("--first", type=int, default=0, help="frame of the motion to start at")
    arguments = parser.parse_args()
    if any(os.environ.get(key) is None for key in ENVIRONMENT):  # read at process start only
        os.execve(sys.executable, [sys.executable, *sys.argv], {**ENVIRONMENT, **os.environ})
    torch.set_num_threads(1)
    gc.freeze()  # as the commands do
    print(machine_name("cpu"))
    print(
        f"{'case':34s} {'':6s} {'on, ms':>8s} {'off':>8s} {'ratio':>6s} {'total':>6s} {'its on':>5s} {'off':>4s}  missed   same"
    )
    for case in arguments.cases:
        for line in run(case, arguments.first, arguments.frames):
            print(line, flush=True)


if __name__ == "__main__":
    main()
