"""What the incremental potential of one step depends on, apart from the unknown next positions."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from hood.cloth.cloth import Cloth
from hood.cloth.state import State, StepInput
from hood.contact.contact import Contact, SecondContact, find_contact
from hood.contact.further import find_entered, find_second_side, hold_off, num_in_skin, signed_distance
from hood.contact.sample_points import PointContact, find_point_contact
from hood.contact.self_contact import LayerPairs, SceneLayers, find_layers, find_sides, late_targets
from hood.tensors.dense import sum_scenes

#: Standard gravity [m/s²], y up.
STANDARD_GRAVITY = 9.81


def _standard_gravity() -> Tensor:
    return torch.tensor([0.0, -STANDARD_GRAVITY, 0.0])


@dataclass(frozen=True)
class StepProblem:
    """One implicit step t → t+1 of B scenes; everything in it is constant while the next positions vary.

    ``contact`` is None without a body, and until somebody who needs it asks for :meth:`with_contact`; ``point_contacts`` holds
    what terms asked for by :meth:`with_points`, ``fold`` contact with the other side of folds of the body where
    :meth:`with_fold` was asked for, ``layers`` the cloth near cloth where :meth:`with_layers` was asked for, ``sides`` its
    sides where :meth:`with_sides` was.
    ``internal_force`` are the forces at x_t of everything but inertia, weight and the body, by which the cloth around a vertex
    presses it onto the skin; None where nobody has asked :meth:`hood.energies.potential.Potential.with_internal_force`.
    """

    cloth: Cloth  # topology, rest shape and fabric
    state: State  # at t
    step: StepInput  # what is prescribed for t → t + 1
    contact: Contact | None = None  # with the body
    gravity: Tensor = field(default_factory=_standard_gravity)  # (3,) m/s²
    point_contacts: tuple[PointContact, ...] = ()  # with the body, at points inside edges and faces
    internal_force: Tensor | None = None  # (V, 3) N
    layers: tuple[SceneLayers, ...] = ()  # one per scene, or none
    sides: LayerPairs | None = None  # of cloth near cloth
    second_contact: SecondContact | None = None  # with the other side of folds of the body

    def __post_init__(self) -> None:
        if self.step.dt.shape[0] != self.cloth.num_scenes:
            raise ValueError(
                f"step problem: dt has {len(self.step.dt)} entries for {self.cloth.num_scenes} scenes; give one per scene"
            )

    @property
    def num_scenes(self) -> int:
        """B."""
        return self.cloth.num_scenes

    def versions(self) -> tuple[int, ...] | None:
        """Numbers that change where state, what is prescribed, masses or gravity are changed in place; None where tensors do
        not count their changes."""
        given = self.cloth.mass, self.gravity, *vars(self.state).values(), *vars(self.step).values()
        try:
            return tuple(value._version for value in given if isinstance(value, Tensor))
        except RuntimeError:  # made in inference mode
            return None

    def with_contact(self) -> StepProblem:
        """The problem with its contact, searched for at x_t; itself where that has been done or there is no body."""
        obstacle = self.step.obstacle
        if self.contact is not None or obstacle is None:
            return self
        return replace(self, contact=find_contact(self.state.pos, self.cloth.vertex_scene, obstacle))

    def with_fold(self) -> StepProblem:
        """The problem with its contact on the other side of folds as well; itself where that has been done or there is no
        body."""
        problem, obstacle = self.with_contact(), self.step.obstacle
        if self.second_contact is not None or obstacle is None or problem.contact is None:
            return problem
        given = self.state.pos, self.cloth.vertex_scene, obstacle, problem.contact
        return replace(problem, second_contact=find_second_side(*given, free_flight(self)))

    def next_depth(self, next_pos: Tensor) -> float:
        """Depth [m] of the free vertex that lies deepest inside the body at t + 1, at ``next_pos`` (V, 3) [m]; 0 where none."""
        obstacle, cloth = self.step.obstacle, self.cloth
        if obstacle is None or not len(obstacle.faces) or not len(next_pos):
            return 0.0
        dist = signed_distance(next_pos, cloth.vertex_scene, obstacle.next_pos, obstacle)
        return max(-float(torch.where(cloth.free, dist, 0.0).min()), 0.0)

    def with_entered(self, next_pos: Tensor) -> StepProblem:
        """The problem with contact where its solution ``next_pos`` (V, 3) [m] lies in skin that it did not know of; itself
        where there is none, and where contact is on the nearest side only."""
        obstacle = self.step.obstacle
        if obstacle is None or self.contact is None or self.second_contact is None:
            return self
        fold = find_entered(next_pos, self.state.pos, self.cloth, obstacle, self.contacts)
        return self if fold is None else replace(self, second_contact=fold)

    def with_held_off(self, next_pos: Tensor, scenes: Tensor | None = None) -> StepProblem:
        """The problem with cloth held farther off where its solution ``next_pos`` (V, 3) [m] has left too many triangles in the
        skin; itself where it has not, or not in the ``scenes`` (B,) bool where that may be done."""
        obstacle = self.step.obstacle
        if obstacle is None or self.contact is None or not len(obstacle.faces) or not len(next_pos):
            return self
        contact = hold_off(next_pos, self.cloth, obstacle, self.contact, scenes)
        return self if contact is None else replace(self, contact=contact)

    def num_in_skin(self, next_pos: Tensor) -> Tensor:
        """Number (B,) int64 of the triangles of every scene that are in the skin at ``next_pos`` (V, 3) [m]."""
        obstacle = self.step.obstacle
        if obstacle is None:
            return torch.zeros(self.num_scenes, dtype=torch.int64, device=next_pos.device)
        return num_in_skin(next_pos, self.cloth, obstacle)

    def with_points(self, place: str) -> StepProblem:
        """The problem with its contact, also at points inside edges and faces (a ``place`` of
        :data:`hood.contact.sample_points.PLACES`); itself where that has been done or there is no body."""
        problem, obstacle = self.with_contact(), self.step.obstacle
        known = place == "vertices" or any(points.place == place for points in self.point_contacts)
        if known or obstacle is None or problem.contact is None:
            return problem
        points = find_point_contact(place, self.cloth, self.state.pos, obstacle, problem.contact)
        return replace(problem, point_contacts=(*self.point_contacts, points))

    def with_layers(self, reach: float, pressure: float, between: bool) -> StepProblem:
        """The problem with its cloth near cloth, see :func:`hood.contact.self_contact.find_layers`; itself where that has been
        done.

        Held vertices that cloth is in the way of have the places that they come to as their targets from then on.
        """
        if self.layers:
            return self
        ahead, target = inertial_guess(self.state, self.step, self.cloth.vertex_scene), self.step.pin_target
        if target is not None:
            ahead = torch.where(self.cloth.pinned.unsqueeze(1), target.to(ahead), ahead)
        layers = find_layers(self.cloth, self.state.pos, ahead, reach, pressure, between)
        if target is None:
            return replace(self, layers=layers)
        return replace(self, layers=layers, step=replace(self.step, pin_target=late_targets(layers, target)))

    def with_sides(self, reach: float) -> StepProblem:
        """The problem with the sides of cloth near cloth, see :func:`hood.contact.self_contact.find_sides`; itself where that
        has been done."""
        if self.sides is not None:
            return self
        return replace(self, sides=find_sides(self.cloth, self.state.pos, reach))

    def with_layers_at_start(self) -> StepProblem:
        """The problem with what is near what at x_t; itself where that is known. Its layers must have been searched for."""
        if all(scene.at_start is not None for scene in self.layers):
            return self
        pos = self.state.pos
        known = (replace(scene, at_start=scene.layers.contacts(scene.of(pos))) for scene in self.layers)
        return replace(self, layers=tuple(known))

    def with_ways_from(self, pos: Tensor) -> StepProblem:
        """The problem with layers that cloth is kept apart by from ``pos`` (V, 3) on, wherever the step began: for what goes on
        from there. Cloth that passes through cloth at ``pos`` is left alone. Itself where nobody searched for layers."""
        return replace(self, layers=tuple(scene.begun_at(pos) for scene in self.layers)) if self.layers else self

    def points_at(self, place: str) -> PointContact | None:
        """Contact at the points of a place; None at ``vertices`` and without a body.

        Raises:
            ValueError: nobody searched for it.
        """
        found = next((points for points in self.point_contacts if points.place == place), None)
        if found is None and place != "vertices" and self.step.obstacle is not None:
            raise ValueError(
                f"step problem: contact={place} not searched for yet; pass the problem through Potential.prepare once"
            )
        return found

    @property
    def searched_contact(self) -> Contact | None:
        """``contact``, demanded: None without a body only.

        Raises:
            ValueError: there is a body, but nobody searched for its contact.
        """
        if self.contact is None and self.step.obstacle is not None:
            raise ValueError("step problem: contact not searched for yet; pass the problem through Potential.prepare once")
        return self.contact

    @property
    def contacts(self) -> tuple[Contact, ...]:
        """``contact`` and that on the other side of folds, as far as there is any.

        Raises:
            ValueError: there is a body, but nobody searched for folds.
        """
        if self.contact is None:
            return ()
        if self.second_contact is None and self.step.obstacle is not None:
            raise ValueError(
                "step problem: folds of the body not searched for yet; pass the problem through Potential.prepare once"
            )
        return (
            (self.contact,)
            if self.second_contact is None or self.second_contact.contact is None
            else (self.contact, self.second_contact.contact)
        )

    @property
    def searched_internal_force(self) -> Tensor | None:
        """``internal_force``, demanded: None in a problem that was given its contact without a body only.

        Raises:
            ValueError: there is a body, but nobody asked for the pull.
        """
        if self.internal_force is None and self.step.obstacle is not None:
            raise ValueError("step problem: internal force not known yet; pass the problem through Potential.prepare once")
        return self.internal_force

    @property
    def vertex_dt(self) -> Tensor:
        """Time step [s] of every vertex's scene, (V, 1); a view of one number where there is one scene, on a CPU."""
        return _dt_of(self.step, self.cloth.vertex_scene)

    def acceleration(self, next_pos: Tensor) -> Tensor:
        """Accelerations [m/s²] (V, 3) that lead to ``next_pos`` (V, 3): (x - x_t - dt v_t) / dt².

        A difference of nearby positions: where an acceleration is known (a network's output), use that
            instead, float32 loses 6e-4 g here at 1/240 s.
        """
        dt = self.vertex_dt
        return (next_pos - self.state.pos - dt * self.state.vel) / dt**2

    def sum_vertices(self, values: Tensor) -> Tensor:
        """Sums (B,) per scene of ``values`` (V,) of vertices."""
        return sum_per_scene(values, self.cloth.vertex_scene, self.num_scenes)


def inertial_guess(state: State, step: StepInput, vertex_scene: Tensor | None = None) -> Tensor:
    """Positions (V, 3) without any force, x_t + dt v_t; several scenes need ``vertex_scene`` (V,)."""
    dt = step.dt.unsqueeze(1) if vertex_scene is None else _dt_of(step, vertex_scene)
    return state.pos + dt * state.vel


def _dt_of(step: StepInput, vertex_scene: Tensor) -> Tensor:
    dt = step.dt
    if dt.shape[0] == 1 and dt.device.type == "cpu" and not dt.requires_grad:
        return dt.expand(vertex_scene.shape[0], 1)
    return dt[vertex_scene].unsqueeze(1)


def free_flight(problem: StepProblem) -> Tensor:
    """Displacements (V, 3) [m] in the step without any force, dt v_t. Cloth at rest goes nowhere, however long the step."""
    return problem.vertex_dt * problem.state.vel


def sum_per_scene(values: Tensor, scene: Tensor, num_scenes: int) -> Tensor:
    """Sum ``values`` (N,) of elements in ``scene`` (N,) to one value per scene (B,).

    Raises:
        ValueError: in half precision, where contact energies of millimetre depths are zero.
    """
    if values.dtype in (torch.float16, torch.bfloat16):
        raise ValueError(f"energies cannot be computed in {values.dtype}; give positions in float32 or float64")
    return sum_scenes(values, scene, num_scenes)


def dot_rows(a: Tensor, b: Tensor) -> Tensor:
    """Products (N,) of rows (N, 3); a sum over so short an axis would be slow."""
    return torch.mv(a * b, a.new_ones(3))
