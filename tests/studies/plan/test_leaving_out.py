"""What a part is worth: held against the gap of the same step, and against the full model itself."""

from __future__ import annotations

import numpy as np
import pytest

from hood.cloth.state import State
from hood.energies.potential import Potential, default_potential
from hood.evaluation.gap import gap
from hood.scene.scene import Scene
from hood.solver.newton import NewtonSettings
from hood.steppers.newton import NewtonStepper
from hood.studies.plan.ablation import (
    AblationWindow,
    Effect,
    Variant,
    active_terms,
    begin,
    choose_windows,
    measure_ablation,
    prices,
    rest_at,
    take_steps,
    world,
)


def variant(scene: Scene, *without: str, target: float = 1e-3) -> Variant:
    potential = Potential({name: term for name, term in default_potential().terms.items() if name not in without})
    return Variant(NewtonStepper(potential, NewtonSettings(target_rg=target)), potential, scene)


@pytest.fixture(scope="module")
def full(tank_scene: Scene) -> Variant:
    return variant(tank_scene)


def test_gamma_is_the_gap_of_the_first_step(full: Variant, tank_scene: Scene) -> None:
    begun = begin(full, [AblationWindow(0, "the start")], "paper", lead=0)
    limp = variant(tank_scene, "bending")
    found = measure_ablation(full, {"limp": limp}, begun, 1)["limp"]
    pos, _ = take_steps(limp, begun[0], 1, Effect())
    expected = gap(full.potential, begun[0].step, pos)
    assert found.gamma[0] == pytest.approx(float(expected.gamma), rel=2e-2)
    assert found.gamma[0] > 1e-4


def test_the_full_model_loses_nothing_against_itself(full: Variant, tank_scene: Scene) -> None:
    begun = begin(full, [AblationWindow(0, "the start")], "paper", lead=0)
    effects = measure_ablation(
        full, {"same": variant(tank_scene), "bare": variant(tank_scene, "friction", "collision")}, begun, 2
    )
    assert effects["same"].mm == effects[""].mm == [0.0]
    assert effects["same"].gamma == effects[""].gamma
    assert 0.0 <= effects[""].gamma[0] < 1e-5
    assert effects["bare"].worst_mm > 1.0
    assert effects["bare"].gamma[0] > 100 * max(effects[""].gamma[0], 1e-6)
    assert len(effects["bare"].ms) == 1  # a first step makes tables
    assert min(effects["bare"].ms) > 0.0


def test_a_rough_rest_is_near_the_rest(full: Variant) -> None:
    """Nearer the more steps it takes, and where the first state of a rollout is given, that is its first."""
    rest = world(rest_at(full, 0, "equilibrium"))

    def apart(state: State) -> float:
        return float((world(state) - rest).norm(dim=1).median())

    near = [apart(rest_at(full, 0, "equilibrium", count)) for count in (1, 8)]
    assert near[1] < near[0] < 0.1
    (rough,) = begin(full, [AblationWindow(0, "the start")], "equilibrium", lead=0, most_steps=1)
    assert apart(rough.rest) == pytest.approx(near[0])


def test_weight_is_one_and_absent_terms_have_no_price(full: Variant) -> None:
    begun = begin(full, [AblationWindow(0, "the start")], "paper", lead=0)
    price = prices(full, begun)
    assert price["gravity"] == pytest.approx(1.0, rel=1e-6)
    assert set(price) == active_terms(full, begun)
    assert "attachment" not in price


def test_windows_begin_at_the_start_and_do_not_overlap(tank_scene: Scene) -> None:
    count = tank_scene.num_frames
    found = choose_windows(tank_scene.motion, count, 3, 2)
    assert found[0] == AblationWindow(0, found[0].reason)
    firsts = sorted(window.first for window in found)
    assert all(second - first >= 1 for first, second in zip(firsts, firsts[1:], strict=False))
    assert firsts[-1] + 2 <= count - 1
    with pytest.raises(ValueError, match="too few for a window of"):
        choose_windows(tank_scene.motion, count, 1, count)


def test_the_fastest_moment_is_found(full: Variant) -> None:
    class Leap:
        """A body that stands, and moves by 0.3 m in one frame."""

        num_vertices, fps = 64, 30.0

        def __init__(self, at: int) -> None:
            self.at = at

        def some_points(self, frames: np.ndarray, stride: int) -> np.ndarray:
            still = np.linspace(0, 1, 64)[::stride, None] * np.ones(3)
            return still + 0.3 * (frames > self.at)[:, None, None]

    found = choose_windows(Leap(23), 40, 2, 4)  # type: ignore[arg-type]
    assert [window.first for window in found] == [0, 23]
    assert found[1].reason == "fastest"
