"""Keys of sizes, wind and damping, and the line on how a garment sits."""

from __future__ import annotations

import pytest
import torch

from hood.app.scene.garments import checked_sizes, cut_to_size, describe_ease, summarise_ease
from hood.app.scene.motion import make_motion
from hood.app.settings.compose import ConfigError, build
from hood.app.settings.rollout_settings import RolloutSettings, overrides
from hood.assets.garment.garment import Garment
from hood.assets.garment.parts import lengths_of
from hood.energies.damping import BendDamping, StretchDamping
from hood.energies.wind import Wind
from hood.rollouts.frame import Ease
from hood.scene.body_motion.motion import BodyMotion
from hood.scene.scene import dressed_scene
from hood.scene.sizing import Sizes


def test_a_size_is_one_factor_or_three_and_may_change() -> None:
    assert checked_sizes(RolloutSettings.from_words([])) == Sizes()
    assert checked_sizes(RolloutSettings.from_words(["size=[1,1.05,1]"])).start == (1.0, 1.05, 1.0)
    growing = checked_sizes(RolloutSettings.from_words(["size=0.9", "size_end={size:[1.1,1,1],seconds:3}"]))
    assert growing == Sizes((0.9,) * 3, (1.1, 1.0, 1.0), 3.0)
    assert checked_sizes(RolloutSettings.from_words(["size_end=0.8"])) == Sizes((1.0,) * 3, (0.8,) * 3, 2.0)
    assert checked_sizes(RolloutSettings.from_words(["size_end={size:0.8}"])) == Sizes((1.0,) * 3, (0.8,) * 3, 2.0)
    given = overrides({"size_end": {"size": 0.8, "seconds": 0.5}})
    assert checked_sizes(RolloutSettings.from_words(given)) == Sizes((1.0,) * 3, (0.8,) * 3, 0.5)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["size=[1,2]"], r"size=\[1,2\].*give one factor, such as 1.1, or three"),
        (["size=20"], "size=20.*give a factor of the garment, 0.2 to 5"),
        (["size_end={sleeves:1.2}"], r"size_end={sleeves:1.2}: give a size, or a size and seconds"),
        (["size_end={size:wide}"], "size_end=.*give one factor"),
        (["size_end=large"], "size_end=large.*give one factor"),
        (["size={sleeves:1.2}", "size_end=1.1"], "size_end=1.1: parts of a garment keep their size"),
        (["size={sleeves:wide}"], "size: sleeves is 'wide'; give a factor of the part"),
        (["size={sleeves:9}"], "size=.*sleeves.*give a factor of the garment, 0.2 to 5"),
        (["size={}"], "size={}: names no part"),
        (["fit=beta"], "unknown value for fit 'beta': did you mean 'betas'"),
        (["size_end=1.1", "step=fixed"], "size_end=1.1: step=fixed has fixed shapes"),
    ],
)
def test_what_is_no_size_names_the_key(words: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        checked_sizes(RolloutSettings.from_words(words))


def test_factors_of_parts_cut_the_garment(garments: dict[str, Garment]) -> None:
    config = RolloutSettings.from_words(["garment=longsleeve", "size={sleeves:1.2,below_waistband:0.9}", "fit=none"])
    sizes = checked_sizes(config)
    assert sizes == Sizes(parts=(1.2, 0.9), to_measure=False)
    motion = make_motion(config, torch.float32)
    shirt = garments["longsleeve"]
    cut = cut_to_size(config, shirt, motion)
    assert isinstance(motion, BodyMotion)
    assert lengths_of(shirt, cut, "sleeves", motion.body) == pytest.approx(1.2, abs=0.02)
    assert cut_to_size(RolloutSettings.from_words([]), shirt, motion) is shirt


def test_a_pattern_made_to_measure_grows_with_the_body_and_another_does_not(garments: dict[str, Garment]) -> None:
    motion = make_motion(RolloutSettings.from_words(["betas=[2]"]), torch.float64)
    tank = garments["tank"]
    own, plain = (dressed_scene(tank, motion, size=Sizes(to_measure=measured)).cloth for measured in (True, False))
    assert torch.equal(plain.rest_pos, torch.as_tensor(tank.rest_pos))
    assert torch.equal(own.rest_pos, torch.as_tensor(motion.rest_pos(motion.dressed(tank))))
    assert float(own.rest_area.sum()) > 1.02 * float(plain.rest_area.sum())


def test_how_a_garment_sits_is_said_of_both_ends() -> None:
    first, last = Ease((0.003, 0.004, 0.02), 0.6, 0.06, 0.0), Ease((float("nan"),) * 3, 0.0, 0.0, 1.2)
    (line,) = describe_ease(summarise_ease(first, last))
    assert line.startswith("size, frame 0: tight (skin 3, 4, 20 mm away")
    assert "the last frame: falls off (no skin within 10 cm" in line
    assert describe_ease(summarise_ease(None, None)) == []


def test_wind_and_damping_reach_the_potential_and_are_left_out_by_default() -> None:
    assert not {"air", "stretch_damping", "bend_damping"} & set(build(RolloutSettings.from_words([]).losses).terms)
    words = ["losses=reference", "wind=3", "losses.terms.air.gusts=0.2", "seed=5", "damping=0.002"]
    terms = build(RolloutSettings.from_words(words).losses).terms
    assert isinstance(terms["air"], Wind)
    assert (terms["air"].x, terms["air"].y, terms["air"].z, terms["air"].gusts, terms["air"].seed) == (0, 0, -3, 0.2, 5)
    for name, kind in (("stretch_damping", StretchDamping), ("bend_damping", BendDamping)):
        assert isinstance(terms[name], kind)
        assert terms[name].time == 0.002
    assert build(RolloutSettings.from_words(["wind=[1,2,0]"]).losses).terms["air"].y == 2.0
    with pytest.raises(ValueError, match="gusts is 0.2, but there is no wind"):
        build(RolloutSettings.from_words(["losses.terms.air.gusts=0.2"]).losses)
