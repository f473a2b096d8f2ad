"""Measured cloth: the conversion, and that the fabrics of the package are what their sources say."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from hood.app.settings.compose import build, load_config, options
from hood.assets.material import Material, bending_length, measured, stretch_stiffness
from hood.cloth.cloth import Cloth, build_cloth
from hood.cloth.state import State, StepInput
from hood.energies.bending import Bending
from hood.energies.membrane import Stretching
from hood.energies.problem import StepProblem

LIBRARY = sorted(
    name for name in options("material") if load_config("rollout", [f"material={name}"]).material._target_.endswith("measured")
)
GF = 9.80665e-3  # N


def energy(term: Stretching | Bending, cloth: Cloth, pos: np.ndarray) -> float:
    state = State(cloth.rest_pos, torch.zeros_like(cloth.rest_pos), torch.zeros(1, 3, dtype=torch.float64))
    problem = StepProblem(cloth, state, StepInput(torch.tensor([1 / 30], dtype=torch.float64), None))
    return float(term(problem, torch.as_tensor(pos), torch.zeros_like(cloth.rest_pos)).sum())


def triangular_sheet(rows: int, columns: int, edge: float) -> tuple[np.ndarray, np.ndarray]:
    """Equilateral triangles in the plane z = 0: positions and faces."""
    y, x = np.mgrid[:rows, :columns]
    pos = np.stack([(x + 0.5 * (y % 2)) * edge, y * edge * math.sqrt(3) / 2, 0 * x], axis=-1).reshape(-1, 3)
    faces = []
    for row in range(rows - 1):
        for column in range(columns - 1):
            a, b = row * columns + column, row * columns + column + 1
            c, d = a + columns, b + columns
            faces += [(a, b, c), (b, d, c)] if row % 2 == 0 else [(a, b, d), (a, d, c)]
    return pos.astype(np.float64), np.array(faces)


def test_shear_of_the_fabric_is_that_of_the_cloth() -> None:
    fabric = measured(0.2, 9000.0, 5000.0, 40.0, 1e-5, 2e-5)
    pos, faces = triangular_sheet(8, 8, 0.01)
    cloth = build_cloth(pos, faces, fabric, dtype=torch.float64)
    angle = 1e-4
    sheared = pos + np.stack([angle * pos[:, 1], 0 * pos[:, 0], 0 * pos[:, 0]], axis=1)
    area = float(cloth.rest_area.sum())
    assert energy(Stretching(), cloth, sheared) == pytest.approx(0.5 * 40.0 * angle**2 * area, rel=1e-3)


def test_stretch_is_that_of_the_cloth_as_far_as_its_shear_allows() -> None:
    soft = measured(0.2, 90.0, 90.0, 40.0, 1e-5, 1e-5)  # between 2 G and 3 G
    assert stretch_stiffness(float(soft.lame_mu), float(soft.lame_lambda), float(soft.thickness)) == pytest.approx(90.0)
    woven = measured(0.2, 9000.0, 4000.0, 40.0, 1e-5, 1e-5)
    assert stretch_stiffness(float(woven.lame_mu), float(woven.lame_lambda), float(woven.thickness)) == pytest.approx(120.0)
    plate = measured(0.2, 60.0, 60.0, 40.0, 1e-5, 1e-5)
    assert plate.lame_lambda == 0.0


@pytest.mark.parametrize("degrees", [0.0, 17.0, 45.0, 90.0])
def test_a_cylinder_of_any_direction_has_the_energy_of_a_plate(degrees: float) -> None:
    rigidity, radius = 1.5e-5, 0.5
    pos, faces = triangular_sheet(60, 60, 0.004)
    cloth = build_cloth(pos, faces, measured(0.2, 900.0, 900.0, 40.0, 1e-5, 2e-5), dtype=torch.float64)
    turn = math.radians(degrees)
    along, axis = np.array([math.cos(turn), math.sin(turn), 0.0]), np.array([-math.sin(turn), math.cos(turn), 0.0])
    angle = pos @ along / radius
    bent = radius * np.sin(angle)[:, None] * along + (pos @ axis)[:, None] * axis
    bent[:, 2] = radius * (1 - np.cos(angle))
    expected = 0.5 * rigidity / radius**2 * float(cloth.rest_area.sum())
    assert energy(Bending(), cloth, bent) == pytest.approx(expected, rel=0.03)  # half of the rim's hinges are missing


@pytest.mark.parametrize("key", ["density", "stretch_warp", "stretch_weft", "shear", "bending_warp", "bending_weft"])
def test_unphysical_values_are_refused_by_their_key(key: str) -> None:
    good = dict.fromkeys(("density", "stretch_warp", "stretch_weft", "shear", "bending_warp"), 0.2) | {"bending_weft": 0.0}
    measured(**good)
    for value in (-1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match=f"material '{key}' is {value}; it must be finite and >"):
            measured(**good | {key: value})


def test_the_bending_length_is_that_of_the_definition() -> None:
    # A rigidity of 1 gf·cm²/cm at 1 gf/cm² has a bending length of 1 cm, by the definition of c³ = B/W.
    assert bending_length(GF * 1e-2, 10.0 * 9.80665 / 9.81) == pytest.approx(0.01)


def test_there_are_ten_fabrics_and_more() -> None:
    assert len(LIBRARY) >= 10
    assert {"wool_suiting", "denim_12oz", "silk_habotai", "cotton_poplin", "linen", "chiffon"} <= set(LIBRARY)


@pytest.mark.parametrize("name", LIBRARY)
def test_every_fabric_says_its_source_and_is_cloth(name: str) -> None:
    from hood.app.settings.compose import CONFIG_FOLDER

    assert "\n# Source: " in (CONFIG_FOLDER / "material" / f"{name}.yaml").read_text(encoding="utf-8")
    node = load_config("rollout", [f"material={name}"]).material
    fabric = build(node)
    assert isinstance(fabric, Material)
    assert 0.03 < node.density < 0.6
    assert 0.008 < bending_length(0.5 * (node.bending_warp + node.bending_weft), node.density) < 0.04
    assert node.shear < node.stretch_weft <= node.stretch_warp
    assert node.bending_weft <= node.bending_warp


def test_units_of_the_trade_are_those_of_the_files() -> None:
    def density(name: str) -> float:
        return float(load_config("rollout", [f"material={name}"]).material.density)

    ounce, momme = 0.028349523 / 0.9144**2, 0.45359237 / (45 * 0.0254 * 91.44)
    assert density("denim_12oz") == pytest.approx(12 * ounce, rel=2e-3)
    assert density("cotton_canvas") == pytest.approx(10 * ounce, rel=2e-3)
    assert density("silk_habotai") == pytest.approx(8 * momme, rel=2e-3)
    assert density("silk_crepe") == pytest.approx(14 * momme, rel=2e-3)


def test_wool_suiting_is_the_mean_of_its_source() -> None:
    node = load_config("rollout", ["material=wool_suiting"]).material
    assert node.density == pytest.approx(0.01 * 10**1.4208, rel=1e-3)
    assert node.bending_warp == pytest.approx(10**-0.8673 * GF * 1e-2, rel=2e-3)
    assert node.shear == pytest.approx(10**-0.0143 * GF / (0.01 * math.radians(1.0)), rel=2e-3)
    extension = 2.0 * 10**0.9621 / (500.0 * 0.6082)
    assert node.stretch_warp == pytest.approx(500.0 * GF / 0.01 / extension, rel=2e-3)


def test_woven_cloth_has_the_stretch_stiffness_that_was_measured_and_the_same_shear() -> None:
    """Strips of a cloth that may narrow, and the sheared sheet: the warp of a sheet in the plane z = 0 is along y."""
    fabric = measured(0.2, 9000.0, 5000.0, 40.0, 1e-5, 2e-5, woven=True)
    pos, faces = triangular_sheet(8, 8, 0.01)
    cloth = build_cloth(pos, faces, fabric, dtype=torch.float64)
    area, e = float(cloth.rest_area.sum()), 1e-5
    poisson = float(fabric.lame_lambda) / float(fabric.lame_lambda + 2.0 * fabric.lame_mu)
    warp, weft = 0.5 * 9000.0 * e**2 * area, 0.5 * 5000.0 * e**2 * area
    along = np.array([1 - poisson * math.sqrt(9.0 / 5.0) * e, 1 + e, 1.0])
    across = np.array([1 + e, 1 - poisson * math.sqrt(5.0 / 9.0) * e, 1.0])
    assert energy(Stretching(), cloth, pos * along) == pytest.approx(warp, rel=1e-3)
    assert energy(Stretching(), cloth, pos * across) == pytest.approx(weft, rel=1e-3)
    sheared = pos + np.stack([e * pos[:, 1], 0 * pos[:, 0], 0 * pos[:, 0]], axis=1)
    assert energy(Stretching(), cloth, sheared) == pytest.approx(0.5 * 40.0 * e**2 * area, rel=1e-3)
    plain = measured(0.2, 9000.0, 5000.0, 40.0, 1e-5, 2e-5)
    assert (plain.warp, plain.weft, plain.shear) == (1.0, 1.0, 1.0)
    with pytest.raises(ValueError, match="material 'woven' is 1; give true"):
        measured(0.2, 9000.0, 5000.0, 40.0, 1e-5, 2e-5, woven=1)  # type: ignore[arg-type]
