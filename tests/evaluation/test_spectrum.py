"""Errors in bands of wavelengths: waves land in their band, the bands are all of the error, nothing hangs on vertex order."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from hood.assets.material import Material
from hood.cloth.cloth import Cloth, build_cloth
from hood.energies.potential import Potential, default_potential
from hood.energies.problem import StepProblem
from hood.evaluation import spectrum
from hood.evaluation.files import write_rows
from hood.evaluation.spectrum import (
    SPECTRUM_COLUMNS,
    Bands,
    band_name,
    bar_panels,
    error_spectrum,
    format_spectrum,
    garment_bands,
    spectrum_rows,
)
from hood.solver.newton import NewtonSettings, minimize
from hood.testing import grid, make_problem

EXACT = NewtonSettings(target_rg=1e-8)


def cloth_of(pos: np.ndarray, faces: np.ndarray) -> Cloth:
    return build_cloth(pos, faces, Material(), dtype=torch.float64)


@pytest.fixture(scope="module")
def problem() -> StepProblem:
    pos, faces = grid(14, 14, 0.5)
    return make_problem(cloth_of(pos, faces))


@pytest.fixture(scope="module")
def bands(problem: StepProblem) -> Bands:
    return garment_bands(problem.cloth)


def wave(problem: StepProblem, half_waves: int) -> torch.Tensor:
    """A displacement along y, 2 mm high, of ``half_waves`` on the sheet, whose length is twice its side over them."""
    rest = problem.cloth.rest_pos
    along = int(np.argmax(np.ptp(rest.numpy(), axis=0)))
    phase = np.pi * half_waves * (rest[:, along] - rest[:, along].min()) / np.ptp(rest[:, along].numpy())
    return 2e-3 * torch.cos(phase)[:, None] * torch.tensor([0.0, 1.0, 0.0], dtype=rest.dtype)


def test_bands_are_octaves_of_the_garment(bands: Bands, problem: StepProblem) -> None:
    assert bands.limits[0] == pytest.approx(0.5 * 2**0.5, rel=1e-6)
    assert np.array(bands.limits[:-1]) / np.array(bands.limits[1:]) == pytest.approx(2.0)
    rest, edges = problem.cloth.rest_pos, problem.cloth.edges
    edge = float((rest[edges[:, 1]] - rest[edges[:, 0]]).norm(dim=1).mean())
    assert 2 * edge <= bands.limits[-1] < 4 * edge


@pytest.mark.parametrize("half_waves", [0, 1, 2, 5])
def test_a_wave_lands_in_its_band(half_waves: int, bands: Bands, problem: StepProblem) -> None:
    length = 2 * 0.5 / half_waves if half_waves else np.inf
    expected = sum(length < limit for limit in bands.limits)
    squares = np.array([bands.modes.mean_square(part) for part in bands.split(wave(problem, half_waves).numpy())])
    assert squares.argmax() == expected
    assert squares.max() > 0.98 * squares.sum()


def test_the_bands_are_all_of_the_error(bands: Bands, problem: StepProblem) -> None:
    noise = np.random.default_rng(0).normal(size=problem.state.pos.shape)
    parts = bands.split(noise)
    assert sum(parts) == pytest.approx(noise, abs=1e-12)
    assert sum(bands.modes.mean_square(part) for part in parts) == pytest.approx(bands.modes.mean_square(noise), rel=1e-9)


def test_unresolved_waves_are_in_the_last_band(problem: StepProblem, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = garment_bands(problem.cloth)
    monkeypatch.setattr(spectrum, "DENSE_VERTICES", 10)
    monkeypatch.setattr(spectrum, "NUM_LONGEST", 40)
    part = garment_bands(problem.cloth)
    assert part.limits == whole.limits[: len(part.limits)]
    assert 0 < len(part.limits) < len(whole.limits)
    noise = np.random.default_rng(0).normal(size=problem.state.pos.shape)
    fine, coarse = ([bands.modes.mean_square(one) for one in bands.split(noise)] for bands in (whole, part))
    assert coarse[:-1] == pytest.approx(fine[: len(coarse) - 1], rel=1e-5)
    assert sum(coarse) == pytest.approx(sum(fine), rel=1e-9)


def test_vertex_order_changes_nothing() -> None:
    pos, faces = grid(9, 9, 0.5)
    pos = pos + np.random.default_rng(1).normal(scale=2e-3, size=pos.shape)
    order = np.random.default_rng(2).permutation(len(pos))
    place = np.argsort(order)
    values = np.random.default_rng(3).normal(size=pos.shape)
    one, two = garment_bands(cloth_of(pos, faces)), garment_bands(cloth_of(pos[order], place[faces]))
    assert one.limits == pytest.approx(two.limits)
    for first, second in zip(one.split(values), two.split(values[order]), strict=True):
        assert first[order] == pytest.approx(second, abs=1e-9)


def test_the_spectrum_of_a_wave_added_to_the_minimum(problem: StepProblem, bands: Bands) -> None:
    potential = default_potential()
    minimum, _ = minimize(potential, problem, settings=EXACT)
    found = error_spectrum(potential, problem, minimum + wave(problem, 2), bands, EXACT)
    expected = sum(1.0 * 0.5 < limit for limit in bands.limits)
    assert found["converged"] == 1.0
    assert int(np.argmax(found["rms"])) == expected
    assert found["rms"][expected] == pytest.approx(2e-3 / 2**0.5, rel=0.05)
    assert all(energy > -1e-9 for energy in found["energy"])
    assert found["limits"] == list(bands.limits)


def test_energies_are_those_of_a_quadratic_potential(problem: StepProblem, bands: Bands) -> None:
    """Inertia alone: a displacement u costs ½ m u² / dt², in e0 the mean of (u / (g dt²))²."""
    whole = default_potential()
    potential = Potential({name: whole.terms[name] for name in ("inertia", "gravity")})
    minimum, _ = minimize(potential, problem, settings=EXACT)
    noise = 1e-3 * torch.randn(minimum.shape, generator=torch.Generator().manual_seed(0), dtype=minimum.dtype)
    found = error_spectrum(potential, problem, minimum + noise, bands, EXACT)
    fall = 9.81 * float(problem.step.dt[0]) ** 2
    assert found["energy"] == pytest.approx([(rms / fall) ** 2 for rms in found["rms"]], rel=1e-5)


def test_a_minimisation_that_stops_early_is_flagged(problem: StepProblem, bands: Bands) -> None:
    wild = problem.state.pos + wave(problem, 5)
    found = error_spectrum(default_potential(), problem, wild, bands, replace(EXACT, max_iterations=0))
    assert found["converged"] == 0.0
    assert max(found["rms"]) < 1e-15  # nothing moved; coordinates are rounded to 5e-17 m


SPECTRA = [
    {"limits": [0.4, 0.2], "rms": [3e-3, 0.0, 4e-3], "energy": [0.1, 0.0, 0.2], "converged": 1.0},
    {"limits": [0.4, 0.2], "rms": [1e-3, 0.0, 0.0], "energy": [0.3, 0.0, 0.4], "converged": 0.0},
]


def test_rows_text_and_files(tmp_path: Path) -> None:
    rows = spectrum_rows("m", "dress", SPECTRA) + spectrum_rows("m", "tank", [])
    assert [(row["longest"], row["shortest"]) for row in rows] == [(None, 0.4), (0.4, 0.2), (0.2, None)]
    assert [row["rms"] for row in rows] == pytest.approx([2.0, 0.0, 2.0])
    assert [row["share"] for row in rows] == pytest.approx([(0.36 + 1.0) / 2, 0.0, 0.32])
    assert [row["energy"] for row in rows] == pytest.approx([0.2, 0.0, 0.3])
    assert {(row["states"], row["unconverged"]) for row in rows} == {(2, 0.5)}
    assert [band_name(row) for row in rows] == ["above 40 cm", "20 to 40 cm", "below 20 cm"]
    assert format_spectrum(rows).splitlines()[2].split() == ["above", "40", "cm", "2.000", "(", "68%;", "0.2)"]
    csv_path, json_path = write_rows(rows, SPECTRUM_COLUMNS, tmp_path, "spectrum")
    assert json.loads(json_path.read_text()) == rows
    with open(csv_path, newline="") as file:
        table = list(csv.DictReader(file))
    assert list(table[0]) == list(SPECTRUM_COLUMNS)
    assert (table[0]["longest"], float(table[0]["rms"])) == ("", pytest.approx(2.0))


def test_the_picture_has_a_bar_for_every_band(tmp_path: Path) -> None:
    from PIL import Image

    from hood.media.bars import COLOURS, write_bars

    rows = spectrum_rows("m", "dress", SPECTRA) + spectrum_rows("n", "dress", SPECTRA[1:])
    panels = bar_panels(rows)
    assert list(panels) == ["dress: RMS error [mm] by wavelength"]
    assert panels["dress: RMS error [mm] by wavelength"]["above 40 cm"] == pytest.approx({"m": 2.0, "n": 1.0})
    write_bars(panels, tmp_path / "bars.png")
    image = np.asarray(Image.open(tmp_path / "bars.png")).astype(int)
    colours = [[int(colour[i : i + 2], 16) for i in (1, 3, 5)] for colour in COLOURS[:2]]
    blue, orange = ((image[..., :3] == colour).all(axis=2).sum() for colour in colours)
    # m: two bars at full height, n: one at half; and a patch of the legend each.
    assert blue > 3.2 * orange > 0
    assert [path.name for path in tmp_path.iterdir()] == ["bars.png"]
