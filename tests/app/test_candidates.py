"""Names of what an evaluation compares."""

from __future__ import annotations

from hood.app.candidates import distinct
from hood.app.common import UNTRAINED
from hood.energies.potential import default_potential
from hood.evaluation.table import Candidate
from hood.steppers.newton import NewtonStepper


def test_random_weights_are_told_from_trained_ones_of_the_same_model() -> None:
    stepper = NewtonStepper(default_potential())
    names = {"ours.safetensors": "ours", UNTRAINED: "ours"}
    given = [Candidate(name, weights, stepper) for weights, name in names.items()] + [Candidate("small", UNTRAINED, stepper)]
    assert [one.name for one in distinct(given)] == ["ours", "untrained:ours", "small"]
