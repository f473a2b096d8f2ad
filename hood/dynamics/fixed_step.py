"""A whole step of a simulator (search, features, network, integration) as a function of tensors of fixed shapes.

It waits for nothing on the host and no shape in it depends on a value, so that a CUDA graph can hold it and a compiler
needs to see it once. Its result is that of :meth:`hood.dynamics.simulator.Simulator.predict` up to rounding.
"""

from __future__ import annotations

import copy
from dataclasses import fields, replace
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from hood.dynamics.simulator import Simulator
from hood.features.inputs import EdgeRows, Inputs
from hood.graph.fixed import Layout, build_fixed_graph
from hood.losses.problem import StepProblem
from hood.scene.contact import find_nearest
from hood.scene.state import Obstacle, State

Item = TypeVar("Item")
_OBSTACLE = tuple(field.name for field in fields(Obstacle))


class StepResult(NamedTuple):
    """What a step leaves on the device."""

    next_pos: Tensor  # (V, 3) m
    acc: Tensor  # (V, 3) m/s²
    next_vel: Tensor  # (V, 3) m/s
    num_found: Tensor  # (2,) body edges and active body vertices; a step with more than it has places for is to be repeated


class FixedStep:
    """``StepResult(*step(*step_inputs(problem)))`` for problems like the one it was made for: same cloth, same attachments,
    same fields, same shapes.

    Everything else (weights, statistics, the cloth) is read when the step is made or later, and must not change.

    Args:
        simulator: in evaluation mode.
        layout: sizes of its graphs.
        like: such a problem.
        dense: search all pairs on a CPU too, as on any other device: what is traced there must not leave torch.

    Raises:
        ValueError: the model asks for more than nearest body vertices, or counts statistics.
    """

    def __init__(self, simulator: Simulator, layout: Layout, like: StepProblem, dense: bool = False) -> None:
        check_model(simulator)
        self.simulator, self.layout, self.dense = simulator, layout, dense
        self._like = like
        self._rows = self._edge_rows()

    def __call__(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """The fields of :class:`StepResult` from :func:`step_inputs`."""
        simulator, problem = self.simulator, self._problem(inputs)
        seen = simulator.rules.stand(self._in_frames(problem))
        cloth, obstacle = seen.cloth, seen.step.obstacle
        nearest = None
        if obstacle is not None:
            nearest = find_nearest(cloth, seen.state.pos, obstacle, simulator.body_radius, self.dense)
        graph = build_fixed_graph(self.layout, obstacle, nearest, simulator.body_radius)
        base = simulator.output.base(seen)
        given = Inputs(cloth, seen.state, seen.step, None, graph, timestep=problem.step.dt, edge_rows=self._rows)
        raw = simulator.network(graph, *simulator.features(given))
        prediction = simulator.integrate(problem, base, raw)
        velocity = simulator.next_velocity(problem, prediction)
        return prediction.next_pos, prediction.acc, velocity, graph.num_found

    def _problem(self, inputs: tuple[Tensor, ...]) -> StepProblem:
        pos, vel, dt, *rest = inputs
        like, values = self._like.step, iter(rest)
        pins = None if like.pin_target is None else next(values)
        obstacle = like.obstacle
        if obstacle is not None:
            present = {name: next(values) for name in _OBSTACLE if getattr(obstacle, name) is not None}
            obstacle = _altered(obstacle, **present)
        step = _altered(like, dt=dt, pin_target=pins, obstacle=obstacle)
        return _altered(self._like, state=State(pos, vel, self._like.state.origin), step=step, contact=None)

    def _in_frames(self, problem: StepProblem) -> StepProblem:
        frame_dt = self.simulator.rules.frame_dt
        if frame_dt is None:
            return problem
        return _altered(problem, step=_altered(problem.step, dt=torch.full_like(problem.step.dt, frame_dt)))

    @torch.no_grad()
    def _edge_rows(self) -> EdgeRows:
        """Kept by the step, with the columns that stay the same: the memory that a CUDA graph reads must not be given back,
        and what is computed for the first time while a function is traced has no values."""
        like = self._like
        graph = build_fixed_graph(self.layout, None, None, self.simulator.body_radius)
        given = Inputs(like.cloth, like.state, like.step, None, graph)
        given = replace(given, edge_rows=given.make_edge_rows())
        for group in self.simulator.features.edge:
            group(given)
        return given.edges


def check_model(simulator: Simulator) -> None:
    """Raise ValueError if the simulator's step has no form of fixed shapes."""
    if simulator.needs_contact:
        raise ValueError(
            "fixed-shape steps serve models that see the body by its nearest vertices (features=paper, output=acceleration); "
            "this one asks for contact with the body's surface: use step=plain"
        )
    if simulator.training:
        raise ValueError("fixed-shape steps are for inference: call simulator.eval() first")


def step_inputs(problem: StepProblem) -> list[Tensor]:
    """What may differ from step to step, in the order that :class:`FixedStep` takes it."""
    step, obstacle = problem.step, problem.step.obstacle
    values = [problem.state.pos, problem.state.vel, step.dt, step.pin_target]
    values += [] if obstacle is None else [getattr(obstacle, name) for name in _OBSTACLE]
    return [value for value in values if value is not None]


def step_shape(problem: StepProblem) -> tuple[Any, ...]:
    """Equal for problems whose inputs fit the same step."""
    step, obstacle = problem.step, problem.step.obstacle
    present = tuple(obstacle is not None and getattr(obstacle, name) is not None for name in _OBSTACLE)
    sizes = tuple((tuple(value.shape), value.dtype, value.device) for value in step_inputs(problem))
    return (step.pin_target is not None, present, sizes)


def _altered(item: Item, **values: Any) -> Item:
    """A copy with other fields; unlike ``dataclasses.replace`` it checks nothing, since a check would wait for the device."""
    altered = copy.copy(item)
    for name, value in values.items():
        object.__setattr__(altered, name, value)
    return altered
