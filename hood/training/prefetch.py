"""Scenes made ahead: garment, body surfaces and settled start of the next rollout, with its noise, in worker processes.

A scene is a function of its request alone, so who makes it, and when, changes nothing: a run with workers, without, or
resumed with another number of them sees the same scenes to the last bit.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
import warnings
from collections.abc import Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing.connection import wait
from typing import Any

import numpy as np
import torch

from hood.cloth.state import State
from hood.solver.step_figures import edge_strain
from hood.training.scenes import SceneSampler, Window

#: Skinning cannot dress every pose: a start with 2% of its edges beyond this strain is drawn again, a few times.
_BAD_START = 0.25
MAX_DRAWS = 4
#: Workers of one process, unless told otherwise: more than these make no rollout of 1k vertices start sooner.
_MAX_WORKERS = 4
#: Tells the generator of a scene's noise from that of the scene.
_NOISE = 1
#: Scenes a run takes before it starts workers: one of a few updates would be over before they are ready.
_WARM_UP = 16


@dataclass(frozen=True)
class Request:
    """Which scene: draw number ``draw`` of slot ``slot``, or the next ones where that cannot be dressed."""

    seed: int
    slot: int
    draw: int
    garments: tuple[int, ...]  # template of each attempt, MAX_DRAWS of them
    num_steps: int


@dataclass(frozen=True)
class Start:
    """A scene and the state before its first step, on the CPU; its velocity is the way of the frame before."""

    window: Window
    state: State
    draws: int  # attempts made


def draw_window(sampler: SceneSampler, seed: int, slot: int, draw: int, garment: int, num_steps: int) -> Window:
    """Scene number ``draw`` of a slot."""
    return sampler.sample(np.random.default_rng([seed, slot, draw]), num_steps, garment=garment)


def make_start(sampler: SceneSampler, request: Request) -> Start:
    """The scene that was asked for; the last attempt is taken as it is, and so is the first where starts are not settled."""
    for attempt, garment in enumerate(request.garments):
        window = draw_window(sampler, request.seed, request.slot, request.draw + attempt, garment, request.num_steps)
        state = window.scene.start(window.start_frame, relaxed=False, by_centroids=sampler.by_centroids)
        strain = edge_strain(window.scene.cloth, state.pos).abs()
        if sampler.by_centroids or float((strain > _BAD_START).double().mean()) < 0.02:
            break
    shaking = np.random.default_rng([request.seed, request.slot, request.draw + attempt, _NOISE])
    return Start(window, _shaken(sampler, window, state, shaking), attempt + 1)


def _shaken(sampler: SceneSampler, window: Window, state: State, rng: np.random.Generator) -> State:
    """``state`` with the sampler's noise: on x_t in its positions, and that of both times in its velocity, the way from x_{t−1}
    over the dt of a regular step."""
    if sampler.noise == 0:
        return state
    now, before = torch.as_tensor(sampler.noise * rng.normal(size=(2, *state.pos.shape))).to(state.pos)
    shaking = sampler.noise_on_pinned | ~window.scene.cloth.pinned[:, None]
    return State(state.pos + now * shaking, state.vel + (now - before) * shaking / window.scene.dt, state.origin)


class SceneFeed:
    """Hands scenes out; with ``workers`` processes those announced by :meth:`expect` are made ahead.

    Workers start when a few scenes have been taken (that takes seconds: each imports PyTorch); what they have not begun when
    it is asked for is made here. Should one die, the feed warns and makes the scenes itself.
    """

    def __init__(self, sampler: SceneSampler, workers: int = 0) -> None:
        self.sampler, self.workers = sampler, workers
        self.takes = 0  # scenes handed out so far
        self._pool: ProcessPoolExecutor | None = None
        self._expected: dict[Request, Future[dict[str, Any]]] = {}

    def expect(self, request: Request) -> None:
        """Announce a scene that :meth:`take` will be asked for."""
        if self.workers < 1 or self.takes < _WARM_UP or request in self._expected:
            return
        # An earlier announcement for the same slot will not be asked for any more.
        for old in [known for known in self._expected if known.slot == request.slot]:
            self._expected.pop(old).cancel()
        try:
            self._expected[request] = self._start_pool().submit(_work, request)
        except BrokenProcessPool as error:
            self._give_up(error)

    def take(self, request: Request) -> Start:
        """The scene, as :func:`make_start` makes it."""
        self.takes += 1
        future = self._expected.pop(request, None)
        if future is not None and not future.cancel():
            try:
                return self._unpack(future.result())
            except BrokenProcessPool as error:
                self._give_up(error)
        return make_start(self.sampler, request)

    def close(self) -> None:
        """End the workers; they start again when needed."""
        self._expected.clear()
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)
            self._pool = None

    def _unpack(self, packed: dict[str, Any]) -> Start:
        pos, vel, origin = (torch.from_numpy(packed[name]) for name in ("pos", "vel", "origin"))
        return Start(self.sampler.unpack(packed), State(pos, vel, origin), packed["draws"])

    def _start_pool(self) -> ProcessPoolExecutor:
        if self._pool is None:
            # Forking a process that runs threads, as OpenMP, CUDA and gloo do, may hang the child; a fresh one cannot.
            context = multiprocessing.get_context("spawn")
            state = (pickle.dumps(self.sampler), torch.get_num_threads())
            self._pool = ProcessPoolExecutor(self.workers, context, _begin_work, state)
        return self._pool

    def _give_up(self, error: Exception) -> None:
        warnings.warn(f"a scene worker died ({error}); scenes are made by the training process from here on", stacklevel=3)
        self.workers = 0
        self.close()


def idle_cores() -> int:
    """Cores that training leaves to workers of this process: what its machine has beyond one per thread that trains."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    local = max(int(os.environ.get("LOCAL_WORLD_SIZE", "1")), 1)
    return max(cores // local - torch.get_num_threads(), 0)


def choose_workers(given: int | None, num_slots: int) -> int:
    """``given``, or as many as there are idle cores and rollouts, at most four.

    Raises:
        ValueError: a negative number.
    """
    if given is None:
        return min(idle_cores(), num_slots, _MAX_WORKERS)
    if given < 0:
        raise ValueError(f"trainer.workers is {given}; it must be at least 0, or null for one per idle core")
    return given


# ---- in the workers --------------------------------------------------------------------------------------------------

_SAMPLER: Sequence[SceneSampler] = ()


def _begin_work(sampler: bytes, num_threads: int) -> None:
    global _SAMPLER
    # A signal to the process group is the training process's to answer: it still needs scenes, or ends this process.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    torch.set_num_threads(num_threads)  # as many as there: sums may depend on it
    _SAMPLER = (pickle.loads(sampler),)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os._exit(1)


def _work(request: Request) -> dict[str, Any]:
    start = make_start(_SAMPLER[0], request)
    state = {name: value.numpy() for name, value in vars(start.state).items()}
    return _SAMPLER[0].pack(start.window) | state | {"draws": start.draws}
