"""A frame of a rollout, and what is measured in it.

How a garment sits on a body: its distance to the skin, how far it is stretched, how far it has slid down; in one word.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from torch import Tensor

from hood.cloth.cloth import Cloth
from hood.cloth.state import State
from hood.contact.contact import Contact, find_contact
from hood.energies.potential import Potential
from hood.energies.problem import StepProblem
from hood.energies.self_contact import has_layers
from hood.rollouts.verdict.distance import DISTANCE_METRICS
from hood.rollouts.verdict.surface import SURFACE_METRICS, SurfaceMeter
from hood.scene.scene import Scene
from hood.solver.step_figures import (
    LAYER_METRICS,
    PENETRATION_METRICS,
    STRAIN_METRICS,
    edge_strain,
    penetration_metrics,
    strain_metrics,
)
from hood.steppers.newton import Stepper


@dataclass(frozen=True)
class Frame:
    """One frame of a rollout."""

    index: int  # from 0
    state: State  # the simulated cloth, at the precision of the simulation
    world_pos: Tensor  # (V, 3) m float64
    body_pos: Tensor  # (W, 3) m float64
    metrics: dict[str, float]  # by name: strain_p99 [1], relative_gradient [1], energy_… [J], ms_… [ms], …
    fields: dict[str, Tensor] = field(default_factory=dict)  # (V,) by name, of the step that led here; NaN in frame 0
    simulated: bool = True  # False: between two simulated frames, see :mod:`hood.rollouts.frames`
    far: bool = False  # the step that led here ended far from its minimum: the next one is measured too


#: What is measured of a frame besides its time and what the stepper reports: strain, penetration, cut surface and energies,
#: strain alone, or nothing. Only ``all`` needs contact with the body's surface.
METRIC_CHOICES = ("all", "strain", "none")
#: What can be had of every vertex: the relative gradient, see :func:`hood.solver.step_figures.vertex_residual`.
FIELD_CHOICES = ("rg",)
#: How frame 0 is made, see :func:`simulate`, and what frame 0 says of an equilibrium.
SETTLE_CHOICES = ("equilibrium", "paper")
SETTLE_METRICS = ("settle_steps", "settle_seconds", "settle_speed", "settle_reached", "settle_away", "settle_sunk")


def metric_names(
    potential: Potential, stepper: Stepper, metrics: str = "all", settle: str = "paper", guarded: bool = False
) -> tuple[str, ...]:
    """Every metric a frame of a rollout can have, for one of :data:`METRIC_CHOICES` and of :data:`SETTLE_CHOICES`, with a guard
    or without."""
    energies = (
        *(f"energy_{name}" for name in potential.terms),
        "energy_total",
        "energy_inertial_guess",
        "gradient_norm",
        "relative_gradient",
        "e0",
    )
    measured = {
        "all": (*STRAIN_METRICS, *PENETRATION_METRICS, *SURFACE_METRICS, *DISTANCE_METRICS, *energies),
        "strain": STRAIN_METRICS,
        "none": (),
    }
    layers = LAYER_METRICS if has_layers(potential) else ()
    settled = SETTLE_METRICS if settle == "equilibrium" else ()
    own = (*layers, *stepper.metrics, *settled)
    times = (*stepper.times, *(["guard"] if guarded else []), "metrics")
    return (*measured[metrics], *own, *(f"ms_{part}" for part in times))


def _is_measured(index: int, count: int, stride: int) -> bool:
    """Whether a frame of ``count`` is one in which what takes longer is measured."""
    return index % stride == 0 or index + 1 == count


def _with_guard(lap: dict[str, float], spent: float) -> dict[str, float]:
    """A frame's times with those of its guard."""
    return {**lap, "guard": spent, "total": lap["total"] + spent}


def _times(stepper: Stepper, lap: dict[str, float]) -> dict[str, float]:
    """The parts that the stepper names, and the guard's; the others (posing the body) go to the rest."""
    named = (*stepper.times, *(["guard"] if "guard" in lap else []))
    times = {part: lap.get(part, 0.0) for part in named}
    times["rest"] += sum(value for part, value in lap.items() if part not in times)
    return {f"ms_{part}": value for part, value in times.items()}


def _state_metrics(
    scene: Scene, cloth: Cloth, state: State, frame: int, problem: StepProblem | None, metrics: str
) -> dict[str, float]:
    """Strain and penetration at ``frame``, as far as ``metrics`` asks for them, of the ``cloth`` there; ``problem`` is the step
    from there."""
    measured = {} if metrics == "none" else strain_metrics(cloth, state.pos)
    if metrics == "all":
        contact = _contact_now(scene, state, frame) if problem is None else problem.with_contact().contact
        measured |= penetration_metrics(contact, scene.cloth)
    return measured


def _surface_now(meter: SurfaceMeter, scene: Scene, state: State, frame: int) -> dict[str, float]:
    return meter(state.pos.cpu().numpy(), scene.motion.surface(frame, state.origin[0].numpy()).cpu().numpy())


def _contact_now(scene: Scene, state: State, frame: int) -> Contact | None:
    obstacle = scene.motion.obstacle(frame, state.origin[0].numpy(), static=True)
    return None if obstacle is None else find_contact(state.pos, scene.cloth.vertex_scene, obstacle)


#: Edges at the skin that are stretched by so much on average are tight: figures in hood/studies/notes/sizes.md.
TIGHT = 0.04
#: A garment whose upper rim is so far [m] below its place has come off.
FALLEN = 0.1
#: The upper rim: this share of the vertices that can move, the highest as worn.
_RIM = 0.1
#: Cloth within this distance [m] of the skin lies on it.
_ON_SKIN = 5e-3

FITS, IS_TIGHT, FALLS_OFF = "fits", "tight", "falls off"


@dataclass(frozen=True)
class Ease:
    """How a garment sits in one frame.

    Args:
        gap: 5th percentile, median and 95th of the distances [m] of its vertices from the skin, of those within the reach of
            the search (a decimetre); NaN without any.
        on_skin: share of its vertices that lie on the skin.
        stretch: mean relative lengthening of the edges on the skin, shortened ones as 0.
        slid: mean height [m] of the upper rim below its place as worn; negative above it.
    """

    gap: tuple[float, float, float]
    on_skin: float
    stretch: float
    slid: float

    @property
    def word(self) -> str:
        """``fits``, ``tight`` or ``falls off``."""
        if not self.slid <= FALLEN:
            return FALLS_OFF
        return IS_TIGHT if self.stretch > TIGHT else FITS


def measure_ease(scene: Scene, cloth: Cloth, state: State, frame: int) -> Ease | None:
    """Of the ``cloth`` at ``state`` on the body of ``frame``; None without a body."""
    origin = state.origin[0].numpy()
    obstacle = scene.motion.obstacle(frame, origin, static=True)
    if obstacle is None:
        return None
    contact = find_contact(state.pos, cloth.vertex_scene, obstacle)
    near = contact.valid.cpu().numpy()
    dist = np.where(near, contact.dist.cpu().double().numpy(), np.inf)
    low, middle, high = np.percentile(dist[near], [5, 50, 95]) if near.any() else [np.nan] * 3
    on_skin = dist < _ON_SKIN
    edges = cloth.edges.cpu().numpy()
    touching = on_skin[edges].all(axis=1)
    strain = edge_strain(cloth, state.pos).cpu().double().numpy().clip(min=0.0)[touching]
    free = cloth.free.cpu().numpy()
    worn = scene.motion.skinned(scene.garment, frame, origin)
    place, height = (values[:, 1].cpu().double().numpy()[free] for values in (worn, state.pos))
    rim = np.argsort(-place, kind="stable")[: max(1, round(_RIM * len(place)))]
    below = place[rim] - height[rim]
    return Ease(
        gap=(float(low), float(middle), float(high)),
        on_skin=float(on_skin.mean()),
        stretch=float(strain.mean()) if len(strain) else 0.0,
        slid=float(below.mean()) if len(below) else 0.0,
    )
