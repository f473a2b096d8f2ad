"""How far a node's input reaches in one step: the paper's Table 1, measured by derivatives."""

from __future__ import annotations

import pytest
import torch

from hood.evaluation.table import measured_radius
from hood.model.graph.builder import parse_schedule, radius
from hood.steppers.network import build_simulator


@pytest.mark.parametrize("schedule, expected", [("fine15", 15), ("ours", 48), ("fine48", 48)])
def test_radius_of_the_papers_models(schedule: str, expected: int) -> None:
    torch.manual_seed(0)
    simulator = build_simulator(schedule=schedule, latent_dim=16)
    assert measured_radius(simulator) == expected
    assert radius(parse_schedule(schedule)) == expected


def test_radius_of_a_small_schedule_with_physical_features() -> None:
    simulator = build_simulator("physical", "velocity_base", "2x(mesh+coarse0) 1x(coarse0)", latent_dim=16)
    assert measured_radius(simulator) == 6


def test_radius_of_several_passes_is_that_of_all_their_steps() -> None:
    schedule = "2x(mesh) | 1x(mesh) 1x(mesh+coarse0) | 1x(mesh)"
    simulator = build_simulator("local", "local_steps", schedule, latent_dim=8)
    plain = build_simulator("physical", "velocity_base", schedule.replace("|", ""), latent_dim=8)
    assert measured_radius(simulator) == measured_radius(plain) == 6


def test_radius_of_a_network_in_half_precision_is_the_same_and_leaves_it_so() -> None:
    simulator = build_simulator("physical", "velocity_base", "2x(mesh+coarse0) 1x(coarse0)", latent_dim=16)
    simulator.network.use_precision("bf16")
    assert measured_radius(simulator) == 6
    assert simulator.network.precision == "bf16"
