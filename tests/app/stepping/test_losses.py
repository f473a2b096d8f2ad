"""The potential of a config: built once for every content."""

from __future__ import annotations

import pytest

from hood.app.settings.compose import ConfigError
from hood.app.settings.rollout_settings import RolloutSettings
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
