"""Wrinkles that the solver adds to a subdivided mesh of a coarse simulation, beside the fine simulation.

    python benchmarks/wrinkles.py circle

Every face of a garment of 1,000 vertices is cut into four, its flat pattern with it. Rows, all of that finer mesh:

smooth         the coarse simulation, as ``refine_mesh=1`` stores it
fine           the simulation of the finer mesh; ``N at most``: with so many iterations of the solver a minimisation
wrinkles RATE  as Müller and Chentanez (Wrinkle meshes, 2010): every frame starts from the one before it, carried by the motion
               of the smooth surface, and is one iteration of the solver with springs of RATE · mass [N/m] to that surface

``apart`` is the mean distance from the fine simulation; folds, height and wavelength of the hem, curvature and width are those
of ``benchmarks/folds.py``; all in the mean of the frames from the sixth on. Times of wrinkles contain the coarse simulation.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import folds
import numpy as np
import torch
from torch import Tensor

import hood
from hood.energies.problem import StepProblem, sum_per_scene
from hood.energies.term import Energy, Form, Passes, Role
from hood.mesh.editing.subdivision import Subdivision
from hood.mesh.topology import boundary_loops
from hood.rollouts.frame import Frame
from hood.solver.newton import NewtonSettings, minimize
from hood.solver.step_figures import reason_number
from hood.steppers.network import Prediction
from hood.steppers.newton import NewtonStepper
from hood.steppers.protocol import Stopwatch, timed

FIRST, RG = 5, 0.01


def cut(garment: hood.Garment, finer: Subdivision) -> hood.Garment:
    """The garment on the finer mesh: pattern, texture and elastic cut with it."""
    found: dict[str, Any] = {"rest_pos": finer.positions(garment.rest_pos), "faces": finer.faces}
    for name in ("pinned", "rest_turn", "region", "colours", "stiffness", "piece"):
        values = getattr(garment, name)
        found[name] = None if values is None else finer.marks(values)
    for name in ("lbs_weights", "shapedirs", "skin_pos"):
        values = getattr(garment, name)
        found[name] = None if values is None else finer.spread(values.reshape(len(values), -1)).reshape(-1, *values.shape[1:])
    if garment.uv is not None and garment.uv_faces is not None:
        found["uv"], found["uv_faces"] = finer.texture(garment.uv, garment.uv_faces)
    found["panels"] = None if garment.panels is None else {name: np.tile(own, 4) for name, own in garment.panels.items()}
    if garment.flat is not None:
        a, b, c = garment.flat.transpose(1, 0, 2)
        ab, bc, ca = (a + b) / 2.0, (b + c) / 2.0, (c + a) / 2.0
        four = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
        found["flat"] = np.concatenate([np.stack(corners, axis=1) for corners in four])
    if garment.elastic is not None:
        a, b, c = garment.elastic.T  # of the side opposite to each corner
        none = np.full(len(a), np.nan if np.isnan(garment.elastic).any() else 1.0)
        found["elastic"] = np.concatenate(
            [np.stack(row, axis=1) for row in ((none, b, c), (a, none, c), (a, b, none), (none, none, none))]
        )
    return replace(garment, **found)


@dataclass
class Springs:
    """½ Σ k ‖x − target‖² [J], as :class:`hood.energies.term.BlockForm`."""

    stiffness: Tensor  # (V,) N/m
    target: Tensor  # (V, 3) m
    problem: StepProblem

    def energy(self, pos: Tensor) -> Tensor:
        square = (pos - self.target.to(pos)).square().sum(dim=1)
        return sum_per_scene(0.5 * self.stiffness.to(pos) * square, self.problem.cloth.vertex_scene, self.problem.num_scenes)

    def derivatives(self, pos: Tensor) -> tuple[Tensor, Tensor]:
        stiffness = self.stiffness.to(pos)[:, None]
        return stiffness * (pos - self.target.to(pos)), torch.diag_embed(stiffness.expand(-1, 3))


class Follow(Energy):
    """Springs of every vertex to the smooth surface."""

    kind: ClassVar[str] = "Follow"
    role = Role.EXTERNAL
    form = Form.BLOCKS

    def __init__(self, rate: float) -> None:
        self.rate, self.target = rate, torch.zeros(0, 3)

    def applies(self, problem: StepProblem) -> bool:
        return len(self.target) > 0

    def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
        return self.closed_form(problem).energy(next_pos)

    def closed_form(self, problem: StepProblem, passes: Passes | None = None) -> Springs:
        return Springs(self.rate * problem.cloth.mass, self.target, problem)


class Wrinkles(NewtonStepper):
    """One iteration a step, from the state that the smooth surface (T, V, 3) [m] carries along."""

    def __init__(self, potential: hood.Potential, smooth: np.ndarray, rate: float, fps: float) -> None:
        self.follow, self.smooth, self.fps = Follow(rate), torch.as_tensor(smooth), fps
        terms = {**potential.terms, "follow": self.follow}
        super().__init__(hood.Potential(terms), NewtonSettings(target_rg=RG, max_iterations=1))

    def predict(self, problem: StepProblem, prepared: None, watch: Stopwatch | None = None) -> Prediction:
        time = problem.step.time
        now = 0 if time is None else min(round(float(time[0]) * self.fps), len(self.smooth) - 1)
        self.follow.target = self.smooth[now] - problem.state.origin
        start = problem.state.pos + self.smooth[now] - self.smooth[now - 1] if now else None
        with timed(watch, "search"):
            problem = self.search(problem)
        with timed(watch, "solver"):
            pos, report = minimize(self.potential, problem, start, self.settings)
        told = {"solver_iterations": 1.0, "solver_converged": 0.0, "solver_reason": reason_number(report.reason)}
        return Prediction(pos, report.acc, told, float(report.relative_gradient.max()))


def played(frames: Iterable[Frame]) -> tuple[np.ndarray, float]:
    """Positions (T, V, 3) [m] and milliseconds a frame."""
    found = list(frames)
    return np.stack([frame.world_pos.numpy() for frame in found]), float(np.median([f.metrics["ms_total"] for f in found[1:]]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("garment", nargs="?", default="circle")
    parser.add_argument("--material", default="silk")
    parser.add_argument("--motion", default="walk_brisk")
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--most", type=int, nargs="*", default=(1, 2, 4), help="iterations of the fine simulation")
    parser.add_argument("--rates", type=float, nargs="*", default=(3.0, 30.0), help="springs [N/(m kg)]")
    given = parser.parse_args()
    keys: dict[str, Any] = {"material": given.material, "num_frames": given.frames, "metrics": "none", "guard": "off"}
    solver = {"stepper": "newton", "solver": {"target_rg": RG}}
    coarse = hood.simulate(given.garment, given.motion, **keys, **solver)
    garment = coarse.scene.garment
    finer = Subdivision(garment.faces, garment.rest_pos, 1)
    fine_garment = cut(garment, finer)
    coarse_pos, coarse_ms = played(coarse)
    smooth = np.stack([finer.positions(pos) for pos in coarse_pos])
    fine = hood.simulate(fine_garment, given.motion, **keys, **solver)
    fine_pos, fine_ms = played(fine)
    rest, surface = fine_garment.rest_pos, folds.Surface(fine_garment.rest_pos, finer.faces)
    hem = max(boundary_loops(finer.faces), key=lambda loop: np.linalg.norm(np.diff(rest[loop], axis=0), axis=1).sum())

    def row(title: str, pos: np.ndarray, spent: float) -> None:
        apart = 1e3 * np.linalg.norm(pos - fine_pos, axis=2)[FIRST:].mean()
        figures = np.mean([(*folds.hem_figures(one, hem), *surface.figures(one)) for one in pos[FIRST:]], axis=0)
        print(f"{title:>18}{apart:10.1f}" + "".join(f"{value:12.1f}" for value in figures) + f"{spent:10.0f}", flush=True)

    print(f"{given.garment} in {given.material}: {len(garment.rest_pos)} and {len(rest)} vertices, {given.frames} frames")
    print(f"{'':>18}{'apart mm':>10}" + "".join(f"{title:>12}" for title in folds.FIGURES) + f"{'ms':>10}")
    row("smooth", smooth, coarse_ms)
    row("fine", fine_pos, fine_ms)
    for most in given.most:
        limited = {"stepper": "newton", "solver": {"target_rg": RG, "max_iterations": most}}
        row(f"fine, {most} at most", *played(hood.simulate(fine_garment, given.motion, **keys, **limited)))
    for rate in given.rates:
        stepper = Wrinkles(fine.potential, smooth, rate, 1.0 / fine.scene.dt)
        pos, spent = played(hood.simulate(fine_garment, given.motion, stepper=stepper, **keys))
        row(f"wrinkles {rate:g}", pos, coarse_ms + spent)


if __name__ == "__main__":
    main()
