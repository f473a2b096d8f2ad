"""Cloth that meets cloth in small scenes at four time steps: folding strip, sheet over a bar, sheets on a ball, stack of ten.

    python benchmarks/layer_scenes.py --seconds 1
    python benchmarks/layer_scenes.py --scenes stack --rates 30 --engine torch --friction 0
    python benchmarks/layer_scenes.py --rates 60 30 --compare                # each step beside one without the layers
    python benchmarks/layer_scenes.py --rates 60 --sheet layers.png          # a picture of every scene at six times

Prints, per scene and time step: pairs of triangles that pass through each other in the worst frame (by
:mod:`hood.mesh.penetration.crossing`, which shares nothing with the solver's search), the least distance of two features at the
end of a step, iterations (mean, 95th percentile, most), steps that missed the accuracy, and milliseconds of CPU time of a step.
With --compare a second line: the same scene with layers free to cross, step by step in turns, and the ratio of the times.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))  # the tests' own scenes
from layer_scenes import SCENES  # type: ignore[attr-defined]  # mypy knows the other module of that name only

from hood.energies.potential import Potential, default_potential
from hood.energies.problem import StepProblem
from hood.energies.self_contact import LayerBarrier, LayerFriction
from hood.media.pieces import outfit_ranks, part_colour
from hood.media.renderer.raster import Camera
from hood.media.renderer.render import BODY_COLOR, Picture, RenderMesh, contact_sheet, render_frame
from hood.media.video import save_png
from hood.mesh.penetration.crossing import self_crossings
from hood.solver.newton import NewtonSettings
from hood.steppers.newton import EulerStep, implicit_euler

#: Pictures of a scene.
PICTURES = 6


@dataclass
class Line:
    """One scene at one time step."""

    pairs: int = 0
    least: float = float("inf")  # m
    missed: list[int] = field(default_factory=list)
    iterations: list[int] = field(default_factory=list)
    milliseconds: list[float] = field(default_factory=list)

    def add(self, index: int, step: EulerStep, spent: float) -> None:
        """Take a step into account."""
        pos = step.state.pos.numpy()
        self.pairs = max(self.pairs, len(self_crossings(pos, step.problem.cloth.faces.numpy())))
        for scene in step.problem.layers:
            found = scene.layers.contacts(pos)
            gap = np.linalg.norm(np.einsum("nc,nck->nk", found.weights, pos[found.corners]), axis=1)
            self.least = min(self.least, gap.min(initial=self.least))
        self.iterations.append(step.report.iterations)
        self.milliseconds.append(spent)
        if not bool(step.report.converged.all()):
            self.missed.append(index)

    def __str__(self) -> str:
        most, p95 = max(self.iterations), np.percentile(self.iterations, 95)
        least = f"{1e3 * self.least:.2g} mm" if np.isfinite(self.least) else "-"
        return (
            f"pairs {self.pairs:3d}   least {least}   iterations {np.mean(self.iterations):5.1f} / {p95:.0f}"
            f" / {most}   missed {len(self.missed)} of {len(self.iterations)}   {np.mean(self.milliseconds):.0f} ms"
        )


def timed(steps: Iterator[EulerStep]) -> Iterator[tuple[EulerStep, float]]:
    """Steps with the milliseconds of CPU time that each took."""
    while True:
        began = time.process_time()
        step = next(steps, None)
        if step is None:
            return
        yield step, 1e3 * (time.process_time() - began)


def picture(problem: StepProblem, pos: np.ndarray, camera: Camera) -> Picture:
    """The cloth at ``pos`` (V, 3) and what it falls on; pieces have colours of their own."""
    cloth, obstacle = problem.cloth, problem.step.obstacle
    faces = cloth.faces.numpy()
    pieces = RenderMesh(pos, faces, [part_colour(rank) for rank in outfit_ranks("+", faces, len(pos)).tolist()])
    if obstacle is None or float(np.ptp(obstacle.pos.numpy()[:, 1])) == 0.0:  # a floor is drawn anyway
        return render_frame([pieces], camera, 320, 240, floor=0.0)
    solid = obstacle.pos.numpy()
    return render_frame([RenderMesh(solid, obstacle.faces.numpy(), BODY_COLOR), pieces], camera, 320, 240, floor=-0.4)


def pictures(problem: StepProblem, frames: list[np.ndarray]) -> list[Picture]:
    """:data:`PICTURES` of a scene from its start to its end, by one camera."""
    chosen = [frames[index] for index in np.linspace(0, len(frames) - 1, PICTURES).round().astype(int)]
    camera = Camera.framing(np.concatenate(chosen), azimuth_deg=35.0, elevation_deg=15.0, aspect=320 / 240)
    return [picture(problem, pos, camera) for pos in chosen]


def run(potentials: list[Potential], problem: StepProblem, steps: int, engine: str) -> tuple[list[Line], list[np.ndarray]]:
    """A line per potential, their steps taken in turns, and the positions (V, 3) that the first went through."""
    lines, frames = [Line() for _ in potentials], [problem.state.pos.numpy()]
    runs = [timed(implicit_euler(potential, problem, steps, NewtonSettings(engine=engine))) for potential in potentials]
    for index, turn in enumerate(zip(*runs, strict=True)):
        frames.append(turn[0][0].state.pos.numpy())
        for line, (step, spent) in zip(lines, turn, strict=True):
            line.add(index, step, spent)
    return lines, frames


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=list(SCENES))
    parser.add_argument("--rates", nargs="+", type=float, default=[240.0, 60.0, 30.0, 15.0], help="steps a second")
    parser.add_argument("--seconds", type=float, default=1.0, help="of simulated time")
    parser.add_argument("--friction", type=float, default=0.5, help="coefficient between layers")
    parser.add_argument("--engine", default="auto", help="form of the solver: auto, compiled or torch")
    parser.add_argument("--compare", action="store_true", help="take every step without the layers as well")
    parser.add_argument("--sheet", type=Path, help="picture (.png) of the scenes from start to end, a row per scene and rate")
    args = parser.parse_args()
    if args.sheet is not None and not (args.sheet.suffix == ".png" and args.sheet.parent.is_dir()):
        parser.error(f"--sheet {args.sheet}: give a .png in a folder that is there")
    potential: Potential = default_potential().with_terms(layers=LayerBarrier())
    drawn: dict[str, list[Picture]] = {}
    if args.friction > 0:
        potential = potential.with_terms(layer_friction=LayerFriction(args.friction))
    for rate in args.rates:
        for name in args.scenes:
            title, steps = f"{name:17s} 1/{rate:<4g}", max(1, round(args.seconds * rate))
            problem = SCENES[name](1 / rate)
            potentials = [potential, default_potential()] if args.compare else [potential]
            lines, frames = run(potentials, problem, steps, args.engine)
            print(f"{title} {lines[0]}", flush=True)
            if args.compare:
                ratio = sum(lines[0].milliseconds) / sum(lines[1].milliseconds)
                print(f"{'':24s} {lines[1]}   off; on takes {ratio:.1f} times as long", flush=True)
            if args.sheet is not None:
                drawn[" ".join(title.split())] = pictures(problem, frames)
    if args.sheet is not None:
        labels = [title if not number else "" for title, row in drawn.items() for number in range(len(row))]
        save_png(args.sheet, contact_sheet([cell for row in drawn.values() for cell in row], PICTURES, labels))


if __name__ == "__main__":
    main()
