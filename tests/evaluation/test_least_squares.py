"""Least squares within bounds: against the closed form of linear problems, and what the data do not tell."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import pytest

from hood.evaluation.fitting import Minimum, Misfit, Observed, Unknown, estimates, fit_steps, observed_frames, seen_ratios
from hood.mesh.shapes import grid

TIMES = np.linspace(0.0, 2.0, 40)


def decay(of: Mapping[str, float]) -> np.ndarray:
    return of["height"] * np.exp(-of["rate"] * TIMES)


def two(guess: float = 1.0) -> list[Unknown]:
    return [Unknown("height", guess, 0.01, 100.0), Unknown("rate", guess, 0.01, 100.0)]


def solved(residual: Misfit, unknowns: Sequence[Unknown], noise: float | None = None, most: int = 40) -> Minimum:
    *_, last = fit_steps(residual, unknowns, noise, 1e-9, most)
    return last


@pytest.mark.parametrize("guess", [0.2, 5.0])
def test_a_decay_is_found_from_afar(guess: float) -> None:
    seen = decay({"height": 1.0, "rate": 1.0})
    found = solved(lambda of: decay(of) - seen, two(guess))
    assert found.converged
    assert found.values == pytest.approx({"height": 1.0, "rate": 1.0}, rel=1e-4)
    assert found.history[0] > 100 * found.rms


def test_intervals_hold_the_truth_in_95_of_100_draws() -> None:
    held, noise = 0, 0.02
    for seed in range(100):
        seen = decay({"height": 2.0, "rate": 1.5}) + noise * np.random.default_rng(seed).normal(size=len(TIMES))
        found = solved(lambda of, seen=seen: decay(of) - seen, two())  # type: ignore[misc]
        one = estimates(found, two())["rate"]
        held += one.low <= 1.5 <= one.high
        assert found.rms == pytest.approx(noise, rel=0.4)
    assert 90 <= held <= 99


def test_the_covariance_of_a_linear_problem_is_the_closed_form() -> None:
    table = np.random.default_rng(0).normal(size=(30, 2))
    unknowns = [Unknown("a", 0.5, -9.0, 9.0, log=False), Unknown("b", 0.5, -9.0, 9.0, log=False)]
    found = solved(lambda of: table @ [of["a"] - 1.0, of["b"] + 2.0], unknowns, noise=0.1)
    assert found.covariance is not None
    np.testing.assert_allclose(found.covariance, 0.01 * np.linalg.inv(table.T @ table), rtol=1e-4)
    assert found.values == pytest.approx({"a": 1.0, "b": -2.0}, abs=1e-3)


def test_of_two_that_scale_together_only_the_ratio_is_seen() -> None:
    seen = decay({"height": 1.0, "rate": 2.0})
    names = ("stiffness", "density")
    unknowns = [Unknown(name, guess, 0.01, 100.0) for name, guess in zip(names, (3.0, 1.0), strict=True)]
    found = solved(lambda of: decay({"height": 1.0, "rate": of["stiffness"] / of["density"]}) - seen, unknowns, noise=1e-3)
    told = estimates(found, unknowns)
    assert not told["stiffness"].seen
    assert not told["density"].seen
    ((pair, share),) = seen_ratios(found, unknowns, told).items()
    assert pair == names
    assert share < 0.01
    assert found.values["stiffness"] / found.values["density"] == pytest.approx(2.0, rel=1e-3)


def test_what_changes_nothing_stays_and_is_not_seen() -> None:
    seen = decay({"height": 1.0, "rate": 2.0})
    unknowns = [*two(), Unknown("bending", 3.0, 0.01, 100.0)]
    found = solved(lambda of: decay(of) - seen, unknowns)
    assert found.converged
    assert found.values["bending"] == pytest.approx(3.0)
    assert not estimates(found, unknowns)["bending"].seen
    known = [*two(), Unknown("bending", 3.0, 0.01, 100.0, prior=(5.0, 0.1))]
    found = solved(lambda of: decay(of) - seen, known)
    one = estimates(found, known)["bending"]
    assert one.value == pytest.approx(5.0, rel=1e-3)
    assert math.log(one.high / one.low) == pytest.approx(2 * 1.96 * 0.1, rel=1e-3)


def test_a_bound_holds_and_is_said() -> None:
    seen = decay({"height": 1.0, "rate": 2.0})
    unknowns = [Unknown("height", 1.0, 0.01, 100.0), Unknown("rate", 1.0, 0.5, 1.5)]
    found = solved(lambda of: decay(of) - seen, unknowns)
    assert found.converged
    assert found.values["rate"] == pytest.approx(1.5)
    assert estimates(found, unknowns)["rate"].at_bound


def test_places_that_cannot_be_simulated_are_left_alone() -> None:
    seen = decay({"height": 1.0, "rate": 1.0})

    def residual(of: Mapping[str, float]) -> np.ndarray:
        return decay(of) - seen if of["rate"] < 4.5 else np.full(1, np.nan)

    assert solved(residual, two(4.0)).values["rate"] == pytest.approx(1.0, rel=1e-3)
    with pytest.raises(ValueError, match="the simulation of the guess is not finite; give another guess"):
        solved(residual, two(5.0))
    with pytest.raises(ValueError, match="2 observed numbers cannot tell 2 parameters"):
        solved(lambda of: decay(of)[:2], two())


def test_a_search_that_is_cut_short_has_not_converged() -> None:
    seen = decay({"height": 1.0, "rate": 1.0})
    assert not solved(lambda of: decay(of) - seen, two(5.0), most=1).converged


def test_intervals_hold_the_truth_where_residuals_go_together() -> None:
    """Model error that neighbours and following frames share tells as often as there are patches, not rows."""
    held, patch = {True: 0, False: 0}, np.repeat(np.arange(8), 50)
    table = np.random.default_rng(1).normal(size=(8, 2))[patch] + 0.1
    unknowns = [Unknown(name, 0.0, -9.0, 9.0, log=False) for name in ("a", "b")]
    for seed in range(60):
        rng = np.random.default_rng(seed)
        off = 0.1 * rng.normal(size=8)[patch] + 0.02 * rng.normal(size=400)
        for known in held:
            groups = np.stack([patch, np.arange(400) % 8]) if known else None

            def residual(of: Mapping[str, float], off: np.ndarray = off) -> np.ndarray:
                return np.asarray(table @ [of["a"], of["b"]] - off)

            *_, last = fit_steps(residual, unknowns, None, 1e-9, 20, groups=groups)
            one = estimates(last, unknowns)["a"]
            held[known] += one.low <= 0.0 <= one.high
    assert held[True] >= 54
    assert held[False] < 30


def test_a_search_looks_along_its_axes_before_it_ends() -> None:
    """Jumps of the residual hide a valley from short differences in each unknown; along its axis longer ones show it."""

    def residual(of: Mapping[str, float]) -> np.ndarray:
        along, across = math.log(of["a"] * of["b"]), math.log(of["a"] / of["b"])
        jumps = 2e-3 * np.sin(np.arange(1.0, 31.0) * round(300.0 * along))
        return np.concatenate([0.05 * along * np.ones(10), across * np.ones(10), jumps])

    found = solved(residual, [Unknown("a", 9.0, 0.01, 100.0), Unknown("b", 2.0, 0.01, 100.0)])
    assert found.converged
    assert found.values["a"] * found.values["b"] == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("whole", [False, True])
def test_cloth_larger_than_a_cloud_is_seen_where_the_cloud_is_whole(whole: bool) -> None:
    pos, faces = grid(21, 21, 1.0)
    rng = np.random.default_rng(0)
    cloud = (rng.dirichlet((1, 1, 1), 800)[:, :, None] * pos[faces[rng.integers(len(faces), size=800)]]).sum(axis=1)
    seen = observed_frames([cloud], True, 800, whole)
    found = solved(lambda of: seen.apart(0, of["size"] * pos, faces), [Unknown("size", 1.4, 0.5, 2.0)], noise=1e-3)
    assert found.values["size"] == pytest.approx(1.0 if whole else 1.4, abs=0.06)
    groups = seen.groups(0, 1, len(pos))
    assert groups.shape == (2, 800 + whole * len(pos))


def test_points_of_other_things_pull_by_their_distance() -> None:
    pos, faces = grid(11, 11, 1.0)
    rng = np.random.default_rng(0)
    cloud = (rng.dirichlet((1, 1, 1), 400)[:, :, None] * pos[faces[rng.integers(len(faces), size=400)]]).sum(axis=1)
    flat = int(np.ptp(pos, axis=0).argmin())
    cloud[:20, flat] += 1.0
    found = {}
    for huber in (math.inf, 0.02):
        seen, up = Observed([cloud], True, huber=huber), np.eye(3)[flat]
        unknowns = [Unknown("height", 0.3, -1.0, 1.0, log=False)]
        found[huber] = solved(
            lambda of, seen=seen, up=up: seen.apart(0, pos + of["height"] * up, faces),  # type: ignore[misc]
            unknowns,
        ).values["height"]
    assert found[math.inf] == pytest.approx(0.05, abs=5e-3)
    assert found[0.02] == pytest.approx(0.02 * 20 / 380, abs=5e-4)
