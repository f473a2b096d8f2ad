"""What errors in predicted positions and in predicted edges cost, and what trained models make of either.

    python benchmarks/heads.py errors                              # the exact answer with errors, on states of the solver
    python benchmarks/heads.py errors --garments dress_4k skirt_4k --states 1
    python benchmarks/heads.py models A.safetensors B.safetensors  # models on the states of their own rollouts
    python benchmarks/heads.py projective --solves 1 10 30         # the control of edges after so many solves
    python benchmarks/heads.py controls FOLDER                     # the controls as model files, for rollouts of their own

An error of 30% is 0.3 times the change from the base at every vertex, or edge, in a direction of its own; ``shrunk`` is the
change 30% too small everywhere. Positions follow from edges by the solve of ``output=edges`` with its default weights; anchors
are exact, in error like the edges, or firm ones of the base. Controls without a network: the base, and its edges rescaled to
their rest lengths (projective dynamics), after one solve and after ten.

Models are told by γ, by the relative error of the change they predict (‖x − x*‖ over ‖base − x*‖, weighted by mass, and the
same of edges, not weighted), and by the CPU time of a step, beside the same controls on the same states.
"""

from __future__ import annotations

import argparse
import math
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from hood.assets.body.load import load_body
from hood.assets.files.library import locate
from hood.assets.garment.garment import load_garment
from hood.assets.motion.load import load_sequence
from hood.cloth.state import StepInput
from hood.energies.potential import default_potential, scale
from hood.energies.problem import StepProblem
from hood.evaluation.gap import REFERENCE, StepSample, starts
from hood.model.graph.builder import MESH, Graph, StaticGraph, build_graph, edge_set
from hood.model.readout.edges import EdgeOutput
from hood.model.readout.network_step import Dirichlet, Moved, NetworkStep
from hood.rollouts.loop import simulate
from hood.scene.scene import Scene, build_scene
from hood.solver.newton import minimize
from hood.solver.system.iterate import in_double
from hood.steppers.checkpoint import load_simulator, save_simulator
from hood.steppers.network import build_simulator
from hood.steppers.newton import NewtonStepper, Stepper

POTENTIAL = default_potential()
MOTIONS = {"dress": "walk_proud", "tshirt": "dance_mixed", "skirt": "twist_and_bend", "trousers": "plie"}
ERRORS = (0.3, 0.1, 0.03)
SOLVES = 10
#: CorrectionPasses of the controls of ``model=forces``.
WHOLE_STEPS = (1, 2, 4, 8)
#: Logarithm of how much more than by default vertices near the body are held where nothing is predicted: 300 N/m, which is best
#: for the controls.
FIRM = math.log(15.0)
#: The same of the strength along the body, which by default is a quarter of that towards it.
ALIKE = math.log(4.0)


@dataclass
class Table:
    """Figures by the name of a row, one per state."""

    rows: dict[str, list[float]] = field(default_factory=dict)

    def add(self, name: str, value: float) -> None:
        self.rows.setdefault(name, []).append(value)

    def print(self) -> None:
        for name, values in self.rows.items():
            known = [value for value in values if math.isfinite(value)]
            middle = f"{statistics.median(known):9.4f}" if known else "        -"
            print(f"{name:40}{middle}   {min(known, default=math.nan):.3g} to {max(known, default=math.nan):.3g}")


class Case:
    """A step in float64, its minimum, and the head's own solve."""

    def __init__(self, problem: StepProblem, near: Tensor) -> None:
        self.problem = problem = in_double(POTENTIAL.prepare(problem))
        minima = [minimize(POTENTIAL, problem, start, REFERENCE) for start in starts(problem, near)]
        self.exact, report = min(minima, key=lambda found: float(found[1].phi))
        self.phi, self.e0 = float(report.phi), float(scale(problem))
        cloth, step = problem.cloth, problem.step
        target = problem.state.pos
        if step.pin_target is not None:
            target = torch.where(cloth.pinned.unsqueeze(1), step.pin_target, target)
        self.held, self.head = Dirichlet(cloth.free, target), EdgeOutput()
        self.base = torch.where(cloth.free.unsqueeze(1), self.head.base(problem), target)
        static = StaticGraph(len(target), cloth.edges, {MESH: edge_set(cloth.edges)}, torch.zeros(len(target)).long())
        self.graph: Graph = build_graph(static, StepInput(step.dt))
        self.edges = self.graph.edge_sets[MESH]

    def gamma(self, pos: Tensor) -> float:
        return (float(POTENTIAL.total(self.problem, pos.double())) - self.phi) / self.e0

    def vectors(self, pos: Tensor) -> Tensor:
        return pos[self.edges.receivers] - pos[self.edges.senders]

    def solve(self, vector: Tensor, anchor: Tensor, base: Tensor | None = None, hold: float = 0.0) -> Tensor:
        """Positions from edges (N, 3) and anchors (V, 3) by the head, ``hold`` being its output for how firm these are."""
        base = self.base if base is None else base
        head = _Given(vector)
        # As firmly along the body as towards it.
        firmness = torch.tensor([hold, hold + ALIKE]).to(anchor).expand(len(anchor), 2)
        raw = torch.cat([(anchor - base) / head.scale, firmness], dim=1)
        return head.positions(self.problem, self.graph, base, raw, vector, self.held)

    def projective(self, solves: int) -> Tensor:
        """The base with its edges rescaled to their rest lengths, ``solves`` times."""
        pos, rest = self.base, self.vectors(self.problem.cloth.rest_pos).norm(dim=1, keepdim=True)
        for _ in range(solves):
            now = self.vectors(pos)
            pos = self.solve(now * (rest / now.norm(dim=1, keepdim=True).clamp_min(1e-9)), pos, pos, FIRM)
        return pos

    def controls(self, table: Table) -> None:
        table.add("base", self.gamma(self.base))
        table.add("rest lengths, one solve", self.gamma(self.projective(1)))
        table.add(f"rest lengths, {SOLVES} solves", self.gamma(self.projective(SOLVES)))


class _Given(EdgeOutput):
    """The head with edges that are known."""

    def __init__(self, vector: Tensor) -> None:
        super().__init__()
        self._vector = vector

    def vectors(self, problem: StepProblem, graph: Graph, vector: Tensor, raw: Tensor) -> Tensor:
        return self._vector


class _Projective(EdgeOutput):
    """Edges of the base at their rest lengths, solved for again and again: projective dynamics, with nothing learned."""

    def __init__(self, solves: int) -> None:
        super().__init__()
        self._solves = solves

    def move(self, step: NetworkStep) -> Moved:
        pos, count = step.base, step.graph.edge_sets[MESH].num_edges
        raw = pos.new_tensor([0.0, 0.0, 0.0, FIRM, FIRM + ALIKE]).expand(len(pos), self.width)
        edge_raw = pos.new_tensor([0.0, 0.0, 0.0, 1.0, 0.0]).expand(count, self.edge_width)
        for _ in range(self._solves):
            pos = self.positions(step.problem, step.graph, pos, raw, edge_raw, step.held)
        return Moved(pos)


def projective(solves: list[int], garments: list[str], states: int, frames: int) -> None:
    """γ and time of what ``output=edges`` makes without a network, on the states of its own rollouts."""
    for count in solves:
        simulator = build_simulator(features="physical", output="edges", schedule="1x(mesh)", latent_dim=16).eval()
        simulator.output = _Projective(count)
        table = Table()
        for garment in garments:
            scene = make_scene(garment)
            prepared = simulator.prepare(scene.cloth, scene.garment.rest_pos)
            for case, problem, pos in cases(simulator, scene, states, frames):
                table.add("γ", case.gamma(pos))
                table.add("CPU ms of a step", 1e3 * cpu_time(partial(simulator.predict, problem, prepared)))
        print(f"rest lengths, solves: {count}")
        table.print()


def make_scene(garment: str) -> Scene:
    return build_scene(load_garment(garment), load_body(), load_sequence(MOTIONS[garment.partition("_")[0]], 30.0))


def cases(stepper: Stepper, scene: Scene, states: int, frames: int) -> list[tuple[Case, StepProblem, Tensor]]:
    """States of the stepper's own rollout, with its answer."""
    sample = StepSample(range(3, frames), states)
    for _ in simulate(stepper, scene, POTENTIAL, frames, observe=sample, metrics="none"):
        pass
    return [(Case(problem, step.next_pos), problem, step.next_pos) for problem, step in sample.steps]


def errors(garments: list[str], states: int, frames: int) -> None:
    """γ of the exact answer with errors."""
    table, generator = Table(), torch.Generator().manual_seed(0)

    def noise(change: Tensor, other: Tensor | None = None) -> Tensor:
        """As large as ``change`` (N, 3) in every row, in a direction of its own; opposite in the row ``other``."""
        drawn = torch.randn(change.shape, generator=generator, dtype=change.dtype)
        drawn = drawn if other is None else (drawn - drawn[other]) / math.sqrt(2)
        return drawn * change.norm(dim=1, keepdim=True) / math.sqrt(3)

    for garment in garments:
        for case, _, _ in cases(NewtonStepper(POTENTIAL), make_scene(garment), states, frames):
            exact, change = case.exact, case.exact - case.base
            edges, turn = case.vectors(exact), case.vectors(exact) - case.vectors(case.base)
            case.controls(table)
            for share in ERRORS:
                pos, vector = exact + share * noise(change), edges + share * noise(turn, case.edges.reverse)
                table.add(f"positions, error {share:.0%}", case.gamma(pos))
                table.add(f"edges, error {share:.0%}", case.gamma(case.solve(vector, exact)))
                table.add(f"edges and anchors, error {share:.0%}", case.gamma(case.solve(vector, pos)))
            shrunk = exact - ERRORS[0] * change
            table.add(f"positions, shrunk {ERRORS[0]:.0%}", case.gamma(shrunk))
            table.add(f"edges and anchors, shrunk {ERRORS[0]:.0%}", case.gamma(case.solve(edges - ERRORS[0] * turn, shrunk)))
            table.add("edges exact, anchors of the base", case.gamma(case.solve(edges, case.base, hold=FIRM)))
            table.add("edges and anchors exact", case.gamma(case.solve(edges, exact)))
    print(f"γ, median and range over {len(table.rows['base'])} states of the solver ({', '.join(garments)})")
    table.print()


def models(paths: list[str], garments: list[str], states: int, frames: int, kernels: str) -> None:
    """Trained models on their own states."""
    for path in paths:
        simulator = load_simulator(Path(path) if Path(path).exists() else locate("weights", path)).eval()
        simulator.network.use_kernels(kernels)
        table = Table()
        for garment in garments:
            scene = make_scene(garment)
            prepared = simulator.prepare(scene.cloth, scene.garment.rest_pos)
            for case, problem, pos in cases(simulator, scene, states, frames):
                table.add("γ", case.gamma(pos))
                case.controls(table)
                weight = case.problem.cloth.mass.unsqueeze(1)
                table.add("error of the change, positions", relative(pos, case.base, case.exact, weight))
                table.add("error of the change, edges", relative(*map(case.vectors, (pos.double(), case.base, case.exact))))
                table.add("CPU ms of a step", 1e3 * cpu_time(partial(simulator.predict, problem, prepared)))
        print(f"{path} ({simulator.config['features']}, {simulator.config['output']}), median and range over its own states")
        table.print()


def write_controls(folder: Path) -> None:
    """Models whose output is the same everywhere: of ``model=edges`` the base, and its edges at their rest lengths; of
    ``model=forces`` in several passes, whole steps of all vertices together, with the forces that there are."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, share, hold in (("base", 0.0, 0.0), ("rest_lengths", 1.0, FIRM)):
        simulator = build_simulator(features="local", output="edges", schedule="1x(mesh)", latent_dim=16)
        vertices, edges = simulator.network.decoder.third, simulator.network.edge_decoder.mlp.third
        with torch.no_grad():
            for layer in (vertices, edges):
                layer.weight.zero_()
                layer.bias.zero_()
            vertices.bias[3], vertices.bias[4], edges.bias[3] = hold, hold + ALIKE, share
        save_simulator(folder / f"{name}.safetensors", simulator)
        print(folder / f"{name}.safetensors")
    for count in WHOLE_STEPS:
        passes = " | ".join(count * ["1x(mesh)"])
        simulator = build_simulator(features="local", output="global_steps", schedule=passes, latent_dim=16, output_init=0.0)
        save_simulator(folder / f"whole_steps_{count}.safetensors", simulator)
        print(folder / f"whole_steps_{count}.safetensors")


def relative(found: Tensor, base: Tensor, exact: Tensor, weight: Tensor | float = 1.0) -> float:
    """‖found − exact‖ / ‖base − exact‖."""
    left, whole = ((value.double() - exact).square() * weight for value in (found, base))
    return math.sqrt(float(left.sum() / whole.sum()))


def cpu_time(call: Callable[[], object]) -> float:
    """Least CPU seconds of five calls after a first one."""
    best = math.inf
    with torch.no_grad():
        for turn in range(6):
            begin = time.process_time()
            call()
            best = min(best, time.process_time() - begin) if turn else best
    return best


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("errors", "models", "projective", "controls"))
    parser.add_argument("models", nargs="*", help="model files or names of shipped ones; a folder for controls")
    parser.add_argument("--garments", nargs="+", default=["dress", "tshirt", "skirt"])
    parser.add_argument("--states", type=int, default=2, help="of every rollout")
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--kernels", default="fused")
    parser.add_argument("--solves", type=int, nargs="+", default=[1, 10, 30], help="of projective")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    common = arguments.garments, arguments.states, arguments.frames
    if arguments.what == "errors":
        errors(*common)
    elif arguments.what == "projective":
        with torch.no_grad():
            projective(arguments.solves, *common)
    elif arguments.what == "controls":
        write_controls(Path(arguments.models[0]))
    else:
        models(arguments.models, *common, arguments.kernels)


if __name__ == "__main__":
    main()
