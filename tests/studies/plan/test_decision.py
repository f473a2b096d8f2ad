"""Which parts are left out: tolerances are read, held, and rivals and combinations settled."""

from __future__ import annotations

import pytest

from hood.studies.plan.ablation import Effect
from hood.studies.plan.decide import Tolerance, decide


def effect(gamma: float, ms: float, mm: float = 1.0) -> Effect:
    return Effect([gamma, gamma], [mm], [ms, ms])


FULL = effect(0.0, 10.0)


@pytest.mark.parametrize(("text", "value", "unit"), [("0.01", 0.01, "gamma"), ("5mm", 5.0, "mm"), ("1e-3", 1e-3, "gamma")])
def test_tolerance_is_of_gamma_or_a_length(text: str, value: float, unit: str) -> None:
    assert Tolerance.read(text) == Tolerance(value, unit)


@pytest.mark.parametrize("text", ["0", "-1", "5cm", "", "mm", ".", "1.2.3", "nan", "inf", "1e400"])
def test_other_tolerances_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match="accuracy="):
        Tolerance.read(text)


def test_a_distance_without_its_unit_is_asked_for() -> None:
    for text in ("5", "1.5"):
        with pytest.raises(ValueError, match=rf"^accuracy={text}: give accuracy=0.01 .*or accuracy={text}mm"):
            Tolerance.read(text)
    assert Tolerance.read("1") == Tolerance(1.0, "gamma")


def test_parts_are_left_out_that_pass_and_save_time() -> None:
    effects = {"": FULL, "cheap": effect(1e-4, 8.0), "needed": effect(0.5, 5.0), "free": effect(1e-4, 9.9)}
    found = decide(effects, {"none": "no body"}, [], Tolerance(0.01, "gamma"), lambda names: (FULL, effect(1e-4, 8.0)))
    assert found.left_out == ("cheap",)
    assert {name: verdict.decision for name, verdict in found.verdicts.items()} == {
        "cheap": "left out", "needed": "kept", "free": "kept", "none": "absent",
    }  # fmt: skip


def test_a_combination_that_misses_the_tolerance_loses_its_worst_part() -> None:
    asked: list[tuple[str, ...]] = []

    def together(names: tuple[str, ...]) -> tuple[Effect, Effect]:
        asked.append(tuple(names))
        return FULL, effect(0.02 if len(names) > 1 else 0.003, 7.0)

    effects = {"": FULL, "a": effect(9e-4, 9.0), "b": effect(3e-4, 9.0)}
    found = decide(effects, {}, [], Tolerance(0.01, "gamma"), together)
    assert asked == [("a", "b"), ("b",)]
    assert found.left_out == ("b",)
    assert "γ = 0.02 more" in found.verdicts["a"].reason
    assert found.together is not None
    assert found.together.gamma == [0.003, 0.003]


def test_of_rivals_the_one_that_saves_most_is_left_out() -> None:
    effects = {"": FULL, "a": effect(1e-4, 9.0), "b": effect(1e-3, 6.0)}
    found = decide(effects, {}, [["a", "b"]], Tolerance(0.01, "gamma"), lambda names: (FULL, effects["b"]))
    assert found.left_out == ("b",)
    assert "'b' saves more" in found.verdicts["a"].reason


def test_what_nothing_watches_stays() -> None:
    effects = {"": FULL, "a": effect(1e-4, 9.0), "b": effect(1e-3, 6.0)}
    found = decide(
        effects, {}, [], Tolerance(0.01, "gamma"), lambda names: (FULL, effects["a"]), stay={"b": "nobody would notice"}
    )
    assert found.left_out == ("a",)
    assert "nobody would notice" in found.verdicts["b"].reason


def test_what_breaks_is_needed_and_lengths_are_judged_by_the_worst_window() -> None:
    effects = {
        "": FULL,
        "nan": effect(float("nan"), 1.0),
        "far": Effect([0.0], [1.0, 6.0], [1.0]),
        "near": effect(9.0, 5.0, 2.0),
    }
    by_gamma = decide({"": FULL, "nan": effects["nan"]}, {}, [], Tolerance(0.01, "gamma"), lambda names: (FULL, FULL))
    assert by_gamma.left_out == ()
    by_mm = decide(
        {k: effects[k] for k in ("", "far", "near")}, {}, [], Tolerance(5.0, "mm"), lambda names: (FULL, effects["near"])
    )
    assert by_mm.left_out == ("near",)
    assert by_mm.verdicts["far"].decision == "kept"


def test_gamma_is_what_is_lost_beside_the_full_models_own() -> None:
    """A network's own steps have a gap; a part that changes nothing about it can go."""
    network = Effect([0.5, 0.1], [0.0], [10.0])
    effects = {"": network, "idle": Effect([0.5, 0.1], [0.0], [8.0]), "needed": Effect([0.5, 0.2], [0.0], [8.0])}
    found = decide(effects, {}, [], Tolerance(0.01, "gamma"), lambda names: (network, effects["idle"]))
    assert found.left_out == ("idle",)
    assert found.verdicts["needed"].decision == "kept"


def test_of_hopeless_parts_the_first_windows_say_enough() -> None:
    tolerance = Tolerance(0.01, "gamma")
    assert tolerance.hopeless(Effect([0.2], [1.0], [1.0]), FULL)
    assert not tolerance.hopeless(Effect([0.05], [1.0], [1.0]), FULL)
    assert tolerance.hopeless(Effect([float("nan")], [1.0], [1.0]), FULL)
    assert (tolerance.text, Tolerance(5.0, "mm").text) == ("0.01", "5mm")


def test_a_part_saves_against_the_same_windows() -> None:
    full = Effect([0.0, 0.0], [0.0, 0.0], [4.0, 10.0])
    assert Effect([0.0], [0.0], [3.0]).saving(full) == 0.25
    assert Effect([0.0, 0.0], [0.0, 0.0], [3.0, 4.0]).saving(full) == pytest.approx(1.0 - (0.75 + 0.4) / 2)


@pytest.mark.parametrize(("priced", "why"), [({"a", "b"}, "come back often"), (set(), "other frames")])
def test_what_is_left_out_by_gamma_has_headroom(priced: set[str], why: str) -> None:
    effects = {"": FULL, "a": effect(5e-3, 6.0), "b": effect(5e-4, 6.0)}
    found = decide(effects, {}, [], Tolerance(0.01, "gamma"), lambda names: (FULL, effects["b"]), priced=priced)
    assert found.left_out == ("b",)
    assert why in found.verdicts["a"].reason
    by_length = decide(effects, {}, [], Tolerance(100.0, "mm"), lambda names: (FULL, effects["b"]), priced=priced)
    assert by_length.left_out == ("a", "b")
