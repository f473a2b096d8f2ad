"""Drag of the air, still, in a steady wind or in gusts.

Drag of the air at the centroids of faces: energy and derivatives in closed form.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor

from hood.energies.problem import StepProblem, sum_per_scene
from hood.energies.term import Energy, Form, Passes, Role

#: Waves that gusts are the sum of, and the band of their frequencies in units of 1/(2π gust_time).
_WAVES, _BAND = 24, (0.05, 20.0)


class DragRows(NamedTuple):
    """What the air does to faces; constant in a step. Faces without an area feel nothing."""

    normal: Tensor  # (F, 3) unit normals at t
    target: Tensor  # (F, 3) m, where the centroids would be if they went with the air
    across: Tensor  # (F,) J/m³, c of the energy c/3 |s|³ of the slip s along the normal
    along: Tensor  # (F,) J/m³, the same of the slip in the plane of the face


class Wind(Energy):
    """Drag of the air on every triangle, as a dissipative potential of the step [J]: dt Σ ½ ρ A (C_n |u_n|³ + C_t |u_t|³) / 3.

    u = (x̄ - x̄_t) / dt - w is the velocity of the triangle's centroid x̄ against the air, u_n and u_t its parts along the normal
    and in the plane. A triangle that meets the air at a right angle feels ½ ρ C_n A u² (Hoerner, "Fluid-Dynamic Drag", 1965):
    a flat sheet of m kg/m² falls at √(2 m g / (ρ C_n)) in the end. Areas A and normals are those at t. The energy is convex in
    the positions, so that light cloth in a strong wind does not ring, however long the step. Which way a face is wound plays no
    role. Lift, and the lee of the body and of other cloth, are not modelled.

    Gusts change the speed w along its direction: w (1 + g), g a sum of waves with the spectrum of Dryden, √⟨g²⟩ =
    ``gusts``, carried along with the mean wind (Taylor's frozen turbulence). The same seed gives the same gusts.

    Args:
        velocity: of the air [m/s], (3,).
        drag: C_n of a flat plate across the stream; 1.17 of a square one.
        friction: C_t of both sides together, along the stream.
        density: ρ of the air [kg/m³].
        gusts: turbulence intensity, the standard deviation of the speed as a share of it; 0.1 over open sea, 0.2 over fields.
        gust_time: [s] over which gusts forget themselves.
        seed: of the gusts.

    Raises:
        ValueError: a value that is not finite or out of range.
    """

    kind: ClassVar[str] = "Wind"
    role = Role.EXTERNAL
    form = Form.DRAG

    def __init__(
        self,
        velocity: Sequence[float] = (0.0, 0.0, 0.0),
        drag: float = 1.17,
        friction: float = 0.02,
        density: float = 1.2,
        gusts: float = 0.0,
        gust_time: float = 1.0,
        seed: int = 0,
    ) -> None:
        if len(velocity) != 3 or not all(math.isfinite(value) for value in velocity):
            raise ValueError(f"wind: velocity is {list(velocity)}; give three numbers [x, y, z] in m/s")
        for name, value in {"gusts": gusts, "gust_time": gust_time}.items():
            if isinstance(value, Tensor):
                raise ValueError(f"wind: {name} is a tensor, by which steps have no derivative; give a number")
        named = {"drag": drag, "friction": friction, "density": density, "gusts": gusts}
        for name, value in named.items():
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(f"wind: {name} is {value}; give a finite number >= 0")
        if not (math.isfinite(gust_time) and gust_time > 0):
            raise ValueError(f"wind: gust_time is {gust_time}; give seconds > 0")
        # A tensor stays one: steps are differentiated by it (hood.rollouts.differentiable).
        self.x, self.y, self.z = (value if isinstance(value, Tensor) else float(value) for value in velocity)
        self.drag, self.friction, self.density = drag, friction, density
        self.gusts, self.gust_time, self.seed = gusts, gust_time, seed
        self._waves = _dryden(gusts, gust_time, seed) if gusts > 0 else None

    def applies(self, problem: StepProblem) -> bool:
        return self.density > 0 and (self.drag > 0 or self.friction > 0)

    def __call__(self, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> Tensor:
        """Energy [J] (B,) at ``next_pos`` (V, 3)."""
        rows, cloth = self.rows(problem), problem.cloth
        slip = next_pos[cloth.faces].mean(dim=1) - rows.target
        across = (slip * rows.normal).sum(dim=1)
        along = slip - across.unsqueeze(1) * rows.normal
        square = (along * along).sum(dim=1)
        slips = square > 0  # the second derivative of the power is not a number at 0
        cubed = torch.where(slips, torch.where(slips, square, 1.0) ** 1.5, 0.0)
        energy = rows.across * across.abs() ** 3 + rows.along * cubed
        return sum_per_scene(energy / 3.0, cloth.face_scene, cloth.num_scenes)

    def rows(self, problem: StepProblem) -> DragRows:
        """What the air does to the faces in a step."""
        cloth, dt = problem.cloth, problem.step.dt[problem.cloth.face_scene]
        corners = problem.state.pos[cloth.faces]
        cross = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        twice = cross.norm(dim=1)
        proper = twice > torch.finfo(twice.dtype).tiny
        normal = cross / torch.where(proper, twice, 1.0).unsqueeze(1)
        pressure = torch.where(proper, 0.25 * self.density * twice / dt**2, 0.0)
        centre = corners.mean(dim=1)
        target = centre + dt.unsqueeze(1) * self.air(problem, centre)
        return DragRows(normal, target, self.drag * pressure, self.friction * pressure)

    def air(self, problem: StepProblem, place: Tensor) -> Tensor:
        """Velocity of the air [m/s] (F, 3) at places (F, 3) of the faces, at the end of the step."""
        # No tensor comes from the host: a step may be recorded.
        mean = torch.stack([torch.zeros_like(place[:, 0]) + value for value in (self.x, self.y, self.z)], dim=1)
        square = self.x**2 + self.y**2 + self.z**2
        if self._waves is None or square == 0.0:
            return mean.expand_as(place)
        scene, step, origin = problem.cloth.face_scene, problem.step, problem.state.origin
        time = step.dt.new_zeros(len(step.dt)) if step.time is None else step.time
        # Seconds by which the air is there later than at the world's origin.
        late = ((place + origin.to(place)[scene]) * mean).sum(dim=1) / square
        frequency, size, phase = (wave.to(place) for wave in self._waves)
        since = (time.to(place)[scene] - late).unsqueeze(1)
        gust = (size * torch.sin(frequency * since + phase)).sum(dim=1)
        return (1.0 + gust).unsqueeze(1) * mean

    def varies_in_time(self) -> bool:
        return self.gusts > 0

    def closed_form(self, problem: StepProblem, passes: Passes | None = None) -> Drag:
        """The drag on the faces of a step, at their centroids."""
        return Drag(*self.rows(problem))


def air(velocity: float | str | Sequence[float] | None = None, **settings: Any) -> Wind | None:
    """The term of a config; None, which a potential leaves out, where there is no air.

    Args:
        velocity: [m/s] (3,), or a number: towards -z, against the front of a body that looks along z; None for no air, as
            ``"auto"`` is here, which ``hood rollout`` settles (:func:`hood.app.stepping.steppers.air_of`).
        settings: of :class:`Wind`.

    Raises:
        ValueError: a value that is not finite or out of range, or gusts without a wind.
    """
    gusts = settings.get("gusts", 0.0)
    if velocity is None or velocity == "auto":
        if gusts:
            raise ValueError(
                f"wind: gusts is {gusts}, but there is no wind that they could be a share of; give wind=3, or "
                "losses.terms.air.gusts=0"
            )
        return None
    if isinstance(velocity, (int, float)) and not isinstance(velocity, bool):
        velocity = (0.0, 0.0, 0.0 - float(velocity))
    if isinstance(velocity, (bool, str)) or not all(isinstance(value, (int, float)) for value in velocity):
        raise ValueError(f"wind={velocity}: give m/s, a number (wind=3) or three (wind=[3,0,0])")
    return Wind(velocity, **settings)


def _dryden(intensity: float, time: float, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Angular frequencies [1/s], amplitudes and phases of gusts (:data:`_WAVES`,): S(ω) ~ 1 / (1 + (ω T)²)."""
    rng = np.random.default_rng(seed)
    edges = np.geomspace(*_BAND, _WAVES + 1) / time
    frequency = rng.uniform(edges[:-1], edges[1:])
    power = np.arctan(edges[1:] * time) - np.arctan(edges[:-1] * time)
    size = intensity * np.sqrt(2.0 * power / power.sum())
    return tuple(torch.from_numpy(part) for part in (frequency, size, rng.uniform(0.0, 2.0 * np.pi, _WAVES)))  # type: ignore[return-value]


@dataclass(frozen=True)
class Drag:
    """A drag term on N points; see :class:`hood.energies.wind.DragRows`."""

    normal: Tensor  # (N, 3)
    target: Tensor  # (N, 3) m
    across: Tensor  # (N,) J/m³
    along: Tensor  # (N,) J/m³

    def take(self, rows: Tensor) -> Drag:
        """Those of some points."""
        return Drag(self.normal[rows], self.target[rows], self.across[rows], self.along[rows])

    def energy(self, pos: Tensor) -> Tensor:
        """Energy [J] (N,) at ``pos`` (N, 3)."""
        _, across, size, _ = self._slip(pos)
        return (self.across * across.abs() ** 3 + self.along * size**3) / 3.0

    def derivatives(self, pos: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient [N] (N, 3) and second derivative [N/m] (N, 3, 3), which is positive, at ``pos`` (N, 3)."""
        slip, across, size, heading = self._slip(pos)
        pressed, dragged = self.across * across.abs(), self.along * size
        gradient = (pressed * across)[:, None] * self.normal + dragged[:, None] * slip
        matrix = torch.diag_embed(dragged[:, None].expand(-1, 3))
        matrix = matrix + _outer((2.0 * pressed - dragged)[:, None] * self.normal, self.normal)
        return gradient, matrix + _outer(dragged[:, None] * heading, heading)

    def _slip(self, pos: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Slip in the plane (N, 3) [m], slip along the normal (N,), size and heading (N, 3) of the former."""
        slip = pos - self.target
        across = torch.mv(slip * self.normal, slip.new_ones(3))
        slip = slip - across[:, None] * self.normal
        size = torch.mv(slip * slip, slip.new_ones(3)).sqrt()
        return slip, across, size, slip / torch.where(size > 0, size, 1.0)[:, None]


def _outer(a: Tensor, b: Tensor) -> Tensor:
    return a[:, :, None] * b[:, None, :]
