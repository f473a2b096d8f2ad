"""Frame 0 at rest: the cloth settled by the solver on the body that stands still in the pose of the first frame."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from hood.losses.potential import Potential
from hood.losses.problem import StepProblem
from hood.mesh.topology import connected_components
from hood.scene.batch import to_device
from hood.scene.cloth import Cloth
from hood.scene.scene import Scene
from hood.scene.state import Attachments, State, StepInput
from hood.solver.held_off import minimize_held_off
from hood.solver.newton import NewtonSettings, minimize
from hood.solver.reasons import NOT_FINITE

#: Steps begin with the first and grow to the second [s]; they last longer while no vertex moves much farther than the third
#: [m] in one: contact is searched once a step, and finds the body within a decimetre.
_SHORTEST, _LONGEST, _STRIDE = 1.0 / 30.0, 1.0, 0.04
#: At rest: in the longest step every part of the cloth moves by less than this [m] on average.
_REST = 1e-3
#: Steps at most: the default garments need half of them, and what creeps goes on creeping.
_MOST_STEPS = 30
#: A part of a garment that has no pins and has moved so far [m] on average is not worn any more.
_LOST = 0.3
#: Accuracy of the steps on the way, and of the longest: the way leads to the same place, whatever is left over on it.
_ROUGH, _FINE = NewtonSettings(target_rg=0.1, max_iterations=15), NewtonSettings(target_rg=1e-2)


@dataclass(frozen=True)
class Rest:
    """Where the cloth has come to, and how.

    Args:
        pos: (V, 3) m, in the frame of the state that it started from.
        steps: taken.
        seconds: of computing.
        speed: [m/s] at which the cloth still moved in the last step, the mean over its fastest part.
        lost: whether the garment came off the body.
    """

    pos: Tensor
    steps: int
    seconds: float
    speed: float
    lost: bool = False

    @property
    def reached(self) -> bool:
        return self.speed <= _REST / _LONGEST and not self.lost


def without_hold(scene: Scene) -> str | None:
    """Why nothing keeps a part of a worn garment from falling, neither pins nor a body; None where something does."""
    loose = scene.motion.num_vertices == 0 and bool(_Parts(scene.cloth).loose.any())
    return "there is no body, and a part of it has no pins" if loose else None


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
    its slip speed (:class:`hood.losses.friction.LaggedFriction`), so that cloth on a slope never stands quite still: at rest
    is what moves by less than a millimetre in a second. Where triangles then lie in the skin, their corners are held farther
    off (:mod:`hood.scene.held_off`). A garment that does not come to rest is warned about and is kept where it is then; of one
    that has come off the body, the start is kept. There is no equilibrium :func:`without_hold`.

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
    problem = StepProblem(cloth, replace(start, vel=torch.zeros_like(start.vel)), step, gravity=gravity.to(start.pos))
    parts = _Parts(cloth)
    *_, (count, pos, speed) = _steps(potential, problem, parts, most_steps or _MOST_STEPS)
    lost = parts.lost(pos - start.pos)
    if not lost and most_steps is None and math.isfinite(speed):
        pos = _out_of_skin(potential, problem, pos)
    rest = Rest((start.pos if lost else pos).to(state.pos), count, time.perf_counter() - began, speed, lost)
    if not rest.reached and most_steps is None:
        _warn(scene, rest)
    return rest


def _steps(potential: Potential, problem: StepProblem, parts: _Parts, most_steps: int) -> Iterator[tuple[int, Tensor, float]]:
    """Number, positions (V, 3) and speed [m/s] after each step, until the cloth is at rest, lost, or out of steps."""
    start, dt = problem.state.pos, _SHORTEST
    for count in range(1, most_steps + 1):
        here = problem.state
        longest = dt >= _LONGEST
        problem = replace(problem, step=replace(problem.step, dt=torch.full_like(problem.step.dt, dt)))
        pos, report = minimize(potential, problem, here.pos, _FINE if longest else _ROUGH)
        if NOT_FINITE in report.reason:
            yield count, here.pos, math.inf
            return
        moved = (pos - here.pos).norm(dim=1)
        speed = float(parts.means(moved).max()) / dt
        yield count, pos, speed
        if (longest and speed <= _REST / _LONGEST) or parts.lost(pos - start):
            return
        growth = _STRIDE / max(float(moved.max()), 1e-9)
        dt = min(max(dt * min(max(growth, 0.5), 2.0), _SHORTEST), _LONGEST)
        problem = replace(problem, state=replace(here, pos=pos))


def _out_of_skin(potential: Potential, problem: StepProblem, pos: Tensor) -> Tensor:
    """Positions (V, 3) at rest with cloth held farther off where too many of its triangles lie in the skin; ``pos`` itself
    where they do not, or where that is not finite."""
    rested = replace(problem.state, pos=pos)
    problem = replace(problem, state=rested, step=replace(problem.step, dt=torch.full_like(problem.step.dt, _LONGEST)))
    return minimize_held_off(potential, potential.prepare(problem), pos, _FINE).pos


class _Parts:
    """The connected parts of a cloth: the garments of an outfit, and what else hangs together."""

    def __init__(self, cloth: Cloth) -> None:
        self._free = cloth.free.cpu()
        self._part = torch.as_tensor(connected_components(cloth.num_vertices, cloth.edges.cpu().numpy()))
        self._free_part = self._part[self._free]
        count = int(self._part.max()) + 1 if len(self._part) else 0
        self._size = torch.bincount(self._free_part, minlength=count)
        pinned = torch.bincount(self._part[cloth.pinned.cpu()], minlength=count)
        self.loose = (pinned == 0) & (self._size > 0)  # (P,) bool: they move, and no pin holds them

    def means(self, values: Tensor) -> Tensor:
        """Means (P,) of ``values`` (V,) over the free vertices of every part; 0 where there are none."""
        total = values.new_zeros(len(self._size)).index_add(0, self._free_part, values[self._free])
        return total / self._size.clamp_min(1)

    def lost(self, moved: Tensor) -> bool:
        """Whether a part that no pin holds has come off, by the way (V, 3) [m] of the vertices."""
        return bool((self.means(moved.norm(dim=1))[self.loose] > _LOST).any())


def _on_cpu(step: StepInput) -> StepInput:
    obstacle = None if step.obstacle is None else to_device(step.obstacle, "cpu")
    attachments = None if step.attachments is None else to_device(step.attachments, "cpu")
    return replace(to_device(step, "cpu"), obstacle=obstacle, attachments=attachments)


def _warn(scene: Scene, rest: Rest) -> None:
    name = f"garment {scene.garment.name!r}"
    if rest.lost:
        text = f"{name} comes off the body when it settles: it starts as it is put on, and will fall"
    elif not math.isfinite(rest.speed):
        text = f"{name} is not at rest in frame 0: the potential has no finite value in step {rest.steps} of settling"
    else:
        moves = f"{1e3 * rest.speed:.1f} mm a second"
        text = f"{name} is not at rest in frame 0: after {rest.steps} steps of settling it still moves by {moves}"
    warnings.warn(f"{text} (pins=… hold it, settle=paper does not settle it)", stacklevel=4)
