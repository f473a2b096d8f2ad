"""Frame 0 at rest: the cloth settled by the solver on the body that stands still in the pose of the first frame."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from hood.assets.files.said import ProgressLines
from hood.cloth.state import Attachments, State, StepInput
from hood.energies.problem import StepProblem
from hood.mesh.parts import find_parts
from hood.mesh.topology import connected_components
from hood.scene.worn import name_worn_part, worn_vertices
from hood.solver.newton import NewtonSettings, minimize
from hood.solver.step_figures import NOT_FINITE
from hood.steppers.newton import minimize_held_off
from hood.tensors.batch import to_device
from hood.tensors.dense import add_rows

if TYPE_CHECKING:
    from hood.cloth.cloth import Cloth
    from hood.energies.potential import Potential
    from hood.scene.scene import Scene

#: Steps begin with the first and grow to the second [s]; they last longer while no vertex moves much farther than the third
#: [m] in one: contact is searched once a step, and finds the body within a decimetre.
_SHORTEST, _LONGEST, _STRIDE = 1.0 / 30.0, 1.0, 0.04
#: At rest: in the longest step every part of the cloth moves by less than this [m] on average.
_REST = 1e-3
#: Steps at most: the default garments need half of them, and what creeps goes on creeping.
_MOST_STEPS = 30
#: Cloth of more vertices than this gets fewer, but for so many.
_MANY, _FEWEST = 10_000, 12
#: A part of a garment that has no pins and has moved so far [m] on average is not worn any more.
_LOST = 0.3
#: Parts that come off make the others begin again, with so many times the steps at most.
_AGAIN = 3
#: Parts that a message names.
_TOLD = 3
#: Accuracy of the steps on the way, and of the longest: the way leads to the same place, whatever is left over on it.
_ROUGH, _FINE = NewtonSettings(target_rg=0.1, max_iterations=15), NewtonSettings(target_rg=1e-2)


@dataclass(frozen=True)
class Rest:
    """Where the cloth has come to, and how.

    Args:
        pos: (V, 3) m, in the frame of the state that it started from.
        began: (V, 3) m, where it was put on.
        steps: taken.
        seconds: of computing.
        speed: [m/s] at which the cloth still moved in the last step, the mean over its fastest part.
        lost: parts of the garment that came off the body, by number from 0; they are where they started.
    """

    pos: Tensor
    began: Tensor
    steps: int
    seconds: float
    speed: float
    lost: tuple[int, ...] = ()

    @property
    def reached(self) -> bool:
        return self.speed <= _REST / _LONGEST and not self.lost


def without_hold(scene: Scene) -> str | None:
    """Why nothing keeps a part of a worn garment from falling, neither pins nor a body; None where something does."""
    if scene.motion.num_vertices:
        return None
    parts = _Parts(scene.cloth, None if scene.held is None else scene.held.stiffness)
    if not bool(parts.loose.any()):
        return None
    which = _named(scene, [int(parts.loose.nonzero()[0, 0])]) or "a part of it"
    return f"there is no body, and {which} has no pins"


@torch.no_grad()
def find_equilibrium(
    scene: Scene,
    potential: Potential,
    state: State,
    frame: int,
    gravity: Tensor,
    attachments: Attachments | None = None,
    most_steps: int | None = None,
) -> Rest:
    """The cloth of ``state`` settled on the still body of ``frame``.

    Pseudo-transient continuation: implicit steps of growing dt on a body that stands still, each from rest, so that nothing
    swings; contact and friction are those of ``potential`` at the start of each step. Friction of the potential creeps below
    its slip speed (:class:`hood.energies.friction.LaggedFriction`), so that cloth on a slope never stands quite still: at rest
    is what moves by less than a millimetre in a second. Where triangles then lie in the skin, their corners are held farther
    off (:mod:`hood.contact.further`). A garment that does not come to rest is warned about and is kept where it is then; of
    one that has come off the body, the start is kept; other parts settle without it. Sheets that are not worn
    (:func:`hood.scene.worn.worn_vertices`) stay as they are given. There is no equilibrium :func:`without_hold`.

    The CPU does it, whatever the device.

    Args:
        state: positions outside the body, near rest lengths; its velocity plays no role.
        gravity: (3,) m/s².
        attachments: closed in ``frame``.
        most_steps: a rough rest after so many steps is enough, and nothing is warned about; None: to rest.
    """
    began = time.perf_counter()
    cloth, start = to_device(scene.cloth, "cpu"), to_device(state, "cpu")
    step = _on_cpu(scene.step_input(frame, state, relaxing=True, attachments=attachments))
    worn = torch.as_tensor(worn_vertices(scene, frame))
    given = ~worn & cloth.free & bool(worn.any())
    problem = StepProblem(cloth, replace(start, vel=torch.zeros_like(start.vel)), step, gravity=gravity.to(start.pos))
    way = _Way(_kept(problem, given, start.pos), start.pos)
    count, speed = way.settle(potential, most_steps or _most_steps(cloth.num_vertices))
    pos = way.pos
    if way.parts.moving and most_steps is None and math.isfinite(speed):
        pos = _out_of_skin(potential, way.problem, pos)
    rest = Rest(pos.to(state.pos), state.pos, count, time.perf_counter() - began, speed, way.lost)
    if not rest.reached and most_steps is None:
        _warn(scene, rest)
    return rest


def relaxed_from(pos: np.ndarray, scene: Scene, potential: Potential, gravity: Tensor) -> State:
    """A start of worn cloth near ``pos`` (V, 3) [m, world], as it was measured, with the velocity of the skinned garment.

    One implicit step from there, from rest on the still body: the cloth gives way to the noise of single vertices, which
    stretches edges, and keeps its folds. Where it settles by itself there are many folds, and changes of 0.1% in its stiffness
    lead from one to another.
    """
    start = replace(scene, start_pos=pos).start(0)
    return replace(start, pos=find_equilibrium(scene, potential, start, 0, gravity, most_steps=1).pos)


def _most_steps(num_vertices: int) -> int:
    """Steps that settling may take: of much cloth fewer, which take longer each."""
    return min(_MOST_STEPS, max(_FEWEST, _MOST_STEPS * _MANY // max(num_vertices, 1)))


class _Way:
    """The cloth on its way to rest, from ``start`` (V, 3) on. Where parts come off the body, all go back there, and the others
    begin again without these: cloth that has settled over a part that is put back would be through it."""

    def __init__(self, problem: StepProblem, start: Tensor) -> None:
        self.problem, self.start = problem, start
        self.parts = _Parts(problem.cloth, problem.step.pin_stiffness)
        self.lost: tuple[int, ...] = ()

    @property
    def pos(self) -> Tensor:
        """(V, 3) m, where the cloth is."""
        return self.problem.state.pos

    def settle(self, potential: Potential, most_steps: int) -> tuple[int, float]:
        """Number of steps taken, and the speed [m/s] in the last, until the cloth is at rest, lost, or out of steps."""
        dt, speed, progress = _SHORTEST, math.inf, ProgressLines("settling the cloth")
        count, last = 0, most_steps
        while count < last:
            count += 1
            here, longest = self.problem.state, dt >= _LONGEST
            step = replace(self.problem.step, dt=torch.full_like(self.problem.step.dt, dt))
            pos, report = minimize(potential, replace(self.problem, step=step), here.pos, _FINE if longest else _ROUGH)
            if NOT_FINITE in report.reason:
                return count, math.inf
            moved = (pos - here.pos).norm(dim=1)
            speed = float(self.parts.means(moved).max()) / dt
            self.problem = replace(self.problem, state=replace(here, pos=pos))
            progress.tell(f"step {count} of at most {last}, it moves by {1e3 * speed:.1f} mm a second")
            if self._lose(self.parts.lost(pos - self.start)):
                dt, last = _SHORTEST, min(last + count, _AGAIN * most_steps)
            if not self.parts.moving or (longest and speed <= _REST / _LONGEST):
                return count, speed
            growth = _STRIDE / max(float(moved[self.parts.free].max()), 1e-9)
            dt = min(max(dt * min(max(growth, 0.5), 2.0), _SHORTEST), _LONGEST)
        return count, speed

    def _lose(self, gone: Tensor) -> bool:
        """Go back to the start and hold the parts ``gone`` (n,) there; whether there are any."""
        if not len(gone):
            return False
        held = torch.isin(self.parts.of_vertices, gone) & self.problem.cloth.free
        begun = replace(self.problem, state=replace(self.problem.state, pos=self.start))
        self.problem = _kept(begun, held, self.start)
        self.lost = tuple(sorted({*self.lost, *gone.tolist()}))
        self.parts = _Parts(self.problem.cloth, self.problem.step.pin_stiffness)
        return True


def _kept(problem: StepProblem, rows: Tensor, start: Tensor) -> StepProblem:
    """The problem with the vertices ``rows`` (V,) bool held where they are at ``start`` (V, 3)."""
    if not bool(rows.any()):
        return problem
    there = torch.where(rows[:, None], start, problem.state.pos)
    target = problem.step.pin_target
    target = there if target is None else torch.where(rows[:, None], start, target)
    cloth = replace(problem.cloth, pinned=problem.cloth.pinned | rows)
    step = replace(problem.step, pin_target=target)
    return replace(problem, cloth=cloth, state=replace(problem.state, pos=there), step=step)


def _out_of_skin(potential: Potential, problem: StepProblem, pos: Tensor) -> Tensor:
    """Positions (V, 3) at rest with cloth held farther off where too many of its triangles lie in the skin; ``pos`` itself
    where they do not, or where that is not finite."""
    rested = replace(problem.state, pos=pos)
    problem = replace(problem, state=rested, step=replace(problem.step, dt=torch.full_like(problem.step.dt, _LONGEST)))
    return minimize_held_off(potential, potential.prepare(problem), pos, _FINE).pos


class _Parts:
    """The connected parts of a cloth: the garments of an outfit, and what else hangs together."""

    def __init__(self, cloth: Cloth, springs: Tensor | None = None) -> None:
        held = (cloth.pinned if springs is None else cloth.pinned | (springs > 0)).cpu()
        self.free = cloth.free.cpu()
        self.of_vertices = torch.as_tensor(connected_components(cloth.num_vertices, cloth.edges.cpu().numpy()))
        self._free_part = self.of_vertices[self.free]
        count = int(self.of_vertices.max()) + 1 if len(self.of_vertices) else 0
        self._size = torch.bincount(self._free_part, minlength=count)
        pinned = torch.bincount(self.of_vertices[held], minlength=count)
        self.loose = (pinned == 0) & (self._size > 0)  # (P,) bool: they move, and no pin holds them

    @property
    def moving(self) -> bool:
        """Whether any part moves."""
        return bool((self._size > 0).any())

    def means(self, values: Tensor) -> Tensor:
        """Means (P,) of ``values`` (V,) over the free vertices of every part; 0 where there are none."""
        total = add_rows(values.new_zeros(len(self._size)), self._free_part, values[self.free])
        return total / self._size.clamp_min(1)

    def lost(self, moved: Tensor) -> Tensor:
        """The parts (n,) that no pin holds and that have come off, by the way (V, 3) [m] of the vertices."""
        return ((self.means(moved.norm(dim=1)) > _LOST) & self.loose).nonzero().squeeze(1)


def _on_cpu(step: StepInput) -> StepInput:
    obstacle = None if step.obstacle is None else to_device(step.obstacle, "cpu")
    attachments = None if step.attachments is None else to_device(step.attachments, "cpu")
    return replace(to_device(step, "cpu"), obstacle=obstacle, attachments=attachments)


def _named(scene: Scene, numbers: Sequence[int]) -> str:
    """Parts by their numbers from 0 in words; "" where the garment is one."""
    label = connected_components(scene.cloth.num_vertices, scene.cloth.edges.cpu().numpy())
    parts = find_parts(scene.garment.rest_pos, scene.garment.faces)
    own = [part for part in parts if label[part.vertices[0]] in numbers]
    words = [name_worn_part(scene, part, len(parts)) for part in own[:_TOLD]]
    return ", ".join(filter(None, words)) + (f" and {len(own) - _TOLD} more" if len(own) > _TOLD else "")


def _warn(scene: Scene, rest: Rest) -> None:
    name = f"garment {scene.garment.name!r}"
    if rest.lost:
        which = _named(scene, rest.lost)
        if not which:
            text = f"{name} comes off the body when it settles: it starts as it is put on, and will fall"
        elif len(rest.lost) == 1:
            text = f"{name}: {which} comes off the body when the cloth settles: it starts as it is put on, and will fall"
        else:
            text = f"{name}: {which} come off the body when the cloth settles: they start as they are put on, and will fall"
    elif not math.isfinite(rest.speed):
        text = f"{name} is not at rest in frame 0: the potential has no finite value in step {rest.steps} of settling"
    else:
        moves = f"{1e3 * rest.speed:.1f} mm a second"
        text = f"{name} is not at rest in frame 0: after {rest.steps} steps of settling it still moves by {moves}"
    warnings.warn(f"{text} (pins=… hold it, settle=paper does not settle it)", stacklevel=4)
