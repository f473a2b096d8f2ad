"""The learned step: contact search, features, network, next positions. The model is what a checkpoint holds."""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from hood.cloth.cloth import Cloth
from hood.cloth.state import State, StepInput
from hood.contact.contact import Contact, SecondContact, find_nearest
from hood.energies.potential import Potential, default_potential
from hood.energies.problem import StepProblem
from hood.mesh.closest_point.vertices import Nearest
from hood.model.features import compiled
from hood.model.features.feature_set import FeatureSet
from hood.model.features.inputs import EdgeRows, Inputs
from hood.model.graph.builder import (
    Graph,
    StaticGraph,
    build_graph,
    build_static,
    edge_set_names,
    find_near_cloth,
    parse_passes,
    parse_schedule,
    set_level,
)
from hood.model.graph.hierarchy import Hierarchy, concatenate_hierarchies, num_passed_over
from hood.model.graph.known_hierarchies import template_hierarchy
from hood.model.network.model import MeshGraphNet
from hood.model.parts import MULTILEVEL, OUTPUTS, SETS, SetSettings, build_features, network_class, output_class, split_name
from hood.model.readout.network_step import Dirichlet, Feedback, NetworkStep
from hood.model.readout.output import Output, OutputSettings
from hood.native import features as native
from hood.solver.vertex.block_jacobi import LocalTerms, check_local
from hood.steppers.protocol import FrameRules, Relaxing, Stopwatch, timed
from hood.steppers.ranges import Conditions
from hood.tensors.batch import to_device
from hood.tensors.dense import is_followed, unfollowed


@dataclass(frozen=True)
class Prepared:
    """What the simulator needs to know about a cloth, computed once: its hierarchy and static graph."""

    hierarchy: Hierarchy
    static: StaticGraph | None = None  # None inside a batch that is still to be put together

    def to(self, device: torch.device | str) -> Prepared:
        """The same with the graph on ``device``; the hierarchy stays where it is."""
        static = self.static
        if static is None:
            return self
        sets = {name: to_device(edges, device) for name, edges in static.edge_sets.items()}
        return replace(self, static=replace(to_device(static, device), edge_sets=sets))


@dataclass(frozen=True)
class Prediction:
    """One predicted step."""

    next_pos: Tensor  # (V, 3) m, local
    acc: Tensor  # (V, 3) m/s², such that next_pos = pos + dt vel + dt² acc
    metrics: dict[str, float] = field(default_factory=dict)  # what the stepper itself has to report
    residual: float = math.nan  # relative gradient at next_pos; NaN where the step does not know it
    #: Of models in several passes: (V, 3) m after every pass but the last, and the forces (V, 3) N there.
    early: tuple[tuple[Tensor, Tensor], ...] = ()
    entered: SecondContact | None = None  # the second contacts that it was taken with, where the step had led into skin first
    held_off: Contact | None = None  # the contact that it was taken with, where it had left triangles in the skin first


class NetworkInputs(NamedTuple):
    """What a network is shown of a step."""

    inputs: Inputs
    force: Tensor | None  # (V, 3) N, −∂Φ/∂x at the base, where there is feedback
    base: Tensor  # (V, 3) m, what its output is relative to
    feedback: Feedback | None  # what it is told between its passes


class NetworkStepper(nn.Module):
    """``State → State``: next_state = simulator.step(cloth, prepared, state, step_input).

    :func:`build_simulator` builds it; ``config`` holds that call's arguments and travels with the weights."""

    gravity: Tensor  # (3,) m/s²
    times: tuple[str, ...] = ("search", "features", "network", "rest", "total")  # parts of a frame's time
    metrics: tuple[str, ...] = ()  # names of the entries of ``Prediction.metrics``
    memoryless = True

    def __init__(
        self,
        features: FeatureSet,
        network: MeshGraphNet,
        output: Output,
        body_radius: float,
        config: dict[str, Any],
        rules: FrameRules | None = None,
        embedded_levels: int = 1,
        layer_radius: float | None = None,
        coarse_edge: float | None = None,
    ) -> None:
        super().__init__()
        self.features, self.network, self.output = features, network, output
        self.body_radius, self.layer_radius, self.coarse_edge = body_radius, layer_radius, coarse_edge
        self.rules = rules or FrameRules()
        self._embedded_levels = embedded_levels
        self.config = config
        self.register_buffer("gravity", torch.tensor([0.0, -9.81, 0.0]), persistent=False)
        self.trained_for: Conditions | None = None  # None: unknown
        self.caution: str | None = None  # sentence that users of the weights are told
        self._potential = default_potential()
        self._wants_feedback = features.needs("feedback")
        self._wants_residual = not self._wants_feedback and features.needs("residual")
        self._wants_base = features.needs("base")

    @property
    def simulator(self) -> NetworkStepper:
        """Whoever takes its steps by a simulator has one."""
        return self

    @property
    def potential(self) -> Potential:
        """What the network is told of, where :attr:`looks_at_potential`."""
        return self._potential

    @property
    def looks_at_potential(self) -> bool:
        """Whether the network is told what the potential says about positions; another potential then changes its steps."""
        return self._wants_feedback or self._wants_residual

    def use_potential(self, potential: Potential) -> None:
        """Look at ``potential`` from now on, where :attr:`looks_at_potential`; until then at the default one.

        Who takes steps hands over what they are judged by: :func:`hood.rollouts.loop.simulate` the potential of the
        rollout, training the one that is trained.

        Raises:
            ValueError: the features cannot say what this potential does; names the term.
        """
        if self._wants_feedback:
            try:
                check_local(potential)
            except ValueError as error:
                raise ValueError(
                    f"{error}; models of features={self.config['features']} look at it: leave the term out, or use "
                    "stepper=newton or another model"
                ) from error
        self._potential = potential

    @property
    def schedule(self) -> tuple[tuple[str, ...], ...]:
        """The sets of edges of every message-passing step."""
        return self.network.schedule

    @property
    def num_coarse(self) -> int:
        """Coarse levels of the hierarchy that the model needs: those it works on and those its level feature tells apart."""
        return max(num_coarse_levels(self.schedule), self._embedded_levels - 1)

    def levels_passed_over(self, cloth: Cloth) -> int:
        """Levels of a garment that are finer than ``coarse_edge``."""
        return num_passed_over(cloth.mean_edge, self.coarse_edge)

    @property
    def uses_statistics(self) -> bool:
        """Whether normalisers must see data before training starts."""
        return self.output.collects_statistics or self.features.node_normalizer is not None

    @property
    def relaxing(self) -> Relaxing:
        """What a rollout makes of the relaxing step."""
        return self.rules.relaxing

    @property
    def velocity_columns(self) -> slice:
        """Columns of the node features that hold the velocity: both feature sets put it first."""
        return slice(0, 3)

    def prepare(self, cloth: Cloth, rest_pos: Any, hierarchy: Hierarchy | None = None) -> Prepared:
        """Hierarchy and static graph of one garment; ``rest_pos`` (V, 3) orders its vertices.

        A ``hierarchy`` that came with the garment (:func:`hood.model.graph.known_hierarchies.given_hierarchy`) is used as it
        is.
        """
        if hierarchy is None:
            edges, passed_over = cloth.edges.cpu().numpy(), self.levels_passed_over(cloth)
            hierarchy = template_hierarchy(cloth.num_vertices, edges, rest_pos, self.num_coarse, passed_over)
        return Prepared(hierarchy, build_static(cloth, hierarchy, self.network.edge_set_names))

    def concatenate(self, cloth: Cloth, prepared: Sequence[Prepared], vertex_counts: Sequence[int]) -> Prepared:
        """The same for a flat batch ``cloth`` of several garments."""
        hierarchy = concatenate_hierarchies([item.hierarchy for item in prepared], vertex_counts)
        return Prepared(hierarchy, build_static(cloth, hierarchy, self.network.edge_set_names))

    @property
    def needs_contact(self) -> bool:
        """Whether the step asks for contact with the body's surface; the paper's needs the nearest body vertices alone."""
        return self.output.needs_contact or self.features.needs("contact")

    def search(self, problem: StepProblem) -> StepProblem:
        """The problem with its contact where the step needs it, and with what the potential asks for that it looks at;
        :meth:`predict` does so if it has not been done."""
        problem = problem.with_contact() if self.needs_contact else problem
        return self._potential.prepare(problem) if self.looks_at_potential else problem

    def nearest(self, problem: StepProblem, seen: StepProblem) -> Nearest | None:
        """Nearest body vertices of the positions the network sees: those of the contact, where that is of the same ones."""
        obstacle = seen.step.obstacle
        if obstacle is None:
            return None
        if seen.contact is not None and seen.state is problem.state:
            return seen.contact.nearest
        return find_nearest(seen.cloth, seen.state.pos, obstacle, self.body_radius)

    def near_cloth(self, seen: StepProblem) -> Tensor | None:
        """Cloth near cloth (E, 2) at the positions that the network sees; None for models that know no such edges."""
        return None if self.layer_radius is None else find_near_cloth(seen.cloth, seen.state.pos, self.layer_radius)

    def predict(self, problem: StepProblem, prepared: Prepared, watch: Stopwatch | None = None) -> Prediction:
        """Positions at t + 1. Pinned vertices reach their targets exactly, massless ones stay where they are.

        Without a gradient and on a CPU features and feedback are computed by the compiled library where there is a compiler.
        """
        with native.in_torch(torch.is_grad_enabled()):
            return self._predict(problem, prepared, watch)

    def _predict(self, problem: StepProblem, prepared: Prepared, watch: Stopwatch | None) -> Prediction:
        assert prepared.static is not None
        with timed(watch, "search"):
            problem = self.search(problem)
            seen = self.rules.enter(problem)
            nearest, layers = self.nearest(problem, seen), self.near_cloth(seen)
        with timed(watch, "features"):
            graph = build_graph(prepared.static, seen.step, nearest, self.body_radius, layers=layers)
            sight = self.look(problem, seen, graph)
            features = self.features(sight.inputs, compiled.COMPILED_COLUMNS if compiled.applies(sight.inputs) else None)
        with timed(watch, "network"):
            return self.advance(problem, seen, sight, *features)

    @unfollowed
    def look(
        self,
        problem: StepProblem,
        seen: StepProblem,
        graph: Graph,
        potential: Potential | None = None,
        edge_rows: EdgeRows | None = None,
    ) -> NetworkInputs:
        """What the features are computed from.

        Args:
            seen: the problem as the network sees it, with its contact where :attr:`needs_contact`.
            graph: of ``seen``.
            potential: what the network is told of, instead of the one that it was given.
            edge_rows: see :class:`hood.model.features.inputs.Inputs`.
        """
        potential = potential or self._potential
        base = self.output.base(seen)
        residual = self._residual_acceleration(potential, seen, base) if self._wants_residual else None
        guess, dt = base if self._wants_base else None, problem.step.dt
        inputs = Inputs(
            seen.cloth, seen.state, seen.step, seen.contact, graph, guess, residual, timestep=dt, edge_rows=edge_rows
        )
        if not self._wants_feedback:
            return NetworkInputs(inputs, None, base, None)
        together = self.features.needs("global_step")
        feedback = Feedback(potential, seen, together, together and self.training, self.output.view_steps)
        held_back = self.output.held_back(seen, base) if together else None
        return NetworkInputs(*feedback(inputs, base, held_back), base, feedback)

    def advance(
        self, problem: StepProblem, seen: StepProblem, sight: NetworkInputs, nodes: Tensor, edges: dict[str, Tensor]
    ) -> Prediction:
        """Positions at t + 1 from the features of what was looked at."""
        free, fixed = problem.cloth.free, self._fixed(problem)
        shown = (sight.inputs, nodes, edges, sight.base, Dirichlet(free, fixed), sight.force, sight.feedback)
        moved = self.output.move(NetworkStep(self.network, seen, *shown))
        acc = problem.acceleration(moved.pos if moved.displacement is None else fixed)
        if moved.displacement is not None:
            acc = torch.where(free.unsqueeze(1), self.rules.acceleration(problem, moved.displacement), acc)
        return Prediction(moved.pos, acc, early=moved.early)

    def _fixed(self, problem: StepProblem) -> Tensor:
        """(V, 3) m: targets of pinned vertices, present places of the others."""
        target = problem.step.pin_target
        if target is None:
            return problem.state.pos
        return torch.where(problem.cloth.pinned.unsqueeze(1), target, problem.state.pos)

    def forward(self, problem: StepProblem, prepared: Prepared, watch: Stopwatch | None = None) -> Prediction:
        """The same as :meth:`predict`; the call that wrappers such as DistributedDataParallel see."""
        return self.predict(problem, prepared, watch)

    def next_velocity(self, problem: StepProblem, prediction: Prediction) -> Tensor:
        """(V, 3) m/s at t + 1 of the implicit Euler step: (x_{t+1} − x_t) / dt."""
        return self.rules.next_velocity(problem, prediction.acc)

    def step(self, cloth: Cloth, prepared: Prepared, state: State, step: StepInput) -> State:
        """The state at t + 1."""
        problem = StepProblem(cloth, state, step, gravity=self.gravity.to(state.pos))
        prediction = self.predict(problem, prepared)
        return State(prediction.next_pos, self.next_velocity(problem, prediction), state.origin)

    def clone(self) -> NetworkStepper:
        """A new simulator of the same model with the same weights, which looks at the same potential."""
        # A copy must not move the generator that a resumed run shares with an uninterrupted one.
        with torch.random.fork_rng(devices=[]):
            copy = build_simulator(**self.config)
        copy.load_state_dict(self.state_dict())
        copy.network.use_precision(self.network.precision)
        copy.network.use_kernels(self.network.kernels)
        copy.use_potential(self._potential)
        copy.trained_for, copy.caution = self.trained_for, self.caution
        return copy.to(self.gravity.device)

    def _residual_acceleration(self, potential: Potential, problem: StepProblem, base: Tensor) -> Tensor:
        force = LocalTerms(potential, problem)(base).force if is_followed() else -potential.gradient(problem, base)[0]
        return force / problem.cloth.mass.clamp_min(1e-12).unsqueeze(1) * problem.cloth.free.unsqueeze(1)


def build_simulator(
    features: str = "paper",
    output: str = "acceleration",
    schedule: str = "ours",
    latent_dim: int = 128,
    aggregation: str = "sum",
    body_radius: float = 0.03,
    output_scale: float = 5e-3,
    output_init: float | None = None,
    normalizer_decay: float = 0.999,
    body_velocity: str = "previous",
    embedded_levels: int | None = None,
    coarse_encoders: int | None = None,
    divisor_floor: float | None = None,
    frame_dt: float | None = None,
    pins_ahead: bool = False,
    velocity: str = "displacement",
    late_scale: float = 1e-3,
    layer_radius: float | None = None,
    network: str = MULTILEVEL,
    output_options: Mapping[str, Any] | None = None,
    coarse_edge: float | None = None,
) -> NetworkStepper:
    """A simulator from plain arguments.

    The arguments from ``body_velocity`` on are conventions of earlier weights; their defaults are the project's own and leave
    no trace in ``config``.

    Args:
        features: ``paper`` (node 24, edge 12, body edge 9, running statistics), ``physical`` (fixed scales, residual) or
            ``local`` (the same with what every vertex and its neighbourhood would do about the residual); ``+NAME`` behind it
            adds a group of a plugin.
        output: ``acceleration`` (paper), ``velocity_base`` (corrections to a base that moves with the body),
            ``local_steps`` (several such corrections with shares of the vertices' own steps; features=local),
            ``global_steps`` (several corrections to the forces, each with a solve for the step of all vertices together;
            features=local) or ``edges`` (corrections to the edges of the base, and a linear solve for the positions;
            features=physical or local); or the name of a plugin's.
        schedule: name (``ours``, ``fine15``, ``fine48``) or text such as ``3x(mesh+coarse0) 3x(coarse0)``; ``|`` between
            passes (``local_steps`` and ``global_steps`` only).
        latent_dim: width of all latents.
        aggregation: ``sum`` or ``mean`` of the messages at a node.
        body_radius: reach of body edges [m].
        output_scale: displacement [m] of one unit of raw output (``velocity_base``; ``local_steps`` in the first pass; of the
            anchors of ``edges``).
        output_init: factor on the decoder's last layer at the start; None: 1.
        normalizer_decay: decay of the exponentially weighted statistics (``paper`` features); 0: plain sums over all rows.
        body_velocity: displacement of the body that its nodes see: from the ``previous`` frame or to the ``next``
            (``paper`` features).
        embedded_levels: levels that the level feature tells apart, the mesh included; None: those the schedule works on.
        coarse_encoders: encoders for coarse edges, see :class:`hood.model.network.model.MeshGraphNet`; None: one per set.
        divisor_floor: least divisor of the statistics, see :class:`hood.model.features.normalizer.RunningNormalizer`.
        frame_dt, pins_ahead, velocity: see :class:`hood.steppers.protocol.FrameRules`.
        late_scale: as ``output_scale``, in the later passes of ``local_steps``.
        layer_radius: reach [m] of edges between layers of cloth, which have networks of their own
            (:func:`hood.model.graph.builder.find_near_cloth`); None: the model has none.
        network: ``multilevel``, or the name of a plugin's.
        output_options: further arguments of the output's class, plain values by name.
        coarse_edge: length [m] that edges of the first coarse level have at least, on average: finer levels are passed over,
            so that messages reach as far on fine meshes as on coarse ones; None: no level is.

    Raises:
        ValueError: values that do not fit together, or a name that nothing has; names the key.
    """
    output_init = 1.0 if output_init is None else output_init
    config = {name: value for name, value in locals().items() if name not in _CONVENTIONS or value != _CONVENTIONS[name]}
    for name in ("latent_dim", "body_radius", "output_scale", "late_scale", "layer_radius", "coarse_edge"):
        if name in config and not (isinstance(config[name], (int, float)) and config[name] > 0):
            raise ValueError(f"model.{name} is {config[name]!r}; it must be a number > 0")
    head, net = output_class(output), network_class(network)
    told, _ = split_name(features)
    if told in SETS and told not in head.feature_sets:
        others = " or ".join(name for name, kind in OUTPUTS.items() if told in kind.feature_sets)
        raise ValueError(
            f"model.features={features} with model.output={output}: this output needs "
            f"{' or '.join(f'model.features={name}' for name in head.feature_sets)}, these features model.output={others}"
        )
    if len(parse_passes(schedule)) > 1 and not head.several_passes:
        able = " or ".join(name for name, kind in OUTPUTS.items() if kind.several_passes)
        raise ValueError(f"model.schedule has several passes (|); they need model.output={able}, not {output}")
    for name, count in (("embedded_levels", embedded_levels), ("coarse_encoders", coarse_encoders)):
        if count is not None and count < 1:
            raise ValueError(f"model.{name} is {count!r}; it must be at least 1, or null for the model's own number")
    rules = FrameRules(frame_dt, pins_ahead, velocity)
    num_levels = 1 + num_coarse_levels(parse_schedule(schedule)) if embedded_levels is None else embedded_levels
    layers = layer_radius is not None
    of_edges = head.sees_global_step and head.edge_width > 0
    of_set = SetSettings(num_levels, layers, head.sees_global_step, of_edges, body_velocity, normalizer_decay, divisor_floor)
    feature_set = build_features(features, of_set)
    of_output = OutputSettings(output_scale, late_scale, normalizer_decay, divisor_floor)
    made = head.from_settings(of_output, output_options or {})
    widths = (feature_set.node_width, feature_set.edge_widths)
    built = net(
        *widths, latent_dim, schedule, head.width, aggregation, output_init, coarse_encoders, head.look_widths, head.edge_width
    )
    return NetworkStepper(feature_set, built, made, body_radius, config, rules, num_levels, layer_radius, coarse_edge)


#: Arguments of :func:`build_simulator` that are written down only where they differ from its defaults: files of models that
#: follow the project's own conventions stay readable by versions that know no other.
_CONVENTIONS: dict[str, Any] = {
    name: parameter.default
    for name, parameter in inspect.signature(build_simulator).parameters.items()
    if name
    in (
        "body_velocity",
        "embedded_levels",
        "coarse_encoders",
        "divisor_floor",
        "frame_dt",
        "pins_ahead",
        "velocity",
        "late_scale",
        "layer_radius",
        "network",
        "output_options",
        "coarse_edge",
    )
}


def num_coarse_levels(schedule: Sequence[tuple[str, ...]]) -> int:
    """Coarse levels that a schedule works on."""
    return max(set_level(name) for name in edge_set_names(schedule))
