"""Autoregressive rollout of a stepper on a scene, one frame at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from hood.dynamics.measure import METRICS, penetration_metrics, strain_metrics
from hood.dynamics.simulator import Prediction
from hood.dynamics.stepper import Stepper
from hood.dynamics.stopwatch import Stopwatch
from hood.losses.potential import Potential, relative_gradient, scale
from hood.losses.problem import StepProblem, inertial_guess
from hood.scene.contact import Contact, find_contact
from hood.scene.scene import Scene, recentre
from hood.scene.start import push_out
from hood.scene.state import Attachments, State

AttachmentSchedule = Callable[[int], Attachments | None]
#: Called after a step with the frame it leads to, what the step had to solve and what came out.
Observer = Callable[[int, StepProblem, Prediction], None]


@dataclass(frozen=True)
class Frame:
    """One frame of a rollout."""

    index: int
    state: State
    world_pos: Tensor  # (V, 3) m float64
    body_pos: Tensor  # (W, 3) m float64
    metrics: dict[str, float]


def metric_names(potential: Potential, stepper: Stepper) -> tuple[str, ...]:
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
        *stepper.metrics,
        *(f"ms_{part}" for part in stepper.times),
    )


@torch.no_grad()
def simulate(
    stepper: Stepper,
    scene: Scene,
    potential: Potential,
    num_frames: int | None = None,
    relaxing_steps: int = 1,
    attachments: AttachmentSchedule | None = None,
    start_frame: int = 0,
    observe: Observer | None = None,
) -> Iterator[Frame]:
    """Frames 0, 1, … of the garment on the moving body.

    Frame 0 is the settled start after ``relaxing_steps`` relaxing steps (paper, section 3.4), vertices pushed out of the
    body. A frame's energies belong to the step that led to it, as do its times. The simulation goes on over non-finite
    frames, so that their number and place are seen. ``observe`` sees every step outside its time.
    """
    count = scene.num_frames - start_frame if num_frames is None else min(num_frames, scene.num_frames - start_frame)
    watch = Stopwatch()
    prepared = stepper.prepare(scene.cloth, scene.garment.rest_pos)
    state = start_state(stepper, scene, potential, relaxing_steps, start_frame)
    metrics: dict[str, float] = {}
    for index in range(count):
        body_frame = start_frame + index
        state = recentre(state, scene.cloth.vertex_scene)
        watch.restart()
        last = body_frame + 1 >= scene.num_frames
        contact: Contact | None
        if last:
            contact = _contact_now(scene, state, body_frame)
        else:
            with watch.part("posing"):
                closed = None if attachments is None else attachments(index)
                step = scene.step_input(body_frame, state, attachments=closed)
            with watch.part("search"):
                contact = stepper.find_contact(scene.cloth, state, step)
        shared = {**strain_metrics(scene.cloth, state.pos), **penetration_metrics(contact, scene.cloth.num_vertices)}
        origin = state.origin[0]
        body_pos = scene.motion.surface(body_frame, origin.numpy()).cpu().double() + origin
        yield Frame(index, state, state.pos.cpu().double() + origin, body_pos, {**shared, **metrics})
        if index + 1 >= count:
            return
        problem = potential.prepare(StepProblem(scene.cloth, state, step, contact, stepper.gravity.to(state.pos)))
        # Metrics, what only they need to know of the step, and the caller's work are not part of the frame's time.
        before = watch.lap()
        prediction = stepper.predict(problem, prepared, watch)
        state = State(prediction.next_pos, stepper.next_velocity(problem, prediction), state.origin)
        times = {**watch.lap(), "search": before["search"]}
        times["rest"] += before["posing"]
        times["total"] += before["search"] + before["posing"]
        metrics = {f"ms_{part}": times.get(part, 0.0) for part in stepper.times} | prediction.metrics
        metrics |= energy_metrics(potential, problem, prediction.next_pos, prediction.acc)
        if observe is not None:
            observe(index + 1, problem, prediction)


def start_state(stepper: Stepper, scene: Scene, potential: Potential, relaxing_steps: int, frame: int = 0) -> State:
    """Settled, relaxed start: the relaxing step is kept only where it lowers the potential of its own problem.

    A stepper with ``keeps_relaxing_step`` goes on from it as it left it, with its positions and its velocity.
    """
    state = scene.start(frame, relaxed=False)
    prepared = stepper.prepare(scene.cloth, scene.garment.rest_pos)
    velocity = scene.start_velocity(frame)
    for _ in range(relaxing_steps):
        step = scene.step_input(frame, state, relaxing=True)
        contact = stepper.find_contact(scene.cloth, state, step)
        problem = potential.prepare(StepProblem(scene.cloth, state, step, contact, stepper.gravity.to(state.pos)))
        prediction = stepper.predict(problem, prepared)
        if stepper.keeps_relaxing_step:
            state = State(prediction.next_pos, state.vel, state.origin)
            velocity = stepper.next_velocity(problem, prediction)
            continue
        pos = push_out(scene.cloth, prediction.next_pos, step.obstacle, scene.clearance)
        if bool(torch.isfinite(pos).all()) and bool(
            (potential.total(problem, pos) < potential.total(problem, state.pos)).all()
        ):
            state = State(pos, state.vel, state.origin)
    return State(state.pos, velocity, state.origin)


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
