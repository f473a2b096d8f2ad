"""The released code's training: its schedule in its own numbers, how its rollouts begin, end and go on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from hood.app.settings.compose import build, load_config
from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.assets.motion.sequence import PoseSequence
from hood.cloth.state import State
from hood.energies.potential import coded_potential
from hood.energies.problem import StepProblem
from hood.mesh.closest_point.vertices import nearest_centroids
from hood.mesh.geometry import face_normals
from hood.scene.scene import RELAXING_DT
from hood.steppers.network import NetworkStepper, build_simulator
from hood.training.curriculum import CollisionRamp, Horizon
from hood.training.prefetch import MAX_DRAWS, Request, make_start
from hood.training.scenes import SceneSampler
from hood.training.settings import TrainerSettings
from hood.training.slots import Slots
from hood.training.trainer import Trainer

DT = 1 / 30
FRAMES = {"frame_dt": DT, "pins_ahead": True, "velocity": "carried", "divisor_floor": 1e-8, "normalizer_decay": 0.0}
PLAIN = {"beta_range": 3.0, "size_range": (1.0, 1.0), "piecewise_fraction": 0.0, "random_yaw": False, "mirror": False}


def settings_of(*words: str) -> TrainerSettings:
    return build(load_config("train", ["experiment=released", *words]).trainer).compressed()


@pytest.fixture(scope="module")
def released() -> TrainerSettings:
    return settings_of()


# ---- the schedule ----------------------------------------------------------------------------------------------------


def test_the_rate_falls_by_update(released: TrainerSettings) -> None:
    rates = [released.learning_rate * released.schedule(u, released.iterations) for u in (0, 49_999, 50_000, 700_000)]
    assert rates == pytest.approx([5e-5 * 1.01, 5e-5 * 1.01, 5e-5 * 0.51, 5e-5 * (0.5**14 + 0.01)])
    assert rates[-1] / rates[0] == pytest.approx(0.010, abs=5e-4)


def test_an_iteration_of_the_released_code_is_a_rollout(released: TrainerSettings) -> None:
    """It makes as many updates as its horizon has steps: 150,000 of them 700,000."""
    horizon = released.horizon
    behind = {0: 0, 1: 1, 5_000: 5_000, 5_001: 5_002, 10_000: 15_000, 15_000: 30_000, 20_000: 50_000, 60_000: 250_000}
    behind[150_000] = 700_000
    assert {n: horizon.updates(n) for n in behind} == behind
    assert released.iterations == horizon.updates(150_000)
    for n, update in behind.items():
        assert released.count(update) == n
        assert update == 0 or released.count(update - 1) == n - 1
    counts = [released.count(u) for u in range(60_000)]
    steps = np.bincount(counts)[:20_500]
    assert steps.tolist() == [horizon(n) for n in range(20_500)]
    assert released.schedule(250_000, 0) == pytest.approx(0.5**5 + 0.01)  # where the published postcvpr weights stop


def test_horizon_and_ramp_go_by_rollouts(released: TrainerSettings) -> None:
    at = {n: released.count(released.horizon.updates(n)) for n in (0, 4_999, 5_000, 9_999, 19_999, 20_000, 149_999)}
    assert [released.horizon(n) for n in at.values()] == [1, 1, 2, 2, 4, 5, 5]
    weights = [released.collision(released.count(released.horizon.updates(n))) for n in (50_000, 100_000, 150_000)]
    assert weights == pytest.approx([5e3, 252_500, 5e5])
    paper = build(load_config("train", ["experiment=paper"]).trainer)
    assert [paper.count(u) for u in (0, 49_999, 150_000)] == [0, 49_999, 150_000]
    assert paper.collision(paper.count(100_000)) == pytest.approx(252_500)


@pytest.mark.parametrize("horizon", [Horizon(3, 4, 2), Horizon(3, 4, 2, True), Horizon(0, 3, 1), Horizon(5, 2, 2)])
def test_rollouts_and_updates_are_each_others_inverse(horizon: Horizon) -> None:
    lengths = [horizon.after_relaxing(n) + 1 for n in range(40)]
    assert lengths[0] == horizon.start + (not horizon.with_relaxing)
    expected = [n for n, length in enumerate(lengths) for _ in range(length)]
    assert [horizon.rollout(u) for u in range(len(expected))] == expected
    assert [horizon.updates(n) for n in range(41)] == [0, *np.cumsum(lengths)]


def test_time_scale_shortens_rollouts_and_updates_alike(released: TrainerSettings) -> None:
    short = settings_of("trainer.time_scale=0.02")
    assert (short.iterations, short.horizon.every, short.schedule.every) == (14_000, 100, 1_000)
    assert short.horizon.updates(3_000) == short.iterations
    for share in (0.0, 0.01, 0.1, 0.3, 0.5, 0.75, 1.0):
        long_at, short_at = round(700_000 * share), round(14_000 * share)
        assert short.horizon(short.count(short_at)) == released.horizon(released.count(long_at))
        assert short.schedule(short_at, 0) == released.schedule(long_at, 0)
        assert short.collision(short.count(short_at)) == pytest.approx(released.collision(released.count(long_at)), rel=0.01)


# ---- rollouts --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def skirt(garments: dict[str, Garment]) -> Garment:
    """A garment with pinned vertices."""
    return garments["skirt"]


def sampler_of(body: Body, garment: Garment, walk: PoseSequence, **options: object) -> SceneSampler:
    return SceneSampler(body, [garment], [walk.window(0, 60)], **{**PLAIN, **options})  # type: ignore[arg-type]


def tiny(**options: object) -> NetworkStepper:
    torch.manual_seed(0)
    return build_simulator(schedule="1x(mesh+coarse0)", latent_dim=8, output_init=0.01, **options).eval()  # type: ignore[arg-type]


def roll(slots: Slots, horizons: Sequence[int]) -> list[tuple[float, bool, Tensor, Tensor]]:
    """What every step was given: dt, whether the body stood still, positions and velocities. Cloth falls by 1 mm a step."""
    seen = []
    for horizon in horizons:
        _, _, state, step, *_ = slots.batch(horizon)
        body = step.obstacle
        assert body is not None
        seen.append((float(step.dt), torch.equal(body.pos, body.next_pos), state.pos, state.vel))
        fall = torch.tensor([0.0, -1e-3, 0.0])
        slots.advance(state.pos + fall, (fall / step.dt).expand_as(state.pos))
    return seen


def test_rollouts_of_one_step_relax_or_hold_the_body_still(body: Body, skirt: Garment, walk: PoseSequence) -> None:
    sampler = sampler_of(body, skirt, walk, still_fraction=0.5)
    windows = [sampler.sample(np.random.default_rng(seed), 5) for seed in range(8)]
    assert [sampler.unpack(sampler.pack(window)).still for window in windows] == [window.still for window in windows]
    assert {window.still for window in windows} == {True, False}
    seen = roll(Slots(sampler, tiny(**FRAMES), 1, 0, 4, whole=True), [0] * 24)
    assert all(still for _, still, *_ in seen)
    dts = [dt for dt, *_ in seen]
    assert {round(dt, 4) for dt in dts} == {0.0333, 0.3333}
    assert 6 <= sum(dt < 0.1 for dt in dts) <= 18
    # Longer ones begin with the relaxing step in any case, and all of them where none is asked to stand still.
    longer = roll(Slots(sampler, tiny(**FRAMES), 1, 0, 4, whole=True), [1] * 8)
    assert [dt > 0.1 for dt, *_ in longer] == [True, False] * 4
    assert all(still for _, still, *_ in longer[::2])
    assert not all(still for _, still, *_ in longer)
    never = roll(Slots(sampler_of(body, skirt, walk), tiny(**FRAMES), 1, 0, 4, whole=True), [0] * 8)
    assert all(dt > 0.1 for dt, *_ in never)


def test_rollouts_keep_the_horizon_of_their_beginning(body: Body, skirt: Garment, walk: PoseSequence) -> None:
    """Where updates are counted, one that grows lengthens those that run."""
    sampler, horizons = sampler_of(body, skirt, walk), [0, 0, 1, 1, 2, 2, 2]
    starts = [[dt > 0.1 for dt, *_ in roll(Slots(sampler, tiny(**FRAMES), 1, 0, 4, whole=w), horizons)] for w in (True, False)]
    assert starts[0] == [True, True, True, False, True, False, False]
    assert starts[1] == [True, True, False, True, False, False, True]


@pytest.mark.parametrize("frames", [True, False])
def test_velocities_after_the_relaxing_step(frames: bool, body: Body, skirt: Garment, walk: PoseSequence) -> None:
    """``own``: 1 mm of the relaxing step is 1 mm a frame, whether or not the model counts in frames."""
    sampler, found = sampler_of(body, skirt, walk), {}
    model = tiny(**FRAMES) if frames else tiny()
    for kind in ("skinned", "own", "zero"):
        slots = Slots(sampler, model, 1, 0, 4, relaxed_velocity=kind)
        slots.batch(2)
        slot = slots._slots[0]
        assert slot.state is not None
        assert slot.window is not None
        fall = torch.tensor([0.0, -1e-3, 0.0]).expand_as(slot.state.pos)
        slots.advance(slot.state.pos + fall, fall / (DT if frames else RELAXING_DT))
        found[kind] = slot.state.vel
        skinned = slot.window.scene.start_velocity(slot.window.start_frame)
    assert torch.equal(found["skinned"], skinned)
    assert not bool(found["zero"].any())
    torch.testing.assert_close(found["own"], fall / DT)


def test_starts_are_shaken_by_millimetres(body: Body, skirt: Garment, walk: PoseSequence) -> None:
    """x_t by 3 mm, x_t − x_{t−1} by √2 of it; pinned vertices where they are asked for; the same scene otherwise."""
    request = Request(5, 0, 2, (0,) * MAX_DRAWS, 3)
    quiet = make_start(sampler_of(body, skirt, walk), request)
    loud = make_start(sampler_of(body, skirt, walk, noise=3e-3), request)
    louder = make_start(sampler_of(body, skirt, walk, noise=3e-3, noise_on_pinned=True), request)
    assert quiet.draws == loud.draws == louder.draws
    assert not bool(quiet.state.vel.any())
    pinned = quiet.window.scene.cloth.pinned
    assert bool(pinned.any())
    shift, way = loud.state.pos - quiet.state.pos, loud.state.vel * DT
    assert float(shift[~pinned].std()) == pytest.approx(3e-3, rel=0.05)
    assert float(way[~pinned].std()) == pytest.approx(3e-3 * 2**0.5, rel=0.05)
    moved = torch.stack([shift[~pinned].flatten(), way[~pinned].flatten()])
    assert float(torch.corrcoef(moved)[0, 1]) == pytest.approx(0.5**0.5, abs=0.05)  # independent at the two times
    assert not bool(shift[pinned].any() or way[pinned].any())
    torch.testing.assert_close(louder.state.pos[~pinned], loud.state.pos[~pinned])
    assert float((louder.state.pos - quiet.state.pos)[pinned].std()) == pytest.approx(3e-3, rel=0.2)
    again = make_start(sampler_of(body, skirt, walk, noise=3e-3), request)
    assert torch.equal(again.state.pos, loud.state.pos)
    assert torch.equal(again.state.vel, loud.state.vel)
    later = make_start(sampler_of(body, skirt, walk, noise=3e-3), replace(request, draw=3))
    assert not torch.equal(later.state.vel, loud.state.vel)


@pytest.mark.parametrize("frames", [True, False])
def test_networks_and_energies_are_told_of_the_same_way(frames: bool, body: Body, skirt: Garment, walk: PoseSequence) -> None:
    """The noise is a way x_t − x_{t−1}: what the network sees in a frame, and where free flight goes on in a relaxing step."""
    sampler = sampler_of(body, skirt, walk, noise=3e-3)
    model = tiny(**FRAMES) if frames else tiny()
    slots = Slots(sampler, model, 1, 0, 4, whole=True)
    cloth, _, state, step, *_ = slots.batch(2)
    way = make_start(sampler, slots._request(0, replace(slots._slots[0], draws=0))).state.vel * DT
    told = state.vel * (DT if frames else RELAXING_DT)
    torch.testing.assert_close(told, way)
    problem = StepProblem(cloth, state, step)
    judged = model.rules.judged(problem)
    assert (judged is problem) != frames
    torch.testing.assert_close(judged.state.vel * judged.vertex_dt, way)
    at_rest = replace(problem, state=State(state.pos, torch.zeros_like(state.vel), state.origin))
    assert model.rules.judged(at_rest) is at_rest


def test_starts_by_centroids(body: Body, garments: dict[str, Garment], walk: PoseSequence) -> None:
    """Skinned, then once along the normal of the face with the nearest centroid, to 2 mm; nothing else moves."""
    tight, request = garments["tshirt"], Request(0, 0, 0, (0,) * MAX_DRAWS, 3)
    start = make_start(sampler_of(body, tight, walk, by_centroids=True), request)
    assert start.draws == 1
    scene, frame, origin = start.window.scene, start.window.start_frame, start.state.origin[0].numpy()
    skinned, obstacle = scene.motion.skinned(scene.garment, frame, origin), scene.motion.obstacle(frame, origin, static=True)
    assert obstacle is not None
    face, _ = nearest_centroids(skinned, scene.cloth.vertex_scene, obstacle.pos, obstacle.faces, obstacle.face_scene)
    corners = obstacle.faces[face]
    normal = face_normals(obstacle.pos, corners)
    depth = 2e-3 - ((skinned - obstacle.pos[corners].mean(dim=1)) * normal).sum(dim=1)
    inside = (depth > 0) & scene.cloth.free
    assert int(inside.sum()) > 10
    torch.testing.assert_close(start.state.pos[inside], (skinned + depth[:, None] * normal)[inside])
    assert torch.equal(start.state.pos[~inside], skinned[~inside])
    settled = make_start(sampler_of(body, tight, walk), request)
    assert float((settled.state.pos - start.state.pos).abs().max()) > 1e-3


# ---- training --------------------------------------------------------------------------------------------------------

SETTINGS = TrainerSettings(
    iterations=20, learning_rate=1e-3, horizon=Horizon(every=3, maximum=3, with_relaxing=True), by_rollout=True,
    relaxed_velocity="own", collision=CollisionRamp(5e3, 5e5, 4, 9), statistics_iterations=3, checkpoint_every=100, log_every=1,
)  # fmt: skip
SAMPLING = {"uniform": ("density", "lame_lambda"), "by_centroids": True, "noise": 3e-3, "noise_on_pinned": True}


def trainer_of(folder: Path, sampler: SceneSampler, settings: TrainerSettings = SETTINGS) -> Trainer:
    return Trainer(tiny(**FRAMES), coded_potential(), sampler, settings, folder, seed=0)


def test_ten_and_ten_updates_are_twenty(tmp_path: Path, body: Body, skirt: Garment, walk: PoseSequence) -> None:
    """A run that is cut inside a rollout goes on with its horizon, its noise behind it, and the same coin tosses ahead."""
    sampler = sampler_of(body, skirt, walk, still_fraction=0.5, **SAMPLING)
    whole = trainer_of(tmp_path / "whole", sampler)
    seen: list[tuple[float, float]] = []
    whole.observe = lambda problem, potential, *_: seen.append(
        (float(problem.step.dt), float(potential.terms["collision"].weight))  # type: ignore[attr-defined]
    )
    assert whole.run()
    first = trainer_of(tmp_path / "parts", sampler)
    assert not first.run(should_stop=lambda: first.iteration >= 11)
    state = torch.load(tmp_path / "parts" / "checkpoint.pt", weights_only=True)["slots"][0]
    assert (state["age"], state["length"]) == (2, 2)
    torch.manual_seed(99)
    second = trainer_of(tmp_path / "parts", sampler)
    second.resume(second.checkpoint_path)
    assert second.run()
    models = [trainer.simulator.state_dict() for trainer in (whole, second)]
    assert all(torch.equal(value, models[1][name]) for name, value in models[0].items())
    # Three rollouts of one step, three of two, then of three; each begins with a relaxing step or, of one, a still one.
    relaxing = [dt > 0.1 for dt, _ in seen]
    assert relaxing[3:] == [True, False] * 3 + [True, False, False] * 3 + [True, False]
    ramp = [SETTINGS.collision(n) for n in [0, 1, 2, 3, 3, 4, 4, 5, 5, *[6] * 3, *[7] * 3, *[8] * 3, 9, 9]]
    assert [weight for _, weight in seen] == pytest.approx(ramp)


def test_older_checkpoints_go_on(tmp_path: Path, body: Body, skirt: Garment, walk: PoseSequence) -> None:
    """They do not say how long their rollouts are."""
    sampler, settings = sampler_of(body, skirt, walk), replace(SETTINGS, by_rollout=False, relaxed_velocity="skinned")
    trainer = trainer_of(tmp_path, sampler, settings)
    for _ in range(4):
        trainer.update()
    trainer.save()
    assert "length" not in torch.load(trainer.checkpoint_path, weights_only=True)["slots"][0]
    resumed = trainer_of(tmp_path, sampler, settings)
    resumed.resume(resumed.checkpoint_path)
    assert resumed.update() == trainer.update()


def test_fabrics_are_drawn_uniformly_where_that_is_asked(body: Body, skirt: Garment, walk: PoseSequence) -> None:
    low, high = 3535.414, 93333.735
    drawn = {}
    for uniform in ((), ("density", "lame_lambda")):
        sampler, rng = sampler_of(body, skirt, walk, uniform=uniform), np.random.default_rng(3)
        cloths = [sampler.sample(rng, 2).scene.cloth for _ in range(150)]
        drawn[uniform] = {name: [float(getattr(c, name)[0]) for c in cloths] for name in ("density", "lame_lambda", "lame_mu")}
    plain, even = drawn.values()
    assert plain["lame_mu"] == even["lame_mu"]  # one number a property, whatever its distribution
    assert np.median(even["lame_lambda"]) == pytest.approx((low + high) / 2, rel=0.2)
    assert np.median(plain["lame_lambda"]) == pytest.approx((low * high) ** 0.5, rel=0.35)
    assert np.median(even["density"]) == pytest.approx((0.0434 + 0.7) / 2, rel=0.2)


@pytest.mark.parametrize(
    "options, words",
    [
        ({"noise": -1.0}, r"data\.sampling\.noise is -1\.0; give metres"),
        ({"noise": 3.0}, r"data\.sampling\.noise is 3\.0; give metres"),
        ({"still_fraction": 1.5}, r"data\.sampling\.still_fraction is 1\.5; give a share"),
        ({"uniform": ("lame_lamda",)}, r"data\.sampling\.uniform is \('lame_lamda',\); give a list of density, lame_mu"),
    ],
)
def test_wrong_sampling_is_named(options: dict, words: str, body: Body, skirt: Garment, walk: PoseSequence) -> None:
    with pytest.raises(ValueError, match=words):
        sampler_of(body, skirt, walk, **options)


def test_a_wrong_velocity_is_named() -> None:
    with pytest.raises(ValueError, match=r"trainer\.relaxed_velocity 'none': give 'skinned' or 'own' or 'zero'"):
        TrainerSettings(relaxed_velocity="none")
