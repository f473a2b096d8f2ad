"""Keys of sizes, wind and damping, and the line on how a garment sits."""

from __future__ import annotations

import pytest

from hood.commands.sizes import checked_sizes, describe_ease, summarise_ease
from hood.config import ConfigError, build, load_config
from hood.dynamics.ease import Ease
from hood.losses.damping import BendDamping, StretchDamping
from hood.losses.wind import Wind
from hood.scene.sizing import Sizes


def test_a_size_is_one_factor_or_three_and_may_change() -> None:
    assert checked_sizes(load_config("rollout")) == Sizes()
    assert checked_sizes(load_config("rollout", ["size=[1,1.05,1]"])).start == (1.0, 1.05, 1.0)
    growing = checked_sizes(load_config("rollout", ["size=0.9", "size_end=[1.1,1,1]", "size_seconds=3"]))
    assert growing == Sizes((0.9,) * 3, (1.1, 1.0, 1.0), 3.0)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["size=[1,2]"], r"size=\[1, 2\].*give one factor, such as 1.1, or three"),
        (["size=20"], "size=20.*give a factor of the garment, 0.2 to 5"),
        (["size_end=large"], "size_end=large.*give one factor"),
        (["size_end=1.1", "step=fixed"], "size_end=1.1: step=fixed has fixed shapes"),
    ],
)
def test_what_is_no_size_names_the_key(words: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        checked_sizes(load_config("rollout", words))


def test_how_a_garment_sits_is_said_of_both_ends() -> None:
    first, last = Ease((0.003, 0.004, 0.02), 0.6, 0.06, 0.0), Ease((float("nan"),) * 3, 0.0, 0.0, 1.2)
    (line,) = describe_ease(summarise_ease(first, last))
    assert line.startswith("size, frame 0: tight (skin 3, 4, 20 mm away")
    assert "the last frame: falls off (no skin within 10 cm" in line
    assert describe_ease(summarise_ease(None, None)) == []


def test_wind_and_damping_reach_the_potential_and_are_left_out_by_default() -> None:
    assert not {"air", "stretch_damping", "bend_damping"} & set(build(load_config("rollout").losses).terms)
    words = ["losses=reference", "wind=3", "gusts=0.2", "seed=5", "damping=0.002"]
    terms = build(load_config("rollout", words).losses).terms
    assert isinstance(terms["air"], Wind)
    assert (terms["air"].x, terms["air"].y, terms["air"].z, terms["air"].gusts, terms["air"].seed) == (0, 0, -3, 0.2, 5)
    for name, kind in (("stretch_damping", StretchDamping), ("bend_damping", BendDamping)):
        assert isinstance(terms[name], kind)
        assert terms[name].time == 0.002
    assert build(load_config("rollout", ["wind=[1,2,0]"]).losses).terms["air"].y == 2.0
    with pytest.raises(ValueError, match="gusts is 0.2, but there is no wind"):
        build(load_config("rollout", ["gusts=0.2"]).losses)
