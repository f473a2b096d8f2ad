"""A whole step of a simulator (search, features, network, integration) as a function of tensors of fixed shapes.

It waits for nothing on the host and no shape in it depends on a value, so that a CUDA graph can hold it and a compiler
needs to see it once. Its result is that of :meth:`hood.dynamics.simulator.Simulator.predict` up to rounding.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from hood.dynamics.fixed_problem import altered, problem_from, with_fixed_contact
from hood.dynamics.simulator import Simulator
from hood.features.inputs import EdgeRows, Inputs
from hood.graph.fixed import Layout, build_fixed_graph
from hood.losses.potential import Potential, keeps_both_sides
from hood.losses.problem import StepProblem
from hood.mesh.nearest import Nearest
from hood.mesh.proximity import Incidence
from hood.native import features as native
from hood.scene.contact import find_nearest
from hood.scene.state import Obstacle
from hood.solver.local import incidence_of


class StepResult(NamedTuple):
    """What a step leaves on the device."""

    next_pos: Tensor  # (V, 3) m
    acc: Tensor  # (V, 3) m/s²
    next_vel: Tensor  # (V, 3) m/s
    #: (3,) body edges, active body vertices, and body faces that every cloth vertex is tested against; a step with more than
    #: it has places for is to be repeated.
    num_found: Tensor


class FixedStep:
    """``StepResult(*step(*inputs))`` with ``inputs = step_inputs(problem, simulator.needs_contact)``
    (:mod:`hood.dynamics.fixed_problem`) for problems like the one it was made for: same cloth, same attachments, same gravity,
    same fields, same shapes.

    Everything else (weights, statistics, the cloth) is read when the step is made or later, and must not change.

    Args:
        simulator: in evaluation mode.
        layout: sizes of its graphs.
        like: such a problem.
        dense: search all pairs on a CPU too, as on any other device: what is traced there must not leave torch.
        potential: what the model is told of, by
            :func:`hood.dynamics.fixed_problem.settled_potential`; needed where ``simulator.looks_at_potential``.

    Raises:
        ValueError: the simulator counts statistics, or its graph has edges between layers of cloth.
    """

    def __init__(
        self,
        simulator: Simulator,
        layout: Layout,
        like: StepProblem,
        dense: bool = False,
        potential: Potential | None = None,
    ) -> None:
        check_model(simulator)
        assert potential is not None or not simulator.looks_at_potential, "the model looks at a potential"
        self.simulator, self.layout, self.dense = simulator, layout, dense
        self._like, self._potential = like, potential
        self._rows = self._edge_rows()
        self._incidence = incidence_of(like.cloth)
        assert like.cloth.scene_sizes  # known to the host before anything is captured

    def __call__(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """The fields of :class:`StepResult`."""
        with native.in_torch():
            return self._step(*problem_from(self._like, inputs))

    def _step(self, problem: StepProblem, incidence: Incidence | None) -> tuple[Tensor, ...]:
        simulator = self.simulator
        folds = self._potential is not None and keeps_both_sides(self._potential)
        problem, num_faces = with_fixed_contact(problem, incidence, self.layout.capacity.faces, folds, self.dense)
        if self._potential is not None:
            problem = self._potential.with_pull(problem, compiled=False)
        seen = simulator.rules.stand(self._in_frames(problem))
        obstacle, nearest = seen.step.obstacle, None
        if obstacle is not None:
            nearest = self._nearest(problem, seen, obstacle)
        graph = build_fixed_graph(self.layout, obstacle, nearest, simulator.body_radius)
        sight = simulator.look(problem, seen, graph, self._potential, self._rows)
        prediction = simulator.advance(problem, seen, sight, *simulator.features(sight.inputs))
        velocity = simulator.next_velocity(problem, prediction)
        return prediction.next_pos, prediction.acc, velocity, torch.cat([graph.num_found, num_faces])

    def _nearest(self, problem: StepProblem, seen: StepProblem, obstacle: Obstacle) -> Nearest:
        if seen.contact is not None and seen.state is problem.state:
            return seen.contact.nearest
        return find_nearest(seen.cloth, seen.state.pos, obstacle, self.simulator.body_radius, self.dense)

    def _in_frames(self, problem: StepProblem) -> StepProblem:
        frame_dt = self.simulator.rules.frame_dt
        if frame_dt is None:
            return problem
        return altered(problem, step=altered(problem.step, dt=torch.full_like(problem.step.dt, frame_dt)))

    @torch.no_grad()
    def _edge_rows(self) -> EdgeRows:
        """Kept by the step, with the columns that stay the same: the memory that a CUDA graph reads must not be given back,
        and what is computed for the first time while a function is traced has no values."""
        like = self._like
        graph = build_fixed_graph(self.layout, None, None, self.simulator.body_radius)
        here = like.state.pos
        given = Inputs(like.cloth, like.state, like.step, None, graph, base_pos=here, global_step=torch.zeros_like(here))
        given = replace(given, edge_rows=given.make_edge_rows())
        for group in self.simulator.features.edge:
            group(given)
        return given.edges


def check_model(simulator: Simulator) -> None:
    """Raise ValueError if the simulator's step has no form of fixed shapes."""
    if simulator.training:
        raise ValueError("fixed-shape steps are for inference: call simulator.eval() first")
    if simulator.layer_radius is not None:
        raise ValueError(
            f"the model has edges between layers of cloth (model.layer_radius={simulator.layer_radius:g}), as many as a step "
            "finds: use step=plain"
        )
