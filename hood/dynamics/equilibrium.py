"""Frame 0 at rest: the cloth settled by the solver on the body that stands still in the pose of the first frame."""

from __future__ import annotations

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
from hood.scene.mesh_motion import wearable
from hood.scene.scene import Scene
from hood.scene.state import Attachments, State, StepInput
from hood.solver.newton import NewtonSettings, minimize

#: Steps begin with the first and grow to the second [s]; they last longer while no vertex moves much farther than the third
#: [m] in one: contact is searched once a step, and finds the body within a decimetre.
_SHORTEST, _LONGEST, _STRIDE = 1.0 / 30.0, 1.0, 0.04
#: At rest: in the longest step every part of the cloth moves by less than this [m] on average.
_REST = 1e-3
#: Steps at most.
_MOST_STEPS = 40
#: A garment that has moved so far [m] on average is not worn any more.
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
    """Why nothing keeps the garment from falling, neither pins nor a body that wears it; None where something does."""
    if bool(scene.cloth.pinned.any()):
        return None
    if scene.motion.num_vertices == 0:
        return "there is no body, and nothing is pinned"
    return None if wearable(scene.garment) else "it is a sheet, and nothing is pinned"


@torch.no_grad()
def find_equilibrium(
    scene: Scene,
    potential: Potential,
    state: State,
    frame: int,
    gravity: Tensor,
    attachments: Attachments | None = None,
) -> Rest:
    """The cloth of ``state`` settled on the still body of ``frame``.

    Pseudo-transient continuation: implicit steps of growing dt on a body that stands still, each from rest, so that nothing
    swings; contact and friction are those of ``potential`` at the start of each step. Friction of the potential creeps below
    its slip speed (:class:`hood.losses.friction.LaggedFriction`), so that cloth on a slope never stands quite still: at rest
    is what moves by less than a millimetre in a second. A garment that does not come to rest is warned about and is kept
    where it is then; of one that has come off the body, the start is kept. There is no equilibrium :func:`without_hold`.

    The CPU does it, whatever the device.

    Args:
        state: positions outside the body, near rest lengths; its velocity plays no role.
        gravity: (3,) m/s².
        attachments: closed in ``frame``.
    """
    began = time.perf_counter()
    cloth, start = (to_device(item, "cpu") for item in (scene.cloth, state))
    step = _on_cpu(scene.step_input(frame, state, relaxing=True, attachments=attachments))
    problem = StepProblem(cloth, replace(start, vel=torch.zeros_like(start.vel)), step, gravity=gravity.to(start.pos))
    parts = _parts(problem)
    *_, (count, pos, speed) = _steps(potential, problem, parts)
    lost = bool((_means((pos - start.pos).norm(dim=1), parts) > _LOST).any())
    rest = Rest((start.pos if lost else pos).to(state.pos), count, time.perf_counter() - began, speed, lost)
    if not rest.reached:
        _warn(scene, rest)
    return rest


def _steps(potential: Potential, problem: StepProblem, parts: Tensor) -> Iterator[tuple[int, Tensor, float]]:
    """Number, positions (V, 3) and speed [m/s] after each step, until the cloth is at rest, lost, or out of steps."""
    start, dt = problem.state.pos, _SHORTEST
    for count in range(1, _MOST_STEPS + 1):
        here = problem.state
        longest = dt >= _LONGEST
        problem = replace(problem, step=replace(problem.step, dt=torch.full_like(problem.step.dt, dt)))
        pos, _ = minimize(potential, problem, here.pos, _FINE if longest else _ROUGH)
        moved = (pos - here.pos).norm(dim=1)
        if not bool(moved.isfinite().all()):
            yield count, here.pos, float("inf")
            return
        speed = float(_means(moved, parts).max()) / dt
        yield count, pos, speed
        if (longest and speed <= _REST / _LONGEST) or bool((_means((pos - start).norm(dim=1), parts) > _LOST).any()):
            return
        growth = _STRIDE / max(float(moved.max()), 1e-9)
        dt = min(max(dt * min(max(growth, 0.5), 2.0), _SHORTEST), _LONGEST)
        problem = replace(problem, state=replace(here, pos=pos))


def _parts(problem: StepProblem) -> Tensor:
    """Connected part (V,) of each vertex that moves, counted from 1; 0 for the others."""
    cloth = problem.cloth
    parts = connected_components(cloth.num_vertices, cloth.edges.numpy())
    return torch.where(cloth.free, torch.as_tensor(parts) + 1, 0)


def _means(values: Tensor, parts: Tensor) -> Tensor:
    """Mean of ``values`` (V,) over the vertices of every part; part 0 and parts without a vertex have 0."""
    count = torch.bincount(parts)
    total = values.new_zeros(len(count)).index_add(0, parts, values)
    total[0] = 0.0
    return total / count.clamp_min(1)


def _on_cpu(step: StepInput) -> StepInput:
    moved = {name: getattr(step, name) for name in ("obstacle", "attachments")}
    return replace(
        to_device(step, "cpu"), **{name: None if item is None else to_device(item, "cpu") for name, item in moved.items()}
    )


def _warn(scene: Scene, rest: Rest) -> None:
    name = scene.garment.name
    if rest.lost:
        text = f"garment {name!r} comes off the body when it settles: it starts as it is put on, and will fall"
    else:
        text = (
            f"garment {name!r} is not at rest in frame 0: after {rest.steps} steps of settling it still moves by "
            f"{1e3 * rest.speed:.1f} mm a second"
        )
    warnings.warn(f"{text} (pins=… hold it, settle=paper does not settle it)", stacklevel=4)
