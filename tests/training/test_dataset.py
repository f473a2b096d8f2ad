"""Training scenes: reproducible, long enough, as varied as promised."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from hood.assets.body.body import Body
from hood.assets.garment.garment import Garment
from hood.assets.material import Material
from hood.assets.motion.load import load_sequence
from hood.assets.motion.sequence import PoseSequence
from hood.training.scenes import SceneSampler


@pytest.fixture(scope="module")
def motions(walk: PoseSequence) -> list[PoseSequence]:
    return [walk.window(0, 25), load_sequence("plie").window(0, 60)]


@pytest.fixture(scope="module")
def sampler(body: Body, garments: dict[str, Garment], motions: list[PoseSequence]) -> SceneSampler:
    return SceneSampler(body, [garments["tank"], garments["skirt"]], motions)


def test_same_seed_same_scene(sampler: SceneSampler) -> None:
    first, second, other = (sampler.sample(np.random.default_rng(seed), 5) for seed in (3, 3, 4))
    assert first.start_frame == second.start_frame
    assert torch.equal(first.scene.cloth.rest_pos, second.scene.cloth.rest_pos)
    assert torch.equal(first.scene.cloth.density, second.scene.cloth.density)
    np.testing.assert_array_equal(first.scene.motion.sequence.poses, second.scene.motion.sequence.poses)
    np.testing.assert_array_equal(first.scene.motion.betas, second.scene.motion.betas)
    assert not torch.equal(first.scene.cloth.mass[:50], other.scene.cloth.mass[:50])


@pytest.mark.parametrize("num_steps", [1, 6, 21])
def test_enough_frames_lie_ahead(sampler: SceneSampler, num_steps: int) -> None:
    rng = np.random.default_rng(0)
    for _ in range(30):
        window = sampler.sample(rng, num_steps)
        assert 0 <= window.start_frame <= 1
        assert window.scene.num_frames > window.start_frame + num_steps


def test_motions_are_drawn_by_length_and_short_ones_not_at_all(sampler: SceneSampler) -> None:
    rng = np.random.default_rng(1)
    drawn = [sampler.sample(rng, 2).scene.motion.sequence.name for _ in range(150)]
    assert np.mean([name == "plie" for name in drawn]) == pytest.approx(57 / 79, abs=0.12)
    drawn = {sampler.sample(rng, 40).scene.motion.sequence.name for _ in range(20)}
    assert drawn == {"plie"}


def test_motions_that_are_all_too_short_are_refused(sampler: SceneSampler) -> None:
    with pytest.raises(ValueError, match=r"no motion has the 72 frames.*'plie', has 60"):
        sampler.sample(np.random.default_rng(0), 70)


def test_garments_by_index_and_at_random(sampler: SceneSampler) -> None:
    rng = np.random.default_rng(2)
    assert [sampler.sample(rng, 2, garment=i).scene.garment.name for i in range(4)] == ["tank", "skirt"] * 2
    assert {sampler.sample(rng, 2).scene.garment.name for _ in range(12)} == {"tank", "skirt"}


def test_share_of_piecewise_fabrics(body: Body, garments: dict[str, Garment], motions: list[PoseSequence]) -> None:
    sampler = SceneSampler(body, [garments["tank"]], motions, piecewise_fraction=0.4)
    rng = np.random.default_rng(5)
    several = [len(sampler.sample(rng, 2).scene.cloth.vertex_fabric.unique(dim=0)) > 1 for _ in range(120)]
    assert np.mean(several) == pytest.approx(0.4, abs=0.13)


def test_shapes_sizes_and_directions_vary(sampler: SceneSampler, garments: dict[str, Garment]) -> None:
    rng = np.random.default_rng(6)
    windows = [sampler.sample(rng, 2, garment=0) for _ in range(40)]
    betas = np.array([w.scene.motion.betas for w in windows])
    assert np.abs(betas).max() <= 2.0
    assert betas.std() == pytest.approx(4 / np.sqrt(12), rel=0.1)
    sizes = []
    for window in windows:
        shaped = garments["tank"].shaped(window.scene.motion.betas)
        sizes.append(np.ptp(window.scene.cloth.rest_pos.numpy()[:, 1]) / np.ptp(shaped[:, 1]))
    assert 0.9 - 1e-5 <= min(sizes) < 0.95
    assert 1.05 < max(sizes) <= 1.1 + 1e-5
    yaw = [np.arctan2(*w.scene.motion.sequence.world_rotation[[0, 2], 0]) for w in windows]
    assert np.ptp(yaw) > np.pi


def test_without_augmentation(body: Body, garments: dict[str, Garment], motions: list[PoseSequence]) -> None:
    plain = SceneSampler(body, [garments["tank"]], motions[:1], 0.0, (1.0, 1.0), 0.0, random_yaw=False, mirror=False)
    scene = plain.sample(np.random.default_rng(0), 5).scene
    np.testing.assert_allclose(scene.cloth.rest_pos, garments["tank"].rest_pos, atol=1e-6)
    np.testing.assert_allclose(scene.motion.sequence.world_rotation, motions[0].world_rotation)


def test_a_given_fabric_is_that_of_every_scene(body: Body, garments: dict[str, Garment], motions: list[PoseSequence]) -> None:
    fabric = Material(density=0.11, bending_stiffness=1e-5)
    sampler = SceneSampler(body, [garments["tank"]], motions, piecewise_fraction=1.0, material=fabric)
    rng = np.random.default_rng(7)
    for _ in range(3):
        cloth = sampler.sample(rng, 2).scene.cloth
        assert cloth.density.unique().tolist() == pytest.approx([0.11])
        assert cloth.bending_stiffness.unique().tolist() == pytest.approx([1e-5])


def test_nothing_to_draw_from(body: Body, motions: list[PoseSequence]) -> None:
    with pytest.raises(ValueError, match="at least one garment and one motion"):
        SceneSampler(body, [], motions)
