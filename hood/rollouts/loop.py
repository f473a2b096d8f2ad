"""Autoregressive rollout of a stepper on a scene, one frame at a time."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hood.cloth.state import Attachments, State
from hood.energies.potential import Potential
from hood.energies.problem import StepProblem
from hood.energies.self_contact import for_networks, has_layers
from hood.limits import CUT_UNSOUND, DISTANCE_FAR
from hood.mesh.closest_point.tree import forget_searches
from hood.mesh.penetration.crossing import crossings
from hood.rollouts.checks.guard import Guard
from hood.rollouts.equilibrium import Rest, find_equilibrium, without_hold
from hood.rollouts.frame import (
    FIELD_CHOICES,
    METRIC_CHOICES,
    SETTLE_CHOICES,
    SETTLE_METRICS,
    Frame,
    _is_measured,
    _state_metrics,
    _surface_now,
    _times,
    _with_guard,
)
from hood.rollouts.verdict.distance import DISTANCE_EVERY, distance_metrics
from hood.rollouts.verdict.surface import SURFACE_STRIDE, SurfaceMeter
from hood.rollouts.verdict.worn import measure_wear
from hood.scene.jumps import Jump, carried, describe_jumps, find_jumps
from hood.scene.scene import LEAD_IN, RELAXING_DT, NotWornError, Scene, recentre
from hood.scene.start import free_stretch, push_out_of_body
from hood.scene.worn import worn_vertices, worst_part
from hood.solver.step_figures import (
    StepFigures,
    layer_metrics,
    vertex_residual,
)
from hood.steppers.network import Prediction
from hood.steppers.newton import Stepper, as_taken
from hood.steppers.protocol import Relaxing, Stopwatch
from hood.steppers.refined import RefinedStepper, prepare_stepper
from hood.steppers.static_shapes.simulator import network_of

#: The way of a relaxing step is looked at so often [m], in so many places at most.
_LOOK, _LOOKS = 0.02, 100

AttachmentSchedule = Callable[[int], Attachments | None]
#: Called after a step with the frame it leads to, what the step had to solve and what came out.
_Observer = Callable[[int, StepProblem, Prediction], None]


@torch.no_grad()
def simulate(
    stepper: Stepper,
    scene: Scene,
    potential: Potential,
    num_frames: int | None = None,
    relaxing_steps: int = 1,
    attachments: AttachmentSchedule | None = None,
    start_frame: int = 0,
    observe: _Observer | None = None,
    metrics: str = "all",
    fields: Sequence[str] = (),
    surface_stride: int = SURFACE_STRIDE,
    settle: str = "paper",
    guard: Guard | None = None,
    afresh: bool = False,
    start: State | None = None,
    after: Frame | None = None,
    goal: Mapping[str, Any] | None = None,
) -> Iterator[Frame]:
    """Frames 0, 1, … of the garment on the moving body.

    ``settle`` is one of :data:`SETTLE_CHOICES`. With ``paper`` frame 0 is the settled start after ``relaxing_steps`` relaxing
    steps (paper, section 3.4), vertices pushed out of the body. Where the stepper restarts from the relaxing step
    (:class:`hood.steppers.protocol.Relaxing`), the last one leads from frame 0 to frame 1 instead. With ``equilibrium`` there
    are no relaxing steps: the solver settles the cloth on the still body (:func:`hood.rollouts.equilibrium.find_equilibrium`),
    the same way for every stepper, and frame 0 has :data:`SETTLE_METRICS` (number, s, m/s, 0 or 1, and how far the part that
    moved most is away from its place on the body and has sunk along it, m, see :mod:`hood.rollouts.verdict.worn`). What has
    a start of its own (:func:`own_start`) keeps ``paper``. Either way frame 0 has the velocity of the skinned garment.

    Where the body jumps, as at a cut in a recording, the cloth is carried along (:mod:`hood.scene.jumps`); a warning says so.

    The cloth of a frame always belongs to the body of the same frame. A frame's energies belong to the step that led to it,
    as do its times. The simulation goes on over non-finite frames, so that their number and place are seen. ``observe`` sees
    every step from frame to frame, outside its time.

    ``metrics`` is one of :data:`METRIC_CHOICES`. What only they need to know, contact included, is no part of the step and
    changes nothing about it; its time is ``ms_metrics``, which ``ms_total`` leaves out as it does the caller's work. The same
    holds for ``fields``, names of :data:`FIELD_CHOICES`. The metrics of :class:`hood.rollouts.verdict.surface.SurfaceMeter`
    belong to every ``surface_stride``-th frame, the first and the last; other frames lack them. Those of
    :func:`hood.rollouts.verdict.distance.distance_metrics` belong to every second of these and to the last, and to the next
    after one that is far beyond the limit; frame 0 lacks them: no step led there.

    A network that looks at a potential looks at ``potential``; a solver keeps its own.

    ``start`` is frame 0, where it is given; ``settle`` plays no role then.

    ``after`` is a frame that this has given before, with everything as it was then: the frames from the next one on are given.
    They are the same to the bit where the ``guard`` knows what it knew (:meth:`Guard.recall`), and a refinement, by ``goal``,
    what it had learned (:attr:`hood.steppers.refined.RefinedStepper.learned`).

    ``afresh``: no search begins with what the step before found. The frames are the same, and take longer.

    A ``guard`` sees every step from frame to frame, but for a relaxing one. The rollout goes on with what it makes of the step,
    and ends before the frame that it stops at. Its time is ``ms_guard``, a part of ``ms_total``; what is measured for
    ``metrics`` anyway stays in ``ms_metrics``.

    Raises:
        ValueError: ``metrics``, ``settle`` or a field is none of the choices, ``surface_stride`` is less than 1, or the network
            cannot look at this potential.
    """
    if settle not in SETTLE_CHOICES:
        raise ValueError(f"settle is {settle!r}; choose {', '.join(SETTLE_CHOICES)}")
    if metrics not in METRIC_CHOICES:
        raise ValueError(f"metrics is {metrics!r}; choose {', '.join(METRIC_CHOICES)}")
    strange = [name for name in fields if name not in FIELD_CHOICES]
    if strange:
        raise ValueError(f"export holds {strange[0]!r}; choose of {', '.join(FIELD_CHOICES)}")
    if surface_stride < 1:
        raise ValueError(f"surface_stride={surface_stride}: must be at least 1, every frame")
    count = scene.num_frames - start_frame if num_frames is None else min(num_frames, scene.num_frames - start_frame)
    network = network_of(stepper)
    if network is not None:
        network.use_potential(for_networks(potential))
    prepared = prepare_stepper(stepper, scene)
    if goal is not None and isinstance(stepper, RefinedStepper):
        stepper.recall(goal)
    if after is not None and scene.sizes.changing:  # what is kept of a cloth, as its layers, is of its size at first
        step = scene.step_input(start_frame + after.index, after.state)
        gravity = stepper.gravity.to(after.state.pos)
        stepper.search(potential.prepare(StepProblem(scene.cloth, after.state, step, gravity=gravity)))
    given, rest = start if after is None else after.state, None
    if given is not None:
        state = given
    elif settle == "equilibrium" and own_start(stepper, scene, start_frame) is None:
        state, rest = rest_state(stepper, scene, potential, relaxing_steps, start_frame, attachments)
    else:
        state = start_state(stepper, scene, potential, relaxing_steps, start_frame)
    relaxing = relaxing_steps > 0 and stepper.relaxing is Relaxing.RESTART
    stepped = {} if rest is None else _settled(rest, scene, start_frame, state)
    known_fields = {name: torch.full((scene.cloth.num_vertices,), torch.nan) for name in fields}
    wants_potential = metrics == "all" or bool(fields)
    meter = SurfaceMeter(scene.garment, scene.motion.faces) if metrics == "all" else None
    jumps = _jumps_within(scene, start_frame, count)
    watch, cloth, far = Stopwatch(), scene.cloth, after is not None and after.far
    first = -1 if after is None else after.index
    for index in range(max(first, 0), count):
        body_frame = start_frame + index
        state = state if index == first else recentre(state, scene.cloth.vertex_scene)
        problem, here = None, cloth
        if afresh:
            forget_searches()
        if index + 1 < count:
            with watch.part("posing"):
                closed = None if attachments is None else attachments(index)
                if body_frame in jumps:
                    there, step = carried(scene, body_frame, state, closed)
                else:
                    there, step = state, scene.step_input(body_frame, state, attachments=closed)
                if relaxing and index == 0:
                    step = replace(step, dt=torch.full_like(step.dt, RELAXING_DT))
                cloth = scene.cloth_of_step(body_frame, start_frame)
                problem = StepProblem(cloth, there, step, gravity=stepper.gravity.to(state.pos))
            with watch.part("search"):
                problem = stepper.search(problem)
        with watch.aside("metrics"):
            known = potential.prepare(problem) if problem is not None and wants_potential else problem
        if index != first:
            with watch.aside("metrics"):
                row = {**_state_metrics(scene, here, state, body_frame, known, metrics), **stepped}
                if meter is not None and _is_measured(index, count, surface_stride):
                    row |= _surface_now(meter, scene, state, body_frame)
            row["ms_metrics"] = watch.spent_aside("metrics")
            if guard is not None and index > 0:
                guard.see_surface(index, row)
                if guard.stopped is not None:
                    return
            with watch.aside("caller"):
                origin = state.origin[0]
                body_pos = scene.motion.surface(body_frame, origin.numpy()).cpu().double() + origin
                yield Frame(index, state, state.pos.cpu().double() + origin, body_pos, row, known_fields, far=far)
        if problem is None or known is None:
            return
        prediction, lap, figures = stepper.predict(problem, prepared, watch), watch.lap(), None
        known = as_taken(known, prediction)
        if wants_potential:
            with watch.aside("metrics"):
                figures = StepFigures(potential, known, prediction.next_pos, prediction.acc)
        if guard is not None and not (relaxing and index == 0):
            with watch.aside("guard"):
                known = known if wants_potential else as_taken(potential.prepare(problem), prediction)
                predicted, prediction = prediction, guard.see(index + 1, known, prediction, figures)
            if guard.stopped is not None:
                return
            lap, known = _with_guard(lap, watch.spent_aside("guard")), as_taken(known, prediction)
            if prediction is not predicted and wants_potential:
                with watch.aside("metrics"):
                    figures = StepFigures(potential, known, prediction.next_pos, prediction.acc)
        state = State(prediction.next_pos, stepper.next_velocity(problem, prediction), problem.state.origin)
        stepped = _times(stepper, lap) | prediction.metrics
        if has_layers(potential):
            stepped |= layer_metrics(known, prediction.next_pos)
        with watch.aside("metrics"):
            if figures is not None:
                known_fields = {name: vertex_residual(known, figures.gradient).float().cpu() for name in fields}
                if metrics == "all":
                    stepped |= figures.metrics()
                    if far or _is_measured(index + 1, count, DISTANCE_EVERY * surface_stride):
                        stepped |= distance_metrics(potential, known, prediction.next_pos)
                        far = not far and stepped["distance_p99"] > DISTANCE_FAR.value * scene.dt
        if observe is not None:
            with watch.aside("caller"):
                observe(index + 1, known, prediction)


def _jumps_within(scene: Scene, start_frame: int, count: int) -> dict[int, Jump]:
    """Jumps of the body in these frames, by frame; a warning says so."""
    jumps = find_jumps(scene.motion, 1.0 / scene.dt)
    within = {frame: jump for frame, jump in jumps.items() if start_frame <= frame < start_frame + count - 1}
    if within:
        warnings.warn(describe_jumps(scene.motion, within), stacklevel=3)
    return within


#: A start with an edge lengthened by more than this share would snap back in the first frames.
_STRETCH = 0.1
#: One with an edge lengthened by more than this is told; measured: at most 0.08 in ordinary poses, 0.18 to 0.69 seated.
_TORN = 0.3


@torch.no_grad()
def start_state(stepper: Stepper, scene: Scene, potential: Potential, relaxing_steps: int, frame: int = 0) -> State:
    """Settled, relaxed start: the relaxing step is kept only where it lowers the potential of its own problem, leaves no edge
    stretched by more than a tenth that was not before, and takes no cloth through the body to its other side.

    Steppers that carry on or restart from it (:class:`hood.steppers.protocol.Relaxing`) get its positions as they are, and the
    velocity of their own rule. Those that restart take the last of the relaxing steps on the way to the next frame: it is not
    taken here, and the start is at rest.

    Garments of an outfit are taken apart where the potential keeps layers apart (:func:`hood.scene.untangle.separate`).

    Where the garment cannot be put on in the pose of ``frame``, the body moves into it from the T-pose first: that second is
    simulated and dropped, and a warning says so. What it leads to is the start, velocity included.

    Raises:
        NotWornError: nor can it be put on in the T-pose, or the way from there ends in numbers that are not finite.
        TangledError: garments of an outfit cannot be taken apart.
    """
    state, told = _begun(stepper, scene, potential, relaxing_steps, frame)
    if told:
        warnings.warn(told, stacklevel=2)
    return state


def _begun(stepper: Stepper, scene: Scene, potential: Potential, relaxing_steps: int, frame: int) -> tuple[State, str]:
    """:func:`start_state`, and in words what stretches its edges beyond :data:`_TORN`; "" where nothing does."""
    try:
        state = scene.start(frame, relaxed=False, thorough=True)
    except NotWornError as refusal:
        return _led_in(stepper, scene, potential, relaxing_steps, frame, refusal), ""
    put_on = _longest(scene, state.pos)
    if has_layers(potential):
        state = _taken_apart(scene, state, frame)
    stretched, told = _longest(scene, state.pos), ""
    if stretched > _TORN:
        part = worst_part(scene, state.pos.double().cpu().numpy())
        starts = (
            f"garment {scene.garment.name!r}{f', {part},' if part else ''} starts with edges stretched by up to {stretched:.0%}"
        )
        told = f"{starts} {_why_stretched(scene, frame, put_on)}"
    prepared = prepare_stepper(stepper, scene)
    velocity = scene.start_velocity(frame)
    if stepper.relaxing is Relaxing.RESTART and relaxing_steps > 0:
        velocity, relaxing_steps = torch.zeros_like(velocity), relaxing_steps - 1
    for _ in range(relaxing_steps):
        step = scene.step_input(frame, state, relaxing=True)
        problem = stepper.search(StepProblem(scene.cloth, state, step, gravity=stepper.gravity.to(state.pos)))
        prediction = stepper.predict(problem, prepared)
        if stepper.relaxing is not Relaxing.SETTLE:
            state = State(prediction.next_pos, state.vel, state.origin)
            velocity = stepper.next_velocity(problem, prediction)
            continue
        pos = push_out_of_body(scene.cloth, prediction.next_pos, step.obstacle, scene.clearance)
        problem = potential.prepare(problem)
        lower = bool((potential.total(problem, pos) < potential.total(problem, state.pos)).all())
        kept = lower and bool(torch.isfinite(pos).all()) and _longest(scene, pos) <= max(_STRETCH, _longest(scene, state.pos))
        if kept and not _passes(scene, frame, state, pos):
            state = State(pos, state.vel, state.origin)
    return State(state.pos, velocity, state.origin), told


def _passes(scene: Scene, frame: int, state: State, pos: Tensor) -> bool:
    """Whether the body of ``frame`` cuts the cloth on its straight way from ``state`` to ``pos``, and not where that begins."""
    body = scene.motion.surface(frame, state.origin[0].numpy()).double().cpu().numpy()
    start, end = (one.double().cpu().numpy() for one in (state.pos, pos))
    looks = min(math.ceil(float(np.linalg.norm(end - start, axis=1).max()) / _LOOK), _LOOKS)
    if not len(scene.motion.faces) or not np.isfinite(body).all():
        return False
    for look in range(looks):
        cut = crossings(start + look / looks * (end - start), scene.garment.faces, body, scene.motion.faces).pairs
        if len(np.unique(cut[:, 0])) > CUT_UNSOUND.value * len(scene.garment.faces):
            return look > 0
    return False


def _why_stretched(scene: Scene, frame: int, put_on: float) -> str:
    """What stretched the edges of a start beyond :data:`_TORN`, which were stretched by ``put_on`` before anything was taken
    apart, and what helps."""
    if put_on > _TORN:
        return (
            f"in frame {frame} of {scene.motion.name!r}: let the body move there from a standing pose (blend_in=1), or start "
            "elsewhere (start=…)"
        )
    if scene.outfit is not None:
        return (
            f"since its garments were taken apart, {put_on:.0%} before: they lie deep in each other; give another order "
            "(layers=[…]), or one that is cut wider (size=…)"
        )
    return (
        f"since it was smoothed where it passes through itself, {put_on:.0%} before: put on this body in frame {frame} of "
        f"{scene.motion.name!r}, its parts lie in each other; give another shape (betas=…), a standing pose (blend_in=1), or a "
        "garment that is made for this body"
    )


def _taken_apart(scene: Scene, state: State, frame: int) -> State:
    """The start with its garments apart; a warning says in which order they are worn where that was guessed."""
    state, found = scene.taken_apart(state, frame)
    if found is not None and found.lifted:
        assert scene.outfit is not None
        order = ", ".join(scene.outfit.names[garment] for garment in found.order)
        warnings.warn(
            "outfit: garments lie in the same place at the start and were laid over each other; from the body outwards: "
            f"{order}",
            stacklevel=3,
        )
    if found is not None and (found.before or found.turned):
        assert scene.outfit is not None
        names = scene.outfit.names
        order = ",".join(scene.outfit.names[garment] for garment in found.order)
        guessed = "" if scene.layers is not None else f" (as they mostly lie; layers=[{order}] or another order settles it)"
        turned = "".join(
            f"; {names[over]!r} lay under {names[under]!r} and was taken over it, with edges stretched by up to "
            f"{found.stretch:.0%}, as layers=… asks"
            for over, under in found.turned
        )
        warnings.warn(
            f"outfit: {found.before} pairs of triangles passed through each other at the start and were taken apart; from the "
            f"body outwards: {order.replace(',', ', ')}{guessed}{turned}; this took {found.seconds:.1f} s",
            stacklevel=3,
        )
    return state


def own_start(stepper: Stepper, scene: Scene, frame: int = 0) -> str | None:
    """Why ``settle="equilibrium"`` does not say where ``frame`` starts; None where it does."""
    if stepper.relaxing is not Relaxing.SETTLE:
        return "these weights go on from their relaxing step, as they were trained to"
    if scene.start_pos is not None and frame == 0:
        return "the scene gives the start"
    return None if worn_vertices(scene, frame).any() else "a sheet starts as it is given"


@torch.no_grad()
def rest_state(
    stepper: Stepper,
    scene: Scene,
    potential: Potential,
    relaxing_steps: int,
    frame: int = 0,
    attachments: AttachmentSchedule | None = None,
    most_steps: int | None = None,
) -> tuple[State, Rest | None]:
    """Start at rest on the still body of ``frame``, moving with the skinned garment, and how it was found; that of
    :func:`start_state`, None and a warning where nothing holds the garment. Edges that are stretched at first are told where
    they still are at rest. ``most_steps`` as in :func:`hood.rollouts.equilibrium.find_equilibrium`."""
    falls = without_hold(scene)
    if falls is not None:
        warnings.warn(f"garment {scene.garment.name!r} is not settled, it falls from its start: {falls}", stacklevel=2)
        return start_state(stepper, scene, potential, relaxing_steps, frame), None
    start, told = _begun(stepper, scene, potential, 0, frame)
    closed = None if attachments is None else attachments(0)
    rest = find_equilibrium(scene, potential, start, frame, stepper.gravity, closed, most_steps)
    if told and _longest(scene, rest.pos) > _TORN:
        warnings.warn(told, stacklevel=2)
    return State(rest.pos, scene.start_velocity(frame), start.origin), rest


def _settled(rest: Rest, scene: Scene, frame: int, state: State) -> dict[str, float]:
    """:data:`SETTLE_METRICS` of the ``state`` that was found."""
    body = scene.motion.surface(frame, state.origin[0].numpy()).double().cpu().numpy()
    before, after = (pos.double().cpu().numpy()[None] for pos in (rest.began, rest.pos))
    faces, pinned = scene.garment.faces, np.flatnonzero(scene.garment.pinned)
    both = (np.concatenate([before, after]), faces, np.stack([body, body]), scene.motion.faces)
    wear = measure_wear(*both, [1], pinned) if len(body) and np.isfinite(after).all() else None
    came = (np.nan, np.nan) if wear is None else (_most(wear.away), _most(wear.sunk))
    values = (float(rest.steps), rest.seconds, rest.speed, float(rest.reached), *came)
    return dict(zip(SETTLE_METRICS, values, strict=True))


def _most(lengths: np.ndarray) -> float:
    """The largest that is known; NaN where none is."""
    return float(np.fmax.reduce(lengths.reshape(-1), initial=np.nan))


def _led_in(
    stepper: Stepper, scene: Scene, potential: Potential, relaxing_steps: int, frame: int, refusal: NotWornError
) -> State:
    """The state at ``frame`` after moving there from the T-pose; ``refusal`` is raised where that does not help."""
    try:
        lead = scene.lead_in(frame)
    except NotWornError:
        lead = None
    if lead is None:
        raise refusal
    *_, last = simulate(stepper, lead, potential, relaxing_steps=relaxing_steps, metrics="none")
    if isinstance(stepper, RefinedStepper):
        stepper.begin_rollout()  # the frames that are dropped are none of its frames
    if not bool(torch.isfinite(last.state.pos).all()):
        raise refusal
    warnings.warn(
        f"garment {scene.garment.name!r} cannot be put on in the pose of frame {frame} of {scene.motion.name!r}: the body "
        f"moves into it from the T-pose in {LEAD_IN:g} s that are simulated and dropped; frame 0 is that of the motion",
        stacklevel=2,
    )
    return last.state


def _longest(scene: Scene, pos: Tensor) -> float:
    """Largest relative lengthening of an edge that is not held at both ends."""
    return float(free_stretch(scene.cloth, pos).max()) if len(scene.cloth.edges) else 0.0
