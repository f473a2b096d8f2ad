"""The running rollouts of a batch: each slot carries one training scene forward until its horizon is reached.

Garments by size: a batch holds scenes of similar size, and as many of them as a budget of vertices allows.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from hood.cloth.cloth import Cloth, concatenate_cloths
from hood.cloth.state import State, StepInput, concatenate_states, concatenate_step_inputs
from hood.scene.scene import RELAXING_DT, recentre
from hood.solver.step_figures import edge_strain
from hood.steppers.network import NetworkStepper, Prepared
from hood.tensors.batch import sent
from hood.tensors.dense import sum_scenes
from hood.training.prefetch import MAX_DRAWS, Request, SceneFeed, Start, choose_workers, draw_window, make_start
from hood.training.scenes import SceneSampler, Window

#: Templates share a bucket up to this ratio of vertices.
_SPREAD = 1.5


@dataclass(frozen=True)
class Bucket:
    """Templates of similar size and the slots that train them."""

    templates: tuple[int, ...]  # indices into the list of garments
    first: int  # number of its first slot; slots are numbered through
    count: int  # slots, the scenes of one update

    def template(self, place: int, draw: int) -> int:
        """The garment of scene number ``draw`` of slot ``first + place``: they go round, each as often as the others."""
        return self.templates[(place + draw * self.count) % len(self.templates)]


def make_buckets(sizes: Sequence[int], batch_size: int, max_vertices: int | None = None) -> list[Bucket]:
    """Buckets for garments of ``sizes`` vertices, small ones first.

    Without ``max_vertices`` there is one bucket of ``batch_size`` scenes of all garments. With it, a bucket's largest garment
    has at most 1.5 × the vertices of its smallest, and its updates hold the largest multiple of ``batch_size`` scenes that
    stays within ``max_vertices``. Nothing here depends on how many processes share the scenes; a number of processes that
    divides ``batch_size`` divides every bucket.

    Raises:
        ValueError: ``batch_size`` scenes of the largest garment are more than ``max_vertices``.
    """
    if max_vertices is None:
        return [Bucket(tuple(range(len(sizes))), 0, batch_size)]
    if batch_size * max(sizes) > max_vertices:
        raise ValueError(
            f"trainer.max_vertices={max_vertices}: {batch_size} scenes (trainer.batch_size) of the largest garment, "
            f"{max(sizes)} vertices, are {batch_size * max(sizes)}; raise the one or lower the other"
        )
    groups: list[list[int]] = []
    for index in sorted(range(len(sizes)), key=lambda i: (sizes[i], i)):
        if groups and sizes[index] <= _SPREAD * sizes[groups[-1][0]]:
            groups[-1].append(index)
        else:
            groups.append([index])
    buckets: list[Bucket] = []
    for group in groups:
        count = max_vertices // (batch_size * sizes[group[-1]]) * batch_size
        first = buckets[-1].first + buckets[-1].count if buckets else 0
        buckets.append(Bucket(tuple(sorted(group)), first, count))
    return buckets


def next_bucket(buckets: Sequence[Bucket], turns: Sequence[int]) -> int:
    """Whose update is next after ``turns`` updates of each: they take turns in proportion to their numbers of templates.

    An update's loss is the mean over its own scenes, so every template has the same weight in the expected gradient,
    whatever its size. The scenes behind that mean are fewer for large garments: their share of it is noisier.
    """
    return min(range(len(buckets)), key=lambda k: ((turns[k] + 1) / len(buckets[k].templates), k))


#: Velocities after the relaxing step.
RELAXED_VELOCITIES = ("skinned", "own", "zero")
#: ``torn_strain`` unless said otherwise: nothing can be learned from debris.
TORN_STRAIN = 1.5


class TrainingStep(NamedTuple):
    """Scenes of an update and the step that they take."""

    cloth: Cloth
    prepared: Prepared
    state: State
    step: StepInput
    kind: tuple[int, bool] | None = None  # template, and whether mirrored: what the topology of a scene alone depends on
    runs: Tensor | None = None  # () bool: whether the rollout of a scene alone still goes on; None: it does
    ahead: Ahead | None = None  # what follows, of a batch


class Ahead:
    """The steps that follow one of a batch, without the rollouts going on."""

    def __init__(self, slots: Slots) -> None:
        self._slots, self._running = slots, slots.running
        self._counts = [slot.window.scene.cloth.num_vertices for slot in self._running if slot.window is not None]

    def velocity(self, next_vel: Tensor) -> Tensor:
        """(V, 3) m/s that the next step begins with, of what the simulator says of this one."""
        return torch.cat(self._slots.velocities(next_vel))

    def step(self, number: int, pos: Tensor) -> tuple[StepInput, Tensor]:
        """What is prescribed for step ``number`` after this one, from positions (V, 3) [m], and which scenes (B,) bool have so
        many in their motion; of the others the last."""
        steps, there, last = [], [], self._slots.max_horizon
        for slot, own in zip(self._running, pos.detach().split(self._counts), strict=True):
            assert slot.window is not None
            assert slot.state is not None
            age = slot.age + number
            there.append(age <= last)
            frame = slot.window.start_frame + max(min(age, last) - 1, 0)
            steps.append(slot.window.scene.step_input(frame, replace(slot.state, pos=own)))
        return concatenate_step_inputs(steps, self._counts), torch.tensor(there, device=pos.device)


@dataclass
class _Slot:
    bucket: int
    place: int  # in its bucket
    draws: int = 0
    age: int = 0
    length: int | None = None  # steps after the relaxing one; None: as many as the horizon of the moment
    still: bool = False  # there is no relaxing step: the first one is a regular one on a still body
    window: Window | None = None
    state: State | None = None
    prepared: Prepared | None = None
    runs: Tensor | None = None  # () bool on the device, where the host does not know yet


class Taken(NamedTuple):
    """A step that a slot has taken without the host knowing what became of its rollout."""

    slot: _Slot
    window: Window
    state: State


class Slots:
    """Running rollouts, a batch of them for every bucket of garments of similar size.

    Scene number ``draws`` of slot *i* is a function of (seed, i, draws), the bucket of an update one of their number: a
    checkpoint stores these numbers and the states, nothing else. Garments go round the slots of their bucket, so that every
    template is seen equally often. This process runs every ``ranks``-th slot from ``rank`` on; the scenes do not depend on
    how many processes share them, nor on ``workers``.

    Args:
        batch_size: scenes of one update, or with ``max_vertices`` what that number is a multiple of.
        max_horizon: regular steps of the longest rollout.
        max_vertices: vertices of one update at most, over all processes; None: garments of all sizes share batches.
        workers: processes that make scenes ahead, see :class:`hood.training.prefetch.SceneFeed`; None: one per idle core.
        whole: rollouts keep the horizon with which they began and go on to it, torn or not; otherwise one that grows lengthens
            those that run, and torn ones end.
        relaxed_velocity: after the relaxing step: ``skinned``, that of the skinned garment; ``own``, its displacement in a
            frame; ``zero``.
        torn_strain: a rollout is torn where 1% of its edges are strained more than this, a share of their length at rest.
    """

    def __init__(
        self,
        sampler: SceneSampler,
        simulator: NetworkStepper,
        batch_size: int,
        seed: int,
        max_horizon: int,
        rank: int = 0,
        ranks: int = 1,
        max_vertices: int | None = None,
        workers: int | None = 0,
        whole: bool = False,
        relaxed_velocity: str = "skinned",
        torn_strain: float = TORN_STRAIN,
    ) -> None:
        self.whole, self.relaxed_velocity, self.torn_strain = whole, relaxed_velocity, torn_strain
        self.sampler, self.simulator, self.seed, self.max_horizon = sampler, simulator, seed, max_horizon
        self.buckets = make_buckets([len(garment.rest_pos) for garment in sampler.garments], batch_size, max_vertices)
        self._slots = {
            bucket.first + place: _Slot(number, place)
            for number, bucket in enumerate(self.buckets)
            for place in range(rank, bucket.count, ranks)
        }
        self._turns = [0] * len(self.buckets)
        self._batches: dict[int, tuple[Cloth, Prepared]] = {}
        self.feed = SceneFeed(sampler, choose_workers(workers, len(self._slots)))

    @property
    def ending_strain(self) -> float:
        """Strain at which a rollout ends, see :func:`is_lost`."""
        return math.inf if self.whole else self.torn_strain

    @property
    def most_scenes(self) -> int:
        """Of an update, over all processes."""
        return max(bucket.count for bucket in self.buckets)

    @property
    def num_slots(self) -> int:
        """Rollouts of all buckets, over all processes."""
        return self.buckets[-1].first + self.buckets[-1].count

    def batch(self, horizon: int) -> TrainingStep:
        """The current problems as one flat batch; slots past ``horizon`` steps after the relaxing one start a scene first."""
        parts, number = self.each(horizon), self._current()[0]
        counts = [part.cloth.num_vertices for part in parts]
        if number not in self._batches:
            cloth = concatenate_cloths([part.cloth for part in parts])
            self._batches[number] = (cloth, self.simulator.concatenate(cloth, [part.prepared for part in parts], counts))
        states, steps = [part.state for part in parts], [part.step for part in parts]
        given = concatenate_states(states), concatenate_step_inputs(steps, counts)
        return TrainingStep(*self._batches[number], *given, ahead=Ahead(self))

    @property
    def running(self) -> list[_Slot]:
        """Those of the update whose turn it is."""
        return list(self._current()[1].values())

    def velocities(self, next_vel: Tensor) -> list[Tensor]:
        """Velocities (V, 3) [m/s] of every rollout after a step of which the simulator says ``next_vel``, of all one after the
        other."""
        found, offset = [], 0
        for slot in self.running:
            assert slot.window is not None
            own = next_vel[offset : (offset := offset + slot.window.scene.cloth.num_vertices)]
            found.append(self._relaxed(slot, own) if slot.age == 0 else own)
        return found

    def each(self, horizon: int) -> list[TrainingStep]:
        """The current problems as in :meth:`batch`, every scene alone."""
        slots = self._current()[1]
        for index, slot in slots.items():
            # Step 0 is the relaxing step; ``horizon`` regular steps follow it.
            if slot.window is None or slot.age > (horizon if slot.length is None else slot.length):
                self._reset(index, slot, horizon)
        return [self._part(slot) for slot in slots.values()]

    def _part(self, slot: _Slot) -> TrainingStep:
        window, prepared = slot.window, slot.prepared
        assert window is not None
        assert prepared is not None
        assert slot.state is not None
        scene, first = window.scene, slot.age == 0
        step = scene.step_input(window.start_frame + max(slot.age - 1, 0), slot.state, relaxing=first)
        if first and slot.still:
            step = replace(step, dt=torch.full_like(step.dt, scene.dt))
        return TrainingStep(scene.cloth, prepared, slot.state, step, (window.template, window.mirrored), slot.runs)

    def skinned_accelerations(self) -> Tensor:
        """(V, 3) m per frame² of the batch's skinned garments at their current frames: the scale of the paper's output."""
        parts = []
        for slot in self._current()[1].values():
            assert slot.window is not None
            parts.append(slot.window.scene.skinned_acceleration(slot.window.start_frame + max(slot.age - 1, 0)))
        return torch.cat(parts)

    def advance(
        self, next_pos: Tensor, next_vel: Tensor, lost: Sequence[bool] | None = None, centres: Tensor | None = None
    ) -> None:
        """Take the predicted positions (V, 3) and velocities (V, 3) over; rollouts that are lost end here.

        Args:
            lost: what :func:`is_lost` says of the positions, where that is known.
            centres: (B, 3) m, on the CPU: :func:`hood.cloth.state.centres_of` the positions, where they are known.

        The turn passes on to the next bucket.
        """
        for place, taken in enumerate(self._take_over(next_pos, next_vel)):
            cloth, pos = taken.window.scene.cloth, taken.state.pos
            ends = bool(is_lost(cloth, pos, self.ending_strain)) if lost is None else lost[place]
            self.settle([taken], [ends], None if centres is None else centres[place : place + 1])

    def advance_unread(self, next_pos: Tensor, next_vel: Tensor, goes_on: Tensor) -> list[Taken]:
        """The same, where the device alone knows which rollouts go on, (B,) bool; :meth:`settle` says it later. Until then the
        origins of the states stay."""
        taken = self._take_over(next_pos, next_vel)
        for one, runs in zip(taken, goes_on.unbind(), strict=True):
            one.slot.runs = runs
        return taken

    def settle(self, taken: Sequence[Taken], lost: Sequence[bool], centres: Tensor | None) -> None:
        """End the rollouts that were lost in a step, and move the origins of those that go on from it next to their ``centres``
        (B, 3) m, on the CPU; None: they are found here."""
        for place, (slot, window, state) in enumerate(taken):
            if slot.window is window and slot.state is state:
                centre = None if centres is None else centres[place : place + 1]
                slot.state = recentre(state, window.scene.cloth.vertex_scene, centre)
            if slot.window is window and lost[place]:
                slot.window = None

    def _take_over(self, next_pos: Tensor, next_vel: Tensor) -> list[Taken]:
        number, slots = self._current()
        taken, velocities = [], self.velocities(next_vel.detach())
        places = next_pos.detach().split([len(vel) for vel in velocities])
        for slot, pos, vel in zip(slots.values(), places, velocities, strict=True):
            assert slot.window is not None
            assert slot.state is not None
            slot.state = State(pos, vel, slot.state.origin)
            slot.age += 1
            taken.append(Taken(slot, slot.window, slot.state))
        self._turns[number] += 1
        return taken

    def state_dict(self) -> dict[int, dict[str, Any]]:
        """By slot: plain numbers and tensors that :meth:`load_state_dict` restores exactly."""
        entries = {}
        for index, slot in self._slots.items():
            entry: dict[str, Any] = {"draws": slot.draws, "age": slot.age, "live": slot.window is not None}
            entry["turns"] = self._turns[slot.bucket]
            if slot.length is not None:
                entry["length"] = slot.length
            if slot.state is not None and slot.window is not None:
                entry |= {"pos": slot.state.pos.cpu(), "vel": slot.state.vel.cpu(), "origin": slot.state.origin}
            entries[index] = entry
        return entries

    def restart(self) -> None:
        """Give every running rollout up: the next batch starts scenes that were not drawn before."""
        self._batches.clear()
        for slot in self._slots.values():
            slot.window = None

    def load_state_dict(self, state: Mapping[int, Mapping[str, Any]]) -> None:
        self.restart()
        for index, slot in self._slots.items():
            entry = state[index]
            slot.draws, slot.age = int(entry["draws"]), int(entry["age"])
            self._turns[slot.bucket] = int(entry["turns"])
            slot.length = entry.get("length")
            if entry["live"]:
                draw, device = slot.draws - 1, self.sampler.device
                garment = self.buckets[slot.bucket].template(slot.place, draw)
                window = draw_window(self.sampler, self.seed, index, draw, garment, self.max_horizon + 1)
                slot.window = window.to(device)
                slot.prepared, slot.runs = self._prepare(window).to(device), None
                slot.state = State(entry["pos"].to(device), entry["vel"].to(device), entry["origin"])
            self.feed.expect(self._request(index, slot))

    def close(self) -> None:
        """End the processes that make scenes ahead; they start again when needed."""
        self.feed.close()

    def _current(self) -> tuple[int, dict[int, _Slot]]:
        """The bucket whose update it is and this process's slots of it."""
        number = next_bucket(self.buckets, self._turns)
        return number, {index: slot for index, slot in self._slots.items() if slot.bucket == number}

    def _reset(self, index: int, slot: _Slot, horizon: int) -> None:
        start = self.feed.take(self._request(index, slot))
        device = self.sampler.device
        slot.window = start.window.to(device)
        slot.length, slot.still = horizon if self.whole else None, slot.window.still and horizon == 0
        # The way of the frame before, as a velocity in the time of the first step.
        vel = start.state.vel if self._in_frames(slot) else start.state.vel * (slot.window.scene.dt / RELAXING_DT)
        begin = recentre(State(start.state.pos, vel, start.state.origin), torch.zeros(len(vel), dtype=torch.int64))
        slot.state = State(sent(begin.pos, device), sent(begin.vel, device), begin.origin)
        slot.draws += start.draws
        slot.prepared, slot.runs = self._prepare(start.window).to(device), None
        slot.age = 0
        self._batches.pop(slot.bucket, None)
        self.feed.expect(self._request(index, slot))

    def scene(self, index: int, draw: int) -> Start:
        """Scene number ``draw`` of a slot of this process, made here; the running rollouts stay as they are."""
        slot = self._slots[index]
        return make_start(self.sampler, self._request(index, _Slot(slot.bucket, slot.place, draw)))

    def _request(self, index: int, slot: _Slot) -> Request:
        """The next scene of a slot."""
        bucket = self.buckets[slot.bucket]
        garments = tuple(bucket.template(slot.place, slot.draws + attempt) for attempt in range(MAX_DRAWS))
        return Request(self.seed, index, slot.draws, garments, self.max_horizon + 1)

    def _in_frames(self, slot: _Slot) -> bool:
        """Whether velocities of the first step are those of a frame."""
        return self.simulator.rules.frame_dt is not None or slot.still

    def _relaxed(self, slot: _Slot, vel: Tensor) -> Tensor:
        """Velocity (V, 3) [m/s] after the first step, of which the simulator says ``vel``."""
        window = slot.window
        assert window is not None
        if self.relaxed_velocity == "skinned":
            return window.scene.start_velocity(window.start_frame)
        if self.relaxed_velocity == "zero":
            return torch.zeros_like(vel)
        return vel if self._in_frames(slot) else vel * (RELAXING_DT / window.scene.dt)

    def _prepare(self, window: Window) -> Prepared:
        # A mirrored scene has the levels of its template: they are then the image of the original's, and found once.
        return self.simulator.prepare(window.scene.cloth, self.sampler.garments[window.template].rest_pos)


def is_lost(cloth: Cloth, pos: Tensor, torn_strain: float) -> Tensor:
    """Scenes (B,) bool whose rollout ends with ``pos`` (V, 3) [m]: it is not finite, or more than 1% of the edges are strained
    more than ``torn_strain``, a share of their length at rest; infinite: however torn."""
    count, like = cloth.num_scenes, cloth.rest_pos.new_zeros(0, dtype=torch.float64)
    broken = sum_scenes((~torch.isfinite(pos)).any(dim=1).to(like), cloth.vertex_scene, count)
    torn = sum_scenes((edge_strain(cloth, pos).abs() > torn_strain).to(like), cloth.edge_scene, count)
    edges = sum_scenes(like.new_ones(len(cloth.edges)), cloth.edge_scene, count)
    return (broken > 0) | (torn / edges.clamp_min(1.0) > 0.01)
