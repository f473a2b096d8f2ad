"""The potential of a config: built once for every content."""

from __future__ import annotations

import pytest

from hood.app.settings.compose import ConfigError
from hood.app.settings.rollout_settings import RolloutSettings
from hood.app.stepping.automatic import decided
from hood.app.stepping.steppers import losses_of
from hood.energies.potential import Potential


class Stateful:
    """A term of another package that counts."""

    def __init__(self) -> None:
        self.count = 0

    def applies(self, problem: object) -> bool:
        return False


def test_the_same_content_has_the_same_terms_and_another_has_its_own() -> None:
    first, second = (losses_of(RolloutSettings.from_words([f"garment={name}"])) for name in ("tank", "dress"))
    assert first is not second  # terms are added to one, not to both
    assert all(first.terms[name] is second.terms[name] for name in first.terms)
    config = RolloutSettings.from_words([])
    other = losses_of(config.with_words(["losses.terms.collision.epsilon=0.004"]))
    assert other.terms["collision"].epsilon == 0.004  # type: ignore[attr-defined]
    assert losses_of(config).terms["collision"].epsilon == first.terms["collision"].epsilon  # type: ignore[attr-defined]


def test_terms_of_other_packages_are_not_shared(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hood.app.stepping.steppers.build", lambda node: Potential({"own": Stateful()}))  # type: ignore[dict-item]
    config = RolloutSettings.from_words([]).with_words([])
    config.losses.terms.bending = {"_target_": "elsewhere.Stateful"}
    assert losses_of(config).terms["own"] is not losses_of(config).terms["own"]


def test_a_value_that_a_term_refuses_is_refused_each_time() -> None:
    config = RolloutSettings.from_words([]).with_words(["losses.terms.collision.reach=far"])
    for _ in range(2):
        with pytest.raises((ConfigError, ValueError), match="far"):
            losses_of(config)


@pytest.mark.parametrize(
    ("words", "wind"),
    [
        ("", None),
        ("material=denim", None),
        ("material=silk_habotai", 0.0),
        ("material=silk_habotai material.density=0.05 stepper=newton", 0.0),
        ("fabrics={below_waistband:linen}", 0.0),
        ("fabrics={below_waistband:{density:0.3}}", None),
        ("material=silk_habotai stepper=network", None),
        ("material=silk_habotai losses.terms.air=null", None),
        ("material=silk_habotai wind=null", None),
        ("material=silk_habotai wind=3", 3),
        ("wind=0", 0),
        ("wind=[1,0,2]", [1, 0, 2]),
    ],
)
def test_still_air_brakes_measured_cloth_that_a_solver_moves(words: str, wind: object) -> None:
    config = RolloutSettings.from_words(words.split())
    settled, why = decided(config)
    assert settled.wind == wind
    assert any(sentence.startswith("wind=0: still air brakes") for sentence in why) == (wind == 0.0 and "wind" not in words)
    for asked in (config, settled):  # what is asked for is judged by the same energies as what it becomes
        term = losses_of(asked).terms.get("air")
        expected = None if wind is None else (0.0, 0.0, 0.0 - wind) if isinstance(wind, (int, float)) else (1.0, 0.0, 2.0)
        assert (None if term is None else (term.x, term.y, term.z)) == expected  # type: ignore[attr-defined]


@pytest.mark.parametrize("word", ["wind=strong", "wind=True"])
def test_a_wind_is_a_speed(word: str) -> None:
    with pytest.raises(ValueError, match=f"{word}: give m/s"):
        losses_of(RolloutSettings.from_words([word]))
