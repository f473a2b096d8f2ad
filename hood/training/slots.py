"""The running rollouts of a batch: each slot carries one training scene forward until its horizon is reached."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hood.dynamics.measure import edge_strain
from hood.dynamics.simulator import Prepared, Simulator
from hood.scene.cloth import Cloth, concatenate_cloths
from hood.scene.dataset import SceneSampler, Window
from hood.scene.scene import concatenate_step_inputs, recentre
from hood.scene.state import State, StepInput, concatenate_states

#: A training rollout is given up once 1% of its edges are strained beyond this: nothing can be learned from debris.
_BROKEN_STRAIN = 1.5
#: Skinning cannot dress every pose: a start with 2% of its edges beyond this strain is drawn again, a few times.
_BAD_START = 0.25
_MAX_DRAWS = 4


@dataclass
class _Slot:
    draws: int = 0
    age: int = 0
    window: Window | None = None
    state: State | None = None
    prepared: Prepared | None = None


class Slots:
    """B running rollouts.

    Scene number ``draws`` of slot *i* is a function of (seed, i, draws): a checkpoint stores these numbers and the states,
    nothing else. Garments go round the slots, so that every template is seen equally often. This process runs the slots
    ``mine`` of ``batch_size``; the scenes do not depend on how many processes share them.
    """

    def __init__(
        self,
        sampler: SceneSampler,
        simulator: Simulator,
        batch_size: int,
        seed: int,
        max_horizon: int,
        mine: Sequence[int] | None = None,
    ) -> None:
        self.sampler, self.simulator, self.seed, self.max_horizon = sampler, simulator, seed, max_horizon
        self.batch_size = batch_size
        self._slots = {index: _Slot() for index in (range(batch_size) if mine is None else mine)}
        self._batch: tuple[Cloth, Prepared] | None = None

    def batch(self, horizon: int) -> tuple[Cloth, Prepared, State, StepInput]:
        """The current problems as one flat batch; slots past ``horizon`` steps start a new scene first."""
        for index, slot in self._slots.items():
            # Step 0 is the relaxing step; ``horizon`` regular steps follow it.
            if slot.window is None or slot.age > horizon:
                self._reset(index, slot)
        states, steps, counts = [], [], []
        for slot in self._slots.values():
            assert slot.window is not None
            assert slot.state is not None
            scene, relaxing = slot.window.scene, slot.age == 0
            slot.state = recentre(slot.state, scene.cloth.vertex_scene)
            frame = slot.window.start_frame + max(slot.age - 1, 0)
            states.append(slot.state)
            steps.append(scene.step_input(frame, slot.state, relaxing=relaxing))
            counts.append(scene.cloth.num_vertices)
        if self._batch is None:
            cloth = concatenate_cloths([slot.window.scene.cloth for slot in self._slots.values()])  # type: ignore[union-attr]
            prepared = self.simulator.concatenate(cloth, [slot.prepared for slot in self._slots.values()], counts)  # type: ignore[misc]
            self._batch = (cloth, prepared)
        return *self._batch, concatenate_states(states), concatenate_step_inputs(steps, counts)

    def skinned_accelerations(self) -> Tensor:
        """(V, 3) m per frame² of the batch's skinned garments at their current frames: the scale of the paper's output."""
        parts = []
        for slot in self._slots.values():
            assert slot.window is not None
            parts.append(slot.window.scene.skinned_acceleration(slot.window.start_frame + max(slot.age - 1, 0)))
        return torch.cat(parts)

    def advance(self, next_pos: Tensor, next_vel: Tensor) -> None:
        """Take the predicted positions (V, 3) and velocities (V, 3) over, detached; broken rollouts end here."""
        offset = 0
        for slot in self._slots.values():
            assert slot.window is not None
            assert slot.state is not None
            scene = slot.window.scene
            rows = slice(offset, offset + scene.cloth.num_vertices)
            offset = rows.stop
            pos, vel = next_pos[rows].detach(), next_vel[rows].detach()
            if slot.age == 0:
                vel = scene.start_velocity(slot.window.start_frame)
            slot.state = State(pos, vel, slot.state.origin)
            slot.age += 1
            if _broken(scene.cloth, pos):
                slot.window = None

    def state_dict(self) -> dict[int, dict[str, Any]]:
        """By slot: plain numbers and tensors that :meth:`load_state_dict` restores exactly."""
        entries = {}
        for index, slot in self._slots.items():
            entry: dict[str, Any] = {"draws": slot.draws, "age": slot.age, "live": slot.window is not None}
            if slot.state is not None and slot.window is not None:
                entry |= {"pos": slot.state.pos, "vel": slot.state.vel, "origin": slot.state.origin}
            entries[index] = entry
        return entries

    def load_state_dict(self, state: dict[int, dict[str, Any]]) -> None:
        self._batch = None
        for index, slot in self._slots.items():
            entry = state[index]
            slot.draws, slot.age = int(entry["draws"]), int(entry["age"])
            if entry["live"]:
                slot.window = self._draw(index, slot.draws - 1)
                slot.prepared = self._prepare(slot.window)
                device = slot.window.scene.cloth.rest_pos.device
                slot.state = State(entry["pos"].to(device), entry["vel"].to(device), entry["origin"])

    def _reset(self, index: int, slot: _Slot) -> None:
        for _ in range(_MAX_DRAWS):
            slot.window = window = self._draw(index, slot.draws)
            slot.state = window.scene.start(window.start_frame, relaxed=False)
            slot.draws += 1
            strain = edge_strain(window.scene.cloth, slot.state.pos).abs()
            if float((strain > _BAD_START).double().mean()) < 0.02:
                break
        slot.prepared = self._prepare(window)
        slot.age = 0
        self._batch = None

    def _prepare(self, window: Window) -> Prepared:
        return self.simulator.prepare(window.scene.cloth, window.scene.garment.rest_pos)

    def _draw(self, index: int, draw: int) -> Window:
        rng = np.random.default_rng([self.seed, index, draw])
        return self.sampler.sample(rng, self.max_horizon + 1, garment=index + draw * self.batch_size)


def _broken(cloth: Cloth, pos: Tensor) -> bool:
    if not bool(torch.isfinite(pos).all()):
        return True
    strain = edge_strain(cloth, pos).abs()
    return float((strain > _BROKEN_STRAIN).double().mean()) > 0.01
