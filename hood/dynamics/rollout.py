"""Autoregressive rollout of a simulator on a scene, one frame at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from hood.dynamics.measure import METRICS, penetration_metrics, strain_metrics
from hood.dynamics.simulator import Simulator
from hood.dynamics.stopwatch import Stopwatch
from hood.losses.potential import Potential, relative_gradient, scale
from hood.losses.problem import StepProblem, inertial_guess
from hood.scene.contact import Contact, find_contact
from hood.scene.scene import Scene, recentre
from hood.scene.start import push_out
from hood.scene.state import Attachments, State

#: Milliseconds of a frame by part, in the metrics of a rollout.
TIMES = ("search", "features", "network", "rest", "total")
AttachmentSchedule = Callable[[int], Attachments | None]


@dataclass(frozen=True)
class Frame:
    """One frame of a rollout."""

    index: int
    state: State
    world_pos: Tensor  # (V, 3) m float64
    body_pos: Tensor  # (W, 3) m float64
    metrics: dict[str, float]


def metric_names(potential: Potential) -> tuple[str, ...]:
    """Every metric a frame of a rollout can have."""
    energies = tuple(f"energy_{name}" for name in potential.terms)
    return (
        *METRICS,
        *energies,
        "energy_total",
        "energy_inertial_guess",
        "gradient_norm",
        "relative_gradient",
        "e0",
        *(f"ms_{t}" for t in TIMES),
    )


@torch.no_grad()
def simulate(
    simulator: Simulator,
    scene: Scene,
    potential: Potential,
    num_frames: int | None = None,
    relaxing_steps: int = 1,
    attachments: AttachmentSchedule | None = None,
    start_frame: int = 0,
) -> Iterator[Frame]:
    """Frames 0, 1, … of the garment on the moving body.

    Frame 0 is the settled start after ``relaxing_steps`` relaxing steps (paper, section 3.4), vertices pushed out of the
    body. A frame's energies belong to the step that led to it, as do its times. The simulation goes on over non-finite
    frames, so that their number and place are seen.
    """
    count = scene.num_frames - start_frame if num_frames is None else min(num_frames, scene.num_frames - start_frame)
    watch = Stopwatch()
    prepared = simulator.prepare(scene.cloth, scene.garment.rest_pos)
    state = start_state(simulator, scene, potential, relaxing_steps, start_frame)
    metrics: dict[str, float] = {}
    for index in range(count):
        body_frame = start_frame + index
        state = recentre(state, scene.cloth.vertex_scene)
        watch.restart()
        last = body_frame + 1 >= scene.num_frames
        step = scene.step_input(body_frame - 1 if last else body_frame, state)
        contact: Contact | None
        if last:
            contact = _contact_now(scene, state, body_frame)
        else:
            if attachments is not None:
                step = scene.step_input(body_frame, state, attachments=attachments(index))
            with watch.part("search"):
                contact = simulator.find_contact(scene.cloth, state, step)
        shared = {**strain_metrics(scene.cloth, state.pos), **penetration_metrics(contact, scene.cloth.num_vertices)}
        origin = state.origin[0]
        body_pos = scene.motion.surface(body_frame, origin.numpy()).cpu().double() + origin
        yield Frame(index, state, state.pos.cpu().double() + origin, body_pos, {**shared, **metrics})
        if index + 1 >= count:
            return
        watch_metrics = watch.lap()  # metrics and the caller's work are not part of the frame's time
        problem = StepProblem(scene.cloth, state, step, contact, simulator.gravity.to(state.pos))
        prediction = simulator.predict(problem, prepared, watch)
        state = State(prediction.next_pos, simulator.next_velocity(problem, prediction), state.origin)
        times = watch.lap()
        search = watch_metrics.get("search", 0.0)
        times["search"] = times.get("search", 0.0) + search
        times["total"] += search
        metrics = {f"ms_{name}": times.get(name, 0.0) for name in TIMES}
        metrics |= energy_metrics(potential, problem, prediction.next_pos, prediction.acc)


def start_state(simulator: Simulator, scene: Scene, potential: Potential, relaxing_steps: int, frame: int = 0) -> State:
    """Settled, relaxed start: the relaxing step is kept only where it lowers the potential of its own problem."""
    state = scene.start(frame, relaxed=False)
    prepared = simulator.prepare(scene.cloth, scene.garment.rest_pos)
    for _ in range(relaxing_steps):
        step = scene.step_input(frame, state, relaxing=True)
        contact = simulator.find_contact(scene.cloth, state, step)
        problem = StepProblem(scene.cloth, state, step, contact, simulator.gravity.to(state.pos))
        prediction = simulator.predict(problem, prepared)
        pos = push_out(scene.cloth, prediction.next_pos, step.obstacle, scene.clearance)
        if bool(torch.isfinite(pos).all()) and bool(
            (potential.total(problem, pos) < potential.total(problem, state.pos)).all()
        ):
            state = State(pos, state.vel, state.origin)
    return State(state.pos, scene.start_velocity(frame), state.origin)


def energy_metrics(potential: Potential, problem: StepProblem, next_pos: Tensor, acc: Tensor) -> dict[str, float]:
    """Energies [J] of one scene's step, its gradient norm [N] (the paper's: mean over vertices of ‖∂Φ/∂x_v‖₂), rg, e0 [J],
    and for comparison the potential of the inertial guess x_t + dt v_t."""
    gradient, energies = potential.gradient(problem, next_pos, acc)
    free = problem.cloth.free
    result = {f"energy_{name}": float(value.sum()) for name, value in energies.items()}
    result["energy_total"] = sum(result.values())
    guess = inertial_guess(problem.state, problem.step, problem.cloth.vertex_scene)
    if problem.step.pin_target is not None:
        guess = torch.where(problem.cloth.pinned.unsqueeze(1), problem.step.pin_target, guess)
    result["energy_inertial_guess"] = float(potential.total(problem, guess).sum())
    result["gradient_norm"] = float(gradient[free].norm(dim=1).mean()) if bool(free.any()) else 0.0
    result["relative_gradient"] = float(relative_gradient(problem, gradient * free.unsqueeze(1)).mean())
    result["e0"] = float(scale(problem).sum())
    return result


def _contact_now(scene: Scene, state: State, frame: int) -> Contact:
    obstacle = scene.motion.obstacle(frame, state.origin[0].numpy(), static=True)
    return find_contact(state.pos, scene.cloth.vertex_scene, obstacle)
