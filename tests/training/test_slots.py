"""Running rollouts: the same scenes whoever makes them, however many processes share them, wherever a run was cut."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.assets.motion.sequence import PoseSequence
from hood.steppers.network import NetworkStepper, build_simulator
from hood.training import prefetch
from hood.training.prefetch import MAX_DRAWS, Request, SceneFeed, choose_workers, make_start
from hood.training.scenes import SceneSampler, Window
from hood.training.slots import Slots

HORIZON = 1


@pytest.fixture(scope="module")
def simulator() -> NetworkStepper:
    torch.manual_seed(0)
    return build_simulator("physical", "velocity_base", "1x(mesh+coarse0)", 8, output_init=0.1).eval()


@pytest.fixture(scope="module")
def sampler(body: Body, garments: dict[str, Garment], walk: PoseSequence) -> SceneSampler:
    return SceneSampler(body, [garments["tank"], garments["skirt"]], [walk.window(0, 60)])


@pytest.fixture(scope="module")
def mixed(body: Body, garments: dict[str, Garment], walk: PoseSequence) -> SceneSampler:
    """Templates of two sizes; a piece of the skirt stands in for the small one."""
    skirt = garments["skirt"]
    keep = skirt.faces[(skirt.faces < 300).all(axis=1)]
    used = np.unique(keep)
    number = np.full(len(skirt.rest_pos), -1)
    number[used] = np.arange(len(used))
    assert skirt.lbs_weights is not None
    assert skirt.shapedirs is not None
    piece = replace(
        skirt, name="piece", rest_pos=skirt.rest_pos[used], faces=number[keep], pinned=skirt.pinned[used],
        lbs_weights=skirt.lbs_weights[used], shapedirs=skirt.shapedirs[used], uv=None, uv_faces=None,
    )  # fmt: skip
    return SceneSampler(body, [garments["tank"], skirt, piece], [walk.window(0, 60)])


@pytest.fixture
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers start with the first scene."""
    monkeypatch.setattr(prefetch, "_WARM_UP", 0)


def record(slots: Slots, num_updates: int) -> list[tuple[Tensor, ...]]:
    """What the network gets to see in the next updates; cloth moves with the body."""
    seen = []
    for _ in range(num_updates):
        cloth, _, state, step, *_ = slots.batch(HORIZON)
        obstacle = step.obstacle
        assert obstacle is not None
        seen.append((cloth.rest_pos, cloth.density, cloth.faces, state.pos, obstacle.pos, obstacle.next_pos, obstacle.faces))
        dt = step.dt[cloth.vertex_scene].unsqueeze(1)
        slots.advance(state.pos + dt * state.vel, state.vel)
    return seen


def assert_same(first: list[tuple[Tensor, ...]], second: list[tuple[Tensor, ...]]) -> None:
    assert len(first) == len(second)
    for a, b in zip(first, second, strict=True):
        for x, y in zip(a, b, strict=True):
            assert torch.equal(x, y)


@pytest.fixture
def closing() -> Iterator[list[SceneFeed]]:
    feeds: list[SceneFeed] = []
    yield feeds
    for feed in feeds:
        feed.close()


@pytest.mark.usefixtures("at_once")
def test_workers_make_the_same_scenes_and_a_dead_one_is_done_without(
    sampler: SceneSampler, simulator: NetworkStepper, closing: list[SceneFeed], monkeypatch: pytest.MonkeyPatch
) -> None:
    alone = record(Slots(sampler, simulator, 2, 0, HORIZON), 8)
    slots = Slots(sampler, simulator, 2, 0, HORIZON, workers=1)
    closing.append(slots.feed)
    received: list[dict] = []
    unpack = SceneSampler.unpack

    def receive(sampler: SceneSampler, packed: dict) -> Window:
        received.append(packed)
        return unpack(sampler, packed)

    monkeypatch.setattr(SceneSampler, "unpack", receive)
    ahead = record(slots, 2)
    for future in slots.feed._expected.values():
        future.result(timeout=60)  # what a worker has not begun when it is asked for would be made here
    ahead += record(slots, 2)
    assert len(received) == 2
    resumed = Slots(sampler, simulator, 2, 0, HORIZON)
    resumed.load_state_dict(slots.state_dict())
    assert_same(alone[4:6], record(resumed, 2))
    assert slots.feed._pool is not None
    for process in list(slots.feed._pool._processes.values()):
        os.kill(process.pid, signal.SIGKILL)
        process.join(10)
    with pytest.warns(UserWarning, match="a scene worker died"):
        ahead += record(slots, 4)
    assert slots.feed.workers == 0
    assert_same(alone, ahead)


@pytest.mark.slow
@pytest.mark.skipif(not os.path.isdir("/proc"), reason="looks processes up in /proc")
def test_workers_do_not_outlive_a_killed_training_process() -> None:
    script = Path(__file__).with_name("training_with_a_worker.py")
    process = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    worker = int(process.stdout.readline())
    assert Path(f"/proc/{worker}").exists()
    process.kill()
    process.wait()
    for _ in range(600):
        if not Path(f"/proc/{worker}").exists() or " Z " in Path(f"/proc/{worker}/stat").read_text():
            return
        time.sleep(0.1)
    raise AssertionError("the worker is still there a minute later")


def test_packing_keeps_every_bit(sampler: SceneSampler) -> None:
    for seed in range(4):  # plain and mirrored
        window = sampler.sample(np.random.default_rng(seed), 20)
        other = sampler.unpack(sampler.pack(window))
        assert (other.start_frame, other.mirrored, other.template) == (window.start_frame, window.mirrored, window.template)
        assert other.scene.garment is window.scene.garment
        assert other.scene.dt == window.scene.dt
        for name, value in vars(window.scene.cloth).items():
            same = getattr(other.scene.cloth, name)
            assert torch.equal(value, same) if isinstance(value, Tensor) else value == same
        origin = np.array([0.25, 1.0, -0.5])
        for frame in range(window.scene.num_frames):
            assert torch.equal(other.scene.motion.surface(frame, origin), window.scene.motion.surface(frame, origin))


def test_bad_starts_are_drawn_again(sampler: SceneSampler, monkeypatch: pytest.MonkeyPatch) -> None:
    request = Request(0, 1, 5, (0, 1, 0, 1), 2)
    assert make_start(sampler, request).draws == 1
    monkeypatch.setattr(prefetch, "_BAD_START", -1.0)
    start = make_start(sampler, request)
    assert start.draws == MAX_DRAWS
    last = make_start(sampler, replace(request, draw=8, garments=(1,)))
    assert torch.equal(start.state.pos, last.state.pos)


def test_buckets_take_turns_and_shares_do_not_matter(mixed: SceneSampler, simulator: NetworkStepper) -> None:
    whole = Slots(mixed, simulator, 2, 0, HORIZON, max_vertices=2200)
    assert whole.num_slots == 2 + 2 * (2200 // (2 * len(mixed.garments[2].rest_pos)))
    parts = [Slots(mixed, simulator, 2, 0, HORIZON, rank, 2, max_vertices=2200) for rank in range(2)]
    sizes = []
    for all_seen, first, second in zip(record(whole, 6), *(record(part, 6) for part in parts), strict=True):
        count = len(all_seen[0])
        sizes.append(count)
        assert count <= 2200
        # A process has every other scene of the batch.
        assert len(first[0]) + len(second[0]) == count
        rows = {tuple(row) for row in all_seen[0].tolist()}
        assert all(tuple(row) in rows for part in (first, second) for row in part[0].tolist())
    assert len(set(sizes)) > 1, "both buckets had a turn"


def test_state_is_restored_between_turns(mixed: SceneSampler, simulator: NetworkStepper) -> None:
    whole = Slots(mixed, simulator, 1, 3, HORIZON, max_vertices=1100)
    record(whole, 5)
    saved = whole.state_dict()
    json.dumps({k: [entry["draws"], entry["age"], entry["turns"]] for k, entry in saved.items()})
    copied = {k: {name: v.clone() if isinstance(v, Tensor) else v for name, v in entry.items()} for k, entry in saved.items()}
    resumed = Slots(mixed, simulator, 1, 3, HORIZON, max_vertices=1100)
    resumed.load_state_dict(copied)
    assert_same(record(whole, 5), record(resumed, 5))


@pytest.mark.parametrize(("torn_strain", "ages"), [(1.5, [1, 2, 3, 4]), (0.25, [1, 1, 1, 1])])
def test_a_rollout_ends_where_it_is_torn(
    sampler: SceneSampler, simulator: NetworkStepper, torn_strain: float, ages: list[int]
) -> None:
    """All edges are strained by 50%."""
    slots, seen = Slots(sampler, simulator, 1, 0, 5, torn_strain=torn_strain), []
    for _ in range(4):
        cloth, _, state, *_ = slots.batch(5)
        slots.advance(1.5 * cloth.rest_pos, torch.zeros_like(state.vel))
        seen.append(slots.state_dict()[0]["age"])
    assert seen == ages


def test_short_runs_start_no_workers(sampler: SceneSampler, simulator: NetworkStepper) -> None:
    slots = Slots(sampler, simulator, 2, 0, HORIZON, workers=2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        record(slots, 4)
    assert slots.feed._pool is None


def test_number_of_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(prefetch, "idle_cores", lambda: 3)
    assert choose_workers(None, 8) == 3
    assert choose_workers(None, 2) == 2
    assert choose_workers(0, 8) == 0
    with pytest.raises(ValueError, match="trainer.workers is -1"):
        choose_workers(-1, 8)


def test_processes_of_one_machine_share_its_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(8)), raising=False)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    assert prefetch.idle_cores() == 6
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "4")
    assert prefetch.idle_cores() == 0
